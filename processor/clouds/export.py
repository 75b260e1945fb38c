"""Clouds out of a run's results and its input, written as a new folder, whole or not at all."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from processor.clouds import CONTENTS, FORMATS, cleaning, exported_clouds, poses, scan_folder
from processor.clouds import earlier_run as runs
from processor.clouds.cleaning import Removed
from processor.clouds.earlier_run import Run
from processor.clouds.poisson_disk import sampled
from processor.clouds.poses import Placed, Poses
from processor.model import Reason, UsageError, reason
from processor.pipeline import Execution
from processor.progress import tracked
from processor.store.whole_output import check_new, unwritable, whole_folder
from processor.writers import e57, las, ply, project, text
from processor.writers.cloud import Cloud

SCANS = "scans"
WRITERS: dict[str, Callable[[Path, Cloud], int]] = {
    "e57": lambda path, cloud: e57.write(path, [cloud])[0],
    "las": las.write,
    "laz": las.write,
    "ply": ply.write,
    "xyz": text.write,
}


@dataclass(frozen=True)
class Exported:
    """The files that were written, by their names in the folder, with the number of points; remarks on them."""

    folder: Path
    what: str
    format: str
    files: dict[str, int]
    remarks: tuple[Reason, ...] = ()


@dataclass(frozen=True)
class _Content:
    """Clouds by the stems of their files, the scans they are of, and remarks; ``frame`` is that of the coordinates.

    ``removed`` counts what is left out of each cloud.
    """

    clouds: dict[str, Cloud]
    scans: tuple[Placed, ...] = ()
    remarks: tuple[Reason, ...] = ()
    frame: str = ""
    removed: dict[str, Removed] = field(default_factory=dict)


def export(
    source: Execution | Path,
    folder: Path,
    what: str,
    format_: str,
    spacing_mm: float = 0.0,
    input_: Path | None = None,
    units: str | None = None,
) -> Exported:
    """Write clouds of a run, in memory or in a folder of results, as a new folder.

    Raises UsageError for names that are not known, a folder that exists, and where a step is missing; InputError for an
    input that has changed, and where the folder cannot be written.
    """
    if what not in CONTENTS:
        raise UsageError(f"what: expected one of {', '.join(CONTENTS)}, found {what!r}")
    if format_ not in FORMATS:
        raise UsageError(f"format: expected one of {', '.join(FORMATS)}, found {format_!r}")
    if not 0.0 <= spacing_mm < np.inf:
        raise UsageError(f"spacing_mm: expected a length of 0 mm or more, found {spacing_mm}")
    check_new(folder)
    with (
        whole_folder(folder) as making,
        tempfile.TemporaryDirectory(prefix=".aside-", dir=making) as aside,
        _opened(source, Path(aside), input_, units) as run,
    ):
        content = CONTENT_OF[what](run, Path(aside))
        clouds = {}
        for stem, cloud in content.clouds.items():
            identity = f"{run.digest} {what} {spacing_mm} {stem}".encode()
            clouds[stem] = replace(cloud, identity=identity)
            if spacing_mm:
                clouds[stem] = sampled(clouds[stem], spacing_mm, Path(aside))
        try:
            return _write(run, replace(content, clouds=clouds), (folder, making), (what, format_))
        except OSError as error:
            if error.errno is None:  # of HDF5: the input is damaged
                raise
            # Here, as an error that passes an open scene file is taken for damage of that file.
            raise unwritable(folder, error) from error


def _opened(
    source: Execution | Path, aside: Path, input_: Path | None, units: str | None
) -> AbstractContextManager[Run]:
    if isinstance(source, Execution):
        return runs.of_execution(source)
    return runs.opened(source, input_, units, aside)


def _write(run: Run, content: _Content, target: tuple[Path, Path], names: tuple[str, str]) -> Exported:
    """Write the files of a content into a folder that is still being made."""
    (folder, making), (what, format_) = target, names
    bright = (
        exported_clouds.brightest(run, [placed.number for placed in content.scans])
        if format_ in ("las", "laz")
        else 0.0
    )
    files = {}
    for stem, cloud in tracked(list(content.clouds.items())):
        name = f"{stem}.{format_}"
        (making / name).parent.mkdir(exist_ok=True)
        comments = (f"coordinates in mm, {content.frame}",)
        files[name] = WRITERS[format_](making / name, replace(cloud, brightest=bright, comments=comments))
    if content.scans:
        scan_folder.write(making, run, content.scans, list(files), what, format_)
    remarks = list(content.remarks)
    if format_ == "e57":
        lost = tuple(one.scan.name for one in content.scans if exported_clouds.has_stations(run, one))
        remarks += [reason("export.stations-lost", scans=lost)] if lost else []
    for stem, removed in content.removed.items():
        if not removed.compared:
            remarks.append(reason("export.not-compared", file=stem))
        remarks.append(reason("export.removed", file=stem, outliers=removed.outliers, clutter=removed.clutter))
    return Exported(folder, what, format_, files, tuple(remarks))


def _registered(run: Run, aside: Path) -> _Content:
    return _scans(run, poses.in_project(run, "registered"))


def _scans(run: Run, placed: Poses) -> _Content:
    stems = project.stems(one.scan.name for one in placed.scans)
    clouds = {
        f"{SCANS}/{stem}": exported_clouds.scan_cloud(run, one) for stem, one in zip(stems, placed.scans, strict=True)
    }
    return _Content(clouds, placed.scans, placed.remarks, "frame of the scan")


def _clean(run: Run, aside: Path) -> _Content:
    placed = poses.own_frames(run)
    content = _scans(run, placed)
    marks = cleaning.filters(run, placed.scans)
    clouds, removed = {}, {}
    for (stem, cloud), one, of_design in zip(content.clouds.items(), placed.scans, marks, strict=True):
        clouds[stem], removed[stem] = cleaning.cleaned(cloud, of_design, cleaning.scanner_of(run, one), aside)
    return replace(content, clouds=clouds, removed=removed)


def _merged(run: Run, aside: Path) -> _Content:
    placed = poses.in_project(run, "merged")
    cloud = exported_clouds.merged_cloud(run, placed.scans)
    return _Content({"merged": cloud}, placed.scans, placed.remarks, "frame of the project")


def _assembled(run: Run, aside: Path) -> _Content:
    placed = poses.in_bridge(run)
    stems = project.stems(_numbered(placed))
    clouds = {
        f"{SCANS}/{stem}": exported_clouds.part_cloud(run, one) for stem, one in zip(stems, placed.scans, strict=True)
    }
    return _Content(clouds, placed.scans, placed.remarks, "frame of the bridge")


def _numbered(placed: poses.Poses) -> list[str]:
    """Return the component of each scan, with a number from a component's second scan on."""
    names, seen = list[str](), dict[str, int]()
    for one in placed.scans:
        seen[one.component] = seen.get(one.component, 0) + 1
        names.append(one.component if seen[one.component] == 1 else f"{one.component}-{seen[one.component]}")
    return names


def _deviation(run: Run, aside: Path) -> _Content:
    return _Content({"deviation": exported_clouds.core_cloud(run)}, frame="frame of the design")


CONTENT_OF: dict[str, Callable[[Run, Path], _Content]] = {
    "registered": _registered,
    "merged": _merged,
    "assembled": _assembled,
    "clean": _clean,
    "deviation": _deviation,
}
