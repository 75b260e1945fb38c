"""Scans written in the file formats of scanners: points in the scan's own frame with its origin added.

PLY is in mm, all others in metres. Intensity is written where there is one, and of merged clouds the number of each
point's station (from 1, 0 = unknown).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from processor.model import SOURCES, Floats, Ints, PointLabels, Scan, Stations, UsageError
from processor.writers import e57, las, ply, text
from processor.writers.cloud import GRID, METRES, Block, Cloud, columns_of, of_scan

WRITERS: dict[str, Callable[[Path, Cloud], int]] = {
    "ply": ply.write, "las": las.write, "laz": las.write, "xyz": text.write,
}  # fmt: skip
LABELLED = ("ply", "las", "laz", "e57")  # formats whose files have the labels of the points


def write_pcd(path: Path, scan: Scan) -> None:
    """Write binary PCD in metres, coordinates as doubles."""
    columns: dict[str, Any] = {axis: (scan.points[:, i] + scan.origin[i]) * METRES for i, axis in enumerate("xyz")}
    columns |= {name: column for name, column in columns_of(scan).items() if name not in GRID}
    rows = ply.records(columns)
    types = [column.dtype for column in columns.values()]
    header = (
        f"VERSION 0.7\nFIELDS {' '.join(columns)}\nSIZE {' '.join(str(t.itemsize) for t in types)}\n"
        f"TYPE {' '.join(t.kind.upper() for t in types)}\nCOUNT {' '.join('1' for _ in types)}\nWIDTH {len(rows)}\n"
        f"HEIGHT 1\nVIEWPOINT 0.0 0.0 0.0 1.0 0.0 0.0 0.0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    path.write_bytes(header.encode() + rows.tobytes())


def write_ptx(path: Path, scan: Scan, stations: Stations | None) -> None:
    """Write PTX: a grid for each station, cropped to the rows and columns with returns.

    Points are in the scanner's frame, and the matrix is the pose of the scanner: in a merged cloud, of each station.
    Raises UsageError for a scan without grid numbers or poses.
    """
    with path.open("w", encoding="ascii", newline="\n") as file:
        for rows, T in ptx_grids(scan, stations):
            points = scan.points[rows] + (scan.origin - T[:3, 3])
            _write_grid(file, scan, rows, points @ T[:3, :3], T)


def ptx_grids(scan: Scan, stations: Stations | None) -> list[tuple[Ints, Floats]]:
    """Return the grids of a PTX file: rows of points in the file's order, pose of the scanner in the points' frame.

    Raises UsageError for a scan without grid numbers or poses.
    """
    if len(scan.grid_row) != len(scan.points) or (len(scan.grid_row) and scan.grid_row.min() < 0):
        raise UsageError(f"scan {scan.name!r} was not made on a scanner's grid: it cannot be written as PTX")
    order = np.lexsort((scan.grid_row, scan.grid_column))
    if not len(scan.point_station):
        return [(order, np.eye(4))]
    if stations is None or not len(stations.T_project_station):
        raise UsageError(f"scan {scan.name!r} has no poses of its stations: it cannot be written as PTX")
    seen = np.unique(scan.point_station)
    return [(order[scan.point_station[order] == k], stations.T_project_station[k]) for k in seen]


def _write_grid(file: Any, scan: Scan, rows: Ints, points: Floats, T_frame_scanner: Floats) -> None:
    row, column = scan.grid_row[rows], scan.grid_column[rows]
    row, column = row - row.min(), column - column.min()
    lines = int(row.max()) + 1
    T = scan.T_project_scan @ T_frame_scanner if scan.T_project_scan.size else T_frame_scanner.copy()
    T[:3, 3] *= METRES
    number = "%.9f %.9f %.9f"
    file.write(f"{int(column.max()) + 1}\n{lines}\n{number % tuple(T[:3, 3])}\n")
    file.writelines(f"{number % tuple(T[:3, i])}\n" for i in range(3))
    file.writelines(f"{number % tuple(T[:3, i])} {float(i == 3):.0f}\n" for i in range(4))  # for row vectors
    points = points * METRES
    bright = scan.intensity[rows] if len(scan.intensity) else np.full(len(rows), 0.5)
    bright = bright / max(float(bright.max(initial=0.0)), 1e-12)
    start = np.searchsorted(column, np.arange(int(column.max()) + 2))
    empty = "0 0 0 0.500000\n"
    for c in range(int(column.max()) + 1):
        cells = [empty] * lines
        for k in range(start[c], start[c + 1]):
            x, y, z = points[k]
            cells[row[k]] = f"{x:.7f} {y:.7f} {z:.7f} {bright[k]:.6f}\n"
        file.writelines(cells)


@dataclass(frozen=True)
class Written:
    """A file of scans; for each scan that a reader finds in it the name, the scan, and the rows of its points."""

    name: str
    scans: tuple[Scan, ...]
    read_as: tuple[tuple[str, Scan, Ints], ...]


def labelled(scan: Scan, labels: Sequence[PointLabels]) -> Cloud:
    """Return the cloud of a scan with its labels, if there are any, as columns.

    ``part``, ``surface`` and ``defect`` are numbers of the truth's names and defects, -1 = none; ``mixed`` marks points
    whose footprint lies on several surfaces.
    """
    cloud = of_scan(scan)
    label = next((label for label in labels if label.scan == scan.name), None)
    if label is None:
        return cloud
    columns = {"part": label.part, "surface": label.surface, "defect": label.defect}
    columns["mixed"] = (label.source == SOURCES.index("mixed")).astype(np.uint8)
    columns = {name: column for name, column in columns.items() if len(column)}

    def blocks() -> Iterator[Block]:
        start = 0
        for block in cloud.blocks():
            rows = slice(start, start + len(block.points))
            start = rows.stop
            yield Block(block.points, {**block.fields, **{name: column[rows] for name, column in columns.items()}})

    types = {name: column.dtype for name, column in columns.items()}
    return dataclasses.replace(cloud, fields={**cloud.fields, **types}, blocks=blocks)


def write_all(
    folder: Path,
    format_: str,
    scans: Sequence[tuple[str, Scan]],
    stations: Stations | None,
    labels: Sequence[PointLabels] = (),
    *,
    spherical: bool,
) -> list[Written]:
    """Write scans under ``folder`` by their file stems: a file each, but several stations together in one E57 file.

    Scans of components have a file each in E57, too, because project.toml names the component of a file. Formats of
    LABELLED have the ``labels`` of the points as columns.
    """
    if format_ == "e57":
        separate = len(scans) == 1 or any(scan.component for _, scan in scans)
        groups = [(stem, [scan]) for stem, scan in scans] if separate else [("scans", [scan for _, scan in scans])]
        return [_write_e57(folder, stem, group, labels, spherical=spherical) for stem, group in groups]
    if format_ == "ptx":
        return [_write_ptx(folder, stem, scan, stations) for stem, scan in scans]
    written = []
    for stem, scan in scans:
        name = f"{stem}.{format_}"
        if format_ == "pcd":
            write_pcd(folder / name, scan)
        else:
            cloud = labelled(scan, labels) if format_ in LABELLED else of_scan(scan)
            WRITERS[format_](folder / name, cloud)
        written.append(Written(name, (scan,), ((stem, scan, np.arange(len(scan.points))),)))
    return written


def _write_e57(
    folder: Path, stem: str, scans: Sequence[Scan], labels: Sequence[PointLabels], *, spherical: bool
) -> Written:
    e57.write(folder / f"{stem}.e57", [labelled(scan, labels) for scan in scans], spherical=spherical)
    names = [stem] if len(scans) == 1 else e57.names_read(stem, [scan.name for scan in scans])
    read_as = tuple((name, scan, np.arange(len(scan.points))) for name, scan in zip(names, scans, strict=True))
    return Written(f"{stem}.e57", tuple(scans), read_as)


def _write_ptx(folder: Path, stem: str, scan: Scan, stations: Stations | None) -> Written:
    write_ptx(folder / f"{stem}.ptx", scan, stations)
    grids = [rows for rows, _ in ptx_grids(scan, stations)]
    names = [stem] if len(grids) == 1 else [f"{stem}-{i + 1}" for i in range(len(grids))]
    return Written(f"{stem}.ptx", (scan,), tuple((n, scan, rows) for n, rows in zip(names, grids, strict=True)))
