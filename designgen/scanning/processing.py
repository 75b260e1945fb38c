"""What other software does to clouds before they are exported: registered, thinned, smoothed, doubled, rounded.

The steps follow each other in this order, scan by scan, in the frame of the scan's file. A point that stands for
several has the labels of the one nearest to it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from designgen.checks import expect
from designgen.randomness import generator
from designgen.rigid import inverse, rigid, translation
from processor.model import Floats, Ints, PointLabels, PoseTruth, Scan, Scene, Truth, UsageError

THIN, SMOOTH = ("voxel", "octree", "nearest"), ("mean", "mls")
NEIGHBOURS = {
    "mean": 8,
    "mls": 20,
}  # usual numbers of noise filters and of moving least squares; the point is among them
BLOCK = 100_000  # points at a time: their neighbours take 50 MB

R = TypeVar("R", Scan, PointLabels)


@dataclass(frozen=True)
class Params:
    """Section ``processing`` of a recipe."""

    thin: str = ""  # centroids of voxels, the point nearest to a cell's centre, the same in the cells of an octree
    cell_mm: float = 5.0  # the octree's cells are up to twice as large
    smooth: str = ""  # mean of the nearest points, or a plane through them (moving least squares)
    round_mm: float = 0.0  # digits of the coordinates
    duplicate: float = 0.0  # share of the points that occur twice, as after a merge of overlapping exports
    register_mm: float = 0.0  # by which the cloud of a structure was registered wrongly, in some direction
    register_mrad: float = 0.0

    def __post_init__(self) -> None:
        for key, choices in (("thin", THIN), ("smooth", SMOOTH)):
            value = getattr(self, key)
            expect(value in ("", *choices), f"processing.{key}", value, f"one of {', '.join(choices)}")
        expect(self.cell_mm > 0.0, "processing.cell_mm", self.cell_mm, "more than 0")
        expect(0.0 <= self.duplicate <= 1.0, "processing.duplicate", self.duplicate, "a share from 0 to 1")
        for key in ("round_mm", "register_mm", "register_mrad"):
            expect(getattr(self, key) >= 0.0, f"processing.{key}", getattr(self, key), "0 or more")


def process(scene: Scene, truth: Truth, params: Params, seed: int) -> tuple[Scene, Truth]:
    """Return a scene as other software left it, and its truth: ``labels`` follow the points, ``pose`` the registration.

    Raises UsageError where a scene that is no structure is to be registered.
    """
    if params.register_mm or params.register_mrad:
        scene, truth = _registered(scene, truth, params, generator(seed, "processing: registration"))
    labels = {label.scan: label for label in truth.labels}
    scans = []
    for scan in scene.scans:
        rows, points = _processed(scan, params, generator(seed, f"processing: {scan.name}"))
        scans.append(replace(_taken(scan, rows, len(scan.points)), points=points))
        if scan.name in labels:
            labels[scan.name] = _taken(labels[scan.name], rows, len(scan.points))
    return replace(scene, scans=tuple(scans)), replace(truth, labels=tuple(labels.values()))


def _processed(scan: Scan, params: Params, rng: np.random.Generator) -> tuple[Ints, Floats]:
    """Return the rows of a scan's points that are left, and where they lie, (n, 3) less the scan's origin."""
    points, rows = scan.points + scan.origin, np.arange(len(scan.points))
    if params.thin:
        rows, points = _thinned(points, params)
    if params.smooth:
        points = _smoothed(points, params.smooth)
    if params.duplicate:
        again = np.flatnonzero(rng.random(len(points)) < params.duplicate)
        rows, points = np.append(rows, rows[again]), np.vstack([points, points[again]])
    if params.round_mm:
        points = np.round(points / params.round_mm) * params.round_mm
    return rows, points - scan.origin


def _thinned(points: Floats, params: Params) -> tuple[Ints, Floats]:
    """Return one row of points (n, 3) for each occupied cell, and its place: of ``voxel`` the mean of the cell."""
    low, cell = np.zeros(3), params.cell_mm
    if params.thin == "octree":  # halves of a cube about all points
        low, side = points.min(axis=0), float(np.ptp(points, axis=0).max())
        cell = side / 2.0 ** max(np.floor(np.log2(max(side, cell) / cell)), 0.0)
    index = np.floor((points - low) / max(cell, 1e-9)).astype(np.int64)
    number = np.unique(index, axis=0, return_inverse=True)[1].reshape(-1)
    count = np.bincount(number)
    mean = np.stack([np.bincount(number, x) for x in points.T], axis=1) / count[:, None]
    aim = mean[number] if params.thin == "voxel" else low + (index + 0.5) * cell
    order = np.lexsort((((points - aim) ** 2).sum(axis=1), number))
    rows = order[np.cumsum(count) - count]
    return rows, mean if params.thin == "voxel" else points[rows]


def _smoothed(points: Floats, how: str) -> Floats:
    """Return points (n, 3) moved to the mean of their neighbours, or onto the plane through these."""
    middle = points.mean(axis=0)
    centred = points - middle
    tree, moved = cKDTree(centred), np.empty_like(points)
    count = min(NEIGHBOURS[how], len(points))
    for start in range(0, len(points), BLOCK):
        own = centred[start : start + BLOCK]
        near = centred[tree.query(own, count)[1].reshape(len(own), count)]
        mean = near.mean(axis=1)
        if how == "mls":
            off = near - mean[:, None]
            normal = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))[1][:, :, 0]
            mean = own - np.einsum("ni,ni->n", own - mean, normal)[:, None] * normal
        moved[start : start + BLOCK] = mean
    moved += middle
    return moved


def _registered(scene: Scene, truth: Truth, params: Params, rng: np.random.Generator) -> tuple[Scene, Truth]:
    """Move a structure's scans together, by given amounts about their middle, in random directions."""
    if scene.structure is None:
        raise UsageError(
            "processing.register_mm: expected 0 for a scene that is no structure, or no register_mrad either"
        )
    shift, turn = (vector / np.linalg.norm(vector) for vector in rng.standard_normal((2, 3)))
    placed = [(scan.points + scan.origin).mean(axis=0) @ scan.pose[:3, :3].T + scan.pose[:3, 3] for scan in scene.scans]
    middle = np.mean(placed, axis=0)
    turned = rigid(Rotation.from_rotvec(1e-3 * params.register_mrad * turn).as_matrix(), np.zeros(3))
    T = translation(middle + params.register_mm * shift) @ turned @ translation(-middle)
    scans = [
        replace(scan, T_project_scan=T @ scan.pose) if scan.T_project_scan.size else _moved(scan, T)
        for scan in scene.scans
    ]
    stations, of_truth = scene.stations, truth.stations
    if stations is not None:
        poses = T @ stations.T_project_station if len(stations.T_project_station) else stations.T_project_station
        stations = replace(stations, positions=stations.positions @ T[:3, :3].T + T[:3, 3], T_project_station=poses)
    if of_truth is not None:
        of_truth = replace(of_truth, T_project_station=T @ of_truth.T_project_station)
    pose = truth.pose if truth.pose is not None else PoseTruth(np.eye(4))
    pose = replace(pose, T_design_project=pose.T_design_project @ inverse(T))
    return replace(scene, scans=tuple(scans), stations=stations), replace(truth, stations=of_truth, pose=pose)


def _moved(scan: Scan, T: Floats) -> Scan:
    """Return a scan without a pose with its points and its scanner moved by T (4, 4)."""
    moved = (scan.points + scan.origin) @ T[:3, :3].T + T[:3, 3] - scan.origin
    position = T[:3, :3] @ scan.position + T[:3, 3] if scan.position.size else scan.position
    return replace(scan, points=moved, position=position)


def _taken(record: R, rows: Ints, count: int) -> R:
    """Return a record of ``count`` points with some of them; a scan that was thinned has no grid any more."""
    columns = {
        field.name: getattr(record, field.name)[rows]
        for field in dataclasses.fields(record)
        if field.metadata.get("shape", ("",))[0] == "n" and len(getattr(record, field.name)) == count
    }
    if not np.array_equal(rows, np.arange(count)):
        columns.update({name: columns[name][:0] for name in ("grid_row", "grid_column") if name in columns})
    return replace(record, **columns)
