"""Jobs spread over processes of this machine, or over the workers of a Dask cluster.

Both give every job with its result as it comes. A process that dies, killed or out of memory, costs the time of what it
was doing: that is tried again, and is Lost only where it takes its process down by itself.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from processor.model import InputError, UsageError

DIED = "the process that made it died, and died again; was it out of memory?"
STOPPED_BY_TERM = 143  # as a shell reports SIGTERM
CONNECT_SECONDS = 10
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Lost:
    """Instead of a result: the job could not be run, and why."""

    reason: str


J = TypeVar("J")
R = TypeVar("R")
Results = Generator[tuple[J, R | Lost], None, None]
# Takes a function of a module, as it travels by name, and the jobs; closing what it returns stops them.
Spread = Callable[[Callable[[Any], Any], Sequence[Any]], Results[Any, Any]]


@contextmanager
def stoppable() -> Iterator[None]:
    """Let SIGTERM end what runs within as Ctrl-C does, with all that is open closed: SystemExit with code 143."""

    def stop(*_: object) -> None:
        raise SystemExit(STOPPED_BY_TERM)

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


# --- on this machine --------------------------------------------------------------------------------------------------


@contextmanager
def over_processes(processes: int) -> Iterator[Spread]:
    """Give what does jobs in processes of their own, of one thread each."""

    def spread(run: Callable[[J], R], jobs: Sequence[J]) -> Results[J, R]:
        waiting = deque(jobs)
        while waiting:
            under_way = yield from _pool(run, waiting, processes)
            # One of these took its process down. Alone, each can only take down its own.
            for job in under_way:
                if (yield from _pool(run, deque([job]), 1)):
                    yield job, Lost(DIED)

    yield spread


def _pool(run: Callable[[J], R], waiting: deque[J], processes: int) -> Generator[tuple[J, R | Lost], None, list[J]]:
    """Take jobs from ``waiting`` until none is left or a process dies: the jobs that were under way then."""
    before = set(multiprocessing.active_children())
    # Spawned, not forked: threads and locks of the libraries loaded here do not survive a fork.
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(processes, len(waiting)), mp_context=spawn, initializer=_die_with_parent)
    running: dict[Future[R], J] = {}
    try:
        while waiting or running:
            while waiting and len(running) < processes:
                job = waiting.popleft()
                try:
                    with _for_children():
                        running[pool.submit(run, job)] = job
                except BrokenProcessPool:
                    return [job, *running.values()]
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job = running.pop(future)
                try:
                    result = future.result()
                except BrokenProcessPool:
                    return [job, *running.values()]
                yield job, result
        return []
    except BaseException:
        # Nothing is waited for: a scene is moved to its name when it is whole, so no file suffers.
        for child in set(multiprocessing.active_children()) - before:
            child.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _for_children() -> Iterator[None]:
    """Set what processes started within inherit: one thread each, and deaf to Ctrl-C, which this process answers."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _die_with_parent() -> None:
    """End this process when the one that started it is gone: after a SIGKILL there nobody else would."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# --- on a cluster -----------------------------------------------------------------------------------------------------


@contextmanager
def over_cluster(address: str) -> Iterator[Spread]:
    """Give what does jobs on the Dask cluster whose scheduler is at ``address``.

    Raises UsageError without the library and where no scheduler answers; InputError where it is lost on the way.
    """
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError:
        raise UsageError("--cluster needs Dask: pip install 'steel-scan-check[cluster]'") from None
    try:
        client = distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        why = " ".join(str(error).split())
        raise UsageError(
            f"--cluster {address}: expected the address of a Dask scheduler that answers ({why})"
        ) from error
    with client:

        def spread(run: Callable[[J], R], jobs: Sequence[J]) -> Results[J, R]:
            # Impure, as a job looks at files: what another run found is not to be taken from the scheduler's memory.
            waiting = {client.submit(run, job, pure=False): job for job in jobs}
            try:
                for future in distributed.as_completed(list(waiting), loop=client.loop):
                    job = waiting.pop(future)
                    result: R | Lost
                    try:
                        result = future.result()
                    except distributed.KilledWorker:
                        result = Lost(DIED)
                    except distributed.CancelledError as error:
                        raise InputError(f"--cluster {address}: the connection is lost; run again to go on") from error
                    except Exception as error:  # the worker could not run it at all, e.g. for want of a package
                        text = " ".join(str(error).split())
                        result = Lost(f"a worker of the cluster could not run it ({type(error).__name__}: {text})")
                    yield job, result
            finally:
                client.cancel(list(waiting))

        yield spread
