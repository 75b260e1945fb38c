"""Candidate rotations between two scans from the main directions of their normals."""

from __future__ import annotations

import itertools

import numpy as np

from processor.geometry import rigid
from processor.model import Floats

CONE_COS = float(np.cos(np.radians(6.0)))  # normals of one mode
SEPARATION_COS = float(np.cos(np.radians(14.0)))  # between modes
MOST_MODES = 12  # work: main directions: the six of a box, and six more
LEAST_SHARE = 0.004  # of all normals in a mode
LEAST_ANGLE_COS = float(np.cos(np.radians(20.0)))  # between two modes that define a frame
ANGLE_TOLERANCE_RAD = float(np.radians(3.0))  # between two modes: half a cone of theirs
MATCHED_COS = float(np.cos(np.radians(5.0)))  # of a mode with its match: two modes' errors together
DISTINCT_RAD = float(np.radians(5.0))  # between candidate rotations
MOST_ROTATIONS = 12  # work: each is tried with many translations
LEAST_OF_BEST = 0.45  # score of a candidate rotation
CHUNK = 2000  # rotations scored at once


def normal_modes(normals: Floats) -> tuple[Floats, Floats]:
    """Return the modes of normals (n, 3): directions (k, 3), the most frequent first, and their shares (k,)."""
    left = np.ones(len(normals), bool)
    near = normals @ normals.T > CONE_COS
    votes = near.sum(axis=1)
    modes, shares = [], []
    for _ in range(MOST_MODES):
        best = int(np.argmax(votes)) if len(votes) else 0
        if not len(votes) or votes[best] < max(3.0, LEAST_SHARE * len(normals)):
            break
        axis = normals[best]
        for _ in range(3):
            inside = (normals @ axis > CONE_COS) & left
            axis = normals[inside].sum(axis=0) if inside.any() else normals[best]
            axis = axis / np.linalg.norm(axis)
        modes.append(axis)
        shares.append(max(votes[best], 1.0) / len(normals))
        taken = left & (normals @ axis > SEPARATION_COS)
        left[taken] = False
        votes = votes - near[:, taken].sum(axis=1)
    return np.array(modes).reshape(-1, 3), np.array(shares)


def candidate_rotations(a: tuple[Floats, Floats], b: tuple[Floats, Floats], most_tilt_rad: float = np.inf) -> Floats:
    """Return rotations R_a_b (k, 3, 3) that bring modes of scan b onto modes of scan a, the best matching first.

    ``a`` and ``b`` are the scans' :func:`normal_modes`. ``most_tilt_rad`` bounds the angle between the third axes, for
    levelled instruments.
    """
    axes_a, share_a = a
    axes_b, share_b = b
    if len(axes_a) < 2 or len(axes_b) < 2:
        return np.empty((0, 3, 3))
    R = _rotations_of_pairs(axes_a, axes_b)
    weight = np.sqrt(np.minimum(share_a[:, None], share_b[None]))
    scores = np.empty(len(R))
    for start in range(0, len(R), CHUNK):
        matches = np.einsum("ai,rij,bj->rab", axes_a, R[start : start + CHUNK], axes_b) > MATCHED_COS
        scores[start : start + CHUNK] = (matches * weight).max(axis=2).sum(axis=1)
    selected: list[Floats] = []
    best_score = np.inf
    for row in np.argsort(-scores, kind="stable"):
        if len(selected) >= MOST_ROTATIONS or (selected and scores[row] < LEAST_OF_BEST * best_score):
            break
        R_a_b = _refined(R[row], axes_a, axes_b, weight)
        if R_a_b[2, 2] < np.cos(min(most_tilt_rad, np.pi)):
            continue
        traces = np.trace(np.array(selected) @ R_a_b.T, axis1=1, axis2=2) if selected else np.empty(0)
        if (traces > 1.0 + 2.0 * np.cos(DISTINCT_RAD)).any():
            continue
        best_score = best_score if selected else float(scores[row])
        selected.append(R_a_b)
    return np.array(selected).reshape(-1, 3, 3)


def _rotations_of_pairs(axes_a: Floats, axes_b: Floats) -> Floats:
    """Return the rotations (r, 3, 3) of all pairs of modes of b onto pairs of modes of a at the same angle."""
    angle_a = np.arccos(np.clip(axes_a @ axes_a.T, -1.0, 1.0))
    angle_b = np.arccos(np.clip(axes_b @ axes_b.T, -1.0, 1.0))
    rows_a = [p for p in itertools.combinations(range(len(axes_a)), 2) if _defines_frame(angle_a[p])]
    rows_b = [p for p in itertools.permutations(range(len(axes_b)), 2) if _defines_frame(angle_b[p])]
    if not rows_a or not rows_b:
        return np.empty((0, 3, 3))
    i, j = np.array(rows_a).T
    k, m = np.array(rows_b).T
    fits = np.abs(angle_a[i, j][:, None] - angle_b[k, m][None]) < ANGLE_TOLERANCE_RAD
    of_a, of_b = np.nonzero(fits)
    R: Floats = _frames(axes_a[i], axes_a[j])[of_a] @ _frames(axes_b[k], axes_b[m])[of_b].transpose(0, 2, 1)
    return R


def _defines_frame(angle: float) -> bool:
    return bool(abs(np.cos(angle)) < LEAST_ANGLE_COS)


def _frames(first: Floats, second: Floats) -> Floats:
    """Return right-handed frames (n, 3, 3, axes in columns) of pairs of directions (n, 3), symmetric in the two."""
    x = first + second
    z = np.cross(first, second)
    x = x / np.linalg.norm(x, axis=1)[:, None]
    z = z / np.linalg.norm(z, axis=1)[:, None]
    return np.stack([x, np.cross(z, x), z], axis=2)


def _refined(R: Floats, axes_a: Floats, axes_b: Floats, weight: Floats) -> Floats:
    """Fit the rotation (3, 3) to all modes that match under ``R`` (Wahba's problem, by the SVD)."""
    matches = (axes_a @ R @ axes_b.T > MATCHED_COS) * weight
    return rigid.nearest_rotation(np.einsum("ab,ai,bj->ij", matches, axes_a, axes_b))
