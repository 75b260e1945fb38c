"""Jobs spread over processes of this machine, or over the workers of a Dask cluster.

Both give every job with its result as it comes, and both do it in a process that does nothing else. On a cluster's
worker, its own threads would otherwise take part: they sample what runs, which keeps datasets open for longer and
moves their bytes in the file, and they starve while compiled code holds the interpreter, so that the worker seems dead.

A process that dies, killed or out of memory, costs the time of its job, which is tried once more.
"""

from __future__ import annotations

import importlib
import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, TypeVar

from processor.model import InputError, UsageError

DIED = "the process that made it died twice (out of memory?); run again, with fewer jobs at a time"
STOPPED_BY_TERM = 143  # as a shell reports SIGTERM
CONNECT_SECONDS = 10
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
CHILD = "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); from designgen import spread; spread.serve()"
WATCH_SECONDS = 0.2


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


# --- processes that do jobs ------------------------------------------------------------------------------------------


@dataclass
class Children:
    """Processes that do jobs: one for each thread that asks, of one thread itself, started when it is first needed."""

    of_thread: threading.local = field(default_factory=threading.local)
    started: list[subprocess.Popen[bytes]] = field(default_factory=list)
    stopped: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock)

    def do(self, run: Callable[[J], R], job: J) -> R | Lost:
        """Do one job in this thread's process, and once more if that dies."""
        message = pickle.dumps((run, job))
        for _ in range(2):
            child = self._child()
            if child is None:
                return Lost("stopped")
            assert child.stdin
            assert child.stdout
            try:
                pickle.dump(message, child.stdin)
                child.stdin.flush()
                result: R | Lost = pickle.load(child.stdout)
                return result
            except (EOFError, BrokenPipeError, pickle.UnpicklingError):
                self._end(child)
                self.of_thread.child = None
        return Lost(DIED)

    def stop(self) -> None:
        """Kill all processes, at work or not, and start no more."""
        with self.lock:
            self.stopped = True
            for child in self.started:
                child.kill()

    def _child(self) -> subprocess.Popen[bytes] | None:
        child: subprocess.Popen[bytes] | None = getattr(self.of_thread, "child", None)
        with self.lock:
            if child is None and not self.stopped:
                # Deaf to Ctrl-C, which a terminal sends to all: the process that started this one answers it.
                mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
                try:
                    child = subprocess.Popen(
                        [sys.executable, "-I", "-c", CHILD],
                        stdin=subprocess.PIPE,
                        stdout=subprocess.PIPE,
                        env={**os.environ, **ONE_THREAD},
                    )
                finally:
                    signal.pthread_sigmask(signal.SIG_SETMASK, mask)
                self.of_thread.child = child
                self.started.append(child)
                assert child.stdin
                pickle.dump(sys.path, child.stdin)
                pickle.dump(os.getpid(), child.stdin)
        return child

    def _end(self, child: subprocess.Popen[bytes]) -> None:
        child.kill()
        with self.lock, suppress(BrokenPipeError), child:
            self.started.remove(child)


def serve() -> None:
    """Do jobs from standard input, with results to standard output, until the input or the parent process ends."""
    jobs, results = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no result
    threading.Thread(target=_end_with, args=(pickle.load(jobs),), daemon=True).start()
    with suppress(EOFError, BrokenPipeError):
        while True:
            message = pickle.load(jobs)
            try:
                run, job = pickle.loads(message)
                result = run(job)
            except Exception as error:  # e.g. for want of a package
                result = Lost(f"could not be run ({type(error).__name__}: {' '.join(str(error).split())})")
            pickle.dump(result, results)
            results.flush()


def _end_with(parent: int) -> None:
    """End this process when the one that started it is gone: after a SIGKILL there nobody else would."""
    while os.getppid() == parent:
        time.sleep(WATCH_SECONDS)
    os._exit(1)


@contextmanager
def over_processes(processes: int) -> Iterator[Spread]:
    """Give what does jobs in so many processes of this machine."""

    def spread(run: Callable[[J], R], jobs: Sequence[J]) -> Results[J, R]:
        children = Children()
        threads = ThreadPoolExecutor(min(processes, len(jobs)))
        try:
            waiting: dict[Future[R | Lost], J] = {threads.submit(children.do, run, job): job for job in jobs}
            while waiting:
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    yield waiting.pop(future), future.result()
        finally:
            # Nothing is waited for: a scene is moved to its name when it is whole, so no file suffers.
            threads.shutdown(wait=False, cancel_futures=True)
            children.stop()
            threads.shutdown()
            for child in children.started:
                with suppress(BrokenPipeError):
                    child.communicate()

    yield spread


# --- on a cluster -----------------------------------------------------------------------------------------------------


WORKERS_CHILDREN = Children()


def on_worker(run: Callable[[J], R], job: J) -> R | Lost:
    """Do a job in a process beside this cluster's worker, which it keeps for the next."""
    return WORKERS_CHILDREN.do(run, job)


@contextmanager
def over_cluster(address: str) -> Iterator[Spread]:
    """Give what does jobs on the Dask cluster whose scheduler is at ``address``.

    Raises UsageError without the library and where no scheduler answers; InputError where it is lost on the way.
    """
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError:
        raise UsageError("--cluster needs Dask: pip install 'steel-scan-check[cluster]'") from None
    # What is wrong with the connection is said below, in a line; the library's own log prints stack traces of it.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        why = " ".join(str(error).split())
        raise UsageError(
            f"--cluster {address}: expected the address of a Dask scheduler that answers ({why})"
        ) from error
    with client:
        if not client.nthreads():
            print(f"cluster {address}: no workers yet; waiting for them", file=sys.stderr)

        def spread(run: Callable[[J], R], jobs: Sequence[J]) -> Results[J, R]:
            # Impure, as a job looks at files: what another run found is not to be taken from the scheduler's memory.
            waiting = {client.submit(on_worker, run, job, pure=False): job for job in jobs}
            try:
                for future in distributed.as_completed(list(waiting), loop=client.loop):
                    job = waiting.pop(future)
                    result: R | Lost
                    try:
                        result = future.result()
                    except distributed.KilledWorker:
                        result = Lost(DIED)
                    except distributed.CancelledError as error:
                        waiting.clear()  # nobody is there to cancel them
                        raise InputError(f"--cluster {address}: the connection is lost; run again to go on") from error
                    except Exception as error:  # the worker could not run it at all, e.g. for want of a package
                        text = " ".join(str(error).split())
                        result = Lost(f"a worker of the cluster could not run it ({type(error).__name__}: {text})")
                    yield job, result
            finally:
                client.cancel(list(waiting))

        yield spread
