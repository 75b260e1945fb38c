"""Jobs run a few at a time on this machine, or by the workers of a Dask cluster; signals and locks of such runs."""

from __future__ import annotations

import fcntl
import importlib
import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

from processor.jobs.causes import one_line
from processor.jobs.child import Loss, Lost
from processor.model import InputError, UsageError

CONNECT_S = 10  # a scheduler of one network answers within seconds; a wrong address should not cost a minute
LOOK_S = 0.1  # between two looks at what may stop the run

J = TypeVar("J")
R = TypeVar("R")
Results = Generator[tuple[J, R | Lost], None, None]


class StoppedError(Exception):
    """SIGTERM or SIGINT came; ``exit_code`` is that of a shell."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.exit_code = 128 + number


def _go_on() -> None:
    return


class Local:
    """Runs jobs on this machine, ``at_once`` at a time."""

    def __init__(self, at_once: int) -> None:
        self.at_once = at_once

    def run(self, do: Callable[..., R], jobs: Sequence[J], check_stop: Callable[[], None] = _go_on) -> Results[J, R]:
        """Yield every job with its result, as it comes. ``do`` takes a job and a function that is true when stopped.

        It is called in a thread, which may wait for a process. Closing the generator stops all jobs, as does an
        exception of ``check_stop`` or of a job.
        """
        stop = threading.Event()
        threads = ThreadPoolExecutor(self.at_once)
        try:
            waiting: dict[Future[R], J] = {threads.submit(do, job, stop.is_set): job for job in jobs}
            while waiting:
                check_stop()
                for future in wait(waiting, timeout=LOOK_S, return_when=FIRST_COMPLETED).done:
                    yield waiting.pop(future), future.result()
        finally:
            stop.set()
            threads.shutdown(cancel_futures=True)


@dataclass(frozen=True)
class Cluster:
    """Runs jobs on the workers of a Dask cluster, through a client of its scheduler."""

    client: Any
    address: str

    def run(self, do: Callable[..., R], jobs: Sequence[J], check_stop: Callable[[], None] = _go_on) -> Results[J, R]:
        """Yield every job with its result, or with the reason why no worker could run it.

        The jobs of a lost worker are run by another one. Closing the generator cancels what is not begun, as does an
        exception of ``check_stop``. InputErrors of jobs are raised. Raises InputError if the scheduler is lost.
        """
        distributed: Any = importlib.import_module("distributed")
        # Impure, as jobs look at files: the scheduler must not return the result of an earlier run.
        waiting = {self.client.submit(do, job, pure=False): job for job in jobs}
        completed = distributed.as_completed(list(waiting), loop=self.client.loop)
        try:
            while waiting:
                check_stop()
                if not completed.has_ready():
                    time.sleep(LOOK_S)
                    continue
                future = completed.next()
                job = waiting.pop(future)
                result: R | Lost
                try:
                    result = future.result()
                except InputError:
                    raise
                except distributed.KilledWorker:
                    result = Lost(Loss.DIED)
                except distributed.CancelledError as error:
                    waiting.clear()  # there is no scheduler to cancel them
                    message = f"--cluster {self.address}: the connection is lost; run again to go on"
                    raise InputError(message) from error
                except Exception as error:  # e.g. for want of a package on the worker
                    result = Lost(Loss.NOT_RUN_BY_WORKER, one_line(error))
                yield job, result
        finally:
            self.client.cancel(list(waiting))


@contextmanager
def executor(cluster: str | None, at_once: int, say: Callable[[str], None]) -> Iterator[Local | Cluster]:
    """Give what runs jobs: the Dask cluster whose scheduler has the address ``cluster``, or this machine.

    Raises UsageError if Dask is not installed, has no key for TLS, or no scheduler answers.
    """
    if not cluster:
        yield Local(at_once)
        return
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError:
        raise UsageError("--cluster needs Dask: pip install 'steel-scan-check[cluster]'") from None
    # The messages here say what is wrong with the connection; the library's log prints stack traces of it.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    if cluster.startswith("tls://") and not distributed.Security().get_connection_args("client").get("ssl_context"):
        raise UsageError(
            f"--cluster {cluster}: expected a certificate and a key in Dask's configuration (distributed.comm.tls), "
            "found none; DASK_CONFIG names its file"
        )
    try:
        client = distributed.Client(cluster, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        why = " ".join(str(error).split())
        raise UsageError(
            f"--cluster {cluster}: expected the address of a Dask scheduler that answers ({why})"
        ) from error
    with client:
        if not client.nthreads():
            say(f"cluster {cluster}: no workers yet; waiting for them")
        yield Cluster(client, cluster)


@contextmanager
def stoppable() -> Iterator[Callable[[], None]]:
    """Give a function that raises StoppedError once SIGTERM or SIGINT came. For the main thread.

    Raised by the signal's handler, at any line, the exception could leave a lock that threads wait for.
    """
    signals = (signal.SIGTERM, signal.SIGINT)
    received: list[int] = []

    def stop(number: int, _: FrameType | None) -> None:
        for each in signals:
            signal.signal(each, signal.SIG_IGN)  # the cleaning up is not disturbed
        received.append(number)

    def check_stop() -> None:
        if received:
            raise StoppedError(received[0])

    before = [signal.signal(number, stop) for number in signals]
    try:
        yield check_stop
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)


@contextmanager
def locked(path: Path, busy: str) -> Iterator[None]:
    """Lock a folder, or a file that is made if it is absent; on a file system without locks nothing is locked.

    Raises UsageError with the message ``busy`` if another process has locked it, OSError if it cannot be opened.
    """
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(busy) from None
        except OSError:
            pass
        yield
    finally:
        os.close(handle)
