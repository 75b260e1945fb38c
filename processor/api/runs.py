"""Whole inputs: read, run and check, as the commands do."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from processor import large_arrays, pipeline, record_checks
from processor.api import tables
from processor.api.argument_checks import function_of, length_of, path_of, seed_of, text_of
from processor.clouds import export as clouds_export
from processor.clouds.export import Exported
from processor.evaluation import evaluate
from processor.evaluation.evaluate import ErrorReport
from processor.geometry.thread_ranges import one_blas_thread
from processor.jobs import tile_cluster
from processor.language.messages import CODES, messages
from processor.model import LONGEST_NAME, Metric, Scene, Truth, UsageError, Verdict, worst
from processor.pipeline import Execution
from processor.progress import stage
from processor.report import headline, write_results
from processor.results.file_names import RESULTS_H5
from processor.scan_folder import files, fingerprint
from processor.store import store, whole_output

if TYPE_CHECKING:
    import pandas as pd

Names = str | Sequence[str] | None


@dataclass(frozen=True, repr=False)
class Results:
    """What a run found.

    ``steps`` holds each step's result record by the step's name, e.g. ``results.steps["spheres"].balls``;
    ``comparison`` those of further methods, by step and method. ``checks`` are empty without a truth.
    """

    execution: Execution
    report: ErrorReport = field(default_factory=ErrorReport)

    @property
    def scene(self) -> Scene:
        """The scene that was processed."""
        return self.execution.scene

    @property
    def steps(self) -> dict[str, Any]:
        """Result records by step."""
        # reversed: the first method of a step is kept, as it comes last
        return {run.step: run.result for run in reversed(self.execution.runs)}

    @property
    def comparison(self) -> dict[str, dict[str, Any]]:
        """Result records of further methods, by step and method."""
        others: dict[str, dict[str, Any]] = {}
        for run in self.execution.runs:
            if self.steps[run.step] is not run.result:
                others.setdefault(run.step, {})[run.method] = run.result
        return others

    @property
    def checks(self) -> tuple[Metric, ...]:
        """Numbers of the results compared with the truth."""
        return self.report.metrics

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of the steps."""
        return worst(run.verdict for run, _ in self.execution.by_step())

    def table(self, *names: str) -> pd.DataFrame:
        """Return the first table that the run has of these names, as its CSV file of that name.

        Columns are named with their units. Raises UsageError where the run has none, ImportError without pandas.
        """
        return tables.frame(self.execution, self.report, *names)

    @property
    def balls(self) -> pd.DataFrame:
        """The balls of step spheres, see :meth:`table`."""
        return self.table("balls")

    @property
    def joints(self) -> pd.DataFrame:
        """The joints of step preassemble, see :meth:`table`."""
        return self.table("joints")

    @property
    def characteristics(self) -> pd.DataFrame:
        """All that step inspect measured, else what any step compared with limits, see :meth:`table`."""
        return self.table("inspect", "characteristics")

    @property
    def defects(self) -> pd.DataFrame:
        """The defects of step defects, see :meth:`table`."""
        return self.table("defects")

    @property
    def scans(self) -> pd.DataFrame:
        """The scans with their poses by step stitch, see :meth:`table`."""
        return self.table("stitch-scans")

    def __repr__(self) -> str:
        """Return the headline of the run."""
        return f"<processor.Results {self.scene.name!r}: {self.verdict}; {headline.of_run(self.execution)}>"


def read(path: str | Path, units: str | None = None) -> Scene:
    """Read a scan folder, a scene file (.h5) or one scan file.

    Parameters
    ----------
    path : a scan folder, a scene file or a scan file (E57, LAS, LAZ, PLY, PCD, PTX, PTS, text).
    units : of the coordinates, "mm", "cm", "dm", "m", "km", "inch", "ft" or "us-ft", whatever the format states; None =
        as the project or the format has it, else metres.

    Returns
    -------
    The scene, in mm. ``scene.units`` and ``scene.units_reason`` state how the coordinates were read.

    Raises
    ------
    InputError : the input cannot be used.
    UsageError : the unit is unknown, or ``units`` is given for a scene file, which states its own.
    """
    return pipeline.read(files.existing(path_of(path, "path")), None if units is None else text_of(units, "units"))


def run(
    input_: str | Path | Scene,
    output: str | Path | None = None,
    steps: Names = None,
    method: Names = None,
    params: str | Path | Mapping[str, Any] | None = None,
    units: str | None = None,
    seed: int | None = 0,
    *,
    lang: str = "en",
    log: Callable[[str], None] = lambda _: None,
    cluster: str | None = None,
) -> Results:
    """Process an input as ``processor run`` does.

    Parameters
    ----------
    input_ : a scan folder, a scene file or a scan file; or a scene.
    output : folder for results.h5, results.json, report.html and tables; None = nothing is written.
    steps : names of the steps, in a list or one text with commas; None = those of the input's kind.
    method : one method or several; the first of a step gives its result, further ones are run for comparison.
    params : a TOML file, or a mapping of one table per step.
    units : of the scans' coordinates, see :func:`read`.
    seed : of all randomness; None = that of the parameters.
    lang : language of report.html, "en" or "zh".
    log : receives a line of progress at a time.
    cluster : address of the scheduler of a Dask cluster, whose workers compute the tiles of large clouds, e.g.
        "tcp://10.0.0.1:8786"; the results are the same. None = all is computed here.

    Returns
    -------
    The results, with checks where the input holds a truth.

    Raises
    ------
    InputError : the input cannot be used, or the output cannot be written.
    UsageError : a name or parameter is unknown, no scheduler answers, or its workers have other software.
    """
    text_of(lang, "lang", CODES)
    for name, text in (("units", units), ("cluster", cluster)):
        if text is not None:
            text_of(text, name)
    results = compute(input_, output, steps, method, params, units, seed, log=log, cluster=cluster)
    return write(results, None if output is None else path_of(output, "output"), lang)


def compute(
    input_: str | Path | Scene,
    output: str | Path | None = None,
    steps: Names = None,
    method: Names = None,
    params: str | Path | Mapping[str, Any] | None = None,
    units: str | None = None,
    seed: int | None = 0,
    *,
    log: Callable[[str], None] = lambda _: None,
    so_far: str | Path | None = None,
    cluster: str | None = None,
) -> Results:
    """Process an input as :func:`run` does, without writing the results; ``output`` is tried before the work.

    Points beyond 64 MB lie in files without a name beside the output, without one in the folder for temporary files.
    The results.h5 in the folder ``so_far`` holds the steps that are done, while others run.
    """
    function_of(log, "log")
    wanted, methods, parameters = _names(steps, "steps"), _names(method, "method"), _parameters(params)
    out = None if output is None else path_of(output, "output")
    seed = None if seed is None else seed_of(seed)
    if isinstance(input_, Scene):
        record_checks.check(input_, f"scene {input_.name[:LONGEST_NAME]!r}")
        jobs = pipeline.jobs_for(input_, wanted, methods, parameters, seed)
        if out is not None:
            write_results.check_output(out, None)
        with tile_cluster.on_cluster(cluster, log), one_blas_thread():
            return Results(pipeline.execute(Path(input_.name), input_, jobs, log))
    path = files.existing(path_of(input_, "input_", " or a scene"))
    if out is not None:
        write_results.check_output(out, path)
    if wanted:
        pipeline.plan(wanted, methods, parameters, seed)  # wrong names are reported before a long reading
    place = out.resolve() if out else None
    before = fingerprint.signature(path.resolve(), place)
    folder = Path(tempfile.gettempdir()) if out is None else whole_output.existing_parent(out)
    with tile_cluster.on_cluster(cluster, log), large_arrays.in_files(folder), one_blas_thread():
        with stage(f"reading {path.name}"):
            scene, jobs, piecewise = pipeline.prepare(path, units, wanted, methods, parameters, seed)
        # How the input was read; ``chosen`` are the jobs if the program chose them
        chosen = () if wanted else jobs
        log(f"{path.name}: read as {scene.units} ({messages('en').text(scene.units_reason)})")
        if scene.clips is not None:
            log(f"{path.name}: {headline.clipped(scene.clips)}")
        if len(scene.scans) == 2 and [job.step for job in chosen] == ["stitch"]:
            log("two scans without a design are stitched; to measure between them: processor compare A B -o OUT")
        keep = None if so_far is None else partial(_keep, Path(so_far), jobs)
        execution = pipeline.execute(path, scene, jobs, log, piecewise, keep)
    results = Results(execution, evaluate.evaluate(path, execution))
    fingerprint.check_unchanged(path.resolve(), before, place)
    return results


def _keep(folder: Path, jobs: Sequence[pipeline.Job], execution: Execution) -> None:
    """Write what is done, and what was planned, so that it is there whatever ends the run."""
    folder.mkdir(parents=True, exist_ok=True)
    planned = [f"{job.step} ({job.params.method})" for job in jobs]
    store.write_results(folder / RESULTS_H5, execution.runs, {**execution.provenance, "planned": planned})


def write(results: Results, out: Path | None, lang: str = "en", further: Sequence[str] = ()) -> Results:
    """Write the folder of results, in place of an earlier one; returns the results."""
    if out is not None:
        with stage("drawing and writing the report"):
            write_results.write_results(out, results.execution, results.report, lang, further)
    return results


def check(results: Results, truth: Truth) -> tuple[Metric, ...]:
    """Compare results with a truth, e.g. that of :func:`designgen.make`.

    Returns
    -------
    The checks: step, quantity, statistic, value, unit, limit and whether the limit is kept.

    Raises
    ------
    InputError : the truth is that of another scene.
    UsageError : ``results`` are no Results, or ``truth`` is no Truth.
    """
    _check_kind(results, Results, "results", "of processor.run")
    _check_kind(truth, Truth, "truth", "of designgen.make or designgen.scan, which return (scene, truth)")
    return evaluate.against(truth, results.execution, results.scene.name).metrics


def export(
    results: Results | str | Path,
    folder: str | Path,
    what: str = "registered",
    format: str = "e57",
    spacing_mm: float | None = None,
) -> Exported:
    """Write point clouds of a run as a new folder, as ``processor export`` does.

    Parameters
    ----------
    results : of :func:`run`, or a folder of results, whose input is beside it or in the current folder.
    folder : a new or an empty one. It is made whole or not at all.
    what : "registered", each scan with its pose; "merged", all as one cloud in the project's frame; "assembled", the
        parts of a bridge in the bridge's frame; "clean", each scan without outliers and points away from the design;
        "deviation", core points with deviation_mm, lod95_mm and component in the design's frame.
    format : "e57", "las", "laz", "ply" or "xyz". PLY is in mm, the others in metres.
    spacing_mm : least distance of two points; others are left out. None = all points.

    Returns
    -------
    The files by name with their numbers of points, and remarks on what was left out.

    Raises
    ------
    InputError : the input has changed since the run, or the folder cannot be written.
    UsageError : a name is unknown, the folder exists, or a step that is needed was not run.
    """
    source = results.execution if isinstance(results, Results) else path_of(results, "results", " or Results")
    spacing = 0.0 if spacing_mm is None else length_of(spacing_mm, "spacing_mm", zero=True)
    return clouds_export.export(source, path_of(folder, "folder"), what, format, spacing)


def _check_kind(value: Any, kind: type, name: str, source: str) -> None:
    if not isinstance(value, kind):
        raise UsageError(f"{name}: expected {kind.__name__} {source}, got {type(value).__name__}")


def _parameters(params: str | Path | Mapping[str, Any] | None) -> Mapping[str, Any]:
    if isinstance(params, Mapping):
        return {text_of(step, "params: name of a step"): table for step, table in params.items()}
    if params is None:
        return {}
    return pipeline.read_params(path_of(params, "params", " or a mapping of one table per step"))


def _names(value: Names, name: str) -> tuple[str, ...]:
    if value is None:
        return ()
    parts = value.split(",") if isinstance(value, str) else value
    if not isinstance(parts, Sequence) or not all(isinstance(part, str) for part in parts):
        raise UsageError(f"{name}: expected names, in a list or one text with commas, got {value!r}")
    return tuple(part.strip() for part in parts if part.strip())
