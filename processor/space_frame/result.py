"""The result of step ``spheres``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.model import NORMAL_95, Checked, Floats, Ints, column, names, optional


@dataclass(frozen=True)
class Result(Checked):
    """The spheres, a row each, in the input's own frame (its offset added), mm. NaN = no answer.

    Only method ``ray`` fills the fields below ``reason``. ``bound_sd`` are the Cramér-Rao bounds of x, y, z, radius and
    lowest point, ``efficiency`` is bound over standard deviation of centre, radius and lowest point. Movements are in
    the design's frame, relative to ``gauge``; tubes run from ``tube_start`` to ``tube_end`` between spheres of these
    ids (-1 = none). ``T_station`` (s, 4, 4) map places as registered to corrected ones.
    """

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
    sizes: Floats = column("k")  # of the catalogue
    axes: Ints = column("k", dtype=np.int64)  # of members that meet at the node
    stations: Ints = column("k", dtype=np.int64)  # that saw the ball
    bound_sd: Floats = column("k", 5)
    efficiency: Floats = column("k", 3)
    movement: Floats = column("k", 3)
    movement_ci95: Floats = column("k", 3)
    movement_covariance: Floats = column("k", 3, 3)
    movement_limit: float = float("nan")  # of its size; NaN = none
    movement_limit_source: str = ""  # where that stands
    gauge: str = ""
    matching: str = ""  # ok | ambiguous | failed
    T_design_scan: Floats = optional(4, 4)
    T_design_scan_covariance: Floats = optional(6, 6)
    T_rivals: Floats = column("r", 4, 4)  # other poses of the design that explain as much
    tube_start: Floats = column("m", 3)
    tube_end: Floats = column("m", 3)
    tube_radii: Floats = column("m")
    tube_bow: Floats = column("m")  # largest departure of the axis from straight
    tube_a: Ints = column("m", dtype=np.int64)
    tube_b: Ints = column("m", dtype=np.int64)
    station_names: tuple[str, ...] = names("s")
    T_station: Floats = column("s", 4, 4)
    station_said: tuple[str, ...] = names("s")
    datum: str = ""  # what holds all stations together where they are
    control_names: tuple[str, ...] = names("c")  # control points, a row a sighting
    control_scan: tuple[str, ...] = names("c")  # that it was seen in
    control_off: Floats = column("c", 3)  # known place minus the sighting after the stations were moved
    control_used: Ints = column("c", dtype=np.int64)  # 1 = yes, 0 = left out: the others speak against it


# --- movements of nodes compared with a limit ------------------------------------------------------------------------


PASS, FAIL, INDETERMINATE, NO_LIMIT = "pass", "fail", "indeterminate", "no limit"


@dataclass(frozen=True)
class Judged:
    """Size (k,) of each movement, its 95 % half-width (k,), mm, and the verdict; NaN and "" where none is known.

    The half-width is along the movement: a size that is not well above it is mostly noise.
    """

    size: Floats
    ci95: Floats
    verdict: tuple[str, ...]


def of_result(result: Result) -> Judged:
    """Compare all movements of a result with the limit.

    Pass where size and interval are within the limit, fail where the size exceeds it by more than the interval, else
    indeterminate. Also indeterminate where other poses of the design fit the nodes as well, and for a sphere that was
    not seen: the point where its axes meet is not the sphere's centre.
    """
    size = np.linalg.norm(result.movement, axis=1)
    along = result.movement / np.where(size > 0.0, size, 1.0)[:, None]
    variance = np.einsum("ki,kij,kj->k", along, result.movement_covariance, along)
    ci95 = NORMAL_95 * np.sqrt(np.maximum(variance, 0.0))
    sure = result.matching == "ok"
    limit = result.movement_limit
    seen = [evidence != "axes" for evidence in result.evidence]
    return Judged(
        size,
        ci95,
        tuple(
            _verdict(s, half, limit, sure and ball)
            for s, half, ball in zip(size.tolist(), ci95.tolist(), seen, strict=True)
        ),
    )


def _verdict(size: float, half: float, limit: float, sure: bool) -> str:
    if np.isnan(size):
        return ""
    if np.isnan(limit):
        return NO_LIMIT
    if not sure or np.isnan(half):
        return INDETERMINATE
    return PASS if size + half <= limit else FAIL if size - half > limit else INDETERMINATE
