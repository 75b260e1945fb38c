"""Errors assumed for the class of terrestrial laser scanners, phase-shift and pulsed, where data cannot show them.

Standard deviations from data sheets and practice (type B evaluation of the GUM), not estimates from the scans.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from processor.geometry import rigid
from processor.model import Floats, Ints

# What the points of one view have in common, relative to other views: data sheets give a range error of 1 mm for up to
# 130 m, which is taken as the limit of 95 %.
VIEW_SD_MM = 0.5
# Scale of the ranges of one view, without unit: the same data sheets give 10 ppm beside 1 mm, as a limit of 95 %.
SCALE_SD = 5e-6
# Shift of all views together, along each axis: targets are measured to about 1 mm, and a network rests on some 25
# sightings of them.
SHIFT_SD_MM = 0.2
# Zero offset of the ranges of a calibrated scanner, which all of its views have in common.
OFFSET_SD_MM = 0.2
# What all surfaces have in common along their normals: bias by incidence, by the signal of their paint, and its layer.
# Black targets were measured 0.2 to 0.7 mm nearer than white ones, in 7 of 8 views of a pulsed scanner.
SURFACE_SD_MM = 0.3


class Instrument(NamedTuple):
    """What the class of a scanner says of its ranges, one standard deviation: offset of a view, and bias by incidence.

    The bias is that where the path through the footprint is twice as long as at normal incidence (60 degrees).
    """

    view_mm: float
    incidence_mm: float


# By name; data sheets of pulsed scanners give 1.2 mm, those of long-range ones 5 mm, as a limit of 95 %, and longer
# pulses and wider footprints move ranges at grazing incidence in proportion.
INSTRUMENTS = {
    "phase": Instrument(VIEW_SD_MM, SURFACE_SD_MM),
    "pulse": Instrument(0.6, 0.36),
    "long-range": Instrument(2.5, 1.5),
}
ASSUMED = "phase"  # where nobody says what the scanner was


def of_class(instrument: str) -> Instrument:
    """Return what is known of a class by its name; "" = not stated."""
    return INSTRUMENTS[instrument or ASSUMED]


def scale_variance(length: float) -> float:
    """Return the variance, mm^2, of a length, mm, by the scale of the scanner."""
    return (SCALE_SD * length) ** 2


def view_errors(ranges: Floats, cosines: Floats, view: Ints, instrument: str = "") -> Floats:
    """Errors (n, v + 1), mm, of ranges (n,) by independent standard variates, along the rays.

    One variate a view (n,), numbered from 0, is its offset and its scale. The last is the bias by incidence that all
    surfaces have in common, of ``cosines`` (n,): a footprint is longer by 1 / cosine, and its mean range off with it.
    """
    known = of_class(instrument)
    of_view = np.sqrt(known.view_mm**2 + (SCALE_SD * ranges) ** 2)[:, None] * (
        view[:, None] == np.arange(view.max() + 1)
    )
    return np.column_stack([of_view, known.incidence_mm * (1.0 / cosines - 1.0)])


def pose_covariance(points: Floats) -> Floats:
    """Covariance (6, 6), rad and mm, of a rotation about the frame's origin and a translation that all views share.

    ``points`` (n, 3), mm, are those that the views saw.

    The offset of all ranges moves what is seen from one side, and the views' shifts rotate what lies between them.
    """
    arm = 0.5 * float(np.linalg.norm(np.ptp(points, axis=0)))
    rotation, shift = SHIFT_SD_MM**2 / max(arm, 1.0) ** 2, SHIFT_SD_MM**2 + OFFSET_SD_MM**2
    return rigid.about_origin(np.diag(np.repeat([rotation, shift], 3)), points.mean(axis=0))
