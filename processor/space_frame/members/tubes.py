"""All tubes fitted, each on its own; see :mod:`processor.space_frame.members.cylinder` for the model."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from processor.geometry.parallel import over_ranges
from processor.model import Floats, Ints
from processor.space_frame.members.cylinder import GRAZING_COS
from processor.space_frame.members.cylinder_fit import COS_BINS, ROUGH_COS, fit_roughly, refine
from processor.space_frame.points.line_crops import Gathered


@dataclass(frozen=True)
class Rough:
    """Straight axes (m,) through ``points`` along ``directions``, with ``radii``, ``sigma`` and ``lengths``.

    ``ok`` marks those that could be fitted. ``by_incidence`` (m, 8, 3) are number, sum and sum of squares of
    distances from the surface, by the cosine of incidence in steps of 0.1 from 0.2. ``scatter`` (m, 2, 3) says how far
    stations are off each other, see :func:`processor.space_frame.members.cylinder_fit.tell`.
    """

    ok: npt.NDArray[np.bool_]
    points: Floats
    directions: Floats
    lengths: Floats
    radii: Floats
    sigma: Floats
    by_incidence: Floats
    scatter: Floats


@dataclass(frozen=True)
class Fits:
    """Tubes (m,): middle of the cylinder ``points``, ``directions``, ``side`` across; see :class:`Tubes`.

    ``ok`` marks the tubes that could be fitted; ``sigma`` is the standard deviation of a residual. ``response``
    (m, s, 4, 2) is how offsets and turns move with a movement of each station across the tube by one standard
    deviation; s = 0 where stations are not off. The covariance includes it.
    """

    ok: npt.NDArray[np.bool_]
    points: Floats
    directions: Floats
    side: Floats
    lengths: Floats
    radii: Floats
    bow: Floats
    covariance: Floats  # (m, 5, 5)
    response: Floats
    count: Ints
    sigma: Floats


def rough(
    gathered: Gathered,
    scanners: Floats,
    points: Floats,
    directions: Floats,
    inner_mm: Floats,
    span_mm: Floats,
    radii_mm: tuple[float, float],
    most: int,
    threads: int = 0,
) -> Rough:
    """Fit straight tubes about lines through points (m, 3) along unit directions (m, 3), off the axes by 40 mm at most.

    Points within ``inner_mm`` (m,) of the middle are believed to be on the tube, and its ends are looked for within
    ``span_mm`` (m,). ``most`` points of each tube are looked at; radii outside of ``radii_mm`` are no tubes.
    """
    m = len(points)
    points, directions = points.copy(), directions.copy()
    ok, lengths, radii, sigmas = np.zeros(m, bool), np.zeros(m), np.zeros(m), np.zeros(m)
    by_incidence, scatter = np.zeros((m, COS_BINS, 3)), np.zeros((m, 2, 3))
    kernel = partial(
        fit_roughly, gathered.counts, gathered.room, gathered.places, gathered.stations, gathered.middles, scanners,
        points, directions, inner_mm, span_mm, most, *radii_mm, ok, lengths, radii, sigmas, by_incidence, scatter,
    )  # fmt: skip
    over_ranges(kernel, m, threads)
    return Rough(ok, points, directions, lengths, radii, sigmas, by_incidence, scatter)


def refined(
    gathered: Gathered,
    scanners: Floats,
    start: Rough,
    span_mm: Floats,
    radii_mm: tuple[float, float],
    most: int,
    bow_share: float,
    least_cos: float,
    station_variance: tuple[float, float],
    threads: int = 0,
) -> Fits:
    """Fit bowed tubes to all points gathered, from their rough axes.

    ``most`` points tell where the axis is before all do. ``bow_share`` is the largest bow to expect, as a share of the
    length. ``least_cos`` bounds the incidence of rays, and stations may be off by :func:`station_variance`.
    """
    m = len(start.points)
    points, directions, sides = start.points.copy(), start.directions.copy(), np.zeros((m, 3))
    ok, lengths, radii, bows = start.ok.copy(), start.lengths.copy(), start.radii.copy(), np.zeros((m, 2))
    covariances, responses = np.zeros((m, 5, 5)), np.zeros((m, len(scanners) if any(station_variance) else 0, 4, 2))
    used, sigmas = np.zeros(m, np.int64), start.sigma.copy()
    kernel = partial(
        refine, gathered.counts, gathered.room, gathered.places, gathered.stations, gathered.middles, scanners, points,
        directions, span_mm, most, *radii_mm, bow_share, least_cos, *station_variance, ok, sides, lengths, radii, bows,
        covariances, responses, used, sigmas,
    )  # fmt: skip
    over_ranges(kernel, m, threads)
    return Fits(ok, points, directions, sides, lengths, radii, bows, covariances, responses, used, sigmas)


def least_cosine(start: Rough, tolerance_mm: float) -> float:
    """Least cosine of incidence down to which points lie on their tubes on the average, to a tolerance.

    A beam as wide as a good part of a tube meets its edge with a part of itself, and such points lie off the tube.
    """
    number, total, square = start.by_incidence[start.ok].sum(axis=0).T
    number = np.maximum(number, 1.0)
    mean, noise = np.abs(total / number), np.sqrt(square) / number
    last = round((ROUGH_COS - GRAZING_COS) * 10.0)
    while last > 0 and mean[last - 1] < tolerance_mm + 2.0 * noise[last - 1]:
        last -= 1
    return GRAZING_COS + 0.1 * last


def station_variance(start: Rough) -> tuple[float, float]:
    """By how much stations are off each other, for each axis: a in mm^2 and b in mm^2/m^2 of a + b distance^2.

    Both are 0 where noise explains all.
    """
    (near, near1, near2), (far, far1, far2) = start.scatter[start.ok].sum(axis=0).tolist()
    if near <= 0.0 and far <= 0.0:
        return 0.0, 0.0
    det = near1 * far2 - near2 * far1
    if det > 1e-6 * near1 * far2:
        a, b = (near * far2 - far * near2) / det, (near1 * far - far1 * near) / det
        if a >= 0.0 and b >= 0.0:
            return a, b
        if a < 0.0:
            return 0.0, max((near + far) / (near2 + far2), 0.0)
    return (max((near + far) / (near1 + far1), 0.0), 0.0) if near1 + far1 > 0.0 else (0.0, 0.0)
