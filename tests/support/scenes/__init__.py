"""Whole scenes."""
