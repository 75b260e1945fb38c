"""Errors stated by the class of terrestrial laser scanners, phase-shift and pulsed, where data cannot show them.

One standard deviation each, in mm. ``VIEW_MM``: what the points of one view have in common, relative to other views;
data sheets give a range error of 1 mm for up to 130 m, which is taken as the limit of 95 %. ``SCALE``: of the ranges of
one view, without unit; the same sheets give 10 ppm beside 1 mm.
``SHIFT_MM``: of all views together, along each axis: targets are measured to about 1 mm, and a network rests on some
25 sightings of them. ``OFFSET_MM``: the zero offset of a calibrated scanner, which all of its views have in common.
"""

from __future__ import annotations

import numpy as np

from processor.geometry import rigid
from processor.model import Floats

VIEW_MM = 0.5
SCALE = 5e-6
SHIFT_MM = 0.2
OFFSET_MM = 0.2


def scale_variance(length: float) -> float:
    """Return the variance of a length by the scale of the scanner, mm^2."""
    return (SCALE * length) ** 2


def pose_covariance(points: Floats) -> Floats:
    """Covariance (6, 6) of a rotation about the frame's origin and a translation that views of points (n, 3) share.

    The offset of all ranges moves what is seen from one side, and the views' shifts rotate what lies between them.
    """
    arm = 0.5 * float(np.linalg.norm(np.ptp(points, axis=0)))
    rotation, shift = SHIFT_MM**2 / max(arm, 1.0) ** 2, SHIFT_MM**2 + OFFSET_MM**2
    return rigid.about_origin(np.diag(np.repeat([rotation, shift], 3)), points.mean(axis=0))
