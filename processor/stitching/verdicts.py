"""Verdicts on a network of scans: misclosures of loops, control points as scanned, and the uncertainty of places."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np

from processor.limits import judging, measurands, standards
from processor.limits.judging import JudgedLimits, Measured
from processor.model import NORMAL_95, Scene, Status
from processor.stitching.result import Result


def judge(scene: Scene, result: Result) -> JudgedLimits | None:
    """Compare a network with the limits of a scene; None where none is given."""
    tolerance = standards.default_for(scene.tolerance)
    return judging.table(
        judging.judge(limit, measured, tolerance)
        for limit in tolerance.limits
        if limit.measure in QUANTITIES
        for measured in QUANTITIES[limit.measure](result)
    )


def _closures(result: Result) -> Iterator[Measured]:
    """Yield the misclosures, which are compared as they are: they have no error, they are one."""
    for loop, mm in zip(result.closures.loop, result.closures.mm.tolist(), strict=True):
        yield Measured.within(" - ".join(loop), mm, 0.0)


def _control_points(result: Result) -> Iterator[Measured]:
    """Yield the distances of control points from their known places, each sighting by itself."""
    if result.control is None:
        return
    seen = result.control.sightings
    for i, (point, scan) in enumerate(zip(seen.point, seen.scan, strict=True)):
        off = seen.off[i]
        size = float(np.linalg.norm(off))
        sd = float(np.sqrt(np.sum(np.square(off / size * seen.sd[i])))) if size > 0.0 else float(seen.sd[i].max())
        half = NORMAL_95 * sd
        yield Measured(f"{point} in {scan}", size, max(size - half, 0.0), size + half)


def _positions(result: Result) -> Iterator[Measured]:
    """Yield the 95 % uncertainty of each scan's place along its least certain axis; a scan without a pose has none."""
    scans = result.scans
    for name, status, sd in zip(scans.name, scans.status, scans.position_sd, strict=True):
        if name != result.reference or result.by_control:
            half = NORMAL_95 * float(sd.max())
            yield Measured.within(name, half, 0.0, doubtful=status in (Status.FAILED, Status.AMBIGUOUS))


QUANTITIES: Mapping[str, Callable[[Result], Iterator[Measured]]] = {
    measurands.CLOSURE: _closures,
    measurands.CONTROL_POINT: _control_points,
    measurands.SCAN_POSITION: _positions,
}
