"""Errors of the scanner where data cannot show them: those of its class, or those that a check of the instrument found.

Standard deviations from data sheets and practice (type B evaluation of the GUM), or from a field check, not estimates
from the scans. Which instrument it was is stated once for a run, see :func:`used`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from typing import NamedTuple

import numpy as np

from processor.adjustment import moderated_variances
from processor.geometry import rigid
from processor.model import Floats, Instrument, Ints, instruments
from processor.robust_statistics import student_factor

# Shift of all views together, along each axis: targets are measured to about 1 mm, and a network rests on some 25
# sightings of them.
SHIFT_SD_MM = 0.2


class ScannerErrors(NamedTuple):
    """What is known of a scanner, one standard deviation each, such that 1.96 of them hold an error in 95 %.

    ``view_mm`` is what the points of one view have in common along their rays, relative to other views; ``offset_mm``
    what all views have in common; ``scale`` that of the ranges of one view, without unit; ``incidence_mm`` the bias
    where the path through the footprint is twice as long as at normal incidence (60 degrees), which stands for what all
    surfaces have in common along their normals: by incidence, by the signal of their paint, and its layer;
    ``direction_rad`` is the error of the direction to a target, across the ray.
    """

    view_mm: float
    offset_mm: float
    scale: float
    incidence_mm: float
    direction_rad: float


def errors_of(instrument: Instrument) -> ScannerErrors:
    """Return the errors of an instrument; what its check is unsure of is in them.

    A bias is not taken off the ranges: value and standard deviation add up. A standard deviation that is known by few
    observations has the factor of Student's t, with v = value^2 / (2 sd^2) degrees of freedom (GUM, E.4.3).
    """
    found = {}
    for term, (value, sd) in instrument.known.items():
        error = math.hypot(value, sd)
        if sd > 0.0 and term not in instruments.BIASES:
            error = max(error, value * float(student_factor(0.5 * (value / sd) ** 2)))
        found[term] = error
    return ScannerErrors(
        view_mm=found["view_mm"],
        offset_mm=found["zero_mm"],
        scale=1e-6 * found["scale_ppm"],
        incidence_mm=found["incidence_mm"],
        direction_rad=1e-6 * max(found["horizontal_urad"], found["vertical_urad"]),
    )


CLASSES = {name: errors_of(instruments.of_class(name)) for name in instruments.class_names()}
_used: ContextVar[ScannerErrors | None] = ContextVar("scanner", default=None)


def stated() -> bool:
    """Whether it is stated what the scanner is."""
    return _used.get() is not None


def known() -> ScannerErrors:
    """Return the errors of the scanner in use; of the assumed class where nobody says what it is."""
    return _used.get() or CLASSES[instruments.ASSUMED]


@contextmanager
def _using(errors: ScannerErrors | None) -> Iterator[None]:
    before = _used.set(errors)
    try:
        yield
    finally:
        _used.reset(before)


def used(given: Sequence[Instrument]) -> AbstractContextManager[None]:
    """Let the block's scanner be the instruments given: of several the largest of each error; none = not stated."""
    errors = [errors_of(one) for one in given]
    return _using(ScannerErrors(*map(max, zip(*errors, strict=True))) if errors else None)


def without() -> AbstractContextManager[None]:
    """Let the block's scanner have no errors but those that points show, as for a check of it."""
    return _using(ScannerErrors(view_mm=0.0, offset_mm=0.0, scale=0.0, incidence_mm=0.0, direction_rad=0.0))


def of_scan(given: Sequence[Instrument], name: str) -> Sequence[Instrument]:
    """Return the one of a scene's instruments that measured a scan; none where it is not stated."""
    return [one for one in given if name in one.scans or not one.scans][:1]


def scale_variance(length: float) -> float:
    """Return the variance, mm^2, of a length, mm, by the scale of the scanner."""
    return (known().scale * length) ** 2


def mean_offset_sd(views: int, square: float = 0.0, dof: float = 0.0) -> float:
    """Return the standard deviation, mm, of the offset that the ranges of so many views have in common.

    It is that of the instrument, and the mean of the views' own. Data show these relative to their mean alone, by a sum
    of squares with its degrees of freedom: of three or four views far too few without the class.
    """
    of_view = moderated_variances.by_class(square, dof, known().view_mm ** 2)
    return math.hypot(known().offset_mm, math.sqrt(of_view / views))


def view_errors(ranges: Floats, cosines: Floats, view: Ints) -> Floats:
    """Errors (n, v + 1), mm, of ranges (n,) by independent standard variates, along the rays.

    One variate a view (n,), numbered from 0, is its offset and its scale. The last is the bias by incidence that all
    surfaces have in common, of ``cosines`` (n,): a footprint is longer by 1 / cosine, and its mean range off with it.
    """
    of = known()
    of_view = np.sqrt(of.view_mm**2 + (of.scale * ranges) ** 2)[:, None] * (view[:, None] == np.arange(view.max() + 1))
    return np.column_stack([of_view, of.incidence_mm * (1.0 / cosines - 1.0)])


def pose_covariance(points: Floats) -> Floats:
    """Covariance (6, 6), rad and mm, of a rotation about the frame's origin and a translation that all views share.

    ``points`` (n, 3), mm, are those that the views saw.

    The offset of all ranges moves what is seen from one side, and the views' shifts rotate what lies between them.
    """
    arm = 0.5 * float(np.linalg.norm(np.ptp(points, axis=0)))
    rotation, shift = SHIFT_SD_MM**2 / max(arm, 1.0) ** 2, SHIFT_SD_MM**2 + known().offset_mm ** 2
    return rigid.about_origin(np.diag(np.repeat([rotation, shift], 3)), points.mean(axis=0))
