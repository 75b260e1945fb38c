"""Centres and radii of a group of holes, by the points that scanners have in their bores.

All holes of a group are adjusted together, as what the points of a station share (offset of its ranges, shift of its
place) moves all of them alike: places within the group do not have that error, radii and the place of the group do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from processor.adjustment import scanner_class_errors
from processor.model import Bools, Floats, Ints
from processor.robust_statistics import biweight, robust_sd

# Points nearer to a rim than a footprint's radius may lie on the face as well.
RIM_MM, RIM_SHARE = 2.5, 0.25  # at most this share of the depth
STEP_MM, GATE_MM = 1.0, 1.5  # of the search for a hole's place, and reach of its circle
FEWEST, FEWEST_SECTORS, SECTORS = 12, 4, 8  # points of a hole, and sectors of its circle that they lie in
ZERO_WEIGHT = 4.5  # robust standard deviations beyond which a point has no weight
LATERAL = 0.2  # variance across the ray as a share of that along it: encoders and footprint
# Of a ray into the wall, as a cosine: at less the footprint lies on more of the wall than is seen as one surface.
LEAST_SLOPE = 0.35
UNNAMED_SHARE = 0.5  # of the class of one view, in the radii of bores that several unnamed views see
ROUNDS = 30  # work: at most; a fit has settled before
SETTLED_MM = 1e-4  # far below what any bore's place is known to
NO_PRIOR_MM = 1e4  # standard deviation of places and radii beforehand: far more than any hole may be off
FLOOR_MM = 0.02  # least standard deviation of a point from the bore: its roughness and the design's mesh


class BorePoints(NamedTuple):
    """Points of one hole across its axis: places (m, 2) from the designed centre, mm, ``source`` (m,) of each.

    ``ray`` (m, 2) is the part across the axis of the unit vector from the scanner to the point, NaN where that is not
    known.
    """

    places: Floats
    source: Ints
    ray: Floats


class Fitted(NamedTuple):
    """Departures (h, 3) of holes from the design, centre across the axis and radius, and their covariance (3h, 3h).

    NaN for a hole that was not found. ``points`` (h,) were used.
    """

    departure: Floats
    covariance: Floats
    points: Ints


def fit(bores: list[BorePoints], radius: Floats, reach: Floats, sources: int) -> Fitted:
    """Fit circles of about ``radius`` (h,) whose centres lie within ``reach`` (h,) of the designed ones.

    The adjustment is linear in the departures of the holes and in the errors of the ``sources``, iterated, with
    biweights (Tukey) against mixed pixels and other steel.
    """
    start = [_searched(bore.places, r, far) for bore, r, far in zip(bores, radius, reach, strict=True)]
    found = np.array([centre is not None for centre in start])
    departure = np.full((len(bores), 3), np.nan)
    covariance = np.full((3 * len(bores), 3 * len(bores)), np.nan)
    points = np.zeros(len(bores), np.int64)
    if not found.any():
        return Fitted(departure, covariance, points)
    rows = np.flatnonzero(found)
    hole = np.repeat(np.arange(len(rows)), [len(bores[k].places) for k in rows])
    places = np.concatenate([bores[k].places for k in rows])
    ray = np.concatenate([bores[k].ray for k in rows])
    source = np.concatenate([bores[k].source for k in rows])
    initial = np.array([[*centre, 0.0] for centre in start if centre is not None])
    solved, of_solved, weight, sector = _adjusted(places, ray, source, hole, radius[rows], initial, sources)
    count = np.bincount(hole, weight > 0.0, len(rows)).astype(np.int64)
    seen = np.array([len(np.unique(sector[(hole == k) & (weight > 0.5)])) for k in range(len(rows))])
    known = (count >= FEWEST) & (seen >= FEWEST_SECTORS)
    departure[rows[known]] = solved[known]
    of_rows, of_known = (3 * at[:, None] + np.arange(3) for at in (rows[known], np.flatnonzero(known)))
    covariance[np.ix_(of_rows.ravel(), of_rows.ravel())] = of_solved[np.ix_(of_known.ravel(), of_known.ravel())]
    if not np.isfinite(ray).all():  # offsets of ranges widen or narrow all bores alike: unknown rays do not show them
        covariance[2::3, 2::3] += (UNNAMED_SHARE * scanner_class_errors.known().view_mm) ** 2
    points[rows] = count
    return Fitted(departure, covariance, points)


def _searched(places: Floats, radius: float, reach: float) -> Floats | None:
    """Return the centre (2,) within ``reach`` whose circle most points lie on, less those within it; None without."""
    if len(places) < FEWEST:
        return None
    steps = np.arange(-reach, reach + 0.5 * STEP_MM, STEP_MM)
    centres = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    off = np.hypot(*(places[:, None] - centres[None]).transpose(2, 0, 1)) - radius
    score = (np.abs(off) < GATE_MM).sum(axis=0) - (off < -GATE_MM).sum(axis=0)
    best = np.flatnonzero(score == score.max())
    if score.max() < FEWEST:
        return None
    middle: Floats = centres[best].mean(axis=0)
    return middle


def _adjusted(
    places: Floats, ray: Floats, source: Ints, hole: Ints, radius: Floats, start: Floats, sources: int
) -> tuple[Floats, Floats, Floats, Ints]:
    """Return departures (h, 3), their covariance (3h, 3h), and weight and sector (n,) of each point.

    Unknowns are the holes' departures, then offset and shift across the axis of each source, the class of scanners as
    their prior. Points without a known ray do not depend on an offset: :func:`fit` adds it to the radii.
    """
    holes, state = len(radius), np.concatenate([start.ravel(), np.zeros(3 * sources)])
    prior = np.concatenate(
        [
            np.full(3 * holes, NO_PRIOR_MM),
            np.tile(
                [
                    scanner_class_errors.known().view_mm,
                    scanner_class_errors.SHIFT_SD_MM,
                    scanner_class_errors.SHIFT_SD_MM,
                ],
                sources,
            ),
        ]
    )
    known: Bools = np.asarray(np.isfinite(ray).all(axis=1))
    ray = np.where(known[:, None], ray, 0.0)
    at = 3 * holes + 3 * source
    columns = np.column_stack([3 * hole, 3 * hole + 1, 3 * hole + 2, at, at + 1, at + 2])
    starts = 6 * np.arange(len(places) + 1)
    weight, sigma, unit = np.ones(len(places)), 1.0, np.zeros((len(places), 2))
    inverse = np.eye(len(state))
    for _ in range(ROUNDS):
        off = places - state[: 3 * holes].reshape(-1, 3)[hole, :2]
        unit, residual = _hit(off, ray, radius[hole] + state[3 * hole + 2])
        slope = np.einsum("ni,ni->n", ray, unit)
        entries = np.column_stack([unit, np.ones(len(unit)), slope, unit])
        jacobian = csr_array((entries.ravel(), columns.ravel(), starts), (len(places), len(state)))
        residual = residual - np.einsum("ni,ni->n", entries[:, 3:], state[columns[:, 3:]])
        precision = 1.0 / (np.where(known, slope**2, 1.0) + LATERAL)
        scaled = residual * np.sqrt(precision)
        near = np.abs(residual) < GATE_MM
        sigma = robust_sd(scaled[near], FLOOR_MM)
        weight = biweight(scaled / (ZERO_WEIGHT * sigma))
        weight[(np.abs(residual) > 3.0 * GATE_MM) | (known & (slope < LEAST_SLOPE))] = 0.0
        weighted = jacobian.multiply((weight * precision / sigma**2)[:, None]).tocsr()
        inverse = np.linalg.inv((jacobian.T @ weighted).toarray() + np.diag(1.0 / prior**2))
        gradient = weighted.T @ residual
        gradient[3 * holes :] -= state[3 * holes :] / prior[3 * holes :] ** 2
        step = inverse @ gradient
        state = state + step
        if np.abs(step).max() < SETTLED_MM:
            break
    sector = np.floor((np.arctan2(unit[:, 1], unit[:, 0]) + np.pi) / (2.0 * np.pi) * SECTORS).astype(np.int64)
    solved = state[: 3 * holes].reshape(-1, 3)
    return solved, inverse[: 3 * holes, : 3 * holes], weight, np.minimum(sector, SECTORS - 1)


def _hit(off: Floats, ray: Floats, radius: Floats) -> tuple[Floats, Floats]:
    """Return the normals (n, 2) where rays meet circles about the origin, and distances (n,) of the points along them.

    ``off`` (n, 2) are the points as measured: noise moves them along their rays, so that the nearest place of the
    circle is not the one that was hit. Without a ray the nearest place is all that is known.
    """
    length = np.maximum(np.linalg.norm(off, axis=1), 1e-6)
    nearest = off / length[:, None]
    square = np.einsum("ni,ni->n", ray, ray)
    along = np.einsum("ni,ni->n", ray, off)
    inner = along**2 - square * (length**2 - radius**2)
    met = (inner > 0.0) & (along > LEAST_SLOPE * length)
    beyond = np.where(met, (along - np.sqrt(np.maximum(inner, 0.0))) / np.maximum(square, 1e-9), 0.0)
    hit = off - beyond[:, None] * ray
    unit = np.where(met[:, None], hit / radius[:, None], nearest)
    return unit, np.where(met, beyond * np.einsum("ni,ni->n", ray, unit), length - radius)
