"""Random generators, one per purpose, and random poses."""

from __future__ import annotations

import hashlib

import numpy as np

from designgen.rigid import rigid
from processor.model import Floats

POSE_REACH_MM = 5000.0  # largest offset of a scan's frame along each axis


def generator(seed: int, purpose: str, *numbers: int) -> np.random.Generator:
    """Return the generator of a seed, purpose and ``numbers`` from 1: draws for one do not change those for another."""
    digest = hashlib.sha256(purpose.encode()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "little"), *numbers])


def random_pose(rng: np.random.Generator) -> Floats:
    """Draw a transform (4, 4): a uniformly distributed rotation, a translation within POSE_REACH_MM along each axis."""
    w, x, y, z = (q := rng.standard_normal(4)) / np.linalg.norm(q)
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return rigid(R, rng.uniform(-POSE_REACH_MM, POSE_REACH_MM, 3))


def small_motion(rng: np.random.Generator, turn_rad: float, shift_mm: float) -> Floats:
    """Draw a small transform (4, 4), by the standard deviations of rotation about and translation along each axis."""
    rotation, shift = turn_rad * rng.standard_normal(3), shift_mm * rng.standard_normal(3)
    angle = float(np.linalg.norm(rotation))
    T = np.eye(4)
    if angle > 0.0:
        x, y, z = rotation / angle
        K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        T[:3, :3] += np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K
    T[:3, 3] = shift
    return T
