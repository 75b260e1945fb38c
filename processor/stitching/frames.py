"""Covariances of poses and their differences under a change of frame. Order: rotation (rad), then translation (mm)."""

from __future__ import annotations

import numpy as np

from processor.geometry import rigid
from processor.model import Floats


def turned(covariance: Floats, R: Floats) -> Floats:
    """Rotate a covariance (6, 6) to other axes by R (3, 3)."""
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = R
    rotated: Floats = J @ covariance @ J.T
    return rotated


def difference(T: Floats, S: Floats) -> Floats:
    """Return the small motion (6,) that brings S to T: rotation about the origin of S, and the shift of that origin."""
    return np.concatenate([rigid.vector_from_rotation(T[:3, :3] @ S[:3, :3].T), T[:3, 3] - S[:3, 3]])
