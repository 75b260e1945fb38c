"""Balls of a space frame: the paper's algebraic least squares and RANSAC with adaptive N, on a crop a ball."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.model import Checked, Floats, Ints, column, names

NEEDS: tuple[str, ...] = ()
KIND = "space-frame"
METHODS = ("ransac", "least-squares")  # the first is the default


@dataclass(frozen=True)
class Params:
    """Parameters (lengths in mm)."""

    method: str = METHODS[0]
    seed: int = 0


@dataclass(frozen=True)
class Result(Checked):
    """The balls, a row each, in the input's own frame (its offset put back), mm. NaN = no answer."""

    status: str  # ok | partial | failed
    method: str
    message: str = ""
    ids: Ints = column("k", dtype=np.int64)
    centres: Floats = column("k", 3)
    radii: Floats = column("k")
    lowest: Floats = column("k", 3)
    covariance: Floats = column("k", 4, 4)  # of centre x, y, z and radius
    lowest_sd: Floats = column("k")  # of the lowest point's z
    points: Ints = column("k", dtype=np.int64)  # that the estimate rests on
    visible_fraction: Floats = column("k")  # of the sphere's surface that has points
    rms: Floats = column("k")  # of the residuals of those points
    nominal_radii: Floats = column("k")  # from the design, NaN without
    evidence: tuple[str, ...] = names("k")  # ball | fused | axes
    flag: tuple[str, ...] = names("k")  # ok | low-confidence | wrong-size | not-found
    reason: tuple[str, ...] = names("k")  # why the flag is not ok
