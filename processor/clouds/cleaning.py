"""Clouds without outliers, and without clutter: points that are not of the design.

A point that step ``deviation`` suspects (1 standard deviation) still counts there in part; what is left out here is
gone, so the limit is wider.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from processor import scene_cloud
from processor.clouds import poses, slabs
from processor.clouds.earlier_run import Run
from processor.clouds.poses import Placed
from processor.deviation.measure import REACH_MM
from processor.geometry import mesh_distance, nearest_neighbours, rigid
from processor.geometry.mesh_distance import MeshSurface
from processor.model import Bools, Floats
from processor.writers.cloud import Block, Cloud

NEIGHBOURS, RATIO = 20, 3.0  # as those of step deviation; beyond 3 standard deviations is 1 of 740 normal distances
LEAST_RANGE_MM = 1.0
HALO = 20.0  # spacings of a cloud, within which the neighbours of a point are searched beyond its slab
OfDesign = Callable[[Floats], Bools]  # marks points (n, 3), less the origin of a cloud, that are of the design


@dataclass
class Removed:
    """Points left out of a cloud, counted while it is written; ``compared``: with a design."""

    outliers: int = 0
    clutter: int = 0
    compared: bool = False


def cleaned(cloud: Cloud, of_design: OfDesign | None, scanner: Floats | None, aside: Path) -> tuple[Cloud, Removed]:
    """Return a cloud without clutter and outliers, and the count of what is left out.

    Outliers are points whose mean distance to NEIGHBOURS neighbours exceeds the mean of all by more than RATIO standard
    deviations (statistical outlier removal), among the points of the design. The distances are relative to the range
    from the ``scanner`` (3,), less the cloud's origin, where it is known: a scan is sparser the farther away it is.
    """
    removed = Removed(compared=of_design is not None)

    def kept() -> Iterator[Block]:
        for block in cloud.blocks():
            if of_design is None:
                yield block
                continue
            marks = of_design(block.points)
            yield Block(block.points[marks], {name: column[marks] for name, column in block.fields.items()})

    on_design = replace(cloud, blocks=kept, count=None)

    def blocks() -> Iterator[Block]:
        count = 0
        for block in _without_outliers(on_design, scanner, removed, aside):
            count += len(block.points)
            yield block
        removed.clutter = (cloud.count or 0) - count - removed.outliers

    return replace(cloud, blocks=blocks, count=None), removed


def _without_outliers(cloud: Cloud, scanner: Floats | None, removed: Removed, aside: Path) -> Iterator[Block]:
    """Yield the blocks of a cloud without statistical outliers."""
    parts = slabs.cut(cloud, aside)
    with tempfile.TemporaryDirectory(dir=aside) as folder:
        paths = [Path(folder) / str(number) for number in range(len(parts))]
        count, total, squares = 0, 0.0, 0.0
        for number, path in enumerate(paths):
            distance = _distances(parts, number, scanner)
            distance.tofile(path)
            count, total = count + len(distance), total + float(distance.sum())
        mean = total / max(count, 1)
        for path in paths:
            squares += float(((np.fromfile(path) - mean) ** 2).sum())
        limit = mean + RATIO * np.sqrt(squares / max(count, 1))
        for number, path in enumerate(paths):
            inlier = np.fromfile(path) <= limit
            removed.outliers += int(np.count_nonzero(~inlier))
            yield from slabs.in_blocks(parts.read(number)[inlier])


def _distances(parts: slabs.Slabs, number: int, scanner: Floats | None) -> Floats:
    """Return the mean distance (n,) of each point of a slab to its neighbours, also those in the slabs beside it."""
    points = slabs.points_of(parts.read(number))
    if not len(points):
        return np.empty(0)
    if len(parts) > 1:
        reach = HALO * nearest_neighbours.spacing(nearest_neighbours.of_spacing(points))
        low, high = parts.edges[number] - reach, parts.edges[number + 1] + reach
        beside = [slabs.points_of(parts.read(other)) for other in (number - 1, number + 1)]
        beside = [one[(one[:, parts.axis] >= low) & (one[:, parts.axis] <= high)] for one in beside]
        every = np.concatenate([points, *beside])
    else:
        every = points
    grid = nearest_neighbours.of_spacing(every)
    mean = np.empty(len(every))
    mean[grid.order] = nearest_neighbours.mean_distances(grid, NEIGHBOURS)
    mean = mean[: len(points)]
    if scanner is not None:
        mean /= np.maximum(np.linalg.norm(points - scanner, axis=1), LEAST_RANGE_MM)
    return mean


def scanner_of(run: Run, placed: Placed) -> Floats | None:
    """Return the scanner's position (3,) in the frame of a scan's points as written, less their origin.

    None where it is not known. A scan with a grid has it at the origin of its frame, which its rows were checked with.
    """
    scan = placed.scan
    if scan.position.size:
        return placed.scale * (scan.position - scan.origin)
    single = not len(run.points.column(placed.number, "point_station"))
    return -placed.scale * scan.origin if single and len(run.points.column(placed.number, "grid_row")) else None


def _near(surface: MeshSurface, depth: float, T: Floats) -> OfDesign:
    """Return the function that marks points within ``depth``, mm, of a surface where they are placed by T (4, 4)."""

    def of_design(points: Floats) -> Bools:
        reach = depth + mesh_distance.DESIGN_SPACING_MM[1]  # to a sample of the surface
        facet, distance, beyond = surface.distances(rigid.apply(T, points), reach)
        with np.errstate(invalid="ignore"):
            near: Bools = (facet >= 0) & (np.abs(distance) <= depth) & (beyond <= depth)
        return near

    return of_design


def filters(run: Run, scans: Sequence[Placed]) -> list[OfDesign | None]:
    """Return for each scan what marks its points, in its own frame less its origin, that are of the design.

    None where the run does not tell: without a design with surfaces, or without a pose in it.
    """
    result, design = run.steps.get("deviation"), run.scene.structure
    if design is not None and result is not None and result.T_design_scan.size:
        vertices, origin = scene_cloud.local_design(design)
        surface = mesh_distance.of_design(vertices, design.faces)
        depth = result.max_depth if np.isfinite(result.max_depth) else REACH_MM
        return [_near(surface, depth, one.to_local(result.T_design_scan @ one.T, origin)) for one in scans]
    if "preassemble" not in run.steps:
        return [None] * len(scans)
    in_bridge = {one.number: one for one in poses.in_bridge(run).scans}
    parts = {} if run.scene.arch is None else {part.name: part for part in run.scene.arch.parts if len(part.faces)}
    marks: list[OfDesign | None] = []
    for one in scans:
        placed = in_bridge.get(one.number)
        part = None if placed is None else parts.get(placed.component)
        if placed is None or part is None:
            marks.append(None)
            continue
        surface = mesh_distance.of_mesh(part.vertices, part.faces)
        marks.append(_near(surface, REACH_MM, placed.to_local(placed.T, np.zeros(3))))
    return marks
