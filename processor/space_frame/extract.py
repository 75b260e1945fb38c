"""Method ``ray``: every sphere of a frame, by its members, the stations against each other, the spheres, the design.

Source: paper 001 has the spheres and their two estimators; this method starts from the members instead of a crop about
each nominal node.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from processor.adjustment import scanner_class_errors
from processor.adjustment.body_motions import point_covariances
from processor.adjustment.control_points import Sightings
from processor.geometry import rigid
from processor.model import DESIGN_FRAMES, Bools, Floats, FrameDesign, Ints, Reason, Status, Tolerance, reason
from processor.space_frame.ball_catalogue import Catalogue
from processor.space_frame.design import matching
from processor.space_frame.design.matching import Matching, NodePattern
from processor.space_frame.design.movement import Movement, movement
from processor.space_frame.members import junctions, member_extraction
from processor.space_frame.members.member_extraction import Measured
from processor.space_frame.members.records import Members, Nodes
from processor.space_frame.points.source import Source
from processor.space_frame.result import NAN, Flag, MovementGauge
from processor.space_frame.spheres import alternating_fit, assessment, ball_joint_classification
from processor.space_frame.spheres.records import Spheres
from processor.space_frame.stations import registration
from processor.space_frame.stations.corrected_source import Corrected, corrected_gathered
from processor.space_frame.stations.records import Stations, StationStatus, moved_by_offset
from processor.space_frame.stations.tube_points import tube_points

SAME_FRAME_SHARE = 0.6  # of the design's nodes that are found in their places: the frames are the same
NEAR_MM = 40.0  # of a node's nominal place, in the same frame
NOMINAL_SD_MM = 20.0  # of a node that no axes fix, about its nominal place
USABLE = (StationStatus.OK, StationStatus.WEAK)  # corrections that are applied
LEAST_STATION_SD_MM = 0.15  # stations with smaller shifts are not corrected


@dataclass(frozen=True)
class Options:
    """Options of the method.

    ``expansion`` is the factor of the design's lengths by temperature. Where no control points fix the datum, all
    stations share a shift of standard deviation ``datum_mm`` beside their own. ``limits`` has the tolerance of a
    sphere's radius, for spheres without a catalogue's size.
    """

    members: member_extraction.Params = field(default_factory=member_extraction.Params)
    expansion: float = 1.0
    register_stations: bool = True
    datum_mm: float = 0.0
    limits: Tolerance | None = None


@dataclass(frozen=True)
class Extracted:
    """Result of the method; places are less the source's origin.

    Rows are nodes: found blind, or those of the design in its order and then further ones found. ``design_row`` (k,)
    is the row of the design, -1 = none. ``datum`` (k, 3, 3) is the part of a centre's covariance that is common to all
    nodes; the spheres' own covariance excludes it. ``source`` has the points with the stations' corrections.
    ``movement_otherwise`` is by the other gauge, where there is one; ``georeference_sd``, mm, is that of a shift of all
    nodes along an axis of the project's frame.
    """

    source: Source
    nodes: Nodes
    members: Members
    spheres: Spheres
    design_row: Ints
    datum: Floats
    stations: Stations | None = None
    matching: Matching | None = None
    movement: Movement | None = None
    movement_otherwise: Movement | None = None
    georeference_sd: float = NAN
    reasons: tuple[Reason, ...] = ()


@dataclass(frozen=True)
class Start:
    """Nodes known to 20 mm, and pairs of them that a member may join; the design's row (k,) of each, -1 = none.

    ``balls`` (k,) are the nodes that have a ball; the members of others are measured as well, for the stations'
    registration. ``pose`` is the matching that gave T_design_scan, where the design had to be located.
    """

    positions: Floats
    pairs: Ints
    design_row: Ints
    measured: Measured
    balls: Bools
    pose: Matching | None = None
    reasons: tuple[Reason, ...] = ()

    def of_nodes(self, kept: Bools) -> Start:
        """Keep some of the nodes (k,)."""
        return replace(self, positions=self.positions[kept], design_row=self.design_row[kept], balls=self.balls[kept])


@dataclass(frozen=True)
class _Registered:
    """Source and members after the stations' corrections; no ``stations`` where they were not registered."""

    source: Source
    measured: Measured
    stations: Stations | None = None

    @property
    def trusted(self) -> Stations | None:
        """The stations, if their covariance may be used."""
        return self.stations if self.stations is not None and self.stations.status in USABLE else None

    @property
    def mean_variance(self) -> float:
        """Variance, mm^2, of the stations' mean place along an axis, where tubes do not correct it; of one alone 0.

        Their errors are independent, and of the size by which they disagree: of one that is too small to be corrected
        only the bound is known, any smaller one is as likely (GUM, 4.3.7).
        """
        known = self.stations is None or self.stations.status is not StationStatus.UNKNOWN
        count = len(self.source.scanners)
        variance = max(self.measured.station_sd_mm**2, LEAST_STATION_SD_MM**2 / 3.0)
        return variance / count if known and count > 1 else 0.0

    def by_shared_offset(self, points: Floats, unnamed: bool) -> Floats:
        """Return the changes (k, 3) of points (k, 3) by an offset common to all ranges, one standard deviation.

        No residual shows it. The errors of ``unnamed`` views have it already.
        """
        places = self.source.scanners
        if unnamed or not len(places):
            return np.zeros_like(points)
        sd = scanner_class_errors.mean_offset_sd(len(places))
        return (sd if self.stations is None else self.stations.shared_offset_sd) * moved_by_offset(points, places)

    def datum_at(self, points: Floats, datum_mm: float) -> Floats:
        """Covariance (k, 3, 3) at points (k, 3) by the motion common to all stations."""
        if self.trusted is None:
            around = points - points.mean(axis=0)
            return point_covariances(around, _of_mean(around, self.mean_variance)) + datum_mm**2 * np.eye(3)
        return self.trusted.datum_at(points)


def extract(
    source: Source,
    design: FrameDesign | None,
    catalogue: Catalogue,
    options: Options,
    control: Sightings | None = None,
) -> Extracted | None:
    """Find every node of a frame; None where the cloud has no members that meet."""
    params = options.members
    start = blind(source, params) if design is None else _designed(source, design, catalogue, options)
    if start is None:
        return None
    registered = _register(source, start, control, options)
    measured = registered.measured
    kept = (start.design_row >= 0) | (start.balls & member_extraction.meeting(measured, params.largest_scatter_mm))
    if not kept.any():
        return None
    measured, start = member_extraction.of_nodes(measured, kept), start.of_nodes(kept)
    nodes, spheres = _fit_spheres(registered.source, measured, start, design, catalogue, options, registered.trusted)
    by_offset = registered.by_shared_offset(spheres.centres, spheres.views is not None)
    shared_offset = by_offset[:, :, None] * by_offset[:, None]
    if registered.stations is not None:
        spheres = assessment.with_shared_offset(spheres, shared_offset)
    matched, georeference_sd = None, NAN
    compared: list[Movement] = []
    if design is not None and (start.design_row >= 0).any():
        matched, compared, georeference_sd = _compare(registered, spheres, by_offset, design, start.pose, options)
        if matched.status is Status.AMBIGUOUS:
            listed = start.pose is not None and len(start.pose.rivals) > 0
            spheres = assessment.with_ambiguous_matching(spheres, start.design_row >= 0, listed)
    of_stations = registered.stations.messages if registered.stations is not None else ()
    return Extracted(
        source=registered.source,
        nodes=nodes,
        members=measured.members,
        spheres=spheres,
        design_row=start.design_row,
        datum=registered.datum_at(spheres.centres, options.datum_mm) + shared_offset,
        stations=registered.stations,
        matching=matched,
        movement=compared[0] if compared else None,
        movement_otherwise=compared[1] if len(compared) > 1 else None,
        georeference_sd=georeference_sd,
        reasons=(*start.reasons, *of_stations),
    )


# --- nodes and members -----------------------------------------------------------------------------------------------


def blind(source: Source, params: member_extraction.Params) -> Start | None:
    """Find nodes and members without a design."""
    lines = member_extraction.rough_lines(source, params)
    graph = junctions.graph(lines) if len(lines.points) > 1 else None
    if graph is None or not len(graph.pairs):
        return None
    rows = np.full(len(graph.nodes), -1, np.int64)
    start = _measured(source, graph.nodes, graph.pairs, rows, params)
    start = replace(
        start, balls=ball_joint_classification.nodes_with_ball(source, start.measured, start.positions, params.threads)
    )
    others = int((~start.balls & member_extraction.meeting(start.measured, params.largest_scatter_mm)).sum())
    return replace(start, reasons=(reason("spheres.other-joints", joints=others),)) if others else start


def _measured(
    source: Source,
    positions: Floats,
    pairs: Ints,
    rows: Ints,
    params: member_extraction.Params,
    pose: Matching | None = None,
) -> Start:
    """Measure the members between pairs of nodes at ``positions`` (k, 3)."""
    points = member_extraction.points_near(source, positions, pairs, params)
    measured = member_extraction.measure(points, source.scanners, positions, pairs, params)
    every = np.ones(len(positions), bool)
    return Start(positions=positions, pairs=pairs, design_row=rows, measured=measured, balls=every, pose=pose)


def _designed(source: Source, design: FrameDesign, catalogue: Catalogue, options: Options) -> Start | None:
    """Measure at the design's nodes in its own frame; if they are not there, find the nodes blind and match them."""
    row = {int(id_): i for i, id_ in enumerate(design.ids)}
    pairs = np.array([[row[int(a)], row[int(b)]] for a, b in zip(design.member_a, design.member_b, strict=True)])
    pairs = pairs.reshape(-1, 2).astype(np.int64)
    nominal, middle = matching.expanded(design, options.expansion)
    if len(pairs):
        positions = nominal + (middle - source.origin)
        nominal_start = _measured(source, positions, pairs, np.arange(len(positions)), options.members)
        off = np.linalg.norm(nominal_start.measured.nodes.positions - positions, axis=1)
        if np.mean(off < NEAR_MM) >= SAME_FRAME_SHARE:
            return nominal_start
    start = blind(source, options.members)
    return None if start is None else _located(source, start, design, pairs, catalogue, options)


def _located(
    source: Source, start: Start, design: FrameDesign, pairs: Ints, catalogue: Catalogue, options: Options
) -> Start:
    """Locate the design among nodes found blind, and measure all members of both."""
    found = start.balls & member_extraction.meeting(start.measured, options.members.largest_scatter_mm)
    seen = member_extraction.of_nodes(start.measured, found)
    node_a, node_b = seen.members.node_a, seen.members.node_b
    pattern = NodePattern(seen.nodes.positions, source.origin, node_a=node_a, node_b=node_b)

    def sized() -> NodePattern:
        fitted = alternating_fit.fit_spheres(source, seen.nodes, seen.members, catalogue)
        return replace(pattern, radii=fitted.radii, radius_sd=np.sqrt(fitted.covariance[:, 3, 3]))

    pose = matching.match(pattern, design, expansion=options.expansion, sized=sized)
    if pose.status is Status.FAILED:
        return replace(start, reasons=(*start.reasons, reason("spheres.design-not-found", reasons=pose.reasons)))
    nominal, middle = matching.expanded(design, options.expansion)
    positions = rigid.apply(rigid.invert(pose.T_best_fit), nominal + middle) - source.origin
    # Found nodes are where they were found, the others where the design has them.
    extra = pose.assignment < 0
    positions[pose.assignment[~extra]] = seen.nodes.positions[~extra]
    place = np.where(extra, len(positions) + np.cumsum(extra) - 1, pose.assignment)
    ends = np.stack([node_a, node_b], axis=1)
    found_pairs = place[ends[(ends >= 0).all(axis=1)]]
    every = np.unique(np.sort(np.vstack([pairs, found_pairs]), axis=1), axis=0)
    rows = np.concatenate([np.arange(len(positions)), np.full(int(extra.sum()), -1)])
    positions = np.vstack([positions, seen.nodes.positions[extra]])
    return replace(_measured(source, positions, every, rows, options.members, pose), reasons=start.reasons)


# --- stations --------------------------------------------------------------------------------------------------------


def _register(source: Source, start: Start, control: Sightings | None, options: Options) -> _Registered:
    """Register the stations on the members, and measure the members again after their corrections."""
    measured = start.measured
    shifted = len(source.scanners) > 1 and measured.station_sd_mm > LEAST_STATION_SD_MM
    if not options.register_stations or not (shifted or control is not None):
        return _Registered(source, measured)
    at, along, radii = measured.axes
    # no name of points on tubes here: they are given back as soon as they are sorted
    stations = registration.register(
        tube_points(measured.points, measured.lines, measured.members),
        at, along, radii, source.scanners, control, options.datum_mm,
    )  # fmt: skip
    if stations.status not in USABLE:
        return _Registered(source, measured, stations)
    corrected = Corrected(source, stations)
    points = corrected_gathered(measured.points, stations)
    measured = member_extraction.measure(points, corrected.scanners, start.positions, start.pairs, options.members)
    return _Registered(corrected, measured, stations)


# --- spheres ---------------------------------------------------------------------------------------------------------


def _fit_spheres(
    source: Source,
    measured: Measured,
    start: Start,
    design: FrameDesign | None,
    catalogue: Catalogue,
    options: Options,
    stations: Stations | None,
) -> tuple[Nodes, Spheres]:
    """Fit a sphere at every node, with the nominal radii and the stations' covariance as priors."""
    nodes = measured.nodes
    expected, disputed = np.full(nodes.count, np.nan), np.zeros(nodes.count, bool)
    if design is not None:
        expected, disputed = _expected(start, design, source.origin, options.expansion)
        # Nodes that no axes fix are at their nominal places, with a large covariance
        lost = ~np.isfinite(nodes.positions).all(axis=1)
        places, covariance = nodes.positions.copy(), nodes.covariance.copy()
        places[lost], covariance[lost] = start.positions[lost], NOMINAL_SD_MM**2 * np.eye(3)
        nodes = Nodes(places, covariance, np.where(lost, 0, nodes.axis_count), nodes.scatter)
    between = None if stations is None else stations.between
    spheres = alternating_fit.fit_spheres(
        source, nodes, measured.members, catalogue, expected, between, limits=options.limits
    )
    smallest = float(catalogue.radii.min()) if len(catalogue.radii) else np.nan
    # Poses of the design give different nominal radii to these spheres: none is wrong then
    reasons = list(spheres.reasons)
    for i in np.flatnonzero(disputed).tolist():
        reasons[i] = (*reasons[i], reason("spheres.ambiguous-node"))
    spheres = replace(spheres, reasons=tuple(reasons))
    return nodes, assessment.with_cause_of_absence(spheres, source, smallest)


def _expected(start: Start, design: FrameDesign, origin: Floats, expansion: float) -> tuple[Floats, Bools]:
    """Nominal radii (k,) of the nodes, NaN = none or disputed, and which are disputed by rival poses."""
    rows = start.design_row
    expected = np.where(rows >= 0, design.radii[np.maximum(rows, 0)], np.nan)
    disputed = np.zeros(len(rows), bool)
    if start.pose is None or start.pose.status in (Status.OK, Status.WEAK):
        return expected, disputed
    if not len(start.pose.rivals):  # the pose is contradicted, and the true one is unknown
        return np.full(len(rows), np.nan), rows >= 0
    nominal, middle = matching.expanded(design, expansion)
    tree = cKDTree(nominal)
    for T in start.pose.rivals:
        # offset less offset first: adding either to the nodes would lose digits
        placed = start.positions @ T[:3, :3].T + (T[:3, :3] @ origin + T[:3, 3] - middle)
        distance, nearest = tree.query(placed)
        other = np.where(distance < matching.FAR * matching.TOLERANCE_MM, design.radii[nearest], np.nan)
        disputed |= (rows >= 0) & (other != expected)
    return np.where(disputed, np.nan, expected), disputed


# --- design ----------------------------------------------------------------------------------------------------------


def _compare(
    registered: _Registered,
    spheres: Spheres,
    by_offset: Floats,
    design: FrameDesign,
    pose: Matching | None,
    options: Options,
) -> tuple[Matching, list[Movement], float]:
    """Match the fitted spheres with the design, and return the movement of each from its nominal place.

    Movements are those of the answer, then by the other gauge where there is one. The last is the standard deviation,
    mm, of the place of all nodes along an axis of the project's frame.
    """
    rows = np.flatnonzero(np.array([flag is not Flag.NOT_FOUND for flag in spheres.flag], bool))
    pattern = _pattern(spheres, rows, registered.measured.members, registered.source.origin)
    matched = _matched(pattern, design, pose, options.expansion)
    at, stations = pattern.positions.mean(axis=0), registered.trusted
    common = _georeference(registered, spheres, pattern, options) if stations is None else stations.common(at)
    covariance, shared = spheres.covariance[rows, :3, :3], by_offset[rows, :, None]
    if spheres.views is not None:
        shared = spheres.views.shared[rows, :3]
        covariance = covariance - shared @ np.swapaxes(shared, 1, 2)
    answer = partial(movement, matched, pattern, covariance, design, common, at, shared, expansion=options.expansion)
    gauges = [MovementGauge.BEST_FIT, *([MovementGauge.DESIGN] if matched.nearby else [])]
    if matched.relation is matching.FrameRelation.SAME:
        gauges.reverse()
    movements = [answer(gauge=gauge) for gauge in gauges]
    assignment, weight = np.full(len(spheres.radii), -1, np.int64), np.zeros(len(spheres.radii))
    assignment[rows], weight[rows] = matched.assignment, matched.weight
    shift = np.trace(common[3:, 3:]) + np.sum(shared.mean(axis=0) ** 2)
    return (
        replace(matched, assignment=assignment, weight=weight),
        [replace(one, found=rows[one.found]) for one in movements],
        float(np.sqrt(shift / 3.0)),
    )


def _georeference(registered: _Registered, spheres: Spheres, pattern: NodePattern, options: Options) -> Floats:
    """Covariance (6, 6) of the nodes' common motion in the project's frame, about their middle; mm, rad.

    Where stations were not registered on the tubes: of several stations that of the mean of independent errors of the
    size by which they disagree, else by the scanner's class. Errors of unnamed views have the shift already.
    """
    around = pattern.positions - pattern.positions.mean(axis=0)
    common = _of_mean(around, registered.mean_variance or scanner_class_errors.SHIFT_SD_MM**2)
    if spheres.views is not None and not registered.mean_variance:
        common[3:, 3:] = 0.0
    common[3:, 3:] += options.datum_mm**2 * np.eye(3)
    return common


def _of_mean(around: Floats, variance: float) -> Floats:
    """Covariance (6, 6) of a motion whose shift has a variance, mm^2, as has its turn at the ends of points (k, 3)."""
    arm = max(0.5 * float(np.linalg.norm(np.ptp(around, axis=0))), 1.0)
    return np.diag(np.repeat([variance / arm**2, variance], 3))


def _pattern(spheres: Spheres, rows: Ints, joined: Members, origin: Floats) -> NodePattern:
    """Return the spheres of some rows as a pattern of nodes."""
    place = np.full(len(spheres.radii), -1, np.int64)
    place[rows] = np.arange(len(rows))
    return NodePattern(
        positions=spheres.centres[rows],
        origin=origin,
        radii=spheres.radii[rows],
        radius_sd=np.sqrt(spheres.covariance[rows, 3, 3]),
        node_a=np.where(joined.node_a >= 0, place[joined.node_a], -1),
        node_b=np.where(joined.node_b >= 0, place[joined.node_b], -1),
    )


def _matched(pattern: NodePattern, design: FrameDesign, pose: Matching | None, expansion: float) -> Matching:
    """Match the nodes with the design; where its pose is known from the search it is only refined."""
    if pose is None:
        return matching.match(pattern, design, expansion=expansion)
    # The frames of the two are the same to a few centimetres from here on.
    T = pose.T_best_fit
    there = replace(pattern, positions=pattern.positions @ T[:3, :3].T, origin=T[:3, :3] @ pattern.origin + T[:3, 3])
    refined = matching.match(there, replace(design, coordinates=DESIGN_FRAMES[1]), expansion=expansion)
    best = refined.T_best_fit @ T
    same = pose.relation is matching.FrameRelation.SAME
    return replace(
        refined,
        relation=pose.relation,
        status=pose.status,
        rivals=pose.rivals,
        reasons=pose.reasons,
        nearby=pose.nearby,
        T_design_scan=pose.T_design_scan if same else best,
        covariance=pose.covariance if same else refined.covariance,
        T_best_fit=best,
    )
