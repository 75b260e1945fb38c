"""Rigid transforms and directions. The generator has its own, so that an error here cannot hide one in processor."""

from __future__ import annotations

import numpy as np

from processor.model import Floats


def rigid(R: Floats, t: Floats) -> Floats:
    """Return the transform (4, 4) of a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def inverse(T: Floats) -> Floats:
    """Return the inverse of a rigid transform (4, 4)."""
    R = T[:3, :3].T
    return rigid(R, -R @ T[:3, 3])


def translation(t: Floats) -> Floats:
    """Return the transform (4, 4) of a translation (3,)."""
    return rigid(np.eye(3), t)


def perpendicular(unit: Floats) -> Floats:
    """Return a unit vector (3,) perpendicular to a unit vector (3,)."""
    across = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit))])
    result: Floats = across / np.linalg.norm(across)
    return result
