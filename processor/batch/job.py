"""One job, from its input to its results under their final name; run by a thread here, or on a cluster's worker."""

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
from pathlib import Path
from typing import Any

from processor.batch import figures, record
from processor.batch.record import JobStatus, Record
from processor.jobs import process
from processor.jobs.process import Cause
from processor.jobs.software import OtherSoftwareError, check_same, versions
from processor.language.messages import messages
from processor.model import InputError, Reason, reason
from processor.scan_folder import fingerprint
from processor.store.atomic_file import sync
from processor.version import __version__

PACKAGES = (
    "ezdxf",
    "h5py",
    "laspy",
    "lazrs",
    "numba",
    "numpy",
    "plyfile",
    "pye57",
    "python-neo-lzf",
    "scipy",
    "trimesh",
)
# By the exit code of `processor run`.
STATUS = {0: JobStatus.DONE, 1: JobStatus.IN_PART, 4: JobStatus.LIMIT_MISSED}
WITH_RESULTS = tuple(STATUS.values())
# Errors of the output folder, not of an input.
OUTPUT_GONE = tuple(os.strerror(code) for code in (errno.ENOSPC, errno.EDQUOT, errno.EROFS))
STOPPED = reason("batch.stopped")


class OutputGoneError(InputError):
    """Results cannot be written any more, whatever the input."""


@dataclass(frozen=True)
class Job:
    """All that another process needs to do a job: paths and texts, no arrays. Paths are absolute."""

    name: str
    source: Path
    root: Path
    out: Path  # of the batch
    place: Path  # of the results
    log: Path
    failed: Path  # of the record of a failure
    work: Path
    token_file: Path
    token: str  # of this run of the batch, which is over when the file holds another one
    arguments: tuple[str, ...]
    parameters: dict[str, Any]
    software: dict[str, str]
    timeout_s: float
    memory_mb: int
    threads: int
    retry: bool = False
    program: tuple[str, ...] = process.GUARDED


@cache
def software() -> dict[str, str]:
    """Return the versions of what results depend on; that of the processor with a hash of its files."""
    digest = hashlib.sha256()
    package = Path(__file__).parents[1]
    for path in sorted(path for path in package.rglob("*") if path.suffix in (".py", ".toml", ".html", ".js", ".css")):
        digest.update(f"{path.relative_to(package)}\0".encode() + hashlib.sha256(path.read_bytes()).digest())
    sources = f"{__version__} {digest.hexdigest()[:16]}"
    return {"processor": sources, "python": ".".join(map(str, sys.version_info[:3])), **versions(PACKAGES)}


def do(job: Job, stopped: Callable[[], bool] = process.never) -> Record:
    """Do a job, or return the record of an earlier run of the batch if input, parameters and software are the same.

    Failures are returned as records. Raises OutputGoneError if results cannot be written.
    """

    def over() -> bool:
        return stopped() or _token(job) != job.token

    try:
        check_same(software(), job.software)
        input_sha256 = fingerprint.content_hash(job.source, job.out)
        identity = record.identity(input_sha256, job.parameters, job.software)
        earlier = _earlier(job, identity)
        if earlier is not None:
            return dataclasses.replace(earlier, kept=True)
        if over():
            return _passing(job, STOPPED)
        return _processed(job, input_sha256, identity, over)
    except OutputGoneError:
        raise
    except OtherSoftwareError as error:
        return _passing(job, reason("batch.other-software", difference=error.args[0]))
    except (InputError, OSError) as error:
        text = str(error)
        if any(sign in text for sign in OUTPUT_GONE):
            raise OutputGoneError(text) from error
        return _passing(job, reason("batch.error", message=_plain(job, text)))


def _passing(job: Job, why: Reason) -> Record:
    """Record a failure that is tried again in the next run."""
    return Record(input=job.name, identity="", status=JobStatus.FAILED, reason=why, lasting=False)


def _token(job: Job) -> str:
    try:
        return job.token_file.read_text("utf-8")
    except OSError:
        return ""


def _earlier(job: Job, identity: str) -> Record | None:
    """Return the record of an earlier run, if it still holds."""
    done = record.read(job.place / record.RECORD)
    if done is not None and done.identity == identity and done.status in WITH_RESULTS:
        whole = (job.place / "report.html").is_file() and (job.place / "results.h5").is_file()
        if whole and record.sha256_of(job.place / record.RESULTS) == done.results_sha256:
            return done
    failed = record.read(job.failed)
    if failed is None or failed.identity != identity or failed.status != JobStatus.FAILED or job.retry:
        return None
    now = {"timeout_s": job.timeout_s, "memory_mb": float(job.memory_mb)}
    more = any(now.get(name, 0.0) > limit for name, limit in failed.limits.items())
    return None if more else failed


def _processed(job: Job, input_sha256: str, identity: str, over: Callable[[], bool]) -> Record:
    """Run the processor and move its results, or the record of its failure, to their final name."""
    job.work.mkdir(parents=True, exist_ok=True)
    job.log.parent.mkdir(parents=True, exist_ok=True)
    making = Path(tempfile.mkdtemp(dir=job.work))
    try:
        made = making / "results"
        ended = _run(job, identity, made, over)
        if ended.cause is Cause.STOPPED:
            return _passing(job, STOPPED)
        status, why, limits, results = _assessed(job, ended, made)
        if why is not None and any(sign in ended.last_line for sign in OUTPUT_GONE):
            raise OutputGoneError(messages("en").text(why))
        if fingerprint.content_hash(job.source, job.out) != input_sha256:
            return _passing(job, reason("batch.input-changed"))
        if over():
            return _passing(job, STOPPED)
        ending = Record(
            input=job.name,
            identity=identity,
            status=status,
            reason=why,
            input_sha256=input_sha256,
            limits=limits,
            seconds=round(ended.seconds, 3),
            peak_mb=round(ended.peak_mb, 1),
        )
        if results is None:
            _remove_results(job)  # of an earlier state of the input
            record.write(job.failed, ending)
            return ending
        digest = record.sha256_of(made / record.RESULTS)
        ending = dataclasses.replace(
            ending, results_sha256=digest, figures=figures.of_results(results), steps=figures.step_status(results)
        )
        record.write(made / record.RECORD, ending)
        _publish(job, made)
        job.failed.unlink(missing_ok=True)
        return ending
    finally:
        shutil.rmtree(making, ignore_errors=True)


def _run(job: Job, identity: str, made: Path, over: Callable[[], bool]) -> process.Ended:
    with job.log.open("a", encoding="utf-8") as log:
        log.write(f"--- {job.token} {identity}\n")
    return process.run(
        (*job.program, str(job.memory_mb), "processor", "run", str(job.source), "-o", str(made), *job.arguments),
        log=job.log,
        env=process.environment(job.threads, PYTHONFAULTHANDLER="1"),
        timeout_s=job.timeout_s,
        memory_mb=job.memory_mb,
        stopped=over,
    )


_Assessed = tuple[JobStatus, Reason | None, dict[str, float], dict[str, Any] | None]


def _assessed(job: Job, ended: process.Ended, made: Path) -> _Assessed:
    """Return the status of a process that ended, the reason, the limits that ended it, and its results."""
    if ended.cause is Cause.TIME:
        return _failure(reason("batch.timeout", limit=job.timeout_s), timeout_s=job.timeout_s)
    last = _plain(job, ended.last_line.replace(str(made), record.RESULTS), 500)
    if ended.cause is Cause.MEMORY or "MemoryError" in last or "Unable to allocate" in last:
        return _failure(reason("batch.memory", limit=job.memory_mb), memory_mb=float(job.memory_mb))
    if ended.cause is Cause.SIGNAL:
        with suppress(ValueError):
            name = signal.Signals(ended.code).name
            return _failure(reason("batch.crashed", signal=name, number=ended.code))
        return _failure(reason("batch.crashed-unnamed", number=ended.code))
    if ended.code in STATUS:
        try:
            results = json.loads((made / record.RESULTS).read_text("utf-8"))
            if results["format"] != "processor-results" or not (made / "report.html").is_file():
                raise ValueError(results["format"])
            return STATUS[ended.code], None, {}, results
        except (OSError, ValueError, TypeError, KeyError):
            pass
    elif last.startswith("error: "):
        return _failure(reason("batch.error", message=last.removeprefix("error: ")))
    if last:
        return _failure(reason("batch.no-results-but", exit_code=ended.code, last=last))
    return _failure(reason("batch.no-results", exit_code=ended.code))


def _failure(why: Reason, **limits: float) -> _Assessed:
    return JobStatus.FAILED, why, limits, None


def _plain(job: Job, text: str, most: int = 2000) -> str:
    """Return a text on one line with relative paths: the summary does not depend on where the folders are."""
    for folder in (job.root, job.out):
        text = text.replace(f"{folder}/", "") if str(folder) != "/" else text
    text = " ".join(text.replace(str(job.source), job.source.name).split())
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)[:most]


def _publish(job: Job, made: Path) -> None:
    """Move results to their final name by one renaming, in place of earlier ones."""
    try:
        for path in made.rglob("*"):
            if path.is_dir():
                sync(path)
        sync(made)
        job.place.parent.mkdir(parents=True, exist_ok=True)
        _remove_results(job)
        os.replace(made, job.place)
        sync(job.place.parent)
    except OSError as error:
        raise InputError(f"{job.place}: cannot be written ({error.strerror or error})") from error


def _remove_results(job: Job) -> None:
    """Remove earlier results. Raises InputError if something else has their name."""
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
