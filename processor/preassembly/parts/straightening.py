"""The bend that parts had as they were scanned, taken out of their ends and edges, or part of their covariance.

A part lies on supports while it is scanned, and bends by its weight and by the sun on one side of it. What is erected
is the part without that bend. Where its supports are stated, or seen in its scan, the sag is subtracted; where they are
not, its second moment over plausible supports is added to the covariances, as is that of a difference of temperature
across the part.
All departures of an end share these errors, and so do all of the edges. A scan is taken to be levelled: gravity acts
along -z of its frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from processor.geometry import rigid
from processor.geometry.lines_and_polylines import Polyline
from processor.model import NORMAL_95, ArchDesign, DesignPart, Floats, Reason, Scene, Status, Steel, reason
from processor.preassembly import topology
from processor.preassembly.ends.bottom_edges import EdgeDepartures
from processor.preassembly.ends.joint_end import JointEnd
from processor.preassembly.ends.joint_frame import joint_frame
from processor.preassembly.ends.outer_end import OuterEnd
from processor.preassembly.parts import bending, supports_seen
from processor.preassembly.parts.bending import Beam, Deflection
from processor.preassembly.parts.measure import MeasuredPart
from processor.preassembly.parts.supports_seen import Seen

# Two trestles, each at up to a third of the length from its end: the middles of four equal shares of that.
PLAUSIBLE = tuple((k + 0.5) / 12.0 for k in range(4))
# Half of the 95 % interval of a gap of two parts bent by differences of temperature on supports not known, by 1.96
# standard deviations: of the law above, and of 0 to 10 K in any direction, the tails are longer than normal ones.
TAIL = 1.07
STEEP = 0.5  # sine of the axis' inclination from which no part lies on trestles: the scan is not levelled
LEVEL = 0.9998  # cosine of 1 degree, by which verticals of several scans of a part may differ: it lay as in the first
PLACE_SD_MM = 50.0  # of a stated support: half the width of its beam, and a tape measure
WORTH_MM = 0.1  # one standard deviation of an end's sag, from which it is named whatever else is uncertain


class _Bend(NamedTuple):
    """How a part may be bent: what is known of it, and deflections of unit variance of what is not, by cause."""

    beam: Beam
    known: tuple[Deflection, ...]
    by_weight: tuple[Deflection, ...]
    by_gradient: tuple[Deflection, ...]


def straighten(
    parts: Sequence[MeasuredPart], scene: Scene, design: ArchDesign, gradient_K: float
) -> tuple[list[MeasuredPart], tuple[Reason, ...]]:
    """Return measured parts without the bend of their scans, and what is to be said of all of them.

    ``gradient_K`` is the standard deviation of a difference of temperature across a part, along each of both axes.
    """
    straight, by_gradient = [], 0.0
    for i, part in enumerate(parts):
        bend: _Bend | None = None
        reasons: tuple[Reason, ...] = ()
        if part.status != Status.FAILED and not topology.is_branch(topology.ends_of(design.joined, i)):
            bend, reasons = _bend(part, scene, design, i, gradient_K)
        if bend is None:
            straight.append(replace(part, reasons=(*part.reasons, *reasons)))
            continue
        sd = [_end_sd(some, bend.beam, design, i) for some in (bend.by_weight, bend.by_gradient)]
        by_gradient = max(by_gradient, sd[1])
        if not bend.known and sd[0] > min(WORTH_MM, _median_sd(part)):
            reasons = (*reasons, reason("preassemble.supports-unknown", ci95=NORMAL_95 * sd[0]))
        straight.append(replace(_corrected(part, bend, design, i), reasons=(*part.reasons, *reasons)))
    if by_gradient == 0.0:
        return straight, ()
    return straight, (reason("preassemble.gradient", kelvin=gradient_K, ci95=NORMAL_95 * by_gradient),)


def _bend(
    part: MeasuredPart, scene: Scene, design: ArchDesign, i: int, gradient_K: float
) -> tuple[_Bend | None, tuple[Reason, ...]]:
    """Return how part ``i`` may be bent, None where it is no beam; and what is to be said of it."""
    beam = bending.beam(design.parts[i], _start(design, i), scene.steel or Steel())
    stated = scene.part_supports is not None and part.name in scene.part_supports.component
    if beam is None:
        return None, (reason("preassemble.no-beam"),) if stated else ()
    gravity = -part.T_bridge_scan[:3, 2]
    if stated:
        places = _stated_supports(part, scene, design.parts[i], beam)
        beside = [s for s in places if not -PLACE_SD_MM <= s <= beam.length + PLACE_SD_MM]
        found = None if beside or not places else bending.sag(beam, gravity, places)
        if found is None:
            why = reason("preassemble.supports-do-not-carry", places=_in_metres(places), length=1e-3 * beam.length)
            return _on_any_supports(beam, gravity, gradient_K), (why,)
        places = found[1]
        sets = [(found[0], tuple(range(len(places))))]
        return _on_supports(beam, gravity, Seen(np.array(places), np.full(len(places), PLACE_SD_MM)), sets, gradient_K)
    seen = _seen(part, design.parts[i], beam)
    sets = [] if seen is None else _carrying(beam, gravity, seen.places)
    if seen is None or not sets:
        return _on_any_supports(beam, gravity, gradient_K), ()
    bend, reasons = _on_supports(beam, gravity, seen, sets, gradient_K)
    ci95 = NORMAL_95 * 1e-3 * float(seen.sd.max())
    why = reason("preassemble.supports-seen", places=_in_metres(seen.places), ci95=ci95, sets=len(sets))
    return bend, (why, *reasons)


def _seen(part: MeasuredPart, of_design: DesignPart, beam: Beam) -> Seen | None:
    """Return the supports that a part's scans show; None without, or where they are not all of one attitude."""
    poses = (part.T_bridge_scan, *part.T_further_scans)
    up = poses[0][:3, 2]
    if abs(float(beam.axes[0] @ up)) > STEEP or any(float(T[:3, 2] @ up) < LEVEL for T in poses):
        return None
    placed = [(T, part.shrink, scan.points) for T, scan in zip(poses, part.scans, strict=True)]
    return supports_seen.find(placed, up, beam, of_design)


def _carrying(beam: Beam, gravity: Floats, places: Floats) -> list[tuple[Deflection, tuple[int, ...]]]:
    """Return how a part bends on each set of supports that carries it, with the numbers of these supports.

    Which do of three or more depends on heights that no scan shows.
    """
    found = []
    for count in range(2, len(places) + 1):
        for some in combinations(range(len(places)), count):
            bent = bending.sag(beam, gravity, places[list(some)].tolist())
            if bent is not None and len(bent[1]) == count:
                found.append((bent[0], some))
    return found


def _on_supports(
    beam: Beam, gravity: Floats, supports: Seen, sets: Sequence[tuple[Deflection, tuple[int, ...]]], gradient_K: float
) -> tuple[_Bend, tuple[Reason, ...]]:
    """Return how a part is bent that lies on one of several sets of supports, each as plausible, and why."""
    places, share = supports.places.tolist(), 1.0 / np.sqrt(len(sets))
    bent = [one.through(beam, places) for one, _ in sets]
    known = reduce(Deflection.plus, bent).scaled(share**2)
    by_weight = [known.scaled(beam.relative_sd), *(one.plus(known, -1.0).scaled(share) for one in bent)]
    by_gradient = list[Deflection]()
    for one, (_, some) in zip(bent, sets, strict=True):
        at = [places[k] for k in some]
        for k, number in enumerate(some):
            moved = bending.sag(beam, gravity, (*at[:k], at[k] + float(supports.sd[number]), *at[k + 1 :]))
            if moved is not None and len(moved[1]) == len(some):
                by_weight.append(moved[0].through(beam, places).plus(one, -1.0).scaled(share))
        for axis in range(2):
            by_gradient.append(bending.by_gradient(beam, axis, at).through(beam, places).scaled(share * gradient_K))
    where = int(np.argmax(np.linalg.norm(known.across, axis=1)))
    sd = float(np.sqrt(sum(np.square(one.across[where]).sum() for one in by_weight)))
    most = float(np.linalg.norm(known.across[where]))
    values = {"places": _in_metres(places), "sag": most, "ci95": NORMAL_95 * sd}
    if beam.plates:
        mass = float(beam.weight.sum()) * beam.step / bending.GRAVITY
        why = reason("preassemble.sag", **values, mass=1e-3 * mass)
    else:
        why = reason("preassemble.sag-by-outline", **values)
    return _Bend(beam, (known,), tuple(by_weight), tuple(by_gradient)), (why,)


def _on_any_supports(beam: Beam, gravity: Floats, gradient_K: float) -> _Bend:
    """Return how a part may be bent on supports that are not known."""
    # Of a scan that is not levelled gravity may act in any direction across the part
    steep = abs(float(beam.axes[0] @ gravity)) > STEEP
    directions = np.sqrt(0.5) * beam.axes[1:] if steep else gravity[None]
    by_weight, by_gradient = [], []
    pairs = [(a * beam.length, (1.0 - b) * beam.length) for a, b in product(PLAUSIBLE, repeat=2)]
    share = 1.0 / np.sqrt(len(pairs))  # the mean of squares over all pairs
    for supports in pairs:
        found = [bending.sag(beam, direction, supports) for direction in directions]
        by_weight += [one[0].scaled(share) for one in found if one is not None]
        scale = TAIL * share * gradient_K
        by_gradient += [bending.by_gradient(beam, axis, supports).scaled(scale) for axis in range(2)]
    return _Bend(beam, (), tuple(by_weight), tuple(by_gradient))


def _start(design: ArchDesign, i: int) -> Floats | None:
    """Return a point (3,) at the start of part ``i``; None where nothing shows it."""
    part = design.parts[i]
    if len(part.bottom_edge_left):
        at: Floats = part.bottom_edge_left[0]
        return at
    start, end = (None if place.joint is None else design.joint_points[place.joint].mean(axis=0)
                  for place in topology.ends_of(design.joined, i))  # fmt: skip
    if start is None and end is not None:
        start = 2.0 * part.vertices.mean(axis=0) - end
    return start


def _stated_supports(part: MeasuredPart, scene: Scene, of_design: DesignPart, beam: Beam) -> tuple[float, ...]:
    """Return the distances of a part's supports along its axis; none where their scan is not used."""
    known = scene.part_supports
    assert known is not None
    rows = [k for k, name in enumerate(known.component) if name == part.name]
    first = next(scan.name for scan in scene.scans if scan.component == part.name)
    used = {
        scan.name: (scan.origin, T)
        for scan, T in zip(part.scans, (part.T_bridge_scan, *part.T_further_scans), strict=True)
    }
    found = []
    for k in rows:
        chainage = float(known.chainages[k])
        edge = Polyline.through(of_design.bottom_edge_left) if len(of_design.bottom_edge_left) else None
        if edge is not None and 0.0 <= chainage <= edge.length:
            found.append(float(beam.axes[0] @ (edge.at(known.chainages[k : k + 1])[0] - beam.origin)))
        elif np.isfinite(chainage):
            found.append(chainage)
        elif first in used:
            origin, T = used[first]
            at = rigid.apply(T, part.shrink * (known.places[k] - origin)[None])[0]
            found.append(float(beam.axes[0] @ (at - beam.origin)))
    return tuple(sorted(found))


def _in_metres(supports: Sequence[float] | Floats) -> tuple[str, ...]:
    return tuple(f"{1e-3 * s:.1f}" for s in supports)


def _corrected(part: MeasuredPart, bend: _Bend, design: ArchDesign, i: int) -> MeasuredPart:
    """Return a part whose ends and edges are without the bend that is known, and have the variance of the rest."""
    joints = [place.joint for place in topology.ends_of(design.joined, i)]
    ends = tuple(
        end if end is None or joint is None else _of_end(end, design.joint_points[joint], bend)
        for end, joint in zip(part.member.ends, joints, strict=True)
    )
    edges = _of_edges(part.member.edges, bend) if len(part.member.edges.points) else part.member.edges
    outer = None if part.outer is None else _of_outer_end(part.outer, design.parts[i], bend)
    return replace(part, member=replace(part.member, ends=ends, edges=edges), outer=outer)


def _of_end(end: JointEnd, points: Floats, bend: _Bend) -> JointEnd:
    known, unknown = (
        _at_end(bend.known, bend.beam, points),
        _at_end((*bend.by_weight, *bend.by_gradient), bend.beam, points),
    )
    departure = end.departure - known.sum(axis=0).reshape(8, 3)
    return replace(end, departure=departure, covariance=end.covariance + unknown.T @ unknown)


def _at_end(deflections: Sequence[Deflection], beam: Beam, points: Floats) -> Floats:
    """Displacements (m, 24) of key points (8, 3) in the joint's axes."""
    R = joint_frame(points)[:3, :3]
    moved = [(one.displacement(beam, points) @ R).ravel() for one in deflections]
    return np.array(moved).reshape(-1, 24)


def _of_edges(edges: EdgeDepartures, bend: _Bend) -> EdgeDepartures:
    def departures(deflections: Sequence[Deflection]) -> Floats:
        moved = [one.displacement(bend.beam, edges.points) for one in deflections]
        found: Floats = np.einsum("mki,kai->mak", np.array(moved).reshape(-1, len(edges.points), 3), edges.axes)
        return found

    unknown = departures((*bend.by_weight, *bend.by_gradient))
    return replace(
        edges,
        departure=edges.departure - departures(bend.known).sum(axis=0).T,
        covariance=edges.covariance + np.einsum("mak,mal->akl", unknown, unknown),
    )


def _of_outer_end(outer: OuterEnd, part: DesignPart, bend: _Bend) -> OuterEnd:
    middles = 0.5 * (part.bottom_edge_left[[0, -1]] + part.bottom_edge_right[[0, -1]])
    at = middles[[int(np.argmax(middles @ outer.direction))]]
    known, unknown = (
        np.array([float(one.displacement(bend.beam, at)[0] @ outer.direction) for one in some])
        for some in (bend.known, (*bend.by_weight, *bend.by_gradient))
    )
    departure = outer.departure - known.sum() * outer.direction
    return replace(outer, departure=departure, variance=outer.variance + float(unknown @ unknown))


def _end_sd(deflections: Sequence[Deflection], beam: Beam, design: ArchDesign, i: int) -> float:
    """Largest standard deviation of a coordinate at the ends of part ``i``."""
    joints = [place.joint for place in topology.ends_of(design.joined, i) if place.joint is not None]
    found = [np.square(_at_end(deflections, beam, design.joint_points[joint])).sum(axis=0) for joint in joints]
    return float(np.sqrt(np.max(found, initial=0.0)))


def _median_sd(part: MeasuredPart) -> float:
    """Median standard deviation of the coordinates of a part's ends as measured; infinite without any."""
    variances = [np.diag(end.covariance) for end in part.member.ends if end is not None]
    known = [one for one in variances if np.isfinite(one).all()]
    return float(np.sqrt(np.median(known))) if known else float("inf")
