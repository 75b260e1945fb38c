"""Scenes written as scan folders: project.toml, design.json with its meshes, scans, picks, and truth.h5."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from designgen.export import METRES, formats, solids
from designgen.export.formats import Written
from designgen.new_folder import check_new, new_folder
from designgen.ply import write_mesh
from processor.model import (
    KEY_POINTS,
    ArchDesign,
    FrameDesign,
    Picks,
    PointLabels,
    Scan,
    Scene,
    UsageError,
    per_point_fields,
)
from processor.store import store

PICKS, PICK_COLUMNS = "picks.csv", ("scan_a", "scan_b", "point", "xa", "ya", "za", "xb", "yb", "zb")
FEWEST_POINTS = 4  # of a scan that a reader accepts


@dataclass(frozen=True)
class Exported:
    """The number of scans in a folder, and the names of scans left out because they have too few points."""

    scans: int
    left_out: tuple[str, ...]


def export(
    source: Path,
    folder: Path,
    format_: str,
    *,
    with_truth: bool,
    spherical: bool = False,
    step: bool = False,
    with_meshes: bool = True,
) -> Exported:
    """Write the scene file ``source`` as a new scan folder.

    The folder is made under a temporary name and renamed. ``spherical`` is for E57; ``step`` adds the design's solids
    as STEP; without ``with_meshes`` the design of an arch bridge has bottom edges and joints only. Scans of less than
    FEWEST_POINTS points are left out. The truth's labels have the names and order of the scans as read from the folder.

    Raises UsageError where the folder exists and is not empty, for a format that cannot hold the scene, where no scan
    is left, and for a scene other than an arch bridge without meshes.
    """
    check_new(folder)
    whole = store.read_scene(source)
    scans = tuple(scan for scan in whole.scans if len(scan.points) >= FEWEST_POINTS)
    if whole.scans and not scans:
        raise UsageError(f"{source}: no scan has {FEWEST_POINTS} points or more, so there is nothing to export")
    if not with_meshes and whole.arch is None:
        raise UsageError(f"{source}: only an arch bridge has a design without meshes")
    scene = dataclasses.replace(whole, scans=scans)
    with new_folder(folder) as making:
        written = _write(scene, making, format_, spherical=spherical, with_meshes=with_meshes)
        if step:
            solids.write_design(store.read_provenance(source).get("parameters") or {}, making / "design")
        if with_truth:
            store.copy_truth(source, making / "truth.h5", lambda labels: _labels_as_read(labels, written))
    return Exported(len(scans), tuple(scan.name for scan in whole.scans if len(scan.points) < FEWEST_POINTS))


def _labels_as_read(labels: Sequence[PointLabels], written: Sequence[Written]) -> tuple[PointLabels, ...]:
    """Return the labels with the names and order of the points as a reader finds them in the files."""
    of_scan = {label.scan: label for label in labels}
    result = []
    for name, scan, rows in (entry for file in written for entry in file.read_as):
        if scan.name not in of_scan:
            continue
        label = of_scan[scan.name]
        columns = {
            field: getattr(label, field)[rows] for field in per_point_fields(PointLabels) if len(getattr(label, field))
        }
        result.append(dataclasses.replace(label, scan=name, **columns))
    return tuple(result)


def _write(scene: Scene, folder: Path, format_: str, *, spherical: bool, with_meshes: bool) -> list[Written]:
    (folder / "scans").mkdir()
    lines = [f"name = {_quoted(scene.name)}", f"kind = {_quoted(scene.kind)}"]
    lines.append(f'units = "{"mm" if format_ == "ply" else "m"}"')
    scale = 1.0 if format_ == "ply" else METRES
    design = _design(scene, folder, scale, with_meshes=with_meshes)
    if design:
        lines.append(f"design = {_quoted(design)}")
    if np.isfinite(scene.temperature_C):
        lines.append(f"temperature_C = {scene.temperature_C!r}")
    named = list(zip(_stems(scene.scans), scene.scans, strict=True))
    written = formats.write_all(folder / "scans", format_, named, scene.stations, spherical=spherical)
    for file in written:
        lines += ["", "[[scan]]", f"file = {_quoted(f'scans/{file.name}')}"]
        if len(file.scans) > 1:
            lines += _of_file(file.scans)
        else:
            (scan,) = file.scans
            with_pose = format_ == "ptx" or (format_ == "e57" and scan.T_project_scan.size > 0)
            lines += _of_scan(scan, scale, with_pose=with_pose)
    if scene.stations is not None and any(len(scan.point_station) for scan in scene.scans):
        places = {
            name: {"position": (position * scale).tolist()}
            for name, position in zip(scene.stations.ids, scene.stations.positions, strict=True)
        }
        _write_json(folder / "stations.json", places)
    if scene.picks is not None:
        names = {scan.name: name for file in written for name, scan, _ in file.read_as}
        _write_picks(folder / PICKS, scene.picks, names, scale)
    (folder / "project.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return written


def _write_picks(path: Path, picks: Picks, names: Mapping[str, str], scale: float) -> None:
    """Write the picked points between scans in ``names`` (names in the folder by scan), coordinates times ``scale``."""
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(PICK_COLUMNS)
        for a, b, point, *at in zip(picks.scan_a, picks.scan_b, picks.points, picks.in_a, picks.in_b, strict=True):
            if a in names and b in names:
                rows.writerow([names[a], names[b], point, *(np.concatenate(at) * scale).tolist()])


def _of_file(scans: Sequence[Scan]) -> list[str]:
    """Return the lines of project.toml about a file with several scans: what is the same for all of them."""
    sigmas = {scan.sigma_mm for scan in scans}
    return [f"sigma_mm = {min(sigmas)!r}"] if len(sigmas) == 1 and np.isfinite(min(sigmas)) else []


def _of_scan(scan: Scan, scale: float, *, with_pose: bool) -> list[str]:
    """Return the lines of project.toml about one scan; ``with_pose``: the file contains the scanner's pose."""
    lines = [f"component = {_quoted(scan.component)}"] if scan.component else []
    if scan.station:
        lines.append(f"station = {_quoted(scan.station)}")
    if np.isfinite(scan.sigma_mm):
        lines.append(f"sigma_mm = {scan.sigma_mm!r}")
    if scan.T_project_scan.size and not with_pose:
        pose = scan.T_project_scan.copy()
        pose[:3, 3] *= scale
        lines.append(f"pose = {json.dumps(pose.tolist())}")
    if scan.position.size and not with_pose:
        lines.append(f"position = {json.dumps((scan.position * scale).tolist())}")
    return lines


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _stems(scans: Sequence[Scan]) -> list[str]:
    """Return unique file stems: each scan's name if it is a plain file name, else a number."""
    plain = {scan.name for scan in scans if scan.name.replace("-", "").replace("_", "").isalnum()}
    stems = []
    for number, scan in enumerate(scans):
        stem = scan.name if scan.name in plain else f"scan{number}"
        while scan.name not in plain and stem in plain:
            stem += "-"
        stems.append(stem)
    return stems


def _design(scene: Scene, folder: Path, scale: float, *, with_meshes: bool) -> str:
    """Write the design, a structure's mesh times ``scale``; return its file name, empty without a design."""
    if scene.arch is not None:
        _write_json(folder / "design.json", _arch_design(scene.arch, folder if with_meshes else None))
    elif scene.frame is not None:
        _write_json(folder / "design.json", _frame_design(scene.frame))
    elif scene.structure is not None:
        (folder / "design").mkdir(exist_ok=True)
        vertices = scene.structure.vertices * scale
        write_mesh(folder / "design/structure.ply", vertices, scene.structure.faces)
        return "design/structure.ply"
    else:
        return ""
    return "design.json"


def _arch_design(design: ArchDesign, folder: Path | None) -> dict[str, Any]:
    """Return the design as JSON, and write its meshes to ``folder`` unless it is None."""
    components: dict[str, dict[str, Any]] = {}
    for part in design.parts:
        component = components[part.name] = {}
        if folder is not None:
            component["mesh"] = f"design/{part.name}.ply"
            (folder / "design").mkdir(exist_ok=True)
            write_mesh(folder / component["mesh"], part.vertices, part.faces)
        component["bottom_edge_left"] = part.bottom_edge_left.tolist()
        component["bottom_edge_right"] = part.bottom_edge_right.tolist()
    joints = [
        {"name": name, "left": left, "right": right, "points": dict(zip(KEY_POINTS, points.tolist(), strict=True))}
        for name, left, right, points in zip(
            design.joint_names, design.joint_left, design.joint_right, design.joint_points, strict=True
        )
    ]
    order = [part.name for part in design.parts]
    return {"units": "mm", "kind": "arch-bridge", "order": order, "components": components, "joints": joints}


def _frame_design(design: FrameDesign) -> dict[str, Any]:
    nodes = [
        {"id": int(i), "centre": centre.tolist(), "radius": float(radius)}
        for i, centre, radius in zip(design.ids, design.centres, design.radii, strict=True)
    ]
    members = [
        {"a": int(a), "b": int(b), "tube_diameter": float(d)}
        for a, b, d in zip(design.member_a, design.member_b, design.tube_diameters, strict=True)
    ]
    return {"units": "mm", "kind": "space-frame", "nodes": nodes, "members": members}
