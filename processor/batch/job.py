"""One job, from its input to its results under their final name; run by a thread here, or on a cluster's worker."""

from __future__ import annotations

import dataclasses
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

from processor.batch import record
from processor.batch.record import JobStatus, Record
from processor.batch.summary_values import step_status, summary_values
from processor.jobs import exit_codes, process
from processor.jobs.causes import Cause, cause_of
from processor.jobs.software import OtherSoftwareError, check_same, source_digest, versions
from processor.language.messages import messages
from processor.model import InputError, Reason, reason
from processor.plain_text import printable
from processor.results.file_names import FORMAT, JOB_RECORD, REPORT_PAGE, RESULTS_H5, RESULTS_JSON
from processor.scan_folder import fingerprint
from processor.store.whole_output import sync
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
)
# By the exit code of `processor run`.
STATUS = {
    exit_codes.DONE: JobStatus.DONE,
    exit_codes.IN_PART: JobStatus.IN_PART,
    exit_codes.LIMIT_MISSED: JobStatus.LIMIT_MISSED,
}
WITH_RESULTS = tuple(STATUS.values())
STOPPED, KILLED = reason("batch.stopped"), reason("batch.killed")


class OutputGoneError(InputError):
    """Results cannot be written any more, whatever the input."""


@dataclass(frozen=True)
class Job:
    """All that another process needs to do a job: paths and texts, no arrays. Paths are absolute."""

    name: str
    source: Path
    root: Path
    out: Path  # of the batch
    results_folder: Path
    log: Path
    failure_record: Path
    work_folder: Path
    token_file: Path
    batch_token: str  # of this run of the batch, which is over when the file holds another one
    run_options: tuple[str, ...]
    identity_parameters: dict[str, Any]
    software: dict[str, str]
    timeout_s: float
    memory_mb: int
    threads: int
    retry: bool = False
    program: tuple[str, ...] = process.GUARDED


@cache
def software() -> dict[str, str]:
    """Return the versions of what results depend on; that of the processor with a hash of its files."""
    sources = f"{__version__} {source_digest(('processor',), ('.py', '.toml', '.html', '.js', '.css'))[:16]}"
    return {"processor": sources, "python": ".".join(map(str, sys.version_info[:3])), **versions(PACKAGES)}


def run_job(job: Job, stopped: Callable[[], bool] = process.never) -> Record:
    """Do a job, or return the record of an earlier run of the batch if input, parameters and software are the same.

    Failures are returned as records. Raises OutputGoneError if results cannot be written.
    """

    def batch_ended() -> bool:
        try:
            token = job.token_file.read_text("utf-8")
        except OSError:
            token = ""
        return stopped() or token != job.batch_token

    try:
        check_same(software(), job.software)
        input_sha256 = fingerprint.content_hash(job.source, job.out)
        identity = record.identity(input_sha256, job.identity_parameters, job.software)
        earlier = _still_valid_record(job, identity)
        if earlier is not None:
            return dataclasses.replace(earlier, kept=True)
        if batch_ended():
            return _failure_to_retry(job, STOPPED)
        return _processed(job, input_sha256, identity, batch_ended)
    except OutputGoneError:
        raise
    except OtherSoftwareError as error:
        return _failure_to_retry(job, reason("batch.other-software", difference=error.args[0]))
    except (InputError, OSError) as error:
        if cause_of(error) is Cause.OUTPUT:
            raise OutputGoneError(str(error)) from error
        return _failure_to_retry(job, reason("batch.error", message=_one_line(job, str(error))))


def _failure_to_retry(job: Job, why: Reason) -> Record:
    """Record a failure that is tried again in the next run."""
    return Record(input=job.name, identity="", status=JobStatus.FAILED, reason=why)


def _still_valid_record(job: Job, identity: str) -> Record | None:
    """Return the record of an earlier run, if it still holds."""
    done = record.read(job.results_folder / JOB_RECORD)
    if done is not None and done.identity == identity and done.status in WITH_RESULTS:
        whole = (job.results_folder / REPORT_PAGE).is_file() and (job.results_folder / RESULTS_H5).is_file()
        if whole and record.sha256_of(job.results_folder / RESULTS_JSON) == done.results_sha256:
            return done
    failed = record.read(job.failure_record)
    if failed is None or failed.identity != identity or failed.status != JobStatus.FAILED or job.retry:
        return None
    now = {"timeout_s": job.timeout_s, "memory_mb": float(job.memory_mb)}
    more = any(now.get(name, 0.0) > limit for name, limit in failed.limits.items())
    return None if more else failed


def _processed(job: Job, input_sha256: str, identity: str, batch_ended: Callable[[], bool]) -> Record:
    """Run the processor and move its results, or the record of its failure, to their final name."""
    job.work_folder.mkdir(parents=True, exist_ok=True)
    job.log.parent.mkdir(parents=True, exist_ok=True)
    temporary_folder = Path(tempfile.mkdtemp(dir=job.work_folder))
    try:
        new_results = temporary_folder / "results"
        ended = _run(job, identity, new_results, batch_ended)
        if ended.cause is Cause.STOPPED:
            return _failure_to_retry(job, STOPPED)
        if ended.cause is Cause.SIGNAL and ended.code == signal.SIGKILL:  # no fault of the input
            return _failure_to_retry(job, KILLED)
        status, why, limits, results = _assessed(job, ended, new_results)
        if why is not None and ended.cause is Cause.OUTPUT:
            raise OutputGoneError(messages("en").text(why))
        if fingerprint.content_hash(job.source, job.out) != input_sha256:
            return _failure_to_retry(job, reason("batch.input-changed"))
        if batch_ended():
            return _failure_to_retry(job, STOPPED)
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
            record.write(job.failure_record, ending)
            return ending
        digest = record.sha256_of(new_results / RESULTS_JSON)
        ending = dataclasses.replace(
            ending, results_sha256=digest, figures=summary_values(results), steps=step_status(results)
        )
        record.write(new_results / JOB_RECORD, ending)
        _publish(job, new_results)
        job.failure_record.unlink(missing_ok=True)
        return ending
    finally:
        shutil.rmtree(temporary_folder, ignore_errors=True)


def _run(job: Job, identity: str, new_results: Path, batch_ended: Callable[[], bool]) -> process.Ended:
    with job.log.open("a", encoding="utf-8") as log:
        log.write(f"--- {job.batch_token} {identity}\n")
    return process.run(
        (
            *job.program,
            str(job.memory_mb),
            "processor",
            "run",
            str(job.source),
            "-o",
            str(new_results),
            *job.run_options,
        ),
        log=job.log,
        env=process.environment(job.threads, PYTHONFAULTHANDLER="1"),
        timeout_s=job.timeout_s,
        memory_mb=job.memory_mb,
        stopped=batch_ended,
    )


_Assessed = tuple[JobStatus, Reason | None, dict[str, float], dict[str, Any] | None]


def _assessed(job: Job, ended: process.Ended, new_results: Path) -> _Assessed:
    """Return the status of a process that ended, the reason, the limits that ended it, and its results."""
    if ended.cause is Cause.TIME:
        return _failure(reason("batch.timeout", limit=job.timeout_s), timeout_s=job.timeout_s)
    error, last = (
        _one_line(job, line.replace(str(new_results), RESULTS_JSON), 500) for line in (ended.error, ended.last_line)
    )
    if ended.cause is Cause.MEMORY:
        return _failure(reason("batch.memory", limit=job.memory_mb), memory_mb=float(job.memory_mb))
    if ended.cause is Cause.SIGNAL:
        with suppress(ValueError):
            name = signal.Signals(ended.code).name
            return _failure(reason("batch.crashed", signal=name, number=ended.code))
        return _failure(reason("batch.crashed-unnamed", number=ended.code))
    if ended.code in STATUS:
        try:
            results = json.loads((new_results / RESULTS_JSON).read_text("utf-8"))
            if results["format"] != FORMAT or not (new_results / REPORT_PAGE).is_file():
                raise ValueError(results["format"])
            return STATUS[ended.code], None, {}, results
        except (OSError, ValueError, TypeError, KeyError):
            pass
    elif error:
        return _failure(reason("batch.error", message=error))
    if last:
        return _failure(reason("batch.no-results-but", exit_code=ended.code, last=last))
    return _failure(reason("batch.no-results", exit_code=ended.code))


def _failure(why: Reason, **limits: float) -> _Assessed:
    return JobStatus.FAILED, why, limits, None


def _one_line(job: Job, text: str, most: int = 2000) -> str:
    """Return a text on one line with relative paths: the summary does not depend on where the folders are."""
    for folder in (job.root, job.out):
        text = text.replace(f"{folder}/", "") if str(folder) != "/" else text
    text = " ".join(text.replace(str(job.source), job.source.name).split())
    return printable(text)[:most]


def _publish(job: Job, new_results: Path) -> None:
    """Move results to their final name by one renaming, in place of earlier ones."""
    try:
        for path in new_results.rglob("*"):
            if path.is_dir():
                sync(path)
        sync(new_results)
        job.results_folder.parent.mkdir(parents=True, exist_ok=True)
        _remove_results(job)
        os.replace(new_results, job.results_folder)
        sync(job.results_folder.parent)
    except OSError as error:
        raise InputError(f"{job.results_folder}: cannot be written ({error.strerror or error})") from error


def _remove_results(job: Job) -> None:
    """Remove earlier results. Raises InputError if something else has their name."""
    if not os.path.lexists(job.results_folder):
        return
    with suppress(OSError):
        job.results_folder.rmdir()  # empty
        return
    if job.results_folder.is_symlink() or not (job.results_folder / RESULTS_JSON).is_file():
        raise InputError(f"{job.results_folder}: is there and holds no results; take it away or name another folder")
    old = job.work_folder / f"old-{secrets.token_hex(8)}"
    os.replace(job.results_folder, old)
    shutil.rmtree(old, ignore_errors=True)
