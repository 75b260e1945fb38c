"""Jobs done a few at a time on this machine, or by the workers of a Dask cluster. Paths travel, no arrays."""

from __future__ import annotations

import importlib
import logging
import threading
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any

from processor.batch.job import Job, OutputGoneError, do
from processor.batch.record import FAILED, Record
from processor.model import InputError, UsageError

Results = Generator[tuple[Job, Record], None, None]
CONNECT_SECONDS = 10
LOOK_S = 0.1  # whether it is to stop
DIED = "every worker that did it died (out of memory?); run again, with fewer jobs at a time"


def here(jobs: Sequence[Job], at_once: int, stop_here: Callable[[], None]) -> Results:
    """Do jobs, each in a process of its own that a thread watches; closing, or ``stop_here`` raising, stops them."""
    stop = threading.Event()
    threads = ThreadPoolExecutor(at_once)
    try:
        waiting: dict[Future[Record], Job] = {threads.submit(do, job, stop.is_set): job for job in jobs}
        while waiting:
            stop_here()
            for future in wait(waiting, timeout=LOOK_S, return_when=FIRST_COMPLETED).done:
                yield waiting.pop(future), future.result()
    finally:
        stop.set()
        threads.shutdown(cancel_futures=True)


def connect(address: str, say: Callable[[str], None]) -> Any:
    """Return a client of the Dask scheduler at ``address``. Raises UsageError without the library, or an answer."""
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
    if not client.nthreads():
        say(f"cluster {address}: no workers yet; waiting for them")
    return client


def over_cluster(jobs: Sequence[Job], client: Any, address: str, stop_here: Callable[[], None]) -> Results:
    """Do jobs on a cluster; of a worker that is lost they are done by another.

    Closing, or ``stop_here`` raising, cancels what is not begun.
    Raises InputError where the scheduler is lost.
    """
    distributed: Any = importlib.import_module("distributed")
    # Impure, as a job looks at files: what an earlier batch found is not to be taken from the scheduler's memory.
    waiting = {client.submit(do, job, pure=False): job for job in jobs}
    completed = distributed.as_completed(list(waiting), loop=client.loop)
    try:
        while waiting:
            stop_here()
            if not completed.has_ready():
                time.sleep(LOOK_S)
                continue
            future = completed.next()
            job = waiting.pop(future)
            try:
                found: Record = future.result()
            except OutputGoneError:
                raise
            except distributed.KilledWorker:
                found = Record(job.name, "", FAILED, DIED, lasting=False)
            except distributed.CancelledError as error:
                waiting.clear()  # nobody is there to cancel them
                raise InputError(f"--cluster {address}: the connection is lost; run again to go on") from error
            except Exception as error:  # the worker could not run it at all, e.g. for want of a package
                text = (
                    f"a worker of the cluster could not run it ({type(error).__name__}: {' '.join(str(error).split())})"
                )
                found = Record(job.name, "", FAILED, text, lasting=False)
            yield job, found
    finally:
        client.cancel(list(waiting))
