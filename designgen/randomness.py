"""Streams of random numbers by purpose, and poses drawn from them."""

from __future__ import annotations

import hashlib

import numpy as np

from processor.model import Floats

POSE_REACH_MM = 5000.0  # scan frames lie this far apart at most, along each axis


def generator(seed: int, purpose: str) -> np.random.Generator:
    """One stream of random numbers a purpose, so that what is added elsewhere leaves it as it was."""
    digest = hashlib.sha256(purpose.encode()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "little")])


def random_pose(rng: np.random.Generator) -> Floats:
    """Draw a rigid T (4, 4): a rotation uniform over all, a translation within POSE_REACH_MM."""
    w, x, y, z = (q := rng.standard_normal(4)) / np.linalg.norm(q)
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = rng.uniform(-POSE_REACH_MM, POSE_REACH_MM, 3)
    return T


def small_motion(rng: np.random.Generator, turn_rad: float, shift_mm: float) -> Floats:
    """Draw a rigid T (4, 4) near none: standard deviations of the turn about, and the shift along, each axis."""
    turn, shift = turn_rad * rng.standard_normal(3), shift_mm * rng.standard_normal(3)
    angle = float(np.linalg.norm(turn))
    T = np.eye(4)
    if angle > 0.0:
        x, y, z = turn / angle
        K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        T[:3, :3] += np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K
    T[:3, 3] = shift
    return T


def rigid(R: Floats, t: Floats) -> Floats:
    """Return the 4x4 of a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T
