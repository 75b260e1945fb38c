"""Scenes written as scan folders: project.toml, design.json with its meshes, scans, picks, and truth.h5."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from designgen.export import formats, step_files
from designgen.export.formats import Written
from processor.model import PointLabels, Scene, UsageError, per_point_fields
from processor.store import store
from processor.store.whole_output import check_new, whole_folder
from processor.writers import project
from processor.writers.toml import as_toml

LABELS = "labels.json"  # names of the parts and surfaces by the numbers in the scans' files
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
    as STEP, with the truth also those as built; without ``with_meshes`` the design of an arch bridge has bottom edges
    and joints only. Scans of less than FEWEST_POINTS points are left out. With the truth, files of the formats LABELLED
    have the points' labels as columns. The truth's labels have the names and order of the scans as the folder is read.

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
    with whole_folder(folder) as making:

        def write(labels: Sequence[PointLabels]) -> tuple[PointLabels, ...]:
            written = _write(scene, making, format_, labels, spherical=spherical, with_meshes=with_meshes)
            return _labels_as_read(labels, written)

        if not (with_truth and store.copy_truth(source, making / "truth.h5", write)):
            write(())
        if step:
            provenance = store.read_provenance(source)
            step_files.write_design(provenance.get("parameters") or {}, making / "design")
            if with_truth:
                recipe, seed = provenance.get("parameters") or {}, int(provenance.get("seed") or 0)
                step_files.write_as_built(recipe, seed, making / "as-built")
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


def _write(
    scene: Scene,
    folder: Path,
    format_: str,
    labels: Sequence[PointLabels],
    *,
    spherical: bool,
    with_meshes: bool,
) -> list[Written]:
    (folder / "scans").mkdir()
    scale, lines = project.scale_of(format_), project.head_lines(scene, folder, format_, with_meshes=with_meshes)
    if np.isfinite(scene.temperature_C):
        lines.append(f"temperature_C = {scene.temperature_C!r}")
    if scene.steel is not None:
        lines += ["", "[steel]", f"E_MPa = {scene.steel.E_MPa!r}", f"density_kg_m3 = {scene.steel.density_kg_m3!r}"]
    named = list(zip(project.stems(scan.name for scan in scene.scans), scene.scans, strict=True))
    written = formats.write_all(folder / "scans", format_, named, scene.stations, labels, spherical=spherical)
    if labels and format_ in formats.LABELLED:
        first = labels[0]
        project.write_json(folder / LABELS, {"part": list(first.part_names), "surface": list(first.surface_names)})
    for file in written:
        lines += ["", "[[scan]]", f"file = {as_toml(f'scans/{file.name}')}"]
        if len(file.scans) > 1:
            lines += project.common_lines(file.scans)
        else:
            (scan,) = file.scans
            with_pose = format_ == "ptx" or (format_ == "e57" and scan.T_project_scan.size > 0)
            lines += project.scan_lines(scan, scale, with_pose=with_pose)
    if scene.stations is not None and any(len(scan.point_station) for scan in scene.scans):
        project.write_stations(folder / "stations.json", scene.stations, scale)
    if scene.picks is not None:
        read_as = {scan.name: (name, scale) for file in written for name, scan, _ in file.read_as}
        project.write_picks(folder / "picks.csv", scene.picks, read_as)
    (folder / "project.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return written
