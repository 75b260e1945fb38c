"""From clouds' own frames to those of their files and of the project, with covariances."""

from __future__ import annotations

import numpy as np

from processor.geometry import rigid
from processor.model import Floats


def turned(covariance: Floats, R: Floats) -> Floats:
    """Covariance (6, 6) along other axes, R (3, 3)."""
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = R
    found: Floats = J @ covariance @ J.T
    return found


def of_file(T_frame_cloud: Floats, origin: Floats) -> Floats:
    """Pose (4, 4) of a scan's file frame, of a cloud whose ``origin`` (3,) was taken off."""
    return rigid.with_origin(T_frame_cloud, origin)


def difference(T: Floats, S: Floats) -> Floats:
    """Small motion (6,) that brings S to T: turn about S's origin's place, and that place's shift."""
    return np.concatenate([rigid.vector_from_rotation(T[:3, :3] @ S[:3, :3].T), T[:3, 3] - S[:3, 3]])
