"""Picked common points of a scene, by pair of scans."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processor.model import Floats, Picks, Scan

Picked = dict[tuple[int, int], tuple[Floats, Floats, tuple[str, ...]]]


def by_pair(picks: Picks | None, scans: Sequence[Scan]) -> Picked:
    """Gather picks by rows of two scans, the lesser first: points (n, 3) in each scan's file frame, and their names."""
    if picks is None:
        return {}
    row = {scan.name: i for i, scan in enumerate(scans)}
    found: dict[tuple[int, int], list[tuple[Floats, Floats, str]]] = {}
    for name_a, name_b, point, xa, xb in zip(
        picks.scan_a, picks.scan_b, picks.points, picks.in_a, picks.in_b, strict=True
    ):
        a, b = row[name_a], row[name_b]
        found.setdefault((min(a, b), max(a, b)), []).append((xa, xb, point) if a < b else (xb, xa, point))
    return {
        key: (np.array([r[0] for r in rows]), np.array([r[1] for r in rows]), tuple(r[2] for r in rows))
        for key, rows in sorted(found.items())
    }
