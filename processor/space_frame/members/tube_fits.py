"""Fits of all tubes, each by itself; see :mod:`processor.space_frame.members.cylinder_model` for the model."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from processor.geometry.thread_ranges import over_ranges
from processor.model import Floats, Ints
from processor.space_frame.members.cylinder_fit import COS_BINS, ROUGH_COS, SECTORS, Errors, Limits, fit_roughly, refine
from processor.space_frame.members.cylinder_model import GRAZING_COS
from processor.space_frame.points.line_crops import Gathered


class Rough(NamedTuple):
    """Straight axes (m,) through ``points`` along ``directions``, with ``radii``, ``sigma`` and ``lengths``.

    ``ok`` marks those that could be fitted. ``by_incidence`` (m, 8, 3) are number, sum and sum of squares of distances
    from the surface, by the cosine of incidence in steps of 0.1 from 0.2. ``scatter`` (m, 2, 3) are statistics of the
    stations' shifts, from which :func:`station_variance` estimates their variance.
    """

    ok: npt.NDArray[np.bool_]
    points: Floats
    directions: Floats
    lengths: Floats
    radii: Floats
    sigma: Floats
    by_incidence: Floats
    scatter: Floats


class Fits(NamedTuple):
    """Tubes (m,): middle of the cylinder ``points``, ``directions``, ``side`` across; see :class:`Members`.

    ``ok`` marks the tubes that could be fitted; ``sigma`` is the standard deviation of a residual. ``response``
    (m, s, 4, 2) is the change of offsets and turns by a shift of each station across the tube by one standard
    deviation; s = 0 where stations have none. The covariance includes it. ``around`` (m, 24) is as in :class:`Members`.
    """

    ok: npt.NDArray[np.bool_]
    points: Floats
    directions: Floats
    side: Floats
    lengths: Floats
    radii: Floats
    bow: Floats
    covariance: Floats  # (m, 5, 5)
    bow_covariance: Floats  # (m, 2, 2)
    response: Floats
    number: Ints  # of points used
    sigma: Floats
    around: Floats


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
    """Fit straight tubes about lines through points (m, 3) along unit directions (m, 3), at most 40 mm off the axes.

    Points within ``inner_mm`` (m,) of the middle are assumed to be on the tube; its ends are searched for within
    ``span_mm`` (m,). ``most`` points of each tube are used; a radius outside of ``radii_mm`` is not that of a tube.
    """
    m = len(points)
    fits = Rough(
        ok=np.zeros(m, bool),
        points=points.copy(),
        directions=directions.copy(),
        lengths=np.zeros(m),
        radii=np.zeros(m),
        sigma=np.zeros(m),
        by_incidence=np.zeros((m, COS_BINS, 3)),
        scatter=np.zeros((m, 2, 3)),
    )
    limits = Limits(*radii_mm, most)
    over_ranges(partial(fit_roughly, gathered, scanners, inner_mm, span_mm, limits, fits), m, threads)
    return fits


def refined(
    gathered: Gathered,
    scanners: Floats,
    start: Rough,
    span_mm: Floats,
    radii_mm: tuple[float, float],
    most: int,
    errors: Errors,
    threads: int = 0,
) -> Fits:
    """Fit bowed tubes to all points gathered, from their rough axes; ``most`` points are enough to find an axis."""
    m = len(start.points)
    fits = Fits(
        ok=start.ok.copy(),
        points=start.points.copy(),
        directions=start.directions.copy(),
        side=np.zeros((m, 3)),
        lengths=start.lengths.copy(),
        radii=start.radii.copy(),
        bow=np.zeros((m, 2)),
        covariance=np.zeros((m, 5, 5)),
        bow_covariance=np.zeros((m, 2, 2)),
        response=np.zeros((m, len(scanners) if errors.a or errors.b else 0, 4, 2)),
        number=np.zeros(m, np.int64),
        sigma=start.sigma.copy(),
        around=np.zeros((m, SECTORS)),
    )
    limits = Limits(*radii_mm, most)
    over_ranges(partial(refine, gathered, scanners, span_mm, limits, errors, fits), m, threads)
    return fits


def least_cosine(start: Rough, tolerance_mm: float) -> float:
    """Least cosine of incidence at which points lie on their tubes on the mean, to a tolerance.

    At grazing incidence only a part of a wide beam meets the tube, and such points lie off the surface.
    """
    number, total, square = start.by_incidence[start.ok].sum(axis=0).T
    number = np.maximum(number, 1.0)
    mean, noise = np.abs(total / number), np.sqrt(square) / number
    last = round((ROUGH_COS - GRAZING_COS) * 10.0)
    while last > 0 and mean[last - 1] < tolerance_mm + 2.0 * noise[last - 1]:
        last -= 1
    return GRAZING_COS + 0.1 * last


def station_variance(start: Rough) -> tuple[float, float]:
    """Variance of the stations' shifts along each axis: a in mm^2 and b in mm^2/m^2 of a + b distance^2.

    Both are 0 where noise explains the scatter.
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
