"""Errors of an assembly against the truth of the scanned parts.

The gaps of imperfect parts depend on the objective. They are compared with those that the same objective has for the
true key points and edges, computed by a general minimiser that shares no code with the adjustment. Joints and parts
without a result have no weight in the adjustment, and so none here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from processor.evaluation.error_statistics import coverage, covered, covered_pulls, pose_pulls, signed
from processor.geometry import rigid
from processor.geometry.lines_and_polylines import Polyline
from processor.model import NORMAL_95, ArchDesign, ArchTruth, Bools, Floats, Metric, Scene, Statistic, Status, Truth
from processor.preassembly import assembly_errors, topology
from processor.preassembly.chain.adjustment import HOLD
from processor.preassembly.chain.span_and_closure import design_span
from processor.preassembly.ends.joint_frame import joint_frame
from processor.preassembly.result import Result
from processor.preassembly.topology import PartEnd

WRONG_POSE_RAD = 0.1  # 6 degrees: an attitude was mistaken; no error of a fit is as large
TRUE_SPLICING = "splicing error of the true key points"
TRUE_LINEAR = "linear error of the true edges"
AS_DESIGNED_MM = 0.01  # key points this near to the design's are those of perfect parts


class TrueAssembly(NamedTuple):
    """The true parts, assembled by the objective; NaN where the objective has no weight.

    ``gaps`` (j, 8, 3); departures (s, 3) of the edges from the design's, and directions (s, 3) square to these and to
    the left, upward on an arch and outward on a ring, at chainages (s,), part by part, left before right; ``span`` is
    the distance of the bottom's middles at both ends of the bridge less the design's; ``motions`` (c, 4, 4) move the
    parts from the truth's poses.
    """

    gaps: Floats
    departures: Floats
    up: Floats
    chainage: Floats
    span: float
    motions: Floats


def check(scene: Scene, result: Result, truth: Truth) -> list[Metric]:
    """Compare an assembly with the truth of the scanned parts.

    Limits: a pose with status ok must be the right one; the splicing error of perfect parts is at most 5 mm at a
    spacing of 5 mm or less. All other figures are for information.
    """
    if truth.arch is None or scene.arch is None:
        return []
    true = {name: i for i, name in enumerate(truth.arch.names)}
    true_poses = [truth.arch.T_bridge_scan[true[name]] for name in result.components.name]
    turns, wrong = [], 0
    key_error, key_sd = _key_point_errors(scene.arch, result, truth.arch, true)
    for i in range(len(true_poses)):
        if np.isfinite(result.components.T_bridge_scan[i]).all():
            turn = rigid.rotation_angle(result.components.T_bridge_scan[i][:3, :3] @ true_poses[i][:3, :3].T)
            turns.append(turn)
            wrong += turn > WRONG_POSE_RAD and result.components.status[i] == Status.OK
    errors_at_points = key_error[np.isfinite(key_error).all(axis=1)]
    rms = float(np.sqrt(_over(np.mean, np.sum(errors_at_points**2, axis=1))))
    mean, largest = _true_linear_error(scene.arch, result, truth.arch, true, true_poses)
    limit = 5.0 if truth.spacing_mm <= 5.0 else float("nan")
    true_gaps = _gaps_of_truth(scene.arch, result, truth.arch, true, true_poses)
    return [
        Metric("wrong poses called ok", float(wrong), Statistic.COUNT, limit=0.0),
        Metric("splicing error", result.splicing.mean, Statistic.MEAN, unit="mm", limit=limit),
        Metric("splicing error", result.splicing.max, Statistic.MAX, unit="mm"),
        Metric(TRUE_SPLICING, _over(np.mean, np.abs(true_gaps)), Statistic.MEAN, unit="mm"),
        Metric(TRUE_SPLICING, _over(np.max, np.abs(true_gaps)), Statistic.MAX, unit="mm"),
        Metric(TRUE_LINEAR, mean, Statistic.MEAN, unit="mm"),
        Metric(TRUE_LINEAR, largest, Statistic.MAX, unit="mm"),
        Metric("key points in the scan", rms, Statistic.RMS, unit="mm"),
        *coverage("key points", key_error, NORMAL_95 * key_sd),
        *signed("key points", errors_at_points),
        *_gaps_by_objective(scene.arch, result, truth.arch, true),
        *coverage("gaps", result.joints.gaps - true_gaps, result.joints.gap_ci95),
        Metric("pose, largest turn", 1000.0 * max(turns, default=float("nan")), unit="mrad"),
    ]


def _key_point_errors(
    design: ArchDesign, result: Result, truth: ArchTruth, true: dict[str, int]
) -> tuple[Floats, Floats]:
    """Errors (n, 3) of the key points in the scan and their standard deviations (n, 3); NaN = unknown."""
    errors_of, sd_of = [np.empty((0, 3))], [np.empty((0, 3))]
    components, joined = result.components, design.joined
    for i, name in enumerate(components.name):
        points, sd = components.key_points_scan[i], components.key_points_sd[i]
        ends = topology.ends_of(joined, i)
        if topology.is_branch(ends):
            points, sd = components.at_joints[i].key_points_scan, components.at_joints[i].key_points_sd
        errors_of.append(
            (points - _at_ends(truth, true[name], ends, truth.key_points_scan, truth.branch_scan)).reshape(-1, 3)
        )
        sd_of.append(sd.reshape(-1, 3))
    return np.vstack(errors_of), np.vstack(sd_of)


def _at_ends(truth: ArchTruth, row: int, ends: Sequence[PartEnd], by_end: Floats, by_branch: Floats) -> Floats:
    """Points (e, 8, 3) of the truth at the ends of the component in a row: at start and end, or at its joints."""
    if not topology.is_branch(ends):
        points: Floats = by_end[row]
        return points
    found = np.full((len(ends), 8, 3), np.nan)
    for e, end in enumerate(ends):
        at = (truth.branch_component == row) & (truth.branch_joint == end.joint)
        found[e] = by_branch[at][0] if at.any() else np.nan
    return found


def _over(what: Callable[[Floats], Floats], values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(what(known)) if len(known) else float("nan")


def _in_bridge(design: ArchDesign, result: Result, truth: ArchTruth, true: dict[str, int]) -> list[Floats]:
    """Key points (e, 8, 3) of each component's ends at the true poses."""
    joined = design.joined
    return [
        _at_ends(truth, true[name], topology.ends_of(joined, i), truth.key_points_bridge, truth.branch_bridge)
        for i, name in enumerate(result.components.name)
    ]


def _gaps_of_truth(
    design: ArchDesign, result: Result, truth: ArchTruth, true: dict[str, int], true_poses: list[Floats]
) -> Floats:
    """Gaps (j, 8, 3) of the true key points at the estimated poses: errors of the poses where parts are perfect."""
    ends = _in_bridge(design, result, truth, true)
    placed = [
        [rigid.apply(pose @ rigid.invert(true_pose), points) for points in of_part]
        for of_part, pose, true_pose in zip(ends, result.components.T_bridge_scan, true_poses, strict=True)
    ]
    return np.array(
        [
            placed[right.part][right.end] - placed[left.part][left.end]
            for left, right in topology.sides_of(design.joined)
        ]
    ).reshape(-1, 8, 3)


def _gaps_by_objective(design: ArchDesign, result: Result, truth: ArchTruth, true: dict[str, int]) -> list[Metric]:
    """Compare the gaps of an adjustment with those of the truth under its objective."""
    if result.adjustment is None:
        return []
    known = np.isfinite(result.joints.gaps) & np.isfinite(result.joints.gap_ci95)
    if not known.any():
        return []
    rows = [true[name] for name in result.components.name]
    edges, ends = truth.edges_bridge[rows], [points.copy() for points in _in_bridge(design, result, truth, true)]
    edges[~np.isfinite(result.components.T_bridge_scan[:, 0, 0])] = np.nan
    for there, sides in zip(known, topology.sides_of(design.joined), strict=True):
        for side in sides if not there.any() else ():
            ends[side.part][side.end] = np.nan
    assembly = by_objective(design, ends, edges, result.adjustment.weight)
    error = (result.joints.gaps - assembly.gaps)[known]
    linear = np.linalg.norm(assembly.departures, axis=1)
    return [
        Metric("gaps against the truth's", float(np.sqrt(np.mean(error**2))), Statistic.RMS, unit="mm"),
        *_mean_max_coverage(result, assembly.gaps[known], linear),
        *signed("gaps", error),
        *_of_the_chain(design, result, truth, assembly, rows, ends),
    ]


def _of_the_chain(
    design: ArchDesign,
    result: Result,
    truth: ArchTruth,
    assembly: TrueAssembly,
    rows: list[int],
    ends: Sequence[Floats],
) -> list[Metric]:
    """Coverage of span, edges, closure and poses; ``rows`` of the truth are those of the components, with their ends.

    Span and poses of a part as built are relative to how it fits the design, which has no truth where the part differs
    from it: poses and closure have a truth for perfect parts alone, whose closure is zero.
    """
    stated = result.adjustment
    if stated is None:
        return []
    metrics = covered("spans", np.array([stated.span_departure - assembly.span]),
                      np.array([stated.span_ci95]))  # fmt: skip
    if len(stated.linear_offset) == len(assembly.departures) and np.allclose(
        result.linear.chainage, assembly.chainage, atol=1.0
    ):
        x, left, z = assembly.departures.T
        up = np.einsum("si,si->s", assembly.departures, assembly.up)
        true = np.stack([left, np.copysign(np.hypot(x, z), up)], axis=1)
        metrics += covered("edges", stated.linear_offset - true, stated.linear_offset_ci95)
    sides = zip(topology.sides_of(design.joined), design.joint_points, strict=True)
    off = np.array([ends[side.part][side.end] - at for both, at in sides for side in both])
    if np.isfinite(off).all() and np.abs(off).max() < AS_DESIGNED_MM:
        if np.isfinite(stated.closure).any():
            metrics += covered_pulls("closures", NORMAL_95 * (stated.closure / stated.closure_ci95).ravel())
        metrics += covered_pulls("poses", _pose_pulls(result, truth, assembly, rows))
    return metrics


def _pose_pulls(result: Result, truth: ArchTruth, assembly: TrueAssembly, rows: list[int]) -> Floats:
    """Errors (6 c,) of the assembled poses in standard deviations, in the bridge's frame."""
    pulls = []
    for i, row in enumerate(rows):
        T, covariance = result.components.T_bridge_scan[i], result.components.covariance[i]
        if np.isfinite(T).all() and np.isfinite(covariance).all():
            pulls.append(pose_pulls(T, assembly.motions[i] @ truth.T_bridge_scan[row], covariance))
    return np.concatenate(pulls) if pulls else np.empty(0)


def _mean_max_coverage(result: Result, gaps: Floats, linear: Floats) -> list[Metric]:
    """Share of the mean and largest errors within their intervals; the truth has gaps (g,) and departures (s,)."""
    if not len(result.errors_ci95):
        return []
    linear_error = result.linear.assembled.error
    stated = np.array([result.splicing.mean, result.splicing.max, linear_error.mean, linear_error.max])
    size = np.abs(gaps)
    true = np.array([size.mean(), size.max(), _over(np.mean, linear), _over(np.max, linear)])
    error = stated - true  # NaN: an assembly without bottom edges has no linear error
    return [
        *coverage("mean and largest errors", error, result.errors_ci95[:4]),
        Metric("mean and largest errors", float(np.isfinite(error + result.errors_ci95[:4]).sum()), Statistic.NUMBER),
    ]


def by_objective(design: ArchDesign, key_points: Sequence[Floats], edges: Floats, weight: float) -> TrueAssembly:
    """Minimise the sum of squared gaps plus ``weight`` times that of the edges' departures over the parts' motions.

    ``key_points`` (e, 8, 3) of each part's ends and ``edges`` (c, 2, e, 3) of the parts are near their places in the
    design, in the bridge's frame. Joints and edges with NaN have no weight; parts are then constrained as in the
    adjustment: along their chords, in pieces wholly. Parts without edges have the departures of their key points
    across the joints.
    """
    lines = [(Polyline.through(p.bottom_edge_left), Polyline.through(p.bottom_edge_right)) for p in design.parts]
    with_edges = [len(p.bottom_edge_left) > 0 for p in design.parts]
    middles = [part.vertices.mean(axis=0) for part in design.parts]
    sides = topology.sides_of(design.joined)
    joined = np.array(
        [bool(np.isfinite([key_points[side.part][side.end] for side in both]).all()) for both in sides], bool
    )
    seen = [i for i in range(len(lines)) if with_edges[i] and np.isfinite(edges[i]).all()]
    at_chainages = {(i, k): _at_chainages(edges[i, k], lines[i][k]) for i in seen for k in range(2)}
    across = [
        (
            side.part,
            key_points[side.part][side.end],
            design.joint_points[j],
            joint_frame(design.joint_points[j])[:3, 1:3],
        )
        for j, both in enumerate(sides)
        for side in both
        if not with_edges[side.part] and np.isfinite(key_points[side.part][side.end]).all()
    ]
    held = _held(design, middles, joined)

    def placed(x: Floats, i: int, points: Floats) -> Floats:
        return rigid.apply(_motion(x, i, middles[i]), points)

    def gaps(x: Floats) -> Floats:
        ends = [[placed(x, side.part, key_points[side.part][side.end]) for side in both] for both in sides]
        return np.array([right - left for left, right in ends]).reshape(-1, 8, 3)

    def departures(x: Floats) -> Floats:
        vectors = (lines[i][k].nearest(placed(x, i, at))[1] for (i, k), at in at_chainages.items())
        return np.vstack([np.zeros((0, 3)), *vectors])

    def objective(x: Floats) -> Floats:
        off = [((placed(x, i, points) - at) @ axes).ravel() for i, points, at, axes in across]
        line = np.sqrt(weight) * np.concatenate([departures(x).ravel(), *off])
        return np.concatenate([gaps(x)[joined].ravel(), line, np.sqrt(HOLD) * held(x)])

    solution = least_squares(objective, np.zeros(6 * len(lines)), xtol=1e-12, ftol=1e-12, gtol=1e-12).x
    before = np.cumsum([[0.0, 0.0], *([left.length, right.length] for left, right in lines)], axis=0)
    at_ends = ((0, edges[0][:, 0]), (len(lines) - 1, edges[-1][:, -1]))
    outer = [placed(solution, i, points).mean(axis=0) for i, points in at_ends]
    return TrueAssembly(
        gaps=gaps(solution),
        departures=departures(solution),
        up=np.vstack([np.zeros((0, 3)), *(_up(lines[i][k]) for i, k in at_chainages)]),
        chainage=np.concatenate([before[i, k] + _chainages(lines[i][k]) for i, k in at_chainages] or [np.empty(0)]),
        span=float(np.linalg.norm(outer[1] - outer[0]) - design_span(design)),
        motions=np.stack([_motion(solution, i, middle) for i, middle in enumerate(middles)]),
    )


def _up(line: Polyline) -> Floats:
    """Directions (n, 3) square to an edge and to the bridge's Y, at the chainages of the linear error."""
    at = _chainages(line)
    up: Floats = np.cross(line.at(at + 5.0) - line.at(at - 5.0), np.array([0.0, 1.0, 0.0]))
    return up


def _chord(design: ArchDesign, i: int) -> Floats:
    """Return the unit vector (3,) along which a part is held: along its edges, or between its last two joints."""
    part = design.parts[i]
    if len(part.bottom_edge_left):
        chord = part.bottom_edge_right[-1] - part.bottom_edge_left[0]
    else:
        middles = [part.vertices.mean(axis=0), *design.joint_points[(design.joined == i).any(axis=1)].mean(axis=1)]
        chord = middles[-1] - middles[-2]
    unit: Floats = chord / np.linalg.norm(chord)
    return unit


def _held(design: ArchDesign, middles: Sequence[Floats], joined: Bools) -> Callable[[Floats], Floats]:
    """Return what of the parts' movements has the weight HOLD, where the joints (j,) that have one do not suffice."""
    chords = np.array([_chord(design, i) for i in range(len(middles))])
    places = [_places(design, i, middle) for i, middle in enumerate(middles)]
    complete = bool(joined.all()) and design.in_row

    def along_chords(x: Floats) -> Floats:
        along: Floats = np.einsum("ci,ci->c", chords, x.reshape(-1, 6)[:, 3:])
        return 0.0 * along if complete else along

    def of_pieces(x: Floats) -> Floats:
        moved = (rigid.apply(_motion(x, i, middles[i]), at) - at for i, at in enumerate(places))
        return np.concatenate([by.ravel() / np.sqrt(len(by)) for by in moved])

    return of_pieces if topology.pieces(design.joined, joined, len(middles)).any() else along_chords


def _places(design: ArchDesign, i: int, middle: Floats) -> Floats:
    """Return the points (n, 3) at which a part of a piece is held: key points, edges, and these mirrored."""
    part = design.parts[i]
    edges = (
        [line.at(_chainages(line)) for line in map(Polyline.through, (part.bottom_edge_left, part.bottom_edge_right))]
        if len(part.bottom_edge_left)
        else []
    )
    points = np.vstack([*design.joint_points[(design.joined == i).any(axis=1)], *edges, middle])
    return np.vstack([points, 2.0 * middle - points])


def _motion(x: Floats, i: int, middle: Floats) -> Floats:
    """Motion (4, 4) of part i by the parameters of the objective: a turn about its middle, mrad, and a shift, mm."""
    R = rigid.rotation_from_vector(1e-3 * x[6 * i : 6 * i + 3])
    return rigid.transform(R, middle - R @ middle + x[6 * i + 3 : 6 * i + 6])


def _at_chainages(edge: Floats, line: Polyline) -> Floats:
    """Points of an edge as built at the design's chainages."""
    arc, at = line.nearest(edge)[0], _chainages(line)
    return np.stack([np.interp(at, arc, edge[:, k]) for k in range(3)], axis=1)


def _chainages(line: Polyline) -> Floats:
    """Chainages of the linear error along one edge of a part."""
    return np.asarray(
        assembly_errors.INTERVAL_MM * (np.arange(max(1, int(line.length / assembly_errors.INTERVAL_MM))) + 0.5)
    )


def _true_linear_error(
    design: ArchDesign, result: Result, truth: ArchTruth, true: dict[str, int], true_poses: list[Floats]
) -> tuple[float, float]:
    """Mean and maximum distance of the bottom edges as built from the design, at the estimated poses."""
    distances = []
    for part, pose, true_pose in zip(design.parts, result.components.T_bridge_scan, true_poses, strict=True):
        if not len(part.bottom_edge_left):
            continue
        lines = (Polyline.through(part.bottom_edge_left), Polyline.through(part.bottom_edge_right))
        for line, edge in zip(lines, truth.edges_bridge[true[part.name]], strict=True):
            placed = rigid.apply(pose @ rigid.invert(true_pose), _at_chainages(edge, line))
            distances.append(np.linalg.norm(line.nearest(placed)[1], axis=1))
    joined = np.concatenate([np.empty(0), *distances])
    return _over(np.mean, joined), _over(np.max, joined)
