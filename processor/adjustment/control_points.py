"""Control points in an adjustment: the covariance of their sightings, and whether they determine a motion."""

from __future__ import annotations

import numpy as np

from processor.model import Floats, Ints

LEAST_POINTS = 3


def covariance(point: Ints, known_sd: Floats, seen_sd: Floats) -> Floats:
    """Covariance (3m, 3m) of known less seen places of m sightings, without that of the scans' poses.

    Sightings of a ``point`` (m,) share the error of its known place, of ``known_sd`` (m,) along each axis. ``seen_sd``
    (m,), or (m, 3) by axis, are the standard deviations of the sightings.
    """
    shared = (point[:, None] == point) * np.outer(known_sd, known_sd)
    seen = np.broadcast_to(seen_sd.reshape(len(point), -1), (len(point), 3))
    total: Floats = np.kron(shared, np.eye(3)) + np.diag(seen.ravel() ** 2)
    return total


def determine_motion(places: Floats, least_share: float, least_mm: float = 0.0) -> bool:
    """Whether points (n, 3) determine a rigid motion: three of them or more, not nearly on a line.

    Their second principal extent is more than a share of the first, and ``least_mm`` or more.
    """
    if len(places) < LEAST_POINTS:
        return False
    extent = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(extent[1] > least_share * extent[0] and extent[1] >= least_mm)
