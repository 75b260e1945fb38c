"""One part of the bridge as scanned: registered to its design, its ends and edges measured, or why that failed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.geometry.lines import Polyline
from processor.geometry.mesh_surface import MeshSurface
from processor.model import ArchDesign, DesignPart, Floats, Scan
from processor.preassembly import (
    attitude,
    bottom_edges,
    features,
    joint_ends,
    network,
    registration,
    systematic,
)
from processor.preassembly.systematic import SystematicParams

RESIDUALS = 4_000  # points of a part whose distances from the design are kept


@dataclass(frozen=True)
class Measured:
    """One part as measured: pose by its whole surface, ends, edges; scan frame with the origin taken off."""

    name: str
    status: str  # ok | ambiguous | weak | failed
    message: str
    T_bridge_scan: Floats
    covariance: Floats
    member: network.Member
    shrink: float  # lengths at the reference temperature by lengths as scanned
    T_rival: Floats  # (4, 4) of an ambiguous part: the other pose that fits as well; NaN of others
    residual_points: Floats  # (r, 3) of the scan, thinned, on the design
    residuals: Floats  # (r,) from the design's surface, outward


def measure(scan: Scan, index: int, design: ArchDesign, shrink: float, doubts: SystematicParams) -> Measured:
    """Register one part and measure its ends and edges; ``index`` is its place in the design's order.

    ``doubts`` are added to the covariance of both.
    """
    part, points = design.parts[index], scan.points * shrink
    design_surface = attitude.sample_surface(part)
    found = attitude.find(points, part, design_surface)
    joints = [j if 0 <= j < len(design.joint_names) else None for j in (index - 1, index)]
    if found.status == "failed":
        return _failed(part, joints, found.message, shrink)
    surface = design_surface.mesh
    fitted = registration.fine(points, surface, design_surface.axes, found.T_surface)
    if not (fitted.used_share > registration.LEAST_SHARE and np.isfinite(fitted.covariance).all()):
        said = f"only {fitted.used_share:.0%} of the points lie near the design's surface"
        return _failed(part, joints, f"{said}; {_looks_like(points, design, part)}", shrink)
    if not registration.fits(fitted):
        said = f"{1.0 - fitted.used_share:.0%} of the points are away from the design's surface, "
        said += f"the others typically {fitted.sigma_mm / 1.4826:.0f} mm"
        return _failed(part, joints, f"{said}; {_looks_like(points, design, part)}", shrink)
    moved = rigid.apply(fitted.T_bridge_scan, points)
    ends: list[joint_ends.JointEnd | None] = []
    said_of: list[str] = [found.message] if found.message else []
    for outward, joint in zip((-1.0, 1.0), joints, strict=True):
        if joint is None:
            ends.append(None)
            continue
        corners = design.joint_points[joint]
        end = joint_ends.fit(moved, surface, features.joint_frame(corners), corners[:4], outward, fitted.covariance)
        said_of += [f"{design.joint_names[joint]}: {end.trouble}"] if end.trouble else []
        ends.append(systematic.of_end(end, doubts, part))
    lines = (Polyline.through(part.bottom_edge_left), Polyline.through(part.bottom_edge_right))
    edges = bottom_edges.measure(moved, surface, *lines, fitted.sigma_mm, fitted.covariance)
    edges = systematic.of_edges(edges, doubts)
    member = network.Member((ends[0], ends[1]), edges, part.vertices.mean(axis=0))
    if fitted.weak:
        said_of.append(f"what the scan shows does not hold {' and '.join(fitted.weak)}")
    weak = bool(fitted.weak) or any(end is not None and end.trouble for end in ends)
    status = "ambiguous" if found.status == "ambiguous" else "weak" if weak else "ok"
    return Measured(
        part.name, status, "; ".join(said_of), fitted.T_bridge_scan, fitted.covariance, member, shrink, found.T_rival,
        *_residuals(moved, surface),
    )  # fmt: skip


def _residuals(moved: Floats, surface: MeshSurface) -> tuple[Floats, Floats]:
    """Return thinned points (r, 3) and their distances (r,) from the design's surface."""
    thin = moved[:: max(1, len(moved) // RESIDUALS)]
    face, distance, beyond = surface.distances(thin, 60.0)
    near = (face >= 0) & (beyond < 1.0)
    return thin[near], distance[near]


def _looks_like(points: Floats, design: ArchDesign, part: DesignPart) -> str:
    """Say which part of the design has the size of the scan."""
    size = _size_of(points)
    apart = [float(np.abs(_size_of(one.vertices) - size).max()) for one in design.parts]
    nearest = design.parts[int(np.argmin(apart))]
    if nearest.name == part.name or min(apart) > 0.5 * apart[design.parts.index(part)]:
        return "is this the right part, and whole?"
    return f"by its size it is rather {nearest.name}"


def _size_of(points: Floats) -> Floats:
    """Return the sizes (3,) of points (n, 3) along their principal axes."""
    middle = points.mean(axis=0)
    axes = np.linalg.eigh(np.cov((points - middle).T))[1]
    found: Floats = np.sort(np.ptp((points - middle) @ axes, axis=0))
    return found


def _failed(part: DesignPart, joints: Sequence[int | None], message: str, shrink: float) -> Measured:
    ends = tuple(None if joint is None else joint_ends.nothing(message) for joint in joints)
    lines = (Polyline.through(part.bottom_edge_left), Polyline.through(part.bottom_edge_right))
    edges = bottom_edges.unseen(*lines)
    member = network.Member((ends[0], ends[1]), edges, part.vertices.mean(axis=0))
    nowhere, nothing = np.full((4, 4), np.nan), np.full((6, 6), np.nan)
    no_points = np.empty((0, 3))
    return Measured(part.name, "failed", message, nowhere, nothing, member, shrink, nowhere, no_points, np.empty(0))
