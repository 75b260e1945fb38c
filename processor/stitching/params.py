"""Parameters of stitching."""

from __future__ import annotations

from dataclasses import dataclass

from processor.model.inputs import Parameters, entry, number, text

METHODS = ("automatic", "three-point")  # the first is the default
SCALES = ("fixed", "free")
LIMIT = number(above=0, infinite=True)


@dataclass(frozen=True)
class Params(Parameters, table="stitch"):
    """Parameters of both methods."""

    method: str = METHODS[0]
    seed: int = 0
    reference: str = ""  # name of the scan whose pose is fixed; empty: the first
    # three-point: fixed = six parameters with scale as a diagnostic, free = the paper's seven, written too
    scale: str = entry(text(*SCALES), default=SCALES[0])
    scale_limit_ppm: float = entry(LIMIT, default=1000.0)  # three-point: a significant scale beyond this is a blunder
    cell_mm: float = entry(number(least=0), default=0.0)  # side of the cells; 0 = from the density of the points
    levelled_mrad: float = entry(number(least=0), default=0.0)  # tilt of the instruments at most; 0 = unknown
    weak_mm: float = entry(LIMIT, default=5.0)  # largest standard deviations of a pose that is not called weak
    weak_mrad: float = entry(LIMIT, default=0.5)
