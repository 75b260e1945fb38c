"""The class of a defect and the confidence in it.

Each rule compares one number with a limit; the distance from the limit gives the confidence, 0.5 at the limit itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.defects.places.profiles import Fit, Profile
from processor.defects.result import DefectClass

PIT_THICKNESSES = 5.0  # largest diameter of a pit by the plate's thickness: bent steel deviates over more than that
CRACK_RATIO = 4.0  # least length of a crack by its width
CRACK_THICKNESSES = 3.0  # largest width of a crack by the plate's thickness
SOFTNESS = 0.15  # of the logarithm of a number by its limit: scale of the logistic function
COIN = 0.5  # confidence of a random choice between two classes
LEAST_CONFIDENCE = 0.6  # below it the class is unknown
BORDER_CONFIDENCE = 0.95  # of edge loss and missing part, told apart by the borders that they reach


@dataclass(frozen=True)
class Classification:
    """A class, the confidence in it (0.5 = both classes are equally likely), and the second most probable class."""

    defect_class: DefectClass
    confidence: float
    otherwise: DefectClass


def of_deviation(
    sign: int, diameter: float, length: float, width: float, thickness: float, z: float, stayed: float = np.nan
) -> Classification:
    """Classify a place that deviates inward (``sign`` -1) or outward, sizes in mm; ``z``: deviation by its sd.

    ``stayed`` is the probability that the other side of the plate did not move, which distinguishes a pit from a dent.
    Where that side was not seen (NaN), the size does.
    """
    slim = _slim(length, width, thickness)
    small = _above(PIT_THICKNESSES * thickness, diameter) if np.isnan(stayed) else stayed
    significance = 1.0 - np.exp(-0.5 * max(z, 0.0))
    if sign > 0:
        ranks = {DefectClass.BULGE: 1.0 - slim, DefectClass.UNKNOWN: slim}
    else:
        ranks = {
            DefectClass.CRACK: slim,
            DefectClass.PIT: (1.0 - slim) * small,
            DefectClass.DENT: (1.0 - slim) * (1.0 - small),
        }
    return _most_probable({kind: rank * significance for kind, rank in ranks.items()})


def of_missing(borders: int, length: float, width: float, thickness: float, strength: float) -> Classification:
    """Classify a missing place by the number of borders of its face that it reaches, and by its sizes in mm."""
    significance = 1.0 - np.exp(-0.5 * strength)
    if borders == 0:
        slim = _slim(length, width, thickness)
        return _most_probable(
            {DefectClass.CRACK: slim * significance, DefectClass.MISSING_PART: (1.0 - slim) * significance}
        )
    if borders == 1:
        return Classification(DefectClass.EDGE_LOSS, BORDER_CONFIDENCE * significance, DefectClass.MISSING_PART)
    return Classification(DefectClass.MISSING_PART, BORDER_CONFIDENCE * significance, DefectClass.EDGE_LOSS)


def of_shape(kind: str, margin: float) -> Classification:
    """Classify the shape of a component; ``margin``: chi-square of the best fit of another kind less this one's."""
    confidence = float(1.0 - 0.5 * np.exp(-0.05 * max(margin, 0.0)))
    if confidence >= LEAST_CONFIDENCE:
        return Classification(DefectClass(kind), confidence, DefectClass.UNKNOWN)
    return Classification(DefectClass.UNKNOWN, confidence, DefectClass(kind))


def of_profile(fitted: Fit, thickness: float, before: Classification) -> Classification:
    """Classify a place with a bent edge or a step by its profile, in place of the classification ``before`` it.

    The lips of a crack are bent over a few thicknesses of the plate; plates joined out of line deviate over more.
    """
    confidence = float(1.0 - COIN * np.exp(-0.05 * max(fitted.margin, 0.0)))
    kind = DefectClass.BEND
    if fitted.profile is Profile.STEP:
        near = _above(PIT_THICKNESSES * thickness, fitted.reach)
        kind = DefectClass.CRACK if near > COIN else DefectClass.STEP
        confidence *= max(near, 1.0 - near)
    return Classification(kind, confidence, before.defect_class)


def _slim(length: float, width: float, thickness: float) -> float:
    """Return between 0 and 1 how surely a place is long and narrow, as cracks are."""
    return _above(length / max(width, 1e-9), CRACK_RATIO) * _above(CRACK_THICKNESSES * thickness, width)


def _above(value: float, limit: float) -> float:
    """Return between 0 and 1 how surely a number is above a limit."""
    return float(1.0 / (1.0 + np.exp(-np.log(max(value, 1e-9) / limit) / SOFTNESS)))


def _most_probable(ranks: dict[DefectClass, float]) -> Classification:
    first, second, *_ = sorted(ranks, key=lambda kind: -ranks[kind])
    if ranks[first] < LEAST_CONFIDENCE and first is not DefectClass.UNKNOWN:
        return Classification(DefectClass.UNKNOWN, float(ranks[first]), first)
    return Classification(first, float(ranks[first]), second)
