"""Members and nodes of a frame from its cloud: blind, or where a design says roughly where they are."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace

import numpy as np

from processor.model import Floats, Ints
from processor.space_frame.members import axis_intersection, junctions
from processor.space_frame.members.linearity import linearity
from processor.space_frame.members.records import Nodes, Tubes
from processor.space_frame.members.segments import segments
from processor.space_frame.members.tubes import Fits, least_cosine, refined, rough, station_variance
from processor.space_frame.points.hash_sampling import STEPS_PER_MM, thinned
from processor.space_frame.points.line_crops import Gathered, corridors, gather
from processor.space_frame.points.source import Source
from processor.space_frame.points.voxels import gathered

NOTHING = np.empty(0, np.int32)


@dataclass(frozen=True)
class Params:
    """How members are looked for (lengths in mm)."""

    kept_points: int = 2_000_000  # that members are looked for in
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
    threads: int = 0  # as many as there are


def find(source: Source, params: Params) -> Measured | None:
    """Find the tubes and the nodes where they meet in a whole cloud, with no design, crop or size given.

    None for a cloud without members, and that is known at once.
    """
    lines = rough_lines(source, params)
    if len(lines.points) < 2:
        return None
    found = junctions.graph(lines)
    if not len(found.pairs):
        return None
    points = points_near(source, found.nodes, found.pairs, params)
    measured = measure(points, source.scanners, found.nodes, found.pairs, params)
    return believed(measured, params.largest_scatter_mm)


def believed(measured: Measured, largest_scatter_mm: float) -> Measured:
    """Leave out what three axes once seemed to meet at, but do not; and tubes with neither of their nodes."""
    nodes, tubes = measured.nodes, measured.tubes
    kept = np.isfinite(nodes.positions).all(axis=1) & ~(nodes.scatter > largest_scatter_mm)
    row = np.where(kept, np.cumsum(kept) - 1, -1)
    a, b = row[tubes.node_a], row[tubes.node_b]
    rows = np.flatnonzero((a >= 0) | (b >= 0))
    columns = {field.name: getattr(tubes, field.name)[rows] for field in dataclasses.fields(tubes)}
    columns |= {"node_a": a[rows], "node_b": b[rows]}
    left = Nodes(nodes.positions[kept], nodes.covariance[kept], nodes.axes[kept], nodes.scatter[kept])
    return replace(measured, nodes=left, tubes=Tubes(**columns), lines=measured.lines[rows])


def rough_lines(source: Source, params: Params) -> junctions.Lines:
    """Axes of all that looks like a tube, to some mm, from a part of the points."""
    most = params.kept_points
    while True:
        steps = thinned(source, most, params.threads)
        voxels = gathered(steps, params.voxel_mm, params.least_in_voxel)
        # A large frame seen thinly needs more points, if there are more.
        wanted = min(params.most_kept_points, round(3.0 * params.per_voxel * voxels.count))
        if most >= source.count or len(steps) >= params.per_voxel * voxels.count or wanted <= most:
            break
        most = wanted
    linear = linearity(voxels, params.least_linearity, params.threads)
    seen = segments(voxels, linear, params.least_linearity, params.least_length_mm)
    margin = 400.0
    near = corridors(seen.points, seen.directions, -seen.halves - margin, seen.halves + margin, params.reach_mm)
    points = gather([(steps, NOTHING)], 1.0, near, params.rough_points, params.threads)
    fits = rough(
        points, np.empty((0, 3)), seen.points, seen.directions, 0.8 * seen.halves, seen.halves + margin,
        params.radii_mm, params.rough_points, params.threads,
    )  # fmt: skip
    # What was seen of a line, from the middle of its cylinder: the longer of the voxels' stretch and the cylinder.
    shift = np.einsum("ij,ij->i", fits.points - seen.points, seen.directions)
    low = np.minimum(-0.5 * fits.lengths, -seen.halves - shift)
    high = np.maximum(0.5 * fits.lengths, seen.halves - shift)
    return junctions.Lines(fits.points[fits.ok], fits.directions[fits.ok], low[fits.ok], high[fits.ok])


@dataclass(frozen=True)
class Measured:
    """Nodes and tubes between known places, with what they rest on: points gathered near lines, a line (m,) a tube.

    ``apart_mm`` is the standard deviation by which stations seem off each other at the tubes; 0 where noise explains
    all.
    """

    nodes: Nodes
    tubes: Tubes
    points: Gathered
    lines: Ints
    apart_mm: float


def points_near(source: Source, starts: Floats, pairs: Ints, params: Params) -> Gathered:
    """Gather the points near the lines between pairs (p, 2) of nodes ``starts`` (k, 3), less the source's origin."""
    middles, directions, length = _lines(starts, pairs)
    lines = corridors(middles, directions, -0.5 * length, 0.5 * length, params.reach_mm)
    room = int(np.clip(params.all_tube_points // max(len(pairs), 1), 64, params.tube_points))
    chunks = ((chunk.points, chunk.station) for chunk in source.chunks())
    return gather(chunks, STEPS_PER_MM, lines, room, params.threads)


def measure(points: Gathered, scanners: Floats, starts: Floats, pairs: Ints, params: Params) -> Measured:
    """Fit the tubes between pairs (p, 2) of nodes that are known to 20 mm, starts (k, 3), to the points near them.

    All starts become nodes, in their order. A node that no two axes fix has NaN for its position, and a tube that
    could not be fitted is left out. ``scanners`` (s, 3) are empty where unknown.
    """
    middles, directions, length = _lines(starts, pairs)
    start = rough(
        points, scanners, middles, directions, 0.5 * length - np.minimum(0.2 * length, 450.0), 0.5 * length,
        params.radii_mm, params.rough_points, params.threads,
    )  # fmt: skip
    least_cos, off = least_cosine(start, params.incidence_tolerance_mm), station_variance(start)
    fits = refined(
        points, scanners, start, 0.5 * length, params.radii_mm, params.rough_points, params.bow_share, least_cos, off,
        params.threads,
    )  # fmt: skip
    nodes, tubes = _nodes(fits, starts, pairs, params)
    away = np.linalg.norm(start.points[start.ok, None] - scanners[None], axis=2)
    apart = float(np.sqrt(off[0] + off[1] * (1e-3 * float(away.mean() if away.size else 0.0)) ** 2))
    return Measured(nodes, tubes, points, np.flatnonzero(fits.ok), apart)


def _lines(starts: Floats, pairs: Ints) -> tuple[Floats, Floats, Floats]:
    """Return middles (p, 3), unit directions (p, 3) and lengths (p,) of the lines between pairs of nodes."""
    a, b = starts[pairs[:, 0]], starts[pairs[:, 1]]
    length = np.linalg.norm(b - a, axis=1)
    return 0.5 * (a + b), (b - a) / length[:, None], length


def _nodes(fits: Fits, starts: Floats, pairs: Ints, params: Params) -> tuple[Nodes, Tubes]:
    rows = np.flatnonzero(fits.ok)
    tube = np.concatenate([rows, rows])
    node = np.concatenate([pairs[rows, 0], pairs[rows, 1]])
    order = np.argsort(node, kind="stable")
    tube, node = tube[order], node[order]
    ends = axis_intersection.incidence(
        node,
        starts,
        fits.points[tube],
        fits.directions[tube],
        fits.side[tube],
        fits.covariance[tube],
        fits.response[tube],
    )
    met = axis_intersection.meet(ends, starts, params.eccentricity_floor_mm)
    nodes = Nodes(met.positions, met.covariance, met.axes, met.scatter)
    tubes = Tubes(
        points=fits.points[rows],
        directions=fits.directions[rows],
        side=fits.side[rows],
        lengths=fits.lengths[rows],
        radii=fits.radii[rows],
        bow=fits.bow[rows],
        covariance=fits.covariance[rows],
        node_a=pairs[rows, 0],
        node_b=pairs[rows, 1],
        count=fits.count[rows],
        rms=fits.sigma[rows],
    )
    return nodes, tubes
