"""Registration of a part's whole scan to its design's surface, fine: from an attitude that is right to a few mm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from processor.geometry import icp, rigid
from processor.geometry.mesh_distance import MeshSurface, on_face
from processor.geometry.neighbors import thinned
from processor.model import NORMAL_95, Floats, Ints

Bools = npt.NDArray[np.bool_]

POINTS, LAST_POINTS = 30_000, 250_000
MOST_TURNS = 30
STILL_MM = 3e-4  # a pose that moves the part by less stands still
SMALL_MM = 0.3  # ... or by less leaves each point on its face
NO_FORM = 2.0  # of the cells' means over what chance makes them
GATES_MM = (60.0, 30.0)
CUT = 4.5  # standard deviations
FLOOR_MM = 0.01  # of sigma, for scans without noise
LEAST_SHARE = 0.5  # of the points that must lie within the last gate
NO_FIT_MM = (10.0, 4.0)  # no noise and no form of a part is as large; the second where much lies beside the design
CLUTTER_SHARE = 0.15
CELL_MM = 500.0  # residuals nearer to each other along the part, on one face, are taken as dependent
WEAK_MM = 5.0  # a motion that may move a part's ends by more (95 %) is weak: they are looked for no further off
MOTIONS = (
    "a turn about its length", "a turn sideways", "a turn up and down", "a shift along its length", "a shift sideways",
    "a shift up and down",
)  # fmt: skip


@dataclass(frozen=True)
class Registration:
    """T_bridge_scan (4, 4), its covariance (6, 6: turn about the bridge's axes, translation), sigma and shares.

    ``weak`` names the motions that what is seen of the part does not hold.
    """

    T_bridge_scan: Floats
    covariance: Floats
    sigma_mm: float
    used_share: float
    weak: tuple[str, ...] = ()


NOWHERE = Registration(np.full((4, 4), np.nan), np.full((6, 6), np.nan), float("nan"), 0.0)


def fine(points: Floats, surface: MeshSurface, axes: Floats, start: Floats) -> Registration:
    """Robust point-to-surface least squares of points (n, 3), scan frame, from ``start`` (4, 4).

    Faces that look along each of the design's principal ``axes`` (3, 3, columns) count the same, so that its ends
    hold the part along its length. Where the part shows no form of its own every point counts the same in the end,
    which is then the best there is. The covariance is a sandwich over cells of neighbouring residuals: what they have
    in common, form and all, counts once (Liang and Zeger 1986).
    """
    held, form = _iterate(thinned(points, POINTS), surface, axes, start, GATES_MM[0], even=True)
    if not form < NO_FORM:
        return held
    return _iterate(thinned(points, LAST_POINTS), surface, axes, held.T_bridge_scan, GATES_MM[1], even=False)[0]


def fits(found: Registration) -> bool:
    """Tell whether the scan is of the design's part: what is not clutter lies on its surface."""
    return found.sigma_mm < NO_FIT_MM[found.used_share < 1.0 - CLUTTER_SHARE]


def _iterate(
    points: Floats, surface: MeshSurface, axes: Floats, start: Floats, gate: float, *, even: bool
) -> tuple[Registration, float]:
    """Iterate until the pose stands still; also the variance of the cells' means against that of chance."""
    T, sigma, covariance, share, form = start.copy(), float("nan"), np.full((6, 6), np.nan), 0.0, float("inf")
    weak: tuple[str, ...] = ()
    face: Ints | None = None
    for turn in range(MOST_TURNS):
        moved = rigid.apply(T, points)
        face, residual, beyond = surface.distances(moved, gate + 60.0, face)
        used = on_face(face, beyond) & (np.abs(residual) < gate)
        if used.sum() < 100:
            break
        r, n = residual[used], surface.normals[face[used]]
        middle = moved[used].mean(axis=0)
        J = np.hstack([np.cross(moved[used] - middle, n), n])
        looks = icp.facing(n, axes)
        spread = np.array([_spread(r[looks == k]) for k in range(3)])
        sigma = _spread(r)
        weight = np.clip(1.0 - (r / (CUT * spread[looks])) ** 2, 0.0, 1.0) ** 2  # Tukey's
        weight = weight * icp.balance(looks) if even else weight
        normal = J.T @ (J * weight[:, None])
        if np.linalg.cond(normal / np.sqrt(np.outer(np.diag(normal), np.diag(normal)) + 1e-300)) > 1e10:
            break  # what is seen does not hold the part: no covariance, and so no answer
        step = np.linalg.solve(normal, -J.T @ (weight * r))
        R = rigid.rotation_from_vector(step[:3])
        T = rigid.transform(R, middle - R @ middle + step[3:]) @ T
        share = float(used.mean())
        if turn >= 3:
            gate = max(GATES_MM[1], 6.0 * sigma)
        move = float(np.linalg.norm(step[3:]) + np.linalg.norm(step[:3]) * np.ptp(moved[:, 0]))
        if turn == MOST_TURNS - 1 or (move < STILL_MM and (turn > 4 or not even)):
            cell = cells(moved[used] @ axes, looks, n @ axes)
            form = _form(r, weight > 0.0, cell)
            inverse = np.linalg.inv(normal)
            at_middle = inverse @ _scatter(J * (weight * r)[:, None], cell) @ inverse
            weak = _weak(at_middle, axes, float(np.abs((moved[used] - middle) @ axes[:, 0]).max()))
            covariance = rigid.about_origin(at_middle, middle)
            break
        face = face if move < SMALL_MM else None
    return Registration(T, covariance, sigma, share, weak), form


def _spread(residual: Floats) -> float:
    return max(1.4826 * float(np.median(np.abs(residual))), FLOOR_MM) if len(residual) else FLOOR_MM


def cells(place: Floats, looks: Ints, normal: Floats) -> Ints:
    """Return the number (n,) of the cell along the part, and of the side, that points at (n, 3) are in."""
    cell = np.floor(place[:, 0] / CELL_MM).astype(np.int64)
    side = normal[np.arange(len(looks)), looks] > 0.0
    number: Ints = np.unique(6 * cell + 2 * looks + side, return_inverse=True)[1].reshape(-1)
    return number


def _form(residual: Floats, counted: Bools, cell: Ints) -> float:
    """Return the mean square of the cells' means over what chance makes it: 1 for a part without form of its own."""
    number = np.bincount(cell, counted)
    full = number > 20
    mean = np.bincount(cell, residual * counted) / np.maximum(number, 1)
    rest = (residual - mean[cell])[counted & full[cell]]
    chance = max(float(rest.var()) if len(rest) else 0.0, FLOOR_MM**2)
    return float(np.mean(number[full] * mean[full] ** 2)) / chance if full.any() else float("inf")


def _scatter(gradient: Floats, cell: Ints) -> Floats:
    """Sum (6, 6) of the outer products of gradients (n, 6), added up over each cell first."""
    cells = int(cell.max()) + 1
    sums = np.stack([np.bincount(cell, gradient[:, k], cells) for k in range(6)], axis=1)
    found: Floats = sums.T @ sums * (cells / max(cells - 6, 1))
    return found


def _weak(covariance: Floats, axes: Floats, half_length: float) -> tuple[str, ...]:
    """Name the motions about the part's middle and its axes that may move its ends by more than WEAK_MM."""
    turned = np.kron(np.eye(2), axes.T)
    spread = NORMAL_95 * np.sqrt(np.diag(turned @ covariance @ turned.T))
    arms = np.array([0.1 * half_length, half_length, half_length, 1.0, 1.0, 1.0])
    order = (0, 2, 1, 3, 4, 5)  # a turn about the third axis is sideways where the second one is
    return tuple(name for name, k in zip(MOTIONS, order, strict=True) if spread[k] * arms[k] > WEAK_MM)
