"""The result of step ``spheres``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.model import Checked, Floats, Ints, column, names, optional


@dataclass(frozen=True)
class Result(Checked):
    """The balls, a row each, in the input's own frame (its offset put back), mm. NaN = no answer.

    Method ``ray`` alone fills what is below ``reason``. ``bound_sd`` are the Cramér-Rao bounds of x, y, z, radius and
    lowest point, ``efficiency`` is bound over standard deviation of centre, radius and lowest point. Movements are in
    the design's frame, relative to ``gauge``; tubes run from ``tube_start`` to ``tube_end`` between balls of these ids
    (-1 = none). ``T_station`` (s, 4, 4) map places as registered to where the tubes have them.
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
