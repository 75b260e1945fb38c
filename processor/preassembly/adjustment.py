"""Method ``adjustment``: every part registered to its design, its ends and edges measured, the chain adjusted at once.

Unlike the source paper's methods it uses all of a part's surface, states an interval for every gap, and says what the
gaps of imperfect parts depend on: the weight lambda of the design's curve against the joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.geometry.lines import Polyline
from processor.model import ArchDesign, DesignPart, Floats, Scan, UsageError
from processor.preassembly import attitude, bottom_edges, features, joint_ends, network, registration
from processor.preassembly.result import Result

EXPANSION_PER_K = 12e-6
REFERENCE_C = 20.0
TRADE_OFF = (1000.0, 1.0, 0.1, 0.01, 0.001)
NORMAL_95 = 1.959964
LIMIT_SOURCE = "GB 50205-2020 table 9.2.3, not verified"


@dataclass(frozen=True)
class AdjustParams:
    """Parameters of the adjustment."""

    weight: float = 0.1  # lambda: of a squared departure of the edges from the design, against a squared gap
    misalignment_limit_mm: float = 2.0  # across a joint: GB 50205-2020 table 9.2.3, not verified

    def __post_init__(self) -> None:
        if not self.weight > 0.0:
            raise UsageError(f"preassemble.adjust.weight: expected a number above 0, got {self.weight!r}")


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


def measure(scan: Scan, index: int, design: ArchDesign, shrink: float) -> Measured:
    """Register one part and measure its ends and edges; ``index`` is its place in the design's order."""
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
        ends.append(end)
    lines = (Polyline.through(part.bottom_edge_left), Polyline.through(part.bottom_edge_right))
    edges = bottom_edges.measure(moved, surface, *lines, fitted.sigma_mm, fitted.covariance)
    member = network.Member((ends[0], ends[1]), edges, part.vertices.mean(axis=0))
    if fitted.weak:
        said_of.append(f"what the scan shows does not hold {' and '.join(fitted.weak)}")
    weak = bool(fitted.weak) or any(end is not None and end.trouble for end in ends)
    status = "ambiguous" if found.status == "ambiguous" else "weak" if weak else "ok"
    return Measured(part.name, status, "; ".join(said_of), fitted.T_bridge_scan, fitted.covariance, member, shrink)


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
    return Measured(part.name, "failed", message, np.full((4, 4), np.nan), np.full((6, 6), np.nan), member, shrink)


def assemble(scans: Sequence[Scan], design: ArchDesign, params: AdjustParams, temperature_C: float) -> Result:
    """Assemble scans in the design's order."""
    degrees = temperature_C - REFERENCE_C if np.isfinite(temperature_C) else 0.0
    shrink = 1.0 / (1.0 + EXPANSION_PER_K * degrees)
    parts = [measure(scan, index, design, shrink) for index, scan in enumerate(scans)]
    frames = np.array([features.joint_frame(points) for points in design.joint_points])
    members = [part.member for part in parts]
    curve = {weight: network.adjust(members, design.joint_points, frames, weight) for weight in TRADE_OFF}
    adjusted = network.adjust(members, design.joint_points, frames, params.weight)
    sd = np.sqrt(np.einsum("jkk->jk", adjusted.gap_covariance)).reshape(-1, 8, 3)
    poses = np.array([motion @ part.T_bridge_scan for motion, part in zip(adjusted.motions, parts, strict=True)])
    key_points, key_sd = _key_points(parts, scans, design, frames)
    placed = np.array([_with_origin(T, scan.origin * shrink) for T, scan in zip(poses, scans, strict=True)])
    ends = np.array(
        [[rigid.apply(T, end * shrink) for end in both] for T, both in zip(placed, key_points, strict=True)]
    )
    gaps = ends[1:, 0] - ends[:-1, 1]  # the linear answer's, but for its second order
    assembled = np.concatenate([_size(one) for one in adjusted.departures])
    best_fit = np.concatenate(_with_first_at_rest(members, adjusted))
    trade = np.array([_figures(curve[weight]) for weight in TRADE_OFF])
    statuses = [part.status for part in parts]
    alone = "temperature corrected" if degrees else "no temperature given: taken as the reference"
    mean, largest = _mean_max(np.abs(gaps))
    return Result(
        status=_overall(statuses),
        method="adjustment",
        message=f"lambda {params.weight:g}; {alone}; limit of misalignment {params.misalignment_limit_mm:g} mm "
        f"({LIMIT_SOURCE}); intervals hold noise alone: add registration and scanner errors of the scans",
        components=tuple(part.name for part in parts),
        component_status=tuple(statuses),
        component_message=tuple(part.message for part in parts),
        T_bridge_scan=placed,
        covariance=_pose_covariances(parts, adjusted, placed),
        key_points_scan=key_points,
        key_points_sd=key_sd,
        joints=design.joint_names,
        joint_left=design.joint_left,
        joint_right=design.joint_right,
        gaps=gaps,
        gap_ci95=NORMAL_95 * sd,
        verdict=_verdicts(adjusted, frames, params.misalignment_limit_mm),
        splicing_mean=mean,
        splicing_max=largest,
        gauge=f"all joints and the design's curve at once, lambda {params.weight:g}",
        linear_mean=_mean_max(assembled)[0],
        linear_max=_mean_max(assembled)[1],
        best_fit_linear_mean=_mean_max(best_fit)[0],
        best_fit_linear_max=_mean_max(best_fit)[1],
        linear_station=_stations(design, members),
        linear_edge=tuple(side for member in members for side in member.edges.side),
        linear_deviation=assembled,
        best_fit_linear_deviation=best_fit,
        trade_lambda=np.array(TRADE_OFF),
        trade_figures=trade,
        weight=params.weight,
    )


def _pose_covariances(parts: Sequence[Measured], adjusted: network.Adjusted, placed: Floats) -> Floats:
    """Covariances (c, 6, 6) of the assembled poses, NaN of parts without one.

    The registration's own error cancels: ends and edges were measured from where it puts the part.
    """
    found = np.full((len(parts), 6, 6), np.nan)
    for i, part in enumerate(parts):
        if np.isfinite(placed[i]).all():
            found[i] = registration.about_origin(adjusted.motion_covariance[i], part.member.middle)
    return found


def _overall(statuses: Sequence[str]) -> str:
    if all(one == "ok" for one in statuses):
        return "ok"
    return "failed" if all(one == "failed" for one in statuses) else "partial"


def _with_origin(T: Floats, origin: Floats) -> Floats:
    return rigid.transform(T[:3, :3], T[:3, 3] - T[:3, :3] @ origin)


def _key_points(
    parts: Sequence[Measured], scans: Sequence[Scan], design: ArchDesign, frames: Floats
) -> tuple[Floats, Floats]:
    """Key points (c, 2, 8, 3) as scanned, and the standard deviation of each coordinate."""
    points, spreads = np.full((len(parts), 2, 8, 3), np.nan), np.full((len(parts), 2, 8, 3), np.nan)
    for i, (part, scan) in enumerate(zip(parts, scans, strict=True)):
        for e, joint in enumerate((i - 1, i)):
            end = part.member.ends[e]
            if end is None or not np.isfinite(end.moved).all():
                continue
            R = frames[joint][:3, :3]
            there = design.joint_points[joint] + end.moved @ R.T
            points[i, e] = rigid.apply(rigid.invert(part.T_bridge_scan), there) / part.shrink + scan.origin
            turn = part.T_bridge_scan[:3, :3].T @ R
            for k in range(8):
                block = end.covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
                spreads[i, e, k] = np.sqrt(np.diag(turn @ block @ turn.T)) / part.shrink
    return points, spreads


def _size(departure: Floats) -> Floats:
    found: Floats = np.linalg.norm(departure, axis=1)
    return found


def _with_first_at_rest(members: Sequence[network.Member], adjusted: network.Adjusted) -> list[Floats]:
    """Departures (k,) of every part with the whole bridge moved so that the first part lies on its design."""
    back = rigid.invert(adjusted.motions[0])
    found = []
    for member, departure in zip(members, adjusted.departures, strict=True):
        edges = member.edges
        at = edges.points + np.einsum("ka,kai->ki", departure, edges.axes)
        moved = rigid.apply(back, at) - edges.points
        found.append(_size(np.einsum("kai,ki->ka", edges.axes, moved)))
    return found


def _stations(design: ArchDesign, members: Sequence[network.Member]) -> Floats:
    """Arc lengths of all stations from the start of the design's bottom edge."""
    found, before = [], {"left": 0.0, "right": 0.0}
    for part, member in zip(design.parts, members, strict=True):
        start = np.array([before[side] for side in member.edges.side])
        found.append(start + member.edges.arc)
        before["left"] += Polyline.through(part.bottom_edge_left).length
        before["right"] += Polyline.through(part.bottom_edge_right).length
    return np.concatenate(found)


def _mean_max(values: Floats) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    return (float(known.mean()), float(known.max())) if len(known) else (float("nan"), float("nan"))


def _figures(adjusted: network.Adjusted) -> tuple[float, float, float, float]:
    sizes = np.concatenate([_size(one) for one in adjusted.departures])
    return (*_mean_max(np.abs(adjusted.gaps)), *_mean_max(sizes))


def _verdicts(adjusted: network.Adjusted, frames: Floats, limit: float) -> tuple[str, ...]:
    """Judge each joint's misalignment across it by ISO 14253-1: only what is surely within or without is said so."""
    found = []
    for gaps, covariance, frame in zip(adjusted.gaps, adjusted.gap_covariance, frames, strict=True):
        R = frame[:3, :3]
        across = np.abs(gaps @ R)[:, 1:]
        turn = np.kron(np.eye(8), R.T)
        spread = NORMAL_95 * np.sqrt(np.diag(turn @ covariance @ turn.T)).reshape(8, 3)[:, 1:]
        if not np.isfinite(across).all():
            found.append("indeterminate")
        elif (across + spread <= limit).all():
            found.append("pass")
        else:
            found.append("fail" if (across - spread > limit).any() else "indeterminate")
    return tuple(found)
