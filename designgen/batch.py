"""Many scenes from one recipe: a file for every combination of seed and varied values, and an index of them all.

A scene's bytes depend on its recipe, its parameters, its seed and the versions of the software, on nothing else. So a
scene that is in the folder already, made from the same, is kept, and the folder is the same whatever made it: one
process, several, a cluster, or a run that was killed and started again.
"""

from __future__ import annotations

import copy
import csv
import fcntl
import hashlib
import io
import itertools
import json
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from designgen import __version__, recipes, spread
from processor.model import InputError, UsageError

INDEX = "index.csv"
MOST_SCENES = 99_999  # in one folder: file names number them by five digits
MOST_SEED = 2**63
SOFTWARE = ("h5py", "numba", "numpy", "scipy")  # packages that a scene's bytes depend on; CAD solids are no part of it
SCENE_FILE = re.compile(r".+-\d{5}-seed\d+\.h5")
LEFTOVER = re.compile(rf"\.({SCENE_FILE.pattern}|{re.escape(INDEX)})\.\d+-[0-9a-f]{{8}}\.tmp")


def make_scene(path: Path, name: str, recipe: recipes.Recipe, seed: int | None) -> tuple[int, int, int]:
    """Make the scene of a recipe with its truth and write it to ``path``: its seed, number of scans, and of points.

    ``seed`` replaces the recipe's own. The same recipe and seed give the same bytes, whatever the time, host and number
    of processors. Raises UsageError for a recipe that cannot be made, InputError where ``path`` cannot be written.
    """
    from threadpoolctl import threadpool_limits

    from designgen.scenes import make
    from processor.store import store

    # BLAS cuts its sums differently for other numbers of threads, and with them the last bits.
    with threadpool_limits(1, user_api="blas"):
        made, truth = make.make(name, recipe, seed)
        used = recipe.get("seed", 0) if seed is None else seed
        store.write_scene(path, made, truth, _provenance(name, recipe, used, software()))
    return used, len(made.scans), sum(len(scan.points) for scan in made.scans)


def software() -> dict[str, str]:
    """Versions of what a scene's bytes depend on, by name; what is not installed is left out."""
    found = {"designgen": __version__}
    for name in SOFTWARE:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def _provenance(name: str, recipe: recipes.Recipe, seed: int, software: dict[str, str]) -> dict[str, Any]:
    return {"software": software, "recipe": name, "parameters": recipe, "seed": seed}


# --- what is to be made -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Content:
    """What the index says of a scene file; both hashes in hex."""

    scans: int
    points: int
    scene_hash: str
    sha256: str


@dataclass(frozen=True)
class Job:
    """One scene to make: all that a process elsewhere needs, and no arrays."""

    folder: str  # absolute: a cluster's workers have another working directory
    file: str
    recipe: str
    parameters: recipes.Recipe
    seed: int
    varied: tuple[str, ...]  # values as they were typed, in the order of their keys
    software: dict[str, str]
    known: Content | None = None  # from the index of an earlier run


@dataclass(frozen=True)
class Outcome:
    """What became of a job: the content of its file, or the reason why there is none."""

    content: Content | None
    reason: str = ""
    made: bool = True  # False: was there already
    said: str = ""  # why a file that was there was not kept


def check_usage(
    output: Path, settings: Sequence[str], vary: Sequence[str], *, many: bool, jobs: int | None, cluster: str | None
) -> None:
    """Raise UsageError for options that do not go together, and for a folder where the one scene should be."""
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
    """Read ``section.key=v1,v2`` settings: the values' texts by key, in the order given.

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
    found, pending = [], ""
    for part in values.split(","):
        pending = f"{pending},{part}" if pending else part
        paired = pending.count("[") == pending.count("]") and pending.count("{") == pending.count("}")
        if paired and pending.count('"') % 2 == 0 and pending.count("'") % 2 == 0:
            found.append(pending.strip())
            pending = ""
    if pending:
        raise UsageError(f"--vary {text}: a bracket or quote is not closed in {pending!r}")
    if not all(found):
        raise UsageError(f"--vary {text}: expected values separated by commas, got an empty one")
    if repeated := [value for value in found if found.count(value) > 1]:
        raise UsageError(f"--vary {text}: {repeated[0]} is given twice")
    return found


def plan(
    folder: Path, name: str, recipe: recipes.Recipe, varied: dict[str, list[str]], first: int | None, count: int
) -> list[Job]:
    """List the jobs of ``count`` seeds from ``first`` (default: the recipe's own) times all varied values.

    The last key varies fastest and the seed slowest, so that a larger count later leaves the numbers of the scenes as
    they are. Raises UsageError for too many scenes, a seed that is none, and a key that does not fit the recipe.
    """
    first = recipe.get("seed", 0) if first is None else first
    if not isinstance(first, int) or isinstance(first, bool) or not 0 <= first <= MOST_SEED - count:
        raise UsageError(f"recipe {name}: seed: expected a whole number from 0 and below 2^63, got {first!r}")
    combinations = 1
    for values in varied.values():
        combinations *= len(values)
    if count * combinations > MOST_SCENES:
        raise UsageError(
            f"{count:,} seed(s) of {combinations:,} combination(s) are {count * combinations:,} scenes; "
            f"a folder holds at most {MOST_SCENES:,}: take several folders"
        )
    stem = re.sub(r"[^\w.+-]+", "_", name).lstrip(".-")[:60] or "scene"
    place, versions = str(folder.resolve()), software()
    jobs: list[Job] = []
    for seed in range(first, first + count):
        for combination in itertools.product(*varied.values()):
            settings = [f"{key}={value}" for key, value in zip(varied, combination, strict=True)]
            # A copy, as settings of deeper sections would reach into the recipe that all jobs come from.
            parameters = recipes.overridden(copy.deepcopy(recipe), settings)
            file = f"{stem}-{len(jobs) + 1:05d}-seed{seed}.h5"
            jobs.append(Job(place, file, name, parameters, seed, combination, versions))
    return jobs


# --- one job ----------------------------------------------------------------------------------------------------------


def run_job(job: Job) -> Outcome:
    """Make one scene, or keep the one that is there; whatever goes wrong is in the outcome."""
    try:
        return _done(job)
    except Exception as error:  # the one place where a batch catches: the rest of the jobs go on
        # On one line, without the folder: the index is the same in another place.
        text = " ".join(str(error).split()).replace(f"{job.folder}/", "")
        foreseen = isinstance(error, (UsageError, InputError))
        return Outcome(None, text if foreseen else f"{type(error).__name__}: {text}".rstrip(": "))


def _done(job: Job) -> Outcome:
    here = software()
    if other := sorted(name for name in {*here, *job.software} if here.get(name) != job.software.get(name)):
        said = ", ".join(f"{name} {here.get(name, 'none')}, not {job.software.get(name, 'none')}" for name in other)
        raise InputError(f"a worker has other software: {said}; install the same everywhere")
    path = Path(job.folder, job.file)
    found = _kept(path, job) if path.exists() else ""
    if isinstance(found, Content):
        return Outcome(found, made=False)
    try:
        make_scene(path, job.recipe, job.parameters, job.seed)
        return Outcome(_content(path), said=f"{found}; made again" if found else "")
    except Exception:
        with suppress(OSError):
            path.unlink(missing_ok=True)  # what is there is not the scene that the index speaks of
        raise


def _kept(path: Path, job: Job) -> Content | str:
    """Return the content of a scene that is there already, or why it cannot be kept."""
    from processor.store import store

    try:
        found = store.read_provenance(path)
    except InputError:
        return "is damaged or no scene"
    wanted = json.loads(json.dumps(_provenance(job.recipe, job.parameters, job.seed, job.software)))
    if other := [key for key in wanted if found.get(key) != wanted[key]]:
        return f"was made with other {' and '.join(other)}"
    digest = _sha256(path)
    if job.known is not None:
        return job.known if digest == job.known.sha256 else "is damaged (not the bytes that the index has)"
    if problems := store.problems(path):
        return f"is damaged ({problems[0]})"
    return _content(path, digest)


def _content(path: Path, digest: str | None = None) -> Content:
    from processor.store import store

    scene = store.read_scene(path)
    points = sum(len(scan.points) for scan in scene.scans)
    return Content(len(scene.scans), points, store.scene_hash(scene), digest or _sha256(path))


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


# --- all of them ------------------------------------------------------------------------------------------------------


def make_many(
    folder: Path, jobs: Sequence[Job], keys: Sequence[str], processes: int = 1, cluster: str | None = None
) -> dict[str, Any]:
    """Do all jobs and write the index, ``keys`` the varied ones: what there is to say, as JSON can hold it.

    Progress and what is remarkable go to standard error. For the main thread, as it answers SIGTERM. Raises UsageError
    where the folder is a file or another run is at work in it, or where the cluster does not answer; InputError where
    the cluster is lost on the way or the folder cannot be written.
    """
    from tqdm import tqdm

    _make_folder(folder)
    spreading = spread.over_cluster(cluster) if cluster else spread.over_processes(processes)
    with (
        spread.stoppable(),
        _alone_in(folder),
        spreading as do,
        tqdm(total=len(jobs), unit="scene", disable=not sys.stderr.isatty()) as bar,
    ):

        def say(line: str) -> None:
            tqdm.write("".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in line), file=sys.stderr)

        known = _read_index(folder / INDEX)
        # Until all is done there is no index: a stale one would speak of scenes that are being replaced.
        (folder / INDEX).unlink(missing_ok=True)
        _remove_leftovers(folder)
        _name_strangers(folder, jobs, say)
        jobs = [replace(job, known=known.get(job.file)) for job in jobs]
        outcomes: dict[str, Outcome] = {}
        try:
            with closing(do(run_job, jobs)) as results:
                for job, result in results:
                    outcome = Outcome(None, result.reason) if isinstance(result, spread.Lost) else result
                    outcomes[job.file] = outcome
                    if outcome.said:
                        say(f"{job.file}: {outcome.said}")
                    bar.update()
        except BaseException:
            say(f"stopped: {len(outcomes)} of {len(jobs)} scene(s) are done; run again to go on")
            raise
        finally:
            _remove_leftovers(folder)
        outcomes = _seen_here(folder, outcomes)
        _write_index(folder / INDEX, jobs, keys, outcomes)
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


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise UsageError(f"{folder}: many scenes need a folder, and there is a file of this name") from None


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Hold the folder, so that two runs cannot remove each other's temporary files."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(f"{folder}: another designgen is making scenes here; wait for it or stop it") from None
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(handle)


def _remove_leftovers(folder: Path) -> None:
    """Remove the temporary files of runs that were killed."""
    for path in folder.iterdir():
        if LEFTOVER.fullmatch(path.name):
            path.unlink(missing_ok=True)


def _name_strangers(folder: Path, jobs: Sequence[Job], say: Callable[[str], None]) -> None:
    ours = {job.file for job in jobs}
    strangers = sorted(p.name for p in folder.iterdir() if SCENE_FILE.fullmatch(p.name) and p.name not in ours)
    if strangers:
        say(f"{folder}: {len(strangers)} scene(s) of other runs are left as they are, e.g. {strangers[0]}")


def _seen_here(folder: Path, outcomes: dict[str, Outcome]) -> dict[str, Outcome]:
    """Let those fail whose file is not in the folder: a cluster's worker may have written to a disk of its own."""
    there = set(os.listdir(folder))
    lost = Outcome(None, "made, but not in this folder: all workers must share the folder under the same path")
    return {file: one if one.content is None or file in there else lost for file, one in outcomes.items()}


def _read_index(path: Path) -> dict[str, Content]:
    """Contents by file name from the index of an earlier run; empty where there is none that can be read."""
    known = {}
    try:
        for row in csv.DictReader(io.StringIO(path.read_text("utf-8"), newline="")):
            with suppress(KeyError, TypeError, ValueError):  # of a failed scene, or by another hand
                content = Content(int(row["scans"]), int(row["points"]), row["scene_hash"], row["sha256"])
                known[row["file"]] = content
    except (OSError, UnicodeDecodeError, csv.Error):
        return {}
    return known


def _write_index(path: Path, jobs: Sequence[Job], keys: Sequence[str], outcomes: dict[str, Outcome]) -> None:
    from processor.store import store

    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["file", "recipe", "seed", *keys, "points", "scans", "scene_hash", "sha256", "status", "reason"])
    for job in jobs:
        outcome = outcomes[job.file]
        one = outcome.content
        content = [one.points, one.scans, one.scene_hash, one.sha256] if one else [""] * 4
        status = "done" if one else "failed"
        table.writerow([job.file, job.recipe, job.seed, *job.varied, *content, status, outcome.reason])
    with store.replacing(path) as temporary:
        temporary.write_text(text.getvalue(), "utf-8")
