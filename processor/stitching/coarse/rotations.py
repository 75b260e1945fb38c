"""Turns that bring the faces of one scan to look the way of those of another: few, told by the main directions."""

from __future__ import annotations

import itertools

import numpy as np

from processor.model import Floats

CONE_COS = float(np.cos(np.radians(6.0)))
APART_COS = float(np.cos(np.radians(14.0)))
MOST_MODES = 12
LEAST_SHARE = 0.004
LEAST_ANGLE_COS = float(np.cos(np.radians(20.0)))
ANGLE_TOLERANCE_RAD = float(np.radians(3.0))
MATCHED_COS = float(np.cos(np.radians(5.0)))
TURNS_APART_RAD = float(np.radians(5.0))
MOST_TURNS = 12


def modes(normals: Floats) -> tuple[Floats, Floats]:
    """Directions (k, 3) that many of normals (n, 3) look, the commonest first, and each one's share (k,)."""
    left = np.ones(len(normals), bool)
    near = normals @ normals.T > CONE_COS
    held = near.sum(axis=1)
    found, shares = [], []
    for _ in range(MOST_MODES):
        best = int(np.argmax(held)) if len(held) else 0
        if not len(held) or held[best] < max(3.0, LEAST_SHARE * len(normals)):
            break
        axis = normals[best]
        for _ in range(3):
            inside = (normals @ axis > CONE_COS) & left
            axis = normals[inside].sum(axis=0) if inside.any() else normals[best]
            axis = axis / np.linalg.norm(axis)
        found.append(axis)
        shares.append(max(held[best], 1.0) / len(normals))
        taken = left & (normals @ axis > APART_COS)
        left[taken] = False
        held = held - near[:, taken].sum(axis=1)
    return np.array(found).reshape(-1, 3), np.array(shares)


def turns(a: tuple[Floats, Floats], b: tuple[Floats, Floats], most_tilt_rad: float = np.inf) -> Floats:
    """Rotations R_a_b (k, 3, 3) by which directions of b are directions of a, those that many agree with first.

    ``a`` and ``b`` are the modes of two scans. ``most_tilt_rad`` bounds how far the third axes may lie apart, for
    instruments that were levelled.
    """
    axes_a, share_a = a
    axes_b, share_b = b
    if len(axes_a) < 2 or len(axes_b) < 2:
        return np.empty((0, 3, 3))
    angle_a = np.arccos(np.clip(axes_a @ axes_a.T, -1.0, 1.0))
    angle_b = np.arccos(np.clip(axes_b @ axes_b.T, -1.0, 1.0))
    rows_a = [p for p in itertools.combinations(range(len(axes_a)), 2) if _apart(angle_a[p])]
    rows_b = [p for p in itertools.permutations(range(len(axes_b)), 2) if _apart(angle_b[p])]
    if not rows_a or not rows_b:
        return np.empty((0, 3, 3))
    i, j = np.array(rows_a).T
    k, m = np.array(rows_b).T
    fits = np.abs(angle_a[i, j][:, None] - angle_b[k, m][None]) < ANGLE_TOLERANCE_RAD
    of_a, of_b = np.nonzero(fits)
    R = _frames(axes_a[i], axes_a[j])[of_a] @ _frames(axes_b[k], axes_b[m])[of_b].transpose(0, 2, 1)
    weight = np.sqrt(np.minimum(share_a[:, None], share_b[None]))
    scores = np.empty(len(R))
    for start in range(0, len(R), 2000):
        alike = np.einsum("ai,rij,bj->rab", axes_a, R[start : start + 2000], axes_b) > MATCHED_COS
        scores[start : start + 2000] = (alike * weight).max(axis=2).sum(axis=1)
    found: list[Floats] = []
    kept: list[float] = []
    for row in np.argsort(-scores, kind="stable"):
        if len(found) >= MOST_TURNS or (kept and scores[row] < 0.45 * kept[0]):
            break
        one = _refined(R[row], axes_a, axes_b, weight)
        if one[2, 2] < np.cos(min(most_tilt_rad, np.pi)):
            continue
        if found and (np.trace(np.array(found) @ one.T, axis1=1, axis2=2) > 1.0 + 2.0 * np.cos(TURNS_APART_RAD)).any():
            continue
        found.append(one)
        kept.append(float(scores[row]))
    return np.array(found).reshape(-1, 3, 3)


def _apart(angle: float) -> bool:
    return bool(abs(np.cos(angle)) < LEAST_ANGLE_COS)


def _frames(first: Floats, second: Floats) -> Floats:
    """Right-handed frames (n, 3, 3, columns) of pairs of directions (n, 3), even in both."""
    x = first + second
    z = np.cross(first, second)
    x = x / np.linalg.norm(x, axis=1)[:, None]
    z = z / np.linalg.norm(z, axis=1)[:, None]
    return np.stack([x, np.cross(z, x), z], axis=2)


def _refined(R: Floats, axes_a: Floats, axes_b: Floats, weight: Floats) -> Floats:
    """Turn (3, 3) that fits all directions that agree with ``R`` (Wahba's problem, by the SVD)."""
    alike = (axes_a @ R @ axes_b.T > MATCHED_COS) * weight
    U, _, Vt = np.linalg.svd(np.einsum("ab,ai,bj->ij", alike, axes_a, axes_b))
    found: Floats = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return found
