"""Covariance of the sightings of control points in an adjustment."""

from __future__ import annotations

import numpy as np

from processor.model import Floats, Ints


def sighting_covariance(point: Ints, known_sd: Floats, seen_sd: Floats) -> Floats:
    """Covariance (3m, 3m), mm^2, of known less seen places of m sightings, without that of the scans' poses.

    Sightings of a ``point`` (m,) share the error of its known place, of ``known_sd`` (m,) along each axis. ``seen_sd``
    (m,), or (m, 3) by axis, are the standard deviations of the sightings, mm.
    """
    shared = (point[:, None] == point) * np.outer(known_sd, known_sd)
    seen = np.broadcast_to(seen_sd.reshape(len(point), -1), (len(point), 3))
    total: Floats = np.kron(shared, np.eye(3)) + np.diag(seen.ravel() ** 2)
    return total
