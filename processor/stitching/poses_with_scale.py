"""Covariances of poses and their differences under a change of frame, also of poses with a scale.

Order: rotation (rad), then translation (mm), then the logarithm of the scale where there is one. A pose with a scale is
T = [s R, t].
"""

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


def scale_of(T: Floats) -> float:
    """Return the scale of T (4, 4)."""
    return float(np.cbrt(np.linalg.det(T[:3, :3])))


def rotation_of(T: Floats) -> Floats:
    """Return the rotation (3, 3) of T (4, 4) without its scale."""
    R: Floats = T[:3, :3] / scale_of(T)
    return R


def invert(T: Floats) -> Floats:
    """Invert T (4, 4) with its scale."""
    back = T[:3, :3].T / scale_of(T) ** 2
    return rigid.transform(back, -back @ T[:3, 3])


def difference(T: Floats, S: Floats) -> Floats:
    """Return the small motion (7,) that brings S to T: rotation about the origin of S, its shift, and the scale."""
    turn = rigid.vector_from_rotation(rotation_of(T) @ rotation_of(S).T)
    return np.concatenate([turn, T[:3, 3] - S[:3, 3], [np.log(scale_of(T) / scale_of(S))]])


def transformed(covariance: Floats, T: Floats) -> Floats:
    """Transform the covariance (6, 6) or (7, 7) of a small motion to the frame that T (4, 4) maps to.

    Rotation, scale and shift are about the origins of the two frames; the derivative is the adjoint of T.
    """
    J, R = np.eye(7), rotation_of(T)
    J[:3, :3] = R
    J[3:6, :3] = rigid.cross_matrix(T[:3, 3]) @ R
    J[3:6, 3:6] = T[:3, :3]
    J[3:6, 6] = -T[:3, 3]
    J = J[: len(covariance), : len(covariance)]
    in_target: Floats = J @ covariance @ J.T
    return in_target
