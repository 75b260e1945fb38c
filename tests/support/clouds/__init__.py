"""Clouds made with numpy alone."""
