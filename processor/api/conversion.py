"""A scan folder or a scan file converted to one scene file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from processor import large_arrays, pipeline
from processor.api.argument_checks import path_of, text_of
from processor.evaluation import evaluate
from processor.language.messages import messages
from processor.model import Scan, Truth, UsageError, per_point_fields
from processor.progress import stage
from processor.scan_folder import files, fingerprint
from processor.store import store, whole_output


@dataclass(frozen=True)
class Converted:
    """What was written: the file, its scans with their numbers of points, and how coordinates were read."""

    path: Path
    points: dict[str, int]
    units: str
    units_reason: str
    with_truth: bool


def convert(input_: str | Path, output: str | Path, units: str | None = None) -> Converted:
    """Write a scan folder, or one scan file, as a scene file, as ``processor convert`` does.

    Points lie in files beside the output while they are read, so memory need not hold them.

    Parameters
    ----------
    input_ : a scan folder or a scan file (E57, LAS, LAZ, PLY, PCD, PTX, PTS, text).
    output : the scene file (.h5). It is written whole or not at all.
    units : of the scans' coordinates, see :func:`processor.read`.

    Returns
    -------
    The scans with their numbers of points, and how coordinates were read.

    Raises
    ------
    InputError : the input cannot be used, or the output cannot be written.
    UsageError : the input is a scene file already, the output has another suffix than .h5, or the unit is unknown.
    """
    path, out = files.existing(path_of(input_, "input_")), path_of(output, "output")
    if path.is_file() and path.suffix.lower() == ".h5":
        raise UsageError(f"{path}: is a scene file already; name a scan folder or a scan file")
    if out.name == files.TRUTH and out.resolve().parent == path.resolve():
        raise UsageError(f"{out}: is where the truth of the input lies; name another file with -o")
    whole_output.check_file(out, ".h5", "a scene file")
    before = fingerprint.signature(path.resolve(), out.resolve())
    with large_arrays.in_files(out.absolute().parent):
        with stage(f"reading {path.name}"):
            scene = pipeline.read(path, None if units is None else text_of(units, "units"))
        truth = evaluate.truth_of(path)
        fingerprint.check_unchanged(path.resolve(), before, out.resolve())
        with stage(f"writing {out.name}"):
            store.write_scene(out, scene, _fitting(truth, scene.scans), _provenance(path))
    points = {scan.name: len(scan.points) for scan in scene.scans}
    return Converted(out, points, scene.units, messages("en").text(scene.units_reason), with_truth=truth is not None)


def _provenance(path: Path) -> dict[str, object]:
    return {"converted_from": path.resolve().name, "software": pipeline.software()}


def _fitting(truth: Truth | None, scans: Sequence[Scan]) -> Truth | None:
    """Return a truth with the labels of those scans whose points are all there: not of one that was clipped."""
    if truth is None:
        return None
    count = {scan.name: len(scan.points) for scan in scans}
    names = per_point_fields(type(truth.labels[0])) if truth.labels else ()
    labels = tuple(
        one
        for one in truth.labels
        if one.scan in count and all(len(getattr(one, name)) in (0, count[one.scan]) for name in names)
    )
    return replace(truth, labels=labels)
