"""Many scenes from one recipe: a file for each seed and varied values, an index of all files, and a card of the set.

The bytes of a scene depend only on its recipe, its parameters, its seed and the versions of the software. A scene in
the folder that was made from the same is therefore kept, and the folder is the same whether one process, several, a
cluster, or a run that was killed and started again has made it.
"""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import json
import math
import os
import re
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from designgen import __version__, card, recipe_files
from designgen.card import Content
from processor.jobs import process, runner
from processor.jobs.child import Loss, Lost
from processor.jobs.software import check_same, versions
from processor.model import InputError, UsageError
from processor.plain_text import printable, spreadsheet_text

INDEX = "index.csv"
# Columns of the index by the fields of a content.
COUNTS = {
    "points": "points", "scans": "scans", "surface": "points_surface", "mixed": "points_mixed",
    "outlier": "points_outlier", "defects": "defects",
}  # fmt: skip
MOST_SCENES = 99_999  # in one folder: file names number them by five digits
MOST_SEED = 2**63  # seeds are stored as int64
SOFTWARE = ("h5py", "numba", "numpy", "scipy")  # packages that a scene's bytes depend on; CAD solids are no part of it
SCENE_FILE = re.compile(r".+-\d{5}-seed\d+\.h5")
OF_SET = (INDEX, card.CARD_JSON, card.CARD_PAGE)
LOSSES = {
    Loss.DIED: "the process that made it died twice (out of memory?); run again, with fewer jobs at a time",
    Loss.STOPPED: "stopped",
    Loss.NOT_RUN: "could not be run ({error})",
    Loss.NOT_RUN_BY_WORKER: "a worker of the cluster could not run it ({error})",
}


def make_scene(
    path: Path, name: str, recipe: recipe_files.Recipe, seed: int | None, folder: str = ""
) -> tuple[int, int, int]:
    """Make the scene of a recipe with its truth and write it to ``path``; returns seed, number of scans, and of points.

    ``seed`` replaces the recipe's. Files that it names are in ``folder``, "": the current one. The same recipe and seed
    give the same bytes, whatever the time, host and number of processors. Raises UsageError for a recipe that cannot be
    made, InputError where ``path`` cannot be written.
    """
    from threadpoolctl import threadpool_limits

    from designgen.scenes import make
    from processor.store import store
    from processor.store.whole_output import check_file

    check_file(path, ".h5", "a scene")
    # The last bits of BLAS results depend on the number of threads.
    with threadpool_limits(1, user_api="blas"):
        made, truth = make.make(name, recipe_files.with_files_in(recipe, folder), seed)
        used = recipe.get("seed", 0) if seed is None else seed
        store.write_scene(path, made, truth, _provenance(name, recipe, used, software()))
    return used, len(made.scans), sum(len(scan.points) for scan in made.scans)


def software() -> dict[str, str]:
    """Return the versions of what a scene's bytes depend on, by name; what is not installed is left out."""
    return {"designgen": __version__, **versions(SOFTWARE)}


def _provenance(name: str, recipe: recipe_files.Recipe, seed: int, software: dict[str, str]) -> dict[str, Any]:
    return {"software": software, "recipe": name, "parameters": recipe, "seed": seed}


# --- the jobs ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """One scene to make: all that another process needs, and no arrays."""

    folder: str  # absolute, as a cluster's workers have another working directory
    file: str
    recipe: str
    parameters: recipe_files.Recipe
    seed: int
    varied: tuple[str, ...]  # values as typed, in the order of their keys
    software: dict[str, str]
    files_in: str = ""  # the folder of files that the recipe names: the current one of the command
    indexed: Content | None = None  # of the file in the index of an earlier run


@dataclass(frozen=True)
class Outcome:
    """The end of a job: the content of its file, or the reason why there is none."""

    content: Content | None
    reason: str = ""
    made: bool = True  # False: the file of an earlier run is kept
    replaced: str = ""  # why a file of an earlier run was not kept


def check_usage(
    output: Path, settings: Sequence[str], vary: Sequence[str], *, many: bool, jobs: int | None, cluster: str | None
) -> None:
    """Raise UsageError for options that exclude each other, and if the path of a single scene is a folder."""
    if not many and (jobs is not None or cluster is not None):
        raise UsageError("--jobs and --cluster are for many scenes: add --count or --vary")
    if not many and output.is_dir():
        raise UsageError(
            f"{output}: expected a file for the scene, and this is a folder; for many add --count or --vary"
        )
    if jobs is not None and cluster is not None:
        raise UsageError("--jobs and --cluster exclude each other: a cluster has as many processes as it has workers")
    both = {text.partition("=")[0].strip() for text in settings} & {text.partition("=")[0].strip() for text in vary}
    if both:
        raise UsageError(f"--vary {min(both)}: it is set by --set as well")


def parse_varied(texts: Sequence[str]) -> dict[str, list[str]]:
    """Read settings ``section.key=v1,v2``; returns the values' texts by key, in the order given.

    Commas inside brackets, braces and quotes belong to a value. Raises UsageError for a setting without key or values,
    and for a key or a value given twice.
    """
    varied: dict[str, list[str]] = {}
    for text in texts:
        key, equals, values = (part.strip() for part in text.partition("="))
        if not equals or "." not in key:
            seeds = "; seeds are varied by --seed and --count" if key == "seed" else ""
            raise UsageError(f"--vary {text}: expected section.key=v1,v2,...{seeds}")
        if key in varied:
            raise UsageError(f"--vary {text}: {key} is varied twice")
        varied[key] = _split(values, text)
    return varied


def _split(values: str, text: str) -> list[str]:
    parts, pending = [], ""
    for part in values.split(","):
        pending = f"{pending},{part}" if pending else part
        paired = pending.count("[") == pending.count("]") and pending.count("{") == pending.count("}")
        if paired and pending.count('"') % 2 == 0 and pending.count("'") % 2 == 0:
            parts.append(pending.strip())
            pending = ""
    if pending:
        raise UsageError(f"--vary {text}: a bracket or quote is not closed in {pending!r}")
    if not all(parts):
        raise UsageError(f"--vary {text}: expected values separated by commas, got an empty one")
    if repeated := [value for value in parts if parts.count(value) > 1]:
        raise UsageError(f"--vary {text}: {repeated[0]} is given twice")
    return parts


def plan(
    folder: Path, name: str, recipe: recipe_files.Recipe, varied: dict[str, list[str]], first: int | None, count: int
) -> list[Job]:
    """List the jobs of ``count`` seeds from ``first`` (default: the recipe's) times all varied values.

    The last key varies fastest and the seed slowest, so that a larger count later does not change the numbers of the
    scenes. Raises UsageError for too many scenes, an invalid seed, and a key that does not fit the recipe.
    """
    first = recipe.get("seed", 0) if first is None else first
    if not isinstance(first, int) or isinstance(first, bool) or not 0 <= first <= MOST_SEED - count:
        raise UsageError(f"recipe {name}: seed: expected a whole number from 0 and below 2^63, got {first!r}")
    combinations = math.prod(len(values) for values in varied.values())
    if count * combinations > MOST_SCENES:
        raise UsageError(
            f"{count:,} seed(s) of {combinations:,} combination(s) are {count * combinations:,} scenes; "
            f"a folder holds at most {MOST_SCENES:,}: take several folders"
        )
    stem = re.sub(r"[^\w.+-]+", "_", name).lstrip(".-")[:60] or "scene"
    place, installed = str(folder.resolve()), software()
    jobs: list[Job] = []
    for seed in range(first, first + count):
        for combination in itertools.product(*varied.values()):
            settings = [f"{key}={value}" for key, value in zip(varied, combination, strict=True)]
            jobs.append(
                Job(
                    folder=place,
                    file=f"{stem}-{len(jobs) + 1:05d}-seed{seed}.h5",
                    recipe=name,
                    parameters=recipe_files.overridden(recipe, settings),
                    seed=seed,
                    varied=combination,
                    software=installed,
                    files_in=os.getcwd(),
                )
            )
    return jobs


# --- one job ----------------------------------------------------------------------------------------------------------


def run_job(job: Job) -> Outcome:
    """Make one scene, or keep that of an earlier run; failures are returned as outcomes."""
    try:
        return _made_or_kept(job)
    except Exception as error:  # the other jobs go on
        # On one line, without the folder, so that the index is the same in another place.
        text = " ".join(str(error).split()).replace(f"{job.folder}/", "")
        foreseen = isinstance(error, (UsageError, InputError))
        return Outcome(None, text if foreseen else f"{type(error).__name__}: {text}".rstrip(": "))


def _made_or_kept(job: Job) -> Outcome:
    check_same(software(), job.software)
    path = Path(job.folder, job.file)
    earlier = _earlier(path, job) if path.exists() else ""
    if isinstance(earlier, Content):
        return Outcome(earlier, made=False)
    try:
        make_scene(path, job.recipe, job.parameters, job.seed, job.files_in)
        return Outcome(_content(path), replaced=f"{earlier}; made again" if earlier else "")
    except Exception:
        with suppress(OSError):
            path.unlink(missing_ok=True)  # a scene made from other parameters than those in the index
        raise


def _earlier(path: Path, job: Job) -> Content | str:
    """Return the content of the scene of an earlier run, or the reason why it cannot be kept."""
    from processor.store import checksums, store

    try:
        provenance = store.read_provenance(path)
    except InputError:
        return "is damaged or no scene"
    expected = json.loads(json.dumps(_provenance(job.recipe, job.parameters, job.seed, job.software)))
    if different := [key for key in expected if provenance.get(key) != expected[key]]:
        return f"was made with other {' and '.join(different)}"
    digest = checksums.of_file(path)
    if job.indexed is not None:
        return job.indexed if digest == job.indexed.sha256 else "is damaged (not the bytes that the index has)"
    if problems := store.problems(path):
        return f"is damaged ({problems[0]})"
    return _content(path, digest)


def _content(path: Path, digest: str | None = None) -> Content:
    from processor.store import checksums, store

    scene = store.read_scene(path)
    points = sum(len(scan.points) for scan in scene.scans)
    truth = store.read_truth(path)
    assert truth is not None  # every scene is written with it
    return Content(
        scans=len(scene.scans),
        points=points,
        scene_hash=store.scene_hash(scene),
        sha256=digest or checksums.of_file(path),
        **card.numbers_of(truth),
    )


# --- the folder -------------------------------------------------------------------------------------------------------


def make_many(
    folder: Path,
    jobs: Sequence[Job],
    recipe: recipe_files.Recipe,
    varied: Mapping[str, Sequence[str]],
    processes: int = 1,
    cluster: str | None = None,
) -> dict[str, Any]:
    """Do all jobs of a recipe and write index and card, with the ``varied`` values; returns a summary for JSON.

    Progress and warnings go to standard error. For the main thread. SIGTERM and SIGINT end the program (SystemExit).
    Raises UsageError if the folder is a file or another run is at work in it, or if the cluster does not answer;
    InputError if the cluster is lost on the way or the folder cannot be written.
    """
    from processor.store.making import remove_leftovers
    from processor.store.whole_output import replace_text

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise UsageError(f"{folder}: many scenes need a folder, and there is a file of this name") from None
    busy = f"{folder}: another designgen is making scenes here; wait for it or stop it"
    try:
        with (
            runner.executor(cluster, processes, print_error_line) as executor,
            runner.stoppable() as check_stop,
            runner.locked(folder, busy),
        ):
            indexed = _read_index(folder / INDEX)
            # There is no index until all is done: an older one would list scenes that are being replaced.
            for name in OF_SET:
                (folder / name).unlink(missing_ok=True)
            remove_leftovers(folder)
            # Scenes of other runs stay, and one line says so
            ours = {job.file for job in jobs}
            strangers = sorted(p.name for p in folder.iterdir() if SCENE_FILE.fullmatch(p.name) and p.name not in ours)
            if strangers:
                print_error_line(
                    f"{folder}: {len(strangers)} scene(s) of other runs are left as they are, e.g. {strangers[0]}"
                )
            jobs = [replace(job, indexed=indexed.get(job.file)) for job in jobs]
            try:
                with closing(executor.run(partial(process.in_process, run_job), jobs, check_stop)) as results:
                    outcomes = _outcomes(results, len(jobs))
            finally:
                process.POOL.close()
                remove_leftovers(folder)
            outcomes = _present(folder, outcomes)
            index = _index(jobs, list(varied), outcomes)
            made = _card(folder, jobs, recipe, varied, outcomes, index)
            for name, text in zip(OF_SET, (index, card.as_json(made), card.as_markdown(made)), strict=True):
                replace_text(folder / name, text)
    except runner.StoppedError as stop:
        raise SystemExit(stop.exit_code) from None
    return _summary(folder, jobs, outcomes)


def print_error_line(line: str) -> None:
    """Write one line on standard error, above a progress bar, with its control characters replaced."""
    from tqdm import tqdm

    tqdm.write(printable(line), file=sys.stderr)


def _outcomes(results: runner.Results[Job, Outcome | Lost], total: int) -> dict[str, Outcome]:
    """Collect the outcomes of all jobs by file, with a progress bar on a terminal."""
    from tqdm import tqdm

    outcomes: dict[str, Outcome] = {}
    try:
        with tqdm(total=total, unit="scene", disable=not sys.stderr.isatty()) as bar:
            for job, result in results:
                if isinstance(result, Lost):
                    outcome = Outcome(None, LOSSES[result.loss].format(error=result.error))
                else:
                    outcome = result
                outcomes[job.file] = outcome
                if outcome.replaced:
                    print_error_line(f"{job.file}: {outcome.replaced}")
                bar.update()
    except BaseException:
        print_error_line(f"stopped: {len(outcomes)} of {total} scene(s) are done; run again to go on")
        raise
    return outcomes


def _summary(folder: Path, jobs: Sequence[Job], outcomes: Mapping[str, Outcome]) -> dict[str, Any]:
    failed = [job for job in jobs if outcomes[job.file].content is None]
    done = [(outcome.made, outcome.content) for outcome in outcomes.values() if outcome.content]
    return {
        "folder": str(folder),
        "index": str(folder / INDEX),
        "scenes": len(jobs),
        "done": len(done),
        "made": sum(made for made, _ in done),
        "kept": sum(not made for made, _ in done),
        "points": sum(content.points for _, content in done),
        "failed": [{"file": job.file, "reason": outcomes[job.file].reason} for job in failed],
    }


def _present(folder: Path, outcomes: dict[str, Outcome]) -> dict[str, Outcome]:
    """Replace outcomes whose file is not in the folder: a cluster's worker may have written to a disk of its own."""
    files = set(os.listdir(folder))
    absent = Outcome(None, "made, but not in this folder: all workers must share the folder under the same path")
    return {file: outcome if outcome.content is None or file in files else absent for file, outcome in outcomes.items()}


def _read_index(path: Path) -> dict[str, Content]:
    """Return contents by file name from the index of an earlier run; empty if there is none that can be read."""
    contents = {}
    try:
        for row in csv.DictReader(io.StringIO(path.read_text("utf-8"), newline="")):
            with suppress(KeyError, TypeError, ValueError):  # of a failed scene, or edited
                counts = {name: int(row[column]) for name, column in COUNTS.items()}
                contents[row["file"]] = Content(**counts, scene_hash=row["scene_hash"], sha256=row["sha256"])
    except (OSError, UnicodeDecodeError, csv.Error):
        return {}
    return contents


def _index(jobs: Sequence[Job], keys: Sequence[str], outcomes: Mapping[str, Outcome]) -> str:
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    columns = {**COUNTS, "scene_hash": "scene_hash", "sha256": "sha256"}
    table.writerow(["file", "recipe", "seed", "split", *keys, *columns.values(), "status", "reason"])
    for job in jobs:
        outcome = outcomes[job.file]
        cells = [getattr(outcome.content, name) if outcome.content else "" for name in columns]
        status, reason = "done" if outcome.content else "failed", spreadsheet_text(outcome.reason)
        split = card.split_of(job.seed)
        table.writerow([job.file, job.recipe, job.seed, split, *job.varied, *cells, status, reason])
    return text.getvalue()


def _card(
    folder: Path,
    jobs: Sequence[Job],
    recipe: recipe_files.Recipe,
    varied: Mapping[str, Sequence[str]],
    outcomes: Mapping[str, Outcome],
    index: str,
) -> dict[str, Any]:
    from processor.store import store

    made = [(job, content) for job in jobs if (content := outcomes[job.file].content)]
    truth = store.read_truth(folder / made[0][0].file) if made else None
    labels = card.labels_of(truth) if truth else []
    digest, scenes = hashlib.sha256(index.encode()).hexdigest(), [(job.seed, content) for job, content in made]
    failed = len(jobs) - len(made)
    return card.of_set(jobs[0].recipe, recipe, varied, jobs[0].software, scenes, failed, labels, digest)
