"""One job, from its input to its results under their final name; done by a thread here, or on a cluster's worker."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import os
import secrets
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from processor.batch import figures, record
from processor.batch.record import FAILED, Record
from processor.jobs import process
from processor.model import InputError
from processor.scan_folder import fingerprint
from processor.version import __version__

PACKAGES = ("ezdxf", "h5py", "laspy", "lazrs", "numba", "numpy", "plyfile", "pye57", "pypcd4", "scipy", "trimesh")
PROGRAM = (sys.executable, "-m", "processor.batch.child")
STATUS = {0: "done", 1: "in-part", 4: "limit-missed"}  # by the exit code of `processor run`
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
# What no input can be blamed for: nothing more can be written.
OUTPUT_GONE = tuple(os.strerror(code) for code in (errno.ENOSPC, errno.EDQUOT, errno.EROFS))
STOPPED = "stopped before it ended"


class OutputGoneError(InputError):
    """Results cannot be written any more, whatever the input."""


@dataclass(frozen=True)
class Job:
    """All that a process elsewhere needs to do a job: paths and texts, no arrays. Paths are absolute."""

    name: str
    source: Path
    root: Path
    out: Path  # of the batch
    place: Path  # of the results
    log: Path
    failed: Path  # of the record of a failure
    work: Path
    token_file: Path
    token: str  # of this run of the batch: where the file says another one, it is over
    arguments: tuple[str, ...]
    parameters: dict[str, Any]
    software: dict[str, str]
    timeout_s: float
    memory_mb: int
    threads: int
    retry: bool = False
    program: tuple[str, ...] = PROGRAM


@cache
def software() -> dict[str, str]:
    """Versions of what results depend on; that of the processor itself with a hash of its files."""
    found = {"python": ".".join(map(str, sys.version_info[:3]))}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    digest = hashlib.sha256()
    package = Path(__file__).parents[1]
    for path in sorted(one for one in package.rglob("*") if one.suffix in (".py", ".toml", ".html", ".js", ".css")):
        digest.update(f"{path.relative_to(package)}\0".encode() + hashlib.sha256(path.read_bytes()).digest())
    return {"processor": f"{__version__} {digest.hexdigest()[:16]}", **found}


def do(job: Job, stopped: Callable[[], bool] = lambda: False) -> Record:
    """Do a job, or take what an earlier run of the batch has found of the same input.

    Whatever goes wrong is in the record. Raises OutputGoneError where results cannot be written.
    """

    def over() -> bool:
        return stopped() or _token(job) != job.token

    try:
        if software() != job.software:
            return _passing(job, _other_software(job))
        before = fingerprint.content_hash(job.source, job.out)
        made_from = record.identity(before, job.parameters, job.software)
        earlier = _earlier(job, made_from)
        if earlier is not None:
            return dataclasses.replace(earlier, kept=True)
        if over():
            return _passing(job, STOPPED)
        return _done(job, before, made_from, over)
    except OutputGoneError:
        raise
    except (InputError, OSError) as error:
        text = str(error)
        if any(sign in text for sign in OUTPUT_GONE):
            raise OutputGoneError(text) from error
        return _passing(job, text)


def _passing(job: Job, reason: str) -> Record:
    return Record(job.name, "", FAILED, _plain(job, reason), lasting=False)


def _token(job: Job) -> str:
    try:
        return job.token_file.read_text("utf-8")
    except OSError:
        return ""


def _other_software(job: Job) -> str:
    here = software()
    other = sorted(name for name in {*here, *job.software} if here.get(name) != job.software.get(name))
    said = ", ".join(f"{name} {here.get(name, 'none')}, not {job.software.get(name, 'none')}" for name in other)
    return f"a worker has other software: {said}; install the same everywhere"


def _earlier(job: Job, made_from: str) -> Record | None:
    """Return what is known of the job, if it still holds."""
    done = record.read(job.place / record.RECORD)
    if done is not None and done.identity == made_from and done.status in record.WITH_RESULTS:
        whole = (job.place / "report.html").is_file() and (job.place / "results.h5").is_file()
        if whole and record.sha256_of(job.place / record.RESULTS) == done.results_sha256:
            return done
    failed = record.read(job.failed)
    if failed is None or failed.identity != made_from or failed.status != FAILED or job.retry:
        return None
    now = {"timeout_s": job.timeout_s, "memory_mb": float(job.memory_mb)}
    more = any(now.get(name, 0.0) > limit for name, limit in failed.limits.items())
    return None if more else failed


def _done(job: Job, before: str, made_from: str, over: Callable[[], bool]) -> Record:
    job.work.mkdir(parents=True, exist_ok=True)
    job.log.parent.mkdir(parents=True, exist_ok=True)
    making = Path(tempfile.mkdtemp(dir=job.work))
    try:
        made = making / "results"
        with job.log.open("a", encoding="utf-8") as log:
            log.write(f"--- {job.token} {made_from}\n")
        env = {**os.environ, **dict.fromkeys(THREADS, str(job.threads)), "PYTHONFAULTHANDLER": "1"}
        arguments = ("run", str(job.source), "-o", str(made), *job.arguments)
        command = (*job.program, str(job.memory_mb), *arguments)
        ended = process.run(command, job.log, env, job.timeout_s, job.memory_mb, over)
        if ended.why == "stopped":
            return _passing(job, STOPPED)
        status, reason, limits, results = _judged(job, ended, made)
        if status == FAILED and any(sign in ended.last_line for sign in OUTPUT_GONE):
            raise OutputGoneError(reason)
        after = fingerprint.content_hash(job.source, job.out)
        if after != before:
            text = "the input changed while it was processed, so nothing is kept; run again when it is complete"
            return _passing(job, text)
        found = Record(
            job.name, made_from, status, reason, before, limits=limits,
            seconds=round(ended.seconds, 3), peak_mb=round(ended.peak_mb, 1),
        )  # fmt: skip
        if over():
            return _passing(job, STOPPED)
        if results is not None:
            digest = record.sha256_of(made / record.RESULTS)
            found = dataclasses.replace(found, results_sha256=digest, figures=figures.of_results(results))
            record.write(made / record.RECORD, found)
            _publish(job, made)
            job.failed.unlink(missing_ok=True)
        else:
            _remove_results(job)  # of the input as it was
            record.write(job.failed, found)
        return found
    finally:
        shutil.rmtree(making, ignore_errors=True)


def _judged(job: Job, ended: process.Ended, made: Path) -> tuple[str, str, dict[str, float], dict[str, Any] | None]:
    """Return status, reason, the limits that ended it, and its results."""
    if ended.why == "time":
        return FAILED, f"took longer than {job.timeout_s:g} s (--timeout-s)", {"timeout_s": job.timeout_s}, None
    last = _plain(job, ended.last_line.replace(str(made), record.RESULTS), 500)
    if ended.why == "memory" or "MemoryError" in last or "Unable to allocate" in last:
        limits = {"memory_mb": float(job.memory_mb)}
        return FAILED, f"needs more memory than {job.memory_mb} MB (--memory-mb)", limits, None
    if ended.why == "signal":
        with suppress(ValueError):
            return FAILED, f"crashed: {signal.Signals(ended.code).name} (signal {ended.code})", {}, None
        return FAILED, f"crashed: signal {ended.code}", {}, None
    if ended.code in STATUS:
        try:
            results = json.loads((made / record.RESULTS).read_text("utf-8"))
            if results["format"] != "processor-results" or not (made / "report.html").is_file():
                raise ValueError(results["format"])
            return STATUS[ended.code], "", {}, results
        except (OSError, ValueError, TypeError, KeyError):
            pass
    elif last.startswith("error: "):
        return FAILED, last.removeprefix("error: "), {}, None
    return FAILED, f"ended with exit code {ended.code} and without results{': ' if last else ''}{last}", {}, None


def _plain(job: Job, text: str, most: int = 2000) -> str:
    """On one line and without the folders' own places: the summary is the same wherever these are."""
    for folder in (job.root, job.out):
        text = text.replace(f"{folder}/", "") if str(folder) != "/" else text
    text = " ".join(text.replace(str(job.source), job.source.name).split())
    return "".join(one if one.isprintable() else "\N{REPLACEMENT CHARACTER}" for one in text)[:most]


def _publish(job: Job, made: Path) -> None:
    """Move results to their final name, in place of earlier ones; they come to be there by one renaming."""
    try:
        for one in made.rglob("*"):
            if one.is_dir():
                record.sync(one)
        record.sync(made)
        job.place.parent.mkdir(parents=True, exist_ok=True)
        _remove_results(job)
        os.replace(made, job.place)
        record.sync(job.place.parent)
    except OSError as error:
        raise InputError(f"{job.place}: cannot be written ({error.strerror or error})") from error


def _remove_results(job: Job) -> None:
    """Take earlier results away. Raises InputError where something else is under their name."""
    if not os.path.lexists(job.place):
        return
    with suppress(OSError):
        job.place.rmdir()  # empty
        return
    if job.place.is_symlink() or not (job.place / record.RESULTS).is_file():
        raise InputError(f"{job.place}: is there and holds no results; take it away or name another folder")
    old = job.work / f"old-{secrets.token_hex(8)}"
    os.replace(job.place, old)
    shutil.rmtree(old, ignore_errors=True)
