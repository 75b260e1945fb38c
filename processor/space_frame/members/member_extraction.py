"""Members and nodes of a frame from its cloud: blind, or where a design gives approximate nodes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from processor.model import Floats, Ints
from processor.space_frame.members import axis_intersection, junctions
from processor.space_frame.members.cylinder_fit import Errors
from processor.space_frame.members.records import Members, Nodes
from processor.space_frame.members.tube_fits import Fits, least_cosine, refined, rough, station_variance
from processor.space_frame.members.voxel_linearity import linearity
from processor.space_frame.members.voxel_lines import segments
from processor.space_frame.points.hash_sampling import STEPS_PER_MM, thinned
from processor.space_frame.points.line_crops import Gathered, corridors, gather
from processor.space_frame.points.source import Source
from processor.space_frame.points.voxels import gathered

NOTHING = np.empty(0, np.int32)
MARGIN_MM = 400.0  # of a line beyond the stretch that was seen


@dataclass(frozen=True)
class Params:
    """Parameters of the search for members (lengths in mm)."""

    kept_points: int = 2_000_000  # that members are searched for in
    most_kept_points: int = 8_000_000  # where the first are fewer than ``per_voxel``
    per_voxel: float = 6.0
    voxel_mm: float = 100.0
    least_in_voxel: int = 2
    least_linearity: float = 0.72
    least_length_mm: float = 400.0  # of a stretch of tube
    rough_points: int = 256  # of a tube, at first
    tube_points: int = 1024  # of a tube, at most
    all_tube_points: int = 8_000_000  # of all tubes together, at most
    reach_mm: float = 120.0  # from a rough axis
    radii_mm: tuple[float, float] = (15.0, 110.0)  # of tubes
    incidence_tolerance_mm: float = 0.2  # mean distance from the tube at which grazing rays are left out
    bow_share: float = 0.001  # of its length that a tube may be bowed
    largest_scatter_mm: float = 15.0  # of the axes about a node found blind
    eccentricity_floor_mm: float = 0.05
    threads: int = 0  # 0 = as many as there are


@dataclass(frozen=True)
class Measured:
    """Nodes and members between known places, and the points gathered near lines; the line (m,) of each member.

    ``station_sd_mm`` is the standard deviation of the stations' shifts at the members; 0 where noise explains the
    scatter.
    """

    nodes: Nodes
    members: Members
    points: Gathered
    lines: Ints
    station_sd_mm: float

    @property
    def axes(self) -> tuple[Floats, Floats, Floats]:
        """Points (m, 3), directions (m, 3) and radii (m,) of the members' axes."""
        return self.members.points, self.members.directions, self.members.radii


def rough_lines(source: Source, params: Params) -> junctions.Lines:
    """Axes of everything that looks like a tube, to some mm, from a part of the points."""
    most = params.kept_points
    while True:
        steps = thinned(source, most, params.threads)
        voxels = gathered(steps, params.voxel_mm, params.least_in_voxel)
        # A large frame with few points a voxel needs more points, if there are more.
        wanted = min(params.most_kept_points, round(3.0 * params.per_voxel * voxels.number))
        if most >= source.count or len(steps) >= params.per_voxel * voxels.number or wanted <= most:
            break
        most = wanted
    linear = linearity(voxels, params.least_linearity, params.threads)
    seen = segments(voxels, linear, params.least_linearity, params.least_length_mm)
    near = corridors(seen.points, seen.directions, -seen.halves - MARGIN_MM, seen.halves + MARGIN_MM, params.reach_mm)
    points = gather([(steps, NOTHING)], 1.0, near, params.rough_points, params.threads)
    fits = rough(
        points, np.empty((0, 3)), seen.points, seen.directions, 0.8 * seen.halves, seen.halves + MARGIN_MM,
        params.radii_mm, params.rough_points, params.threads,
    )  # fmt: skip
    # A line's extent from the middle of its cylinder: the longer of the voxels' stretch and the cylinder.
    shift = np.einsum("ij,ij->i", fits.points - seen.points, seen.directions)
    low = np.minimum(-0.5 * fits.lengths, -seen.halves - shift)
    high = np.maximum(0.5 * fits.lengths, seen.halves - shift)
    return junctions.Lines(fits.points[fits.ok], fits.directions[fits.ok], low[fits.ok], high[fits.ok])


def points_near(source: Source, starts: Floats, pairs: Ints, params: Params) -> Gathered:
    """Gather the points near the lines between pairs (p, 2) of nodes ``starts`` (k, 3), less the source's origin."""
    middles, directions, length = _lines(starts, pairs)
    lines = corridors(middles, directions, -0.5 * length, 0.5 * length, params.reach_mm)
    room = int(np.clip(params.all_tube_points // max(len(pairs), 1), 64, params.tube_points))
    chunks = ((chunk.points, chunk.station) for chunk in source.chunks())
    return gather(chunks, STEPS_PER_MM, lines, room, params.threads)


def measure(points: Gathered, scanners: Floats, starts: Floats, pairs: Ints, params: Params) -> Measured:
    """Fit the tubes between pairs (p, 2) of nodes that are known to 20 mm, starts (k, 3), to the points near them.

    All starts become nodes, in their order. A node without two axes that fix it has NaN for its position; a tube that
    could not be fitted is left out. ``scanners`` (s, 3) are empty where unknown.
    """
    middles, directions, length = _lines(starts, pairs)
    start = rough(
        points, scanners, middles, directions, 0.5 * length - np.minimum(0.2 * length, 450.0), 0.5 * length,
        params.radii_mm, params.rough_points, params.threads,
    )  # fmt: skip
    variance = station_variance(start)
    errors = Errors(params.bow_share, least_cosine(start, params.incidence_tolerance_mm), *variance)
    fits = refined(points, scanners, start, 0.5 * length, params.radii_mm, params.rough_points, errors, params.threads)
    away = np.linalg.norm(start.points[start.ok, None] - scanners[None], axis=2)
    mean_m = 1e-3 * float(away.mean() if away.size else 0.0)
    return Measured(
        nodes=_nodes(fits, starts, pairs, params),
        members=_members(fits, pairs),
        points=points,
        lines=np.flatnonzero(fits.ok),
        station_sd_mm=float(np.sqrt(variance[0] + variance[1] * mean_m**2)),
    )


def meeting(measured: Measured, largest_scatter_mm: float) -> npt.NDArray[np.bool_]:
    """Return at which nodes (k,) axes meet within a scatter."""
    nodes = measured.nodes
    return np.asarray(np.isfinite(nodes.positions).all(axis=1) & ~(nodes.scatter > largest_scatter_mm))


def of_nodes(measured: Measured, kept: npt.NDArray[np.bool_]) -> Measured:
    """Keep some of the nodes (k,), and the members with either of their nodes left."""
    nodes, members = measured.nodes, measured.members
    row = np.where(kept, np.cumsum(kept) - 1, -1)
    a, b = row[members.node_a], row[members.node_b]
    rows = np.flatnonzero((a >= 0) | (b >= 0))
    left = replace(members.take(rows), node_a=a[rows], node_b=b[rows])
    return replace(measured, nodes=nodes.take(kept), members=left, lines=measured.lines[rows])


def _lines(starts: Floats, pairs: Ints) -> tuple[Floats, Floats, Floats]:
    """Return middles (p, 3), unit directions (p, 3) and lengths (p,) of the lines between pairs of nodes."""
    a, b = starts[pairs[:, 0]], starts[pairs[:, 1]]
    length = np.linalg.norm(b - a, axis=1)
    return 0.5 * (a + b), (b - a) / length[:, None], length


def _nodes(fits: Fits, starts: Floats, pairs: Ints, params: Params) -> Nodes:
    rows = np.flatnonzero(fits.ok)
    tube = np.concatenate([rows, rows])
    node = np.concatenate([pairs[rows, 0], pairs[rows, 1]])
    order = np.argsort(node, kind="stable")
    tube, node = tube[order], node[order]
    ends = axis_intersection.axis_ends(
        node,
        starts,
        fits.points[tube],
        fits.directions[tube],
        fits.side[tube],
        fits.covariance[tube],
        fits.response[tube],
    )
    met = axis_intersection.intersect_axes(ends, starts, params.eccentricity_floor_mm)
    return Nodes(met.positions, met.covariance, met.axis_count, met.scatter)


def _members(fits: Fits, pairs: Ints) -> Members:
    rows = np.flatnonzero(fits.ok)
    return Members(
        points=fits.points[rows],
        directions=fits.directions[rows],
        side=fits.side[rows],
        lengths=fits.lengths[rows],
        radii=fits.radii[rows],
        bow=fits.bow[rows],
        covariance=fits.covariance[rows],
        bow_covariance=fits.bow_covariance[rows],
        node_a=pairs[rows, 0],
        node_b=pairs[rows, 1],
        count=fits.number[rows],
        rms=fits.sigma[rows],
        around=fits.around[rows],
    )
