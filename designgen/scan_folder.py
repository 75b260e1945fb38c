"""Scenes written as scan folders: project.toml, design.json with its meshes, scans, and truth.h5."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from processor import store
from processor.model import KEY_POINTS, ArchDesign, Floats, FrameDesign, Ints, Scan, Scene, UsageError

MM = 0.001  # metres


def export(source: Path, folder: Path, format_: str, *, with_truth: bool) -> int:
    """Write the scene file ``source`` as a new scan folder; the number of scans.

    The folder is made under a temporary name and moved. Raises UsageError when it exists and is not empty.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder}: exists and is not empty; name a new folder")
    scene = store.read_scene(source)
    folder.parent.mkdir(parents=True, exist_ok=True)
    making = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        _write(scene, making, format_)
        if with_truth:
            store.copy_truth(source, making / "truth.h5")
        if folder.exists():
            folder.rmdir()
        os.chmod(making, 0o755)
        os.replace(making, folder)
    except BaseException:
        shutil.rmtree(making, ignore_errors=True)
        raise
    return len(scene.scans)


def _write(scene: Scene, folder: Path, format_: str) -> None:
    (folder / "scans").mkdir()
    lines = [f"name = {json.dumps(scene.name, ensure_ascii=False)}", f'kind = "{scene.kind}"']
    lines.append(f'units = "{"mm" if format_ == "ply" else "m"}"')
    if scene.arch is not None or scene.frame is not None:
        lines.append('design = "design.json"')
        (folder / "design.json").write_text(json.dumps(_design(scene, folder), indent=1) + "\n", encoding="utf-8")
    if np.isfinite(scene.temperature_C):
        lines.append(f"temperature_C = {scene.temperature_C!r}")
    for number, scan in enumerate(scene.scans):
        file = f"scans/{_file_name(scan.name, number)}.{format_}"
        WRITERS[format_](folder / file, scan)
        lines += ["", "[[scan]]", f"file = {json.dumps(file, ensure_ascii=False)}"]
        if scan.component:
            lines.append(f"component = {json.dumps(scan.component, ensure_ascii=False)}")
        if np.isfinite(scan.sigma_mm):
            lines.append(f"sigma_mm = {scan.sigma_mm!r}")
    (folder / "project.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _file_name(name: str, number: int) -> str:
    """Return the scan's name where it is a plain file name, else its number."""
    return name if name.replace("-", "").replace("_", "").isalnum() else f"scan{number}"


def _design(scene: Scene, folder: Path) -> dict[str, Any]:
    return _arch_design(scene.arch, folder) if scene.arch is not None else _frame_design(scene.frame)


def _arch_design(design: ArchDesign, folder: Path) -> dict[str, Any]:
    (folder / "design").mkdir()
    components = {}
    for part in design.parts:
        _write_ply(folder / "design" / f"{part.name}.ply", part.vertices, part.faces)
        components[part.name] = {
            "mesh": f"design/{part.name}.ply",
            "bottom_edge_left": part.bottom_edge_left.tolist(),
            "bottom_edge_right": part.bottom_edge_right.tolist(),
        }
    joints = [
        {"name": name, "left": left, "right": right, "points": dict(zip(KEY_POINTS, points.tolist(), strict=True))}
        for name, left, right, points in zip(
            design.joint_names, design.joint_left, design.joint_right, design.joint_points, strict=True
        )
    ]
    order = [part.name for part in design.parts]
    return {"units": "mm", "kind": "arch-bridge", "order": order, "components": components, "joints": joints}


def _frame_design(design: FrameDesign | None) -> dict[str, Any]:
    assert design is not None
    nodes = [
        {"id": int(i), "centre": centre.tolist(), "radius": float(radius)}
        for i, centre, radius in zip(design.ids, design.centres, design.radii, strict=True)
    ]
    members = [
        {"a": int(a), "b": int(b), "tube_diameter": float(d)}
        for a, b, d in zip(design.member_a, design.member_b, design.tube_diameters, strict=True)
    ]
    return {"units": "mm", "kind": "space-frame", "nodes": nodes, "members": members}


def _write_ply(path: Path, points: Floats, faces: Ints | None = None) -> None:
    """Write binary PLY with coordinates as doubles, mm."""
    from plyfile import PlyData, PlyElement

    vertex = np.empty(len(points), dtype=[("x", "<f8"), ("y", "<f8"), ("z", "<f8")])
    vertex["x"], vertex["y"], vertex["z"] = points.T
    elements = [PlyElement.describe(vertex, "vertex")]
    if faces is not None:
        face = np.empty(len(faces), dtype=[("vertex_indices", "<i4", (3,))])
        face["vertex_indices"] = faces
        elements.append(PlyElement.describe(face, "face"))
    PlyData(elements, byte_order="<").write(str(path))


def _scan_ply(path: Path, scan: Scan) -> None:
    _write_ply(path, scan.points + scan.origin)


def _scan_las(path: Path, scan: Scan) -> None:
    """Write LAS or LAZ in metres, to 0.0001 m."""
    import laspy

    metres = (scan.points + scan.origin) * MM
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales = np.full(3, 0.0001)
    header.offsets = np.floor(metres.min(axis=0))
    las = laspy.LasData(header)
    las.x, las.y, las.z = metres.T
    las.write(str(path))


def _scan_e57(path: Path, scan: Scan) -> None:
    """Write E57 in metres, doubles."""
    import pye57

    metres = (scan.points + scan.origin) * MM
    with_axes = {f"cartesian{axis}": np.ascontiguousarray(metres[:, i]) for i, axis in enumerate("XYZ")}
    file = pye57.E57(str(path), mode="w")
    try:
        file.write_scan_raw(with_axes, name=scan.name)
    finally:
        file.close()


def _scan_xyz(path: Path, scan: Scan) -> None:
    np.savetxt(path, (scan.points + scan.origin) * MM, fmt="%.7f")


WRITERS = {"ply": _scan_ply, "las": _scan_las, "laz": _scan_las, "e57": _scan_e57, "xyz": _scan_xyz}
