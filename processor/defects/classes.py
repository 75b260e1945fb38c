"""What a place that deviates or is missing is called, and how sure that is.

Each rule is one number held against a border, and by how much it is beyond says how sure the answer is: a border that
is reached just so is as good as a coin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PIT_THICKNESSES = 5.0  # of the plate: steel that is bent in does so over more than that, a pit takes less
CRACK_RATIO = 4.0  # of length to width
CRACK_THICKNESSES = 3.0  # of width
SOFT = 0.15  # of the logarithm of a number by its border: what a border is uncertain by
UNKNOWN = 0.6  # confidence below which a class is not named
LARGE_SHARE = 0.25  # of a face, from which on a hole within it is a missing part beyond doubt


@dataclass(frozen=True)
class Named:
    """A class, how sure it is (0.5 = a coin), and the class that it would be otherwise."""

    kind: str
    confidence: float
    second: str


def of_deviation(sign: int, diameter: float, length: float, width: float, thickness: float, z: float) -> Named:
    """Name a place that deviates, of sizes in mm; ``z`` = its deviation by its noise."""
    slim = _beyond(length / max(width, 1e-9), CRACK_RATIO) * _beyond(CRACK_THICKNESSES * thickness, width)
    small = _beyond(PIT_THICKNESSES * thickness, diameter)
    sure = 1.0 - np.exp(-0.5 * max(z, 0.0))
    if sign > 0:
        ranks = {"bulge": 1.0 - slim, "unknown": slim}
    else:
        ranks = {"crack": slim, "pit": (1.0 - slim) * small, "dent": (1.0 - slim) * (1.0 - small)}
    return _chosen({kind: rank * sure for kind, rank in ranks.items()})


def of_missing(borders: int, length: float, width: float, thickness: float, strength: float) -> Named:
    """Name a place that is missing: by how many of its face's borders it reaches, and its sizes in mm."""
    sure = 1.0 - np.exp(-0.5 * strength)
    if borders == 0:
        slim = _beyond(length / max(width, 1e-9), CRACK_RATIO) * _beyond(CRACK_THICKNESSES * thickness, width)
        return _chosen({"crack": slim * sure, "missing-part": (1.0 - slim) * sure})
    if borders == 1:
        return Named("edge-loss", 0.95 * sure, "missing-part")
    return Named("missing-part", 0.95 * sure, "edge-loss")


def of_shape(kind: str, margin: float) -> Named:
    """Name the shape of a component; ``margin`` is how much more chi-square any other kind would leave."""
    sure = float(1.0 - 0.5 * np.exp(-0.05 * max(margin, 0.0)))
    return Named(kind if sure >= UNKNOWN else "unknown", sure, "unknown" if sure >= UNKNOWN else kind)


def _beyond(value: float, border: float) -> float:
    """Between 0 and 1: how surely a number is above a border."""
    return float(1.0 / (1.0 + np.exp(-np.log(max(value, 1e-9) / border) / SOFT)))


def _chosen(ranks: dict[str, float]) -> Named:
    order = sorted(ranks, key=lambda kind: -ranks[kind])
    kind, second = order[0], order[1] if len(order) > 1 else ""
    if ranks[kind] < UNKNOWN and kind != "unknown":
        return Named("unknown", float(ranks[kind]), kind)
    return Named(kind, float(ranks[kind]), second)
