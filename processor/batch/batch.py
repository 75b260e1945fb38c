"""Finds, processes and summarises all inputs below a folder; run again, it continues where it stopped.

The state is in files only, each moved into place by one renaming, so that it is whole whenever the batch is killed.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from processor.batch import job as batch_job
from processor.batch import summary
from processor.batch.find_inputs import STATE, Input, find
from processor.batch.job import Job, OutputGoneError
from processor.batch.record import JobStatus, Record
from processor.jobs import process, runner
from processor.jobs.child import Loss, Lost
from processor.jobs.runner import StoppedError
from processor.language.messages import messages
from processor.model import InputError, UsageError, reason
from processor.results.file_names import JOB_RECORD
from processor.scan_folder.files import missing
from processor.store.making import remove_leftovers
from processor.store.whole_output import check_folder, replace_text

LOGS, TOKEN = "logs", "token"
LONGEST_NAME = 240  # bytes of a file's name, with room for prefix and suffix
MEMORY_SHARE, LEAST_MEMORY_MB = 0.8, 1024  # of the machine, for all jobs together; for a job


@dataclass(frozen=True)
class Settings:
    """Settings of a batch; ``run_options`` are passed to every ``processor run``, ``units`` to those of scans."""

    root: Path
    out: Path
    run_options: tuple[str, ...] = ()
    params_toml: bytes = b""  # the parameter file, as it was when the batch began
    identity_parameters: dict[str, Any] = field(default_factory=dict)  # all settings that results depend on
    units: str | None = None
    at_a_time: int = 1
    cluster: str | None = None
    timeout_s: float = 3600.0
    memory_mb: int | None = None
    retry: bool = False
    program: tuple[str, ...] = process.GUARDED
    lang: str = "en"  # of the index

    @property
    def at_once(self) -> int:
        """Number of jobs at a time on one machine."""
        return 1 if self.cluster else self.at_a_time


def run(settings: Settings, say: Callable[[str], None], ended: Callable[[Record], None]) -> summary.Summary:
    """Do all jobs and write the summary; ``ended`` is called with the record of each. For the main thread.

    Raises UsageError if another batch is at work in the folder, or the cluster does not answer; InputError if there
    are no inputs, results cannot be written, or the cluster is lost; StoppedError after a signal.
    """
    root, out = settings.root.resolve(), settings.out.resolve()
    if not root.is_dir():
        if not root.exists():
            raise missing(settings.root)
        raise InputError(f"{settings.root}: expected a folder, found a file")
    if out == root or root.is_relative_to(out):
        raise UsageError(f"{settings.out}: holds the inputs; name another folder for the results")
    check_folder(out / LOGS)
    found, left_out = find(root, out)
    for name in [each.name for each in found if each.name.split("/", 1)[0] in (*summary.FILES, LOGS)]:
        left_out[name] = reason("batch.reserved-name")
    inputs = [each for each in found if each.name not in left_out]
    for name, why in sorted(left_out.items()):
        say(f"{name}: left out: {messages('en').text(why)}")
    if not inputs:
        raise InputError(f"{settings.root}: expected scan folders, scenes or scans in it, found none")
    around = next((each for each in inputs if out.is_relative_to(each.path)), None)
    if around is not None:  # its own state and logs would be files of the input, which change while it is processed
        raise UsageError(
            f"{settings.out}: lies in the scan folder {around.path}; name a folder outside for the results"
        )
    with (
        runner.executor(settings.cluster, settings.at_a_time, say) as executor,
        runner.stoppable() as check_stop,
        _alone_in(out) as state,
    ):
        try:
            jobs = _jobs(settings, inputs, root, out, state)
        except OSError as error:
            raise InputError(f"{out}: cannot be written ({error.strerror or error})") from error
        try:
            with closing(executor.run(batch_job.run_job, jobs, check_stop)) as results:
                records = _records(results, len(jobs), say, ended)
        finally:
            with suppress(OSError):
                (state / TOKEN).unlink()  # jobs that still run on a worker out of reach end themselves
            shutil.rmtree(state / "work", ignore_errors=True)
        return summary.write(out, [(job, records[job.name]) for job in jobs], left_out, settings.lang)


def _records(
    results: runner.Results[Job, Record], total: int, say: Callable[[str], None], ended: Callable[[Record], None]
) -> dict[str, Record]:
    """Collect the records of all jobs by name, with a progress bar on a terminal."""
    from tqdm import tqdm

    records: dict[str, Record] = {}
    try:
        with tqdm(total=total, unit="input", disable=not sys.stderr.isatty()) as bar:
            for job, result in results:
                ending = records[job.name] = _checked(job, result)
                with tqdm.external_write_mode(file=sys.stderr):
                    ended(ending)
                bar.update()
    except OutputGoneError as error:
        raise InputError(f"{error}; make room and run again to go on ({len(records)} of {total} are done)") from error
    except StoppedError:
        say(f"stopped: {len(records)} of {total} inputs are done; run again to go on")
        raise
    return records


def _checked(job: Job, result: Record | Lost) -> Record:
    """Return a job's record; a failure if no worker could run it, or if its worker wrote to another disk."""
    if isinstance(result, Lost):
        died = result.loss is Loss.DIED
        why = reason("batch.workers-died") if died else reason("batch.worker-failed", error=str(result.error))
    elif result.status == JobStatus.FAILED or (job.results_folder / JOB_RECORD).is_file():
        return result
    else:
        why = reason("batch.not-shared")
    return Record(input=job.name, identity="", status=JobStatus.FAILED, reason=why)


def _jobs(settings: Settings, inputs: Sequence[Input], root: Path, out: Path, state: Path) -> list[Job]:
    """Make the list of jobs, and prepare the folder for them."""
    shutil.rmtree(state / "work", ignore_errors=True)
    for folder in ("failed", "work"):
        (state / folder).mkdir(exist_ok=True)
    token = secrets.token_hex(8)
    replace_text(state / TOKEN, token)
    summary.remove(out)  # there is none until all jobs are done: an older one would be of other results
    run_options = (*settings.run_options, "--methods-from", str(Path.cwd()))
    if settings.params_toml:
        replace_text(state / "params.toml", settings.params_toml.decode("utf-8"))
        run_options = (*run_options, "--params", str(state / "params.toml"))
    keys = {each.name: hashlib.sha256(os.fsencode(each.name)).hexdigest()[:32] for each in inputs}
    remove_leftovers(state / "failed")  # of a batch that was killed while it wrote the record of a failure
    for path in (state / "failed").glob("*.json"):
        if path.stem not in keys.values():
            path.unlink()
    threads = max(1, (os.cpu_count() or 1) // settings.at_once)
    jobs = []
    for each in inputs:
        key = keys[each.name]
        log = out / LOGS / f"{each.path.name if each.name == '.' else each.name}.log"
        units = ("--units", settings.units) if settings.units and not each.is_scene else ()
        # Of the machine's share each job at once has its part
        total_mb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20
        jobs.append(
            Job(
                name=each.name,
                source=each.path,
                root=root,
                out=out,
                results_folder=out / (root.name if each.name == "." else each.name),
                log=log if len(os.fsencode(log.name)) <= LONGEST_NAME else log.with_name(f"{key}.log"),
                failure_record=state / "failed" / f"{key}.json",
                work_folder=state / "work" / key,
                token_file=state / TOKEN,
                batch_token=token,
                run_options=(*run_options, *units),
                identity_parameters={**settings.identity_parameters, "units": settings.units if units else None},
                software=batch_job.software(),
                timeout_s=settings.timeout_s,
                memory_mb=settings.memory_mb or max(LEAST_MEMORY_MB, int(MEMORY_SHARE * total_mb / settings.at_once)),
                threads=threads,
                retry=settings.retry,
                program=settings.program,
            )
        )
    return jobs


@contextmanager
def _alone_in(out: Path) -> Iterator[Path]:
    """Make and lock the folder of results; yield the folder of the batch's state."""
    state = out / STATE
    busy = f"{out}: another batch is running here; wait for it or stop it"
    with ExitStack() as stack:
        try:
            state.mkdir(parents=True, exist_ok=True)
            stack.enter_context(runner.locked(state / "lock", busy))
        except (FileExistsError, NotADirectoryError):
            raise UsageError(f"{out}: is a file; name a folder for the results") from None
        except OSError as error:
            raise InputError(f"{out}: cannot be written ({error.strerror or error})") from error
        yield state
