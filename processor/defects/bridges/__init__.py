"""Defects of bridges, part by part."""
