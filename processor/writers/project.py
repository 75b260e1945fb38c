"""The files of a scan folder beside the clouds: lines of project.toml, the design with its meshes, JSON files."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from processor.model import KEY_POINTS, SUPPORTS, ArchDesign, FrameDesign, Picks, Scan, Scene, Stations
from processor.plain_text import spreadsheet_text
from processor.writers.cloud import METRES
from processor.writers.ply import write_mesh
from processor.writers.toml import as_toml

PICK_COLUMNS = ("scan_a", "scan_b", "point", "xa", "ya", "za", "xb", "yb", "zb")
LONGEST_STEM = 200  # bytes: with a suffix and a number less than the 255 that file systems take


def scale_of(format_: str) -> float:
    """Return the factor of coordinates in files of a format, of mm: PLY is in mm, all others are in metres."""
    return 1.0 if format_ == "ply" else METRES


def head_lines(scene: Scene, folder: Path, format_: str, *, with_meshes: bool = True) -> list[str]:
    """Write the design, and return the lines of project.toml before those of scans in files of a format."""
    lines = [f"name = {as_toml(scene.name)}", f"kind = {as_toml(scene.kind)}"]
    lines.append(f'units = "{"mm" if format_ == "ply" else "m"}"')
    design = write_design(scene, folder, scale_of(format_), with_meshes=with_meshes)
    return [*lines, f"design = {as_toml(design)}"] if design else lines


def common_lines(scans: Iterable[Scan]) -> list[str]:
    """Return the lines of project.toml about a file with several scans: what is the same for all of them."""
    sigmas = {scan.sigma_mm for scan in scans}
    return [f"sigma_mm = {min(sigmas)!r}"] if len(sigmas) == 1 and np.isfinite(min(sigmas)) else []


def write_stations(path: Path, stations: Stations, scale: float) -> None:
    """Write where the stations are, coordinates times ``scale``."""
    places = zip(stations.ids, stations.positions, strict=True)
    write_json(path, {name: {"position": (position * scale).tolist()} for name, position in places})


def write_picks(path: Path, picks: Picks, read_as: Mapping[str, tuple[str, float]]) -> None:
    """Write the picked points between scans that are ``read_as`` a name in the folder, coordinates times a scale."""
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(PICK_COLUMNS)
        for a, b, point, in_a, in_b in zip(
            picks.scan_a, picks.scan_b, picks.points, picks.in_a, picks.in_b, strict=True
        ):
            if a in read_as and b in read_as:
                (name_a, scale_a), (name_b, scale_b) = read_as[a], read_as[b]
                places = [*(in_a * scale_a).tolist(), *(in_b * scale_b).tolist()]
                rows.writerow([name_a, name_b, spreadsheet_text(point), *places])


def scan_lines(scan: Scan, scale: float, *, with_pose: bool) -> list[str]:
    """Return the lines of project.toml about one scan; ``with_pose``: the file contains the scanner's pose."""
    lines = [f"component = {as_toml(scan.component)}"] if scan.component else []
    if scan.station:
        lines.append(f"station = {as_toml(scan.station)}")
    if np.isfinite(scan.sigma_mm):
        lines.append(f"sigma_mm = {scan.sigma_mm!r}")
    if scan.T_project_scan.size and not with_pose:
        pose = scan.T_project_scan.copy()
        pose[:3, 3] *= scale
        lines.append(f"pose = {json.dumps(pose.tolist())}")
    if scan.position.size and not with_pose:
        lines.append(f"position = {json.dumps((scan.position * scale).tolist())}")
    return lines


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file."""
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def stems(names: Iterable[str]) -> list[str]:
    """Return a file stem for each name: the name itself where it is a plain one, and no two that differ in case alone.

    Names that are plain keep theirs whatever others become.
    """
    every = list(names)
    plain = [name for name in every if name == _plain(name)]
    taken = {name.casefold() for name in plain}
    found, kept = [], set[str]()
    for name in every:
        stem = name
        if name not in plain or name.casefold() in kept:
            stem, number = _plain(name), 2
            while stem.casefold() in taken:
                stem, number = f"{_plain(name)}-{number}", number + 1
        kept.add(stem.casefold())
        taken.add(stem.casefold())
        found.append(stem)
    return found


def _plain(name: str) -> str:
    """Return a name of letters, digits, - and _ alone, that any file system takes."""
    plain = "".join(c if c.isalnum() or c in "-_" else "_" for c in name) or "scan"
    return plain.encode("utf-8")[:LONGEST_STEM].decode("utf-8", "ignore")


def write_design(scene: Scene, folder: Path, scale: float, *, with_meshes: bool) -> str:
    """Write the design, a structure's mesh times ``scale``; return its file name, empty without a design."""
    if scene.arch is not None:
        write_json(folder / "design.json", _arch_design(scene.arch, folder if with_meshes else None))
    elif scene.frame is not None:
        write_json(folder / "design.json", _frame_design(scene.frame))
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
    for part, stem in zip(design.parts, stems(part.name for part in design.parts), strict=True):
        component = components[part.name] = {}
        if folder is not None and part.source == "mesh":
            component["mesh"] = f"design/{stem}.ply"
            (folder / "design").mkdir(exist_ok=True)
            write_mesh(folder / component["mesh"], part.vertices, part.faces)
        if len(part.bottom_edge_left):
            component["bottom_edge_left"] = part.bottom_edge_left.tolist()
            component["bottom_edge_right"] = part.bottom_edge_right.tolist()
    joints = [
        {"name": name, "left": left, "right": right, "points": dict(zip(KEY_POINTS, points.tolist(), strict=True))}
        for name, left, right, points in zip(
            design.joint_names, design.joint_left, design.joint_right, design.joint_points, strict=True
        )
    ]
    content: dict[str, Any] = {"units": "mm", "kind": "arch-bridge"}
    if design.in_row:
        content["order"] = [part.name for part in design.parts]
    return {**content, "components": components, "joints": joints}


def _frame_design(design: FrameDesign) -> dict[str, Any]:
    nodes: list[dict[str, Any]] = [
        {"id": name, "centre": centre.tolist(), "radius": float(radius)}
        for name, centre, radius in zip(design.names, design.centres, design.radii, strict=True)
    ]
    for node, support in zip(nodes, design.supports.tolist(), strict=False):
        if support:
            node["support"] = SUPPORTS[support - 1]
    for node, deflection in zip(nodes, design.deflections.tolist(), strict=False):
        if deflection > 0.0:
            node["deflection"] = deflection
    name_of = design.name_of
    members = [
        {"a": name_of[int(a)], "b": name_of[int(b)], "tube_diameter": float(d)}
        for a, b, d in zip(design.member_a, design.member_b, design.tube_diameters, strict=True)
    ]
    return {"units": "mm", "kind": "space-frame", "nodes": nodes, "members": members}
