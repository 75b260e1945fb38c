"""All inputs below a folder: found, done, and summed up; run again, it goes on where it was.

State is files alone, each of which comes to be there by one renaming, so it is whole whenever the batch is killed.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import secrets
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from processor.batch import job as jobs_
from processor.batch import record, summary
from processor.batch.finding import STATE, Found, Input, find
from processor.batch.job import Job
from processor.batch.record import Record
from processor.jobs import runner
from processor.model import InputError, UsageError

LOGS = "logs"
LONGEST_NAME = 240  # bytes of a file's name, with room for what is put around it
MEMORY_SHARE, LEAST_MEMORY_MB = 0.8, 1024  # of the machine, for all jobs together; for a job


class StoppedError(Exception):
    """SIGTERM or SIGINT came."""


@dataclass(frozen=True)
class Settings:
    """What a batch is to do; ``arguments`` go to every ``processor run``, ``units`` to those of scans."""

    root: Path
    out: Path
    arguments: tuple[str, ...] = ()
    params: bytes = b""  # the parameter file, as it was when the batch began
    parameters: dict[str, Any] = field(default_factory=dict)  # all that results depend on
    units: str | None = None
    jobs: int = 1
    cluster: str | None = None
    timeout_s: float = 3600.0
    memory_mb: int | None = None
    retry: bool = False
    program: tuple[str, ...] = jobs_.PROGRAM
    lang: str = "en"  # of the index


def run(settings: Settings, say: Callable[[str], None], ended: Callable[[Record], None]) -> summary.Summary:
    """Do all jobs and write the summary; ``ended`` is called for each as it is done. For the main thread.

    Raises UsageError where another batch is at work in the folder, or the cluster does not answer; InputError where
    nothing is found, results cannot be written, or the cluster is lost; StoppedError after a signal.
    """
    root, out = settings.root.resolve(), settings.out.resolve()
    if not root.is_dir():
        raise InputError(f"{settings.root}: expected a folder, found {'a file' if root.exists() else 'nothing'}")
    if out == root or root.is_relative_to(out):
        raise UsageError(f"{settings.out}: holds the inputs; name another folder for the results")
    found = find(root, out)
    for name in [one.name for one in found.inputs if _first(one.name) in (*summary.FILES, LOGS)]:
        found.left_out[name] = "has the name of one of the batch's own files; rename it"
    found.inputs = [one for one in found.inputs if one.name not in found.left_out]
    for name, reason in sorted(found.left_out.items()):
        say(f"{name}: left out: {reason}")
    if not found.inputs:
        raise InputError(f"{settings.root}: expected scan folders, scenes or scans in it, found none")
    client = runner.connect(settings.cluster, say) if settings.cluster else None
    try:
        with _stoppable() as stop_here, _alone_in(out) as state:
            return _run(settings, found, root, out, state, client, say, ended, stop_here)
    finally:
        if client is not None:
            client.close()


def _first(name: str) -> str:
    return name.split("/", 1)[0]


def _run(
    settings: Settings,
    found: Found,
    root: Path,
    out: Path,
    state: Path,
    client: Any,
    say: Callable[[str], None],
    ended: Callable[[Record], None],
    stop_here: Callable[[], None],
) -> summary.Summary:
    from tqdm import tqdm

    token = state / "token"
    try:
        jobs = _jobs(settings, found, root, out, state, token)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror or error})") from error
    if client:
        spread = runner.over_cluster(jobs, client, settings.cluster or "", stop_here)
    else:
        spread = runner.here(jobs, settings.jobs, stop_here)
    records: dict[str, Record] = {}
    try:
        with closing(spread), tqdm(total=len(jobs), unit="input", disable=not sys.stderr.isatty()) as bar:
            for job, one in spread:
                records[job.name] = one = _seen_here(job, one)
                with tqdm.external_write_mode(file=sys.stderr):
                    ended(one)
                bar.update()
    except jobs_.OutputGoneError as error:
        raise InputError(
            f"{error}; make room and run again to go on ({len(records)} of {len(jobs)} are done)"
        ) from error
    except StoppedError:
        say(f"stopped: {len(records)} of {len(jobs)} inputs are done; run again to go on")
        raise
    finally:
        with suppress(OSError):
            token.unlink()  # whoever still works for this run, on a worker out of reach, ends
        shutil.rmtree(state / "work", ignore_errors=True)
    return summary.write(out, [(job, records[job.name]) for job in jobs], found.left_out, settings.lang)


def _jobs(settings: Settings, found: Found, root: Path, out: Path, state: Path, token_file: Path) -> list[Job]:
    """Make the list of jobs, and the folder ready for them."""
    shutil.rmtree(state / "work", ignore_errors=True)
    for folder in ("failed", "work"):
        (state / folder).mkdir(exist_ok=True)
    token = secrets.token_hex(8)
    record.write_text(token_file, token)
    summary.remove(out)  # until all is done there is none: a stale one would speak of other results
    arguments = settings.arguments
    if settings.params:
        record.write_text(state / "params.toml", settings.params.decode("utf-8"))
        arguments = (*arguments, "--params", str(state / "params.toml"))
    keys = {one.name: hashlib.sha256(os.fsencode(one.name)).hexdigest()[:32] for one in found.inputs}
    for path in (state / "failed").iterdir():
        if path.stem not in keys.values():
            path.unlink()
    memory_mb = settings.memory_mb or _memory_mb(1 if settings.cluster else settings.jobs)
    threads = max(1, (os.cpu_count() or 1) // (1 if settings.cluster else settings.jobs))
    made = []
    for one in found.inputs:
        key = keys[one.name]
        units = ("--units", settings.units) if settings.units and not one.is_scene else ()
        parameters = {**settings.parameters, "units": settings.units if units else None}
        place = out / (root.name if one.name == "." else one.name)
        made.append(
            Job(
                one.name, one.path, root, out, place, _log(out, one, key), state / "failed" / f"{key}.json",
                state / "work" / key, token_file, token, (*arguments, *units), parameters, jobs_.software(),
                settings.timeout_s, memory_mb, threads, settings.retry, settings.program,
            )
        )  # fmt: skip
    return made


def _log(out: Path, one: Input, key: str) -> Path:
    path = out / LOGS / f"{one.path.name if one.name == '.' else one.name}.log"
    return path if len(os.fsencode(path.name)) <= LONGEST_NAME else path.with_name(f"{key}.log")


def _memory_mb(at_once: int) -> int:
    """Memory for a job where so many run at once: a share of the machine's."""
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20
    return max(LEAST_MEMORY_MB, int(MEMORY_SHARE * whole / at_once))


def _seen_here(job: Job, one: Record) -> Record:
    """Let a job fail whose results are not here: a cluster's worker may have written to a disk of its own."""
    if one.status == record.FAILED or (job.place / record.RECORD).is_file():
        return one
    reason = "done, but not in this folder: all workers must share it, and the inputs, under the same path"
    return Record(job.name, "", record.FAILED, reason, lasting=False)


@contextmanager
def _alone_in(out: Path) -> Iterator[Path]:
    """Make and hold the folder of results; gives that of the batch's state."""
    state = out / STATE
    try:
        state.mkdir(parents=True, exist_ok=True)
        handle = os.open(state / "lock", os.O_RDWR | os.O_CREAT, 0o644)
    except (FileExistsError, NotADirectoryError):
        raise UsageError(f"{out}: is a file; name a folder for the results") from None
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror or error})") from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(f"{out}: another batch is at work here; wait for it or stop it") from None
        except OSError:
            pass  # a file system without locks
        yield state
    finally:
        os.close(handle)


@contextmanager
def _stoppable() -> Iterator[Callable[[], None]]:
    """Give a function that raises StoppedError once SIGTERM or SIGINT came; what is cleared up then is not disturbed.

    Raised wherever the signal happens to come, it could leave a lock that threads wait for, and hang.
    """
    signals = (signal.SIGTERM, signal.SIGINT)
    asked = threading.Event()

    def stop(*_: int | FrameType | None) -> None:
        for one in signals:
            signal.signal(one, signal.SIG_IGN)
        asked.set()

    def stop_here() -> None:
        if asked.is_set():
            raise StoppedError

    before = [signal.signal(one, stop) for one in signals]
    try:
        yield stop_here
    finally:
        for one, handler in zip(signals, before, strict=True):
            signal.signal(one, handler)
