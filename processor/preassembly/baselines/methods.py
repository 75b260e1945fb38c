"""The source paper's three methods, as baselines: corner (W1), line (W2) and design-aided (W3).

They chain the parts by the edges of their joints; ``design-aided`` also holds the bottom edges against the design's.
They state no uncertainty (:mod:`~processor.preassembly.baselines.bootstrap_bands` gives them a band), and their key
points lie on the inner edges of the plates. Source: paper 000.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from processor.geometry import rigid
from processor.geometry.neighbors import surface_spacing
from processor.geometry.polyline import Polyline
from processor.model import ArchDesign, Floats, Scan
from processor.preassembly import errors
from processor.preassembly.baselines import edge_features, joint_alignment
from processor.preassembly.params import Params
from processor.preassembly.parts import attitude
from processor.preassembly.result import Result

INNER_EDGES = "key points lie on the plates' inner edges"
NOWHERE = np.full((4, 4), np.nan)
GAUGES = {
    "corner": "Foot 1 at its principal-axes attitude, its joint corners on the design's",
    "line": "Foot 1 at its principal-axes attitude, its joint corners on the design's",
    "design-aided": "Foot 1 aligned to the design's lines",
}


@dataclass(frozen=True)
class Part:
    """What was taken from one scan: its attitude, joint ends (None where none was found) and bottom edges."""

    name: str
    scan: Scan
    attitude: attitude.Attitude
    ends: tuple[
        edge_features.JointEdges | None, edge_features.JointEdges | None
    ]  # start, end; scan's frame, origin taken off
    lines: Floats  # (n, 3) along both bottom edges, for matching; scan's frame
    edges: errors.BottomEdges  # the same from thicker slices, for the linear error
    trouble: str


@dataclass(frozen=True)
class Assembly:
    """The parts as placed: T_bridge_scan (4, 4), status and message of each, gaps (j, 8, 3), errors by both gauges."""

    poses: list[Floats]
    status: list[str]
    messages: list[str]
    gaps: Floats
    linear: errors.LinearError
    best_fit: errors.LinearError


def extract(scans: Sequence[Scan], design: ArchDesign, params: Params) -> list[Part]:
    """Take from every scan, in the design's order, what any of the methods needs."""
    return [
        features_of(scan, index, attitude.find(scan.points, design.parts[index]), design, params)
        for index, scan in enumerate(scans)
    ]


def assemble(parts: list[Part], design: ArchDesign, params: Params) -> Result:
    """Assemble extracted parts by the method of the parameters."""
    return _result(parts, place(parts, design, params), design, params)


def generator(params: Params, purpose: str) -> np.random.Generator:
    """Return the random numbers of one purpose."""
    return np.random.default_rng([params.seed, zlib.crc32(purpose.encode())])


def features_of(scan: Scan, index: int, found: attitude.Attitude, design: ArchDesign, params: Params) -> Part:
    """Take the features from the scan of the design's part ``index``, whose attitude is found."""
    part = design.parts[index]
    points = scan.points
    spacing = surface_spacing(points)
    ends: list[edge_features.JointEdges | None] = []
    trouble: list[str] = []
    for outward, joint in ((-1.0, index - 1), (1.0, index)):
        if not 0 <= joint < len(design.joint_names):
            ends.append(None)
            continue
        edges, said = _joint_end(points, found, design.joint_points[joint], outward, spacing, params, part.name)
        ends.append(edges)
        trouble += [f"{design.joint_names[joint]}: {said}"] if said else []
    slices = params.slices
    lines, checked = (
        edge_features.slice_edges(points, found.T_principal, spacing, thickness, slices)
        for thickness in (slices.thickness, slices.check_thickness)
    )
    bottom = errors.BottomEdges(
        *checked, Polyline.through(part.bottom_edge_left), Polyline.through(part.bottom_edge_right)
    )
    return Part(part.name, scan, found, (ends[0], ends[1]), np.vstack(lines), bottom, "; ".join(trouble))


def _joint_end(
    points: Floats,
    found: attitude.Attitude,
    design_points: Floats,
    outward: float,
    spacing: float,
    params: Params,
    purpose: str,
) -> tuple[edge_features.JointEdges | None, str]:
    """Edges of one joint end in the scan's frame, or None and the reason why there are none."""
    T_joint_scan = rigid.invert(edge_features.joint_frame(design_points)) @ found.T_principal
    corners = design_points[:4]
    size = np.array([np.linalg.norm(corners[0] - corners[1]), np.linalg.norm(corners[3] - corners[0])])
    cut = edge_features.cut_joint_end(points, T_joint_scan, outward, size, params.boxes)
    rng = generator(params, f"{purpose} {outward}")
    edges = edge_features.reduced_boxes(cut, outward, spacing, params.boxes, rng)
    if edges is None:
        return None, "no joint edges found"
    T_scan_joint = rigid.invert(T_joint_scan)
    edges = edge_features.JointEdges(
        rigid.apply(T_scan_joint, edges.points), rigid.apply(T_scan_joint, edges.key_points)
    )
    off = rigid.apply(found.T_surface, edges.key_points[:4]).mean(axis=0) - corners.mean(axis=0)
    distance = float(np.linalg.norm(off))
    if not distance <= params.end_limit_mm:
        return None, f"what was taken for the joint's end lies {distance:.0f} mm from where the design has it"
    return edges, ""


def place(parts: list[Part], design: ArchDesign, params: Params) -> Assembly:
    """Chain extracted parts by the method of the parameters, and say how they fit."""
    poses, messages = _chained(parts, design, params)
    joint_gaps = np.full((len(parts) - 1, 8, 3), np.nan)
    status = [_status(part, pose) for part, pose in zip(parts, poses, strict=True)]
    for j, (left, right) in enumerate(pairwise(range(len(parts)))):
        a, b = parts[left].ends[1], parts[right].ends[0]
        if a is not None and b is not None and "failed" not in (status[left], status[right]):
            joint_gaps[j] = errors.gaps(a.key_points, b.key_points, poses[left], poses[right])
            widest = float(np.abs(joint_gaps[j]).max())
            if widest > params.gap_limit_mm:
                messages[right] += f"; {design.joint_names[j]} gapes by {widest:.0f} mm: the alignment may have failed"
                status[right] = "weak" if status[right] == "ok" else status[right]
    edges = [part.edges for part in parts]
    to_design = parts[0].attitude.T_surface @ _inverse(poses[0])
    at_rest = [to_design @ pose for pose in poses]
    linear, best_fit = errors.linear_error(edges, poses), errors.linear_error(edges, at_rest)
    return Assembly(poses, status, messages, joint_gaps, linear, best_fit)


def _chained(parts: list[Part], design: ArchDesign, params: Params) -> tuple[list[Floats], list[str]]:
    """Chain the parts from the first: T_bridge_scan of each (NaN where the chain is broken) and a message each."""
    poses = [_place_first(parts[0], design, params)]
    messages = [""]
    for before, part in pairwise(parts):
        placement = _place_next(before, poses[-1], part, params)
        poses.append(placement.T_bridge_scan)
        messages.append(placement.message)
    return poses, messages


def _place_first(part: Part, design: ArchDesign, params: Params) -> Floats:
    end = part.ends[1]
    if end is None:
        return NOWHERE
    T = part.attitude.T_principal
    corners = design.joint_points[0][:4]
    T = _shifted(T, corners.mean(axis=0) - rigid.apply(T, end.key_points[:4]).mean(axis=0))
    if params.method != "design-aided":
        return T
    source = np.vstack([end.points, part.lines])
    target = np.vstack([_outline(corners, 5.0), _design_lines(part, 5.0)])
    return joint_alignment.by_lines(
        source, target, T, params.match, generator(params, "match " + part.name)
    ).T_bridge_scan


def _place_next(before: Part, T_before: Floats, part: Part, params: Params) -> joint_alignment.Placement:
    theirs, ours = before.ends[1], part.ends[0]
    if theirs is None or ours is None or not np.isfinite(T_before).all():
        return joint_alignment.Placement(NOWHERE, "not placed: the chain is broken before it")
    corners = rigid.apply(T_before, theirs.key_points[:4])
    if params.method == "corner":
        return joint_alignment.Placement(rigid.fit(ours.key_points[:4], corners), "")
    start = _shifted(
        part.attitude.T_principal,
        corners.mean(axis=0) - rigid.apply(part.attitude.T_principal, ours.key_points[:4]).mean(axis=0),
    )
    source, target = ours.points, rigid.apply(T_before, theirs.points)
    if params.method == "design-aided":
        source = np.vstack([source, part.lines])
        target = np.vstack([target, _design_lines(part, 5.0)])
    return joint_alignment.by_lines(source, target, start, params.match, generator(params, "match " + part.name))


def _shifted(T: Floats, by: Floats) -> Floats:
    return rigid.transform(T[:3, :3], T[:3, 3] + by)


def _outline(corners: Floats, spacing_mm: float) -> Floats:
    """Points (k, 3) along the rectangle of four corners."""
    ring = Polyline.through(np.vstack([corners, corners[:1]]))
    return ring.at(np.arange(0.0, ring.length, spacing_mm))


def _design_lines(part: Part, spacing_mm: float) -> Floats:
    """Points (k, 3) along both bottom edges of the design."""
    lines = (part.edges.design_left, part.edges.design_right)
    return np.vstack([line.at(np.arange(0.0, line.length, spacing_mm)) for line in lines])


def _result(parts: list[Part], placed: Assembly, design: ArchDesign, params: Params) -> Result:
    splicing_mean, splicing_max = errors.splicing_error(placed.gaps)
    said = [
        "; ".join(filter(None, (part.attitude.message, part.trouble, message.lstrip("; "))))
        for part, message in zip(parts, placed.messages, strict=True)
    ]
    some = any(one != "failed" for one in placed.status)
    return Result(
        status="ok" if all(one == "ok" for one in placed.status) else "partial" if some else "failed",
        method=params.method,
        message=f"no uncertainty is stated by this method; {INNER_EDGES}",
        components=tuple(part.name for part in parts),
        component_status=tuple(placed.status),
        component_message=tuple(said),
        component_scans=tuple(part.scan.name for part in parts),
        T_bridge_scan=np.array(
            [rigid.with_origin(pose, part.scan.origin) for pose, part in zip(placed.poses, parts, strict=True)]
        ),
        covariance=np.full((len(parts), 6, 6), np.nan),
        key_points_scan=np.array([[_key_points(part, end) for end in part.ends] for part in parts]),
        key_points_sd=np.full((len(parts), 2, 8, 3), np.nan),
        joints=design.joint_names,
        joint_left=design.joint_left,
        joint_right=design.joint_right,
        gaps=placed.gaps,
        gap_ci95=np.full_like(placed.gaps, np.nan),
        verdict=("indeterminate",) * len(placed.gaps),
        splicing_mean=splicing_mean,
        splicing_max=splicing_max,
        gauge=GAUGES[params.method],
        linear_mean=placed.linear.mean,
        linear_max=placed.linear.max,
        best_fit_linear_mean=placed.best_fit.mean,
        best_fit_linear_max=placed.best_fit.max,
        linear_station=placed.linear.station,
        linear_edge=placed.linear.edge,
        linear_deviation=placed.linear.deviation,
        best_fit_linear_deviation=placed.best_fit.deviation,
    )


def _inverse(T: Floats) -> Floats:
    return rigid.invert(T) if np.isfinite(T).all() else NOWHERE


def _status(part: Part, pose: Floats) -> str:
    if part.trouble or part.attitude.status == "failed" or not np.isfinite(pose).all():
        return "failed"
    return part.attitude.status


def _key_points(part: Part, end: edge_features.JointEdges | None) -> Floats:
    return np.full((8, 3), np.nan) if end is None else end.key_points + part.scan.origin
