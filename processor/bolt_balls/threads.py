"""Compiled kernels over ranges of items on a few threads; see :mod:`processor.geometry.threads`."""

from __future__ import annotations

from processor.geometry.threads import over_ranges, usable

__all__ = ["over_ranges", "usable"]
