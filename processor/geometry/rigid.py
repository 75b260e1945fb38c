"""Rigid motions as 4x4 matrices, ``T_a_b`` maps coordinates in frame b to frame a, and directions across another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processor.large_arrays import allocate, blocks
from processor.model import Floats

LEAST_POINTS = 3  # that determine a rigid motion


def transform(rotation: Floats, translation: Floats) -> Floats:
    """Build T (4, 4) from a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def apply(T: Floats, points: Floats) -> Floats:
    """Map points (..., 3) by T (4, 4)."""
    mapped: Floats = points @ T[:3, :3].T
    mapped += T[:3, 3]
    return mapped


def placed(clouds: Sequence[tuple[Floats, Floats]]) -> Floats:
    """Place the points (k, 3) of several clouds by a T (4, 4) each, and join them (n, 3); many lie in files."""
    found, before = allocate(sum(len(points) for _, points in clouds), 3), 0
    for T, points in clouds:
        for rows in blocks(len(points)):
            found[before + rows.start : before + rows.stop] = apply(T, points[rows])
        before += len(points)
    return found


def invert(T: Floats) -> Floats:
    """Invert a rigid T (4, 4) exactly: the rotation is transposed."""
    R = T[:3, :3]
    return transform(R.T, -R.T @ T[:3, 3])


def with_origin(T: Floats, origin: Floats) -> Floats:
    """T (4, 4) for coordinates to which an ``origin`` (3,), subtracted before, has been added again."""
    return transform(T[:3, :3], T[:3, 3] - T[:3, :3] @ origin)


def between_origins(T: Floats, source: Floats, target: Floats) -> Floats:
    """T (4, 4) for coordinates less an origin ``source`` (3,), to such less an origin ``target`` (3,).

    Large offsets are subtracted from each other first: added to the points, either would cost them digits.
    """
    R = T[:3, :3]
    return transform(R, R @ source + (T[:3, 3] - target))


def rotation_angle(R: Floats) -> float:
    """Angle of a rotation (3, 3) in rad, accurate near 0 and near pi."""
    sine = 0.5 * np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.arctan2(sine, 0.5 * (np.trace(R) - 1.0)))


def rotation_from_vector(w: Floats) -> Floats:
    """Rotation (3, 3) about the axis w by |w| rad (Rodrigues)."""
    angle = float(np.linalg.norm(w))
    if angle == 0.0:
        return np.eye(3)
    K = cross_matrix(np.asarray(w) / angle)
    R: Floats = np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K)
    return R


def vector_from_rotation(R: Floats) -> Floats:
    """Return the rotation vector (3,) of R (3, 3): its axis times its angle in rad, less than half a turn."""
    skew = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = float(np.linalg.norm(skew))
    vector: Floats = skew * (rotation_angle(R) / sine if sine > 0.0 else 1.0)
    return vector


def motion(points: Floats) -> Floats:
    """Return the derivative (n, 3, 6) of points (n, 3) by a small turn about the origin and a translation."""
    derivative = np.zeros((len(points), 3, 6))
    x, y, z = points.T
    derivative[:, 0, 1], derivative[:, 0, 2] = z, -y
    derivative[:, 1, 0], derivative[:, 1, 2] = -z, x
    derivative[:, 2, 0], derivative[:, 2, 1] = y, -x
    derivative[:, :, 3:] = np.eye(3)
    return derivative


def about_origin(covariance: Floats, position: Floats) -> Floats:
    """Covariance of a motion about the frame's origin from that of the same motion about a ``position`` (3,).

    A motion is a small turn (rad), then a translation (mm): t_origin = t_position + position x turn. A covariance of
    (7, 7) has the logarithm of a scale as well, by which t_origin is less by scale times position.
    """
    J = np.eye(len(covariance))
    J[3:6, :3] = cross_matrix(position)
    J[3:6, 6:] = -position[:, None]
    at_origin: Floats = J @ covariance @ J.T
    return at_origin


def moved_about_own_origins(T: Floats, motion: Floats) -> Floats:
    """Rotate poses T (k, 4, 4) about their own origins and shift them, by ``motion`` (k, 6), rad and mm."""
    moved: Floats = T.copy()
    for s in np.flatnonzero(np.abs(motion).sum(axis=1) > 0.0):
        moved[s, :3, :3] = rotation_from_vector(motion[s, :3]) @ T[s, :3, :3]
        moved[s, :3, 3] = T[s, :3, 3] + motion[s, 3:]
    return moved


def cross_matrix(v: Floats) -> Floats:
    """Matrix (3, 3) of the cross product of ``v`` (3,) with another vector."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def nearest_rotation(M: Floats) -> Floats:
    """Rotation (3, 3), no reflection, nearest to a matrix (3, 3): it has the largest trace of R^T M (by the SVD)."""
    U, _, Vt = np.linalg.svd(M)
    R: Floats = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return R


def fit(source: Floats, target: Floats) -> Floats:
    """Rigid T_target_source (..., 4, 4), no reflection, of least squared distances of pairs (..., n, 3), n >= 3.

    Source: the objective of Besl and McKay (paper 000, eq. 5), solved by the SVD of the covariance.
    """
    centre_source, centre_target = source.mean(axis=-2, keepdims=True), target.mean(axis=-2, keepdims=True)
    U, _, Vt = np.linalg.svd(np.swapaxes(source - centre_source, -1, -2) @ (target - centre_target))
    V, Ut = np.swapaxes(Vt, -1, -2), np.swapaxes(U, -1, -2)
    V[..., 2] *= np.sign(np.linalg.det(V @ Ut))[..., None]
    T = np.zeros((*source.shape[:-2], 4, 4))
    T[..., 3, 3] = 1.0
    T[..., :3, :3] = V @ Ut
    T[..., :3, 3] = (centre_target - centre_source @ np.swapaxes(T[..., :3, :3], -1, -2))[..., 0, :]
    return T


def points_determine_motion(places: Floats, least_share: float, least_mm: float = 0.0) -> bool:
    """Whether points (n, 3), mm, determine a rigid motion: LEAST_POINTS of them or more, not nearly on a line.

    Their second principal extent is more than a share of the first, and ``least_mm`` or more.
    """
    if len(places) < LEAST_POINTS:
        return False
    extent = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(extent[1] > least_share * extent[0] and extent[1] >= least_mm)


def axes_across(direction: Floats) -> Floats:
    """Return two unit vectors, rows (..., 2, 3), square to unit directions (..., 3) and to each other."""
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction), axis=-1)])
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(direction, first)], axis=-2)


def looks_forwards(direction: Floats) -> bool:
    """Whether the largest component of a direction (3,) is positive."""
    return bool(direction[np.argmax(np.abs(direction))] > 0.0)


def forwards(direction: Floats) -> Floats:
    """Return a direction (3,) or its opposite, the one whose largest component is positive."""
    return direction if looks_forwards(direction) else -direction
