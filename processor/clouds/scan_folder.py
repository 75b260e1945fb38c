"""The files beside exported scans that make their folder a scan folder: project.toml, design, stations, points."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from processor.clouds import exported_clouds
from processor.clouds.earlier_run import Run
from processor.clouds.poses import Placed
from processor.model import Control, Tolerance
from processor.plain_text import spreadsheet_text
from processor.scan_folder.control_points import COLUMNS
from processor.scan_folder.files import CONTROL, PICKS, PROJECT, STATIONS
from processor.scan_folder.tolerance import AGREED
from processor.writers import project
from processor.writers.toml import as_toml

NO_POSE = np.empty(0)
EACH_SCAN = ("registered", "clean")  # contents with a file per scan, in the scan's own frame


def write(folder: Path, run: Run, scans: Sequence[Placed], files: Sequence[str], what: str, format_: str) -> None:
    """Write what `processor run` needs beside the ``files`` of ``scans`` in a folder."""
    scene, scale = run.scene, project.scale_of(format_)
    lines = project.head_lines(scene, folder, format_)
    if scene.frame is not None and scene.frame.coordinates:
        lines.append(f"design_frame = {as_toml(scene.frame.coordinates)}")
    if np.isfinite(scene.temperature_C) and what != "assembled":  # the assembled parts have their reference lengths
        lines.append(f"temperature_C = {scene.temperature_C!r}")
    lines += _tolerance(scene.tolerance)
    if what in EACH_SCAN:
        lines += _supports(run, scans, scale)
    if what == "merged":
        stations = exported_clouds.stations_of(run, scans)
        of_all = project.common_lines(one.scan for one in scans)
        lines += ["", "[[scan]]", f"file = {as_toml(files[0])}", *of_all]
    else:
        stations = exported_clouds.stations_moved(run, scans)
        for one, file in zip(scans, files, strict=True):
            # The pose and the position that belong to the points as written
            position = one.scale * one.scan.position
            if what in EACH_SCAN:
                pose, component = one.T if one.known else NO_POSE, one.scan.component
            else:
                position = one.T[:3, :3] @ position + one.T[:3, 3] if position.size else position
                pose, component = NO_POSE, one.component
            written = dataclasses.replace(one.scan, T_project_scan=pose, position=position, component=component)
            lines += ["", "[[scan]]", f"file = {as_toml(file)}"]
            in_file = format_ == "e57" and written.T_project_scan.size > 0
            lines += project.scan_lines(
                dataclasses.replace(written, T_project_scan=NO_POSE) if in_file else written, scale, with_pose=False
            )
    (folder / PROJECT).write_text("\n".join(lines) + "\n", encoding="utf-8")
    if stations is not None:
        project.write_stations(folder / STATIONS, stations, scale)
    if what in EACH_SCAN:
        names = {one.number: Path(file).stem for one, file in zip(scans, files, strict=True)}
        if scene.picks is not None:
            read_as = {one.scan.name: (names[one.number], one.scale * scale) for one in scans}
            project.write_picks(folder / PICKS, scene.picks, read_as)
        _write_control(folder / CONTROL, scene.control, run, names, scale)


def _supports(run: Run, scans: Sequence[Placed], scale: float) -> list[str]:
    """Return the lines of what the exported components lay on, and of their steel."""
    known, steel, lines = run.scene.part_supports, run.scene.steel, []
    if steel is not None:
        lines += ["", "[steel]", f"E_MPa = {steel.E_MPa!r}", f"density_kg_m3 = {steel.density_kg_m3!r}"]
    factors = {one.scan.component: one.scale * scale for one in reversed(scans)}
    for row, name in enumerate(() if known is None else known.component):
        if known is not None and name in factors:
            chainage = float(known.chainages[row])
            at = f"at = {(factors[name] * known.places[row]).tolist()}"
            lines += ["", "[[support]]", f"component = {as_toml(name)}"]
            lines.append(f"chainage_mm = {chainage!r}" if np.isfinite(chainage) else at)
    return lines


def _tolerance(tolerance: Tolerance | None) -> list[str]:
    """Return the lines of the limits that the project names."""
    if tolerance is None:
        return []
    lines = ["", "[tolerance]"]
    if tolerance.standard:
        lines.append(f"standard = {as_toml(tolerance.standard)}")
    if tolerance.rule is not None:
        lines.append(f"rule = {as_toml(tolerance.rule)}")
    if tolerance.risk is not None:
        lines.append(f"risk = {tolerance.risk!r}")
    if tolerance.root_gap_mm:
        lines.append(f"root_gap_mm = {tolerance.root_gap_mm!r}")
    agreed = ""
    for limit in tolerance.limits:
        source, _, by = limit.source.partition(AGREED)
        if source == PROJECT and limit.component is None:
            both = [limit.low, limit.high] if np.isfinite(limit.low) else limit.high
            lines.append(f"{limit.key} = {both!r}")
            agreed = by
    lines += [f"agreed_by = {as_toml(agreed)}"] if agreed else []
    return lines


def _write_control(path: Path, control: Control | None, run: Run, names: dict[int, str], scale: float) -> None:
    """Write the control points, and where the exported scans have them."""
    if control is None:
        return
    stations = run.scene.stations
    rows: list[list[object]] = [
        [spreadsheet_text(name), "", *(position * scale).tolist(), float(sd)]
        for name, position, sd in zip(control.ids, control.positions, control.sd, strict=True)
    ]
    for point, scan, station, seen, sd in zip(
        control.point, control.scan, control.station, control.seen, control.seen_sd, strict=True
    ):
        if int(scan) in names:
            name = stations.ids[station] if stations is not None and station >= 0 else names[int(scan)]
            rows.append([spreadsheet_text(control.ids[point]), name, *(seen * scale).tolist(), float(sd)])
    if len(rows) > len(control.ids):
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerows([COLUMNS, *rows])
