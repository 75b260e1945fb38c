"""The source paper's three methods, as baselines: corner (W1), line (W2) and design-aided (W3).

They chain the parts by the edges of their joints: ``corner`` pairs the four scanned points at the corners of a joint,
``line`` aligns the points on its edges, ``design-aided`` aligns them together with the bottom edges, with the design's
as their target. They state no uncertainty, and
their key points lie on the inner edges of the plates. Source: paper 000.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from processor import diagnostics
from processor.geometry import rigid
from processor.geometry.lines_and_polylines import Polyline
from processor.geometry.nearest_neighbours import surface_spacing
from processor.geometry.thinning import by_cell
from processor.model import ArchDesign, Floats, Reason, Scan, Status, Verdict, reason
from processor.preassembly import assembly_errors
from processor.preassembly.baselines import edge_features, joint_alignment
from processor.preassembly.baselines.edge_features import JointEdges
from processor.preassembly.baselines.joint_alignment import Alignment
from processor.preassembly.ends.joint_frame import joint_frame
from processor.preassembly.params import Params
from processor.preassembly.parts import attitude, measure
from processor.preassembly.parts.attitude import Attitude
from processor.preassembly.parts.each_part import each_part
from processor.preassembly.result import (
    Components,
    Deviations,
    EdgeSide,
    Gauge,
    Joints,
    Linear,
    MeanMax,
    Result,
    overall_status,
)

NOWHERE = np.full((4, 4), np.nan)  # no pose
LINE_SPACING_MM = 5.0  # of points along the design's lines
GAUGES = {"corner": Gauge.PRINCIPAL_AXES, "line": Gauge.PRINCIPAL_AXES, "design-aided": Gauge.LINES}


@dataclass(frozen=True)
class PartFeatures:
    """Features of one scan, in its frame with the origin taken off."""

    name: str
    scan: Scan
    attitude: Attitude
    ends: tuple[JointEdges | None, JointEdges | None]  # start, end
    lines: Floats  # (n, 3) along both bottom edges, for the alignment
    edges: assembly_errors.BottomEdges  # the same from thicker slices, for the linear error
    reasons: tuple[Reason, ...]  # why a joint end was not found


@dataclass(frozen=True)
class Assembly:
    """The parts as placed: T_bridge_scan (4, 4), status and remarks of each, gaps (j, 8, 3), errors by both gauges."""

    poses: list[Floats]
    status: list[Status]
    reasons: list[tuple[Reason, ...]]
    gaps: Floats
    linear: assembly_errors.LinearError
    best_fit: assembly_errors.LinearError


def extract(
    scans: Sequence[Scan], design: ArchDesign, params: Params, known: Mapping[int, Attitude] | None = None
) -> list[PartFeatures]:
    """Extract the features for all methods from every scan, in the design's order.

    Attitudes that are ``known``, by the numbers of the parts, are not searched for again.
    """
    known = known or {}

    def of_part(k: int) -> PartFeatures:
        # By points in the order that the adjustment has them in
        pose = (
            known[k] if k in known else attitude.find(by_cell(scans[k].points, measure.CELL_MM).points, design.parts[k])
        )
        return features_of(scans[k], k, pose, design, params)

    return each_part(of_part, [[scan] for scan in scans])


def assemble(parts: list[PartFeatures], design: ArchDesign, params: Params) -> Result:
    """Assemble parts by the method of the parameters."""
    return _result(parts, place(parts, design, params), design, params)


def generator(params: Params, purpose: str) -> np.random.Generator:
    """Return the random number generator of one purpose."""
    return np.random.default_rng([params.seed, zlib.crc32(purpose.encode())])


def features_of(scan: Scan, index: int, pose: Attitude, design: ArchDesign, params: Params) -> PartFeatures:
    """Extract the features from the scan of the design's part ``index`` with a known attitude."""
    part = design.parts[index]
    points = scan.points
    spacing = surface_spacing(points)
    ends: list[JointEdges | None] = []
    reasons: list[Reason] = []
    for outward, joint in ((-1.0, index - 1), (1.0, index)):
        if not 0 <= joint < len(design.joint_names):
            ends.append(None)
            continue
        rng = generator(params, f"{part.name} {outward}")
        with _in_scan(scan), diagnostics.at(f"{part.name} at {design.joint_names[joint]}"):
            edges, missing = _joint_end(points, pose, design.joint_points[joint], outward, spacing, params, rng)
        ends.append(edges)
        if missing is not None:
            reasons.append(reason("preassemble.at", place=design.joint_names[joint], reasons=(missing,)))
    slices = params.slices
    with _in_scan(scan), diagnostics.at(part.name):
        lines, checked = (
            edge_features.slice_edges(points, pose.T_principal, spacing, thickness, slices)
            for thickness in (slices.thickness, slices.check_thickness)
        )
    bottom = assembly_errors.BottomEdges(
        *checked, Polyline.through(part.bottom_edge_left), Polyline.through(part.bottom_edge_right)
    )
    return PartFeatures(
        name=part.name,
        scan=scan,
        attitude=pose,
        ends=(ends[0], ends[1]),
        lines=np.vstack(lines),
        edges=bottom,
        reasons=tuple(reasons),
    )


def _in_scan(scan: Scan) -> AbstractContextManager[None]:
    return diagnostics.placed(rigid.transform(np.eye(3), scan.origin), f"scan {scan.name}")


def place(parts: list[PartFeatures], design: ArchDesign, params: Params) -> Assembly:
    """Chain parts by the method of the parameters, with their gaps and errors."""
    poses, remarks = _chain(parts, design, params)
    gaps = np.full((len(parts) - 1, 8, 3), np.nan)
    status = [_status(part, pose) for part, pose in zip(parts, poses, strict=True)]
    for j, (left, right) in enumerate(pairwise(range(len(parts)))):
        a, b = parts[left].ends[1], parts[right].ends[0]
        if a is not None and b is not None and Status.FAILED not in (status[left], status[right]):
            gaps[j] = rigid.apply(poses[right], b.key_points) - rigid.apply(poses[left], a.key_points)
            widest = float(np.abs(gaps[j]).max())
            if widest > params.gap_limit_mm:
                wide = reason("preassemble.wide-gap", joint=design.joint_names[j], gap=widest)
                remarks[right] = (*remarks[right], wide)
                status[right] = Status.WEAK if status[right] == Status.OK else status[right]
    edges = [part.edges for part in parts]
    to_design = parts[0].attitude.T_surface @ (rigid.invert(poses[0]) if np.isfinite(poses[0]).all() else NOWHERE)
    return Assembly(
        poses=poses,
        status=status,
        reasons=remarks,
        gaps=gaps,
        linear=assembly_errors.linear_error(edges, poses),
        best_fit=assembly_errors.linear_error(edges, [to_design @ pose for pose in poses]),
    )


def _joint_end(
    points: Floats,
    pose: Attitude,
    design_points: Floats,
    outward: float,
    spacing: float,
    params: Params,
    rng: np.random.Generator,
) -> tuple[JointEdges | None, Reason | None]:
    """Edges of one joint end in the scan's frame, or the reason why there are none."""
    T_joint_scan = rigid.invert(joint_frame(design_points)) @ pose.T_principal
    corners = design_points[:4]
    size = np.array([np.linalg.norm(corners[0] - corners[1]), np.linalg.norm(corners[3] - corners[0])])
    cut = edge_features.cut_joint_end(points, T_joint_scan, outward, size, params.boxes)
    with diagnostics.placed(rigid.invert(T_joint_scan)):
        diagnostics.note("cut end", points=len(cut))
        diagnostics.keep("cut end", cut)
        edges = edge_features.reduced_boxes(cut, outward, spacing, params.boxes, rng)
    if edges is None:
        return None, reason("preassemble.no-joint-edges")
    edges = edges.moved(rigid.invert(T_joint_scan))
    off = rigid.apply(pose.T_surface, edges.key_points[:4]).mean(axis=0) - corners.mean(axis=0)
    distance = float(np.linalg.norm(off))
    if not distance <= params.end_limit_mm:
        return None, reason("preassemble.joint-end-misplaced", distance=distance)
    return edges, None


def _chain(
    parts: list[PartFeatures], design: ArchDesign, params: Params
) -> tuple[list[Floats], list[tuple[Reason, ...]]]:
    """Chain the parts from the first: T_bridge_scan of each (NaN where the chain is broken), and remarks on each."""
    with diagnostics.at(parts[0].name):
        poses = [_place_first(parts[0], design, params)]
    reasons: list[tuple[Reason, ...]] = [()]
    for before, part in pairwise(parts):
        with diagnostics.at(part.name):
            alignment = _place_next(before, poses[-1], part, params)
        poses.append(alignment.T_bridge_scan)
        reasons.append(alignment.reasons)
    return poses, reasons


def _place_first(part: PartFeatures, design: ArchDesign, params: Params) -> Floats:
    end = part.ends[1]
    if end is None:
        return NOWHERE
    corners = design.joint_points[0][:4]
    T = _at_corners(part.attitude.T_principal, end, corners)
    if params.method != "design-aided":
        return T
    ring, lines = _ring(corners), (part.edges.design_left, part.edges.design_right)
    outline = ring.at(np.arange(0.0, ring.length, LINE_SPACING_MM))
    source, target = np.vstack([end.points, part.lines]), np.vstack([outline, _design_lines(part)])
    rng = generator(params, "match " + part.name)
    return joint_alignment.by_lines(source, target, (ring, *lines), T, params.match, rng).T_bridge_scan


def _place_next(before: PartFeatures, T_before: Floats, part: PartFeatures, params: Params) -> Alignment:
    end_before, end = before.ends[1], part.ends[0]
    if end_before is None or end is None or not np.isfinite(T_before).all():
        return Alignment(NOWHERE, (reason("preassemble.chain-broken"),))
    if params.method == "corner":
        return Alignment(rigid.fit(end.corners, rigid.apply(T_before, end_before.corners)))
    corners = rigid.apply(T_before, end_before.key_points[:4])
    start = _at_corners(part.attitude.T_principal, end, corners)
    source, target = end.points, rigid.apply(T_before, end_before.points)
    lines = [_ring(corners)]
    if params.method == "design-aided":
        source = np.vstack([source, part.lines])
        target = np.vstack([target, _design_lines(part)])
        lines += [part.edges.design_left, part.edges.design_right]
    return joint_alignment.by_lines(source, target, lines, start, params.match, generator(params, "match " + part.name))


def _ring(corners: Floats) -> Polyline:
    """Return the outline through the corners (4, 3) of a joint: its four edges."""
    return Polyline.through(np.vstack([corners, corners[:1]]))


def _at_corners(T: Floats, end: JointEdges, corners: Floats) -> Floats:
    """Shift a pose so that the middle of the end's corners is that of ``corners`` (4, 3)."""
    shift = corners.mean(axis=0) - rigid.apply(T, end.key_points[:4]).mean(axis=0)
    return rigid.transform(T[:3, :3], T[:3, 3] + shift)


def _design_lines(part: PartFeatures) -> Floats:
    """Points (k, 3) along both bottom edges of the design."""
    lines = (part.edges.design_left, part.edges.design_right)
    return np.vstack([line.at(np.arange(0.0, line.length, LINE_SPACING_MM)) for line in lines])


def _status(part: PartFeatures, pose: Floats) -> Status:
    if part.reasons or part.attitude.status == Status.FAILED or not np.isfinite(pose).all():
        return Status.FAILED
    return part.attitude.status


def _result(parts: list[PartFeatures], assembly: Assembly, design: ArchDesign, params: Params) -> Result:
    splicing_mean, splicing_max = assembly_errors.splicing_error(assembly.gaps)
    components = Components(
        name=tuple(part.name for part in parts),
        status=tuple(assembly.status),
        reasons=tuple(
            (*part.attitude.reasons, *part.reasons, *remarks)
            for part, remarks in zip(parts, assembly.reasons, strict=True)
        ),
        scans=tuple(part.scan.name for part in parts),
        T_bridge_scan=np.array(
            [rigid.with_origin(pose, part.scan.origin) for pose, part in zip(assembly.poses, parts, strict=True)]
        ),
        covariance=np.full((len(parts), 6, 6), np.nan),
        key_points_scan=np.array([[_key_points(part, end) for end in part.ends] for part in parts]),
        key_points_sd=np.full((len(parts), 2, 8, 3), np.nan),
    )
    return Result(
        status=overall_status(components.status),
        method=params.method,
        reasons=(reason("preassemble.no-uncertainty"), reason("preassemble.inner-edges")),
        components=components,
        joints=Joints(
            name=design.joint_names,
            left=design.joint_left,
            right=design.joint_right,
            gaps=assembly.gaps,
            gap_ci95=np.full_like(assembly.gaps, np.nan),
            verdict=(Verdict.INDETERMINATE,) * len(assembly.gaps),
        ),
        splicing=MeanMax(mean=splicing_mean, max=splicing_max),
        linear=Linear(
            gauge=GAUGES[params.method],
            chainage=assembly.linear.chainage,
            edge=tuple(map(EdgeSide, assembly.linear.edge)),
            assembled=_deviations(assembly.linear),
            best_fit=_deviations(assembly.best_fit),
        ),
    )


def _deviations(error: assembly_errors.LinearError) -> Deviations:
    return Deviations(error=MeanMax(mean=error.mean, max=error.max), deviation=error.deviation)


def _key_points(part: PartFeatures, end: JointEdges | None) -> Floats:
    return np.full((8, 3), np.nan) if end is None else end.key_points + part.scan.origin
