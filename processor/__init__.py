"""Checks steel structures from laser scans, on machines without a screen."""

__version__ = "0.1.0"
