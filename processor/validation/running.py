"""Cells done in processes of this machine, or on the workers of a Dask cluster."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from processor.model import InputError, UsageError
from processor.validation import child
from processor.validation.cells import Cell, Outcome

# Does cells and gives each with its outcome as it comes; closing it stops what is under way.
Runner = Callable[[Sequence[Cell]], Generator[tuple[Cell, Outcome], None, None]]

TIMEOUT_S = 3600.0
CONNECT_S = 10
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def do(
    spec: dict[str, Any],
    threads: int,
    scratch: str | None = None,
    live: set[int] | None = None,
    timeout_s: float = TIMEOUT_S,
) -> Outcome:
    """Do one cell in processes of its own, which end when this one does; the scene is deleted afterwards.

    ``live`` holds the number of its process group while it is under way.
    """
    live = set() if live is None else live
    with tempfile.TemporaryDirectory(prefix="cell-", dir=scratch, ignore_cleanup_errors=True) as made:
        folder = Path(made)
        (folder / child.SPEC).write_text(json.dumps(spec, ensure_ascii=False), "utf-8")
        process = subprocess.Popen(
            [sys.executable, "-m", "processor.validation.child", str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            env={**os.environ, **dict.fromkeys(THREADS, str(threads))},
            start_new_session=True,
        )
        live.add(process.pid)
        try:
            process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return Outcome(failed=f"took longer than {timeout_s:g} s", seconds=timeout_s)
        finally:
            if process.poll() is None:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            live.discard(process.pid)
            assert process.stdin
            process.stdin.close()
        try:
            said = json.loads((folder / child.DONE).read_text("utf-8"))
            text = "{}" if said["failed"] else (folder / child.RESULTS / "results.json").read_text("utf-8")
            return Outcome(said["failed"], json.loads(text), said["seconds"], said["peak_mb"])
        except (OSError, ValueError) as error:
            return Outcome(failed=f"its process ended with code {process.returncode} and left no answer ({error})")


@contextmanager
def over_processes(jobs: int, scratch: Path) -> Iterator[Runner]:
    """Give what does so many cells at a time on this machine, in folders below ``scratch``."""
    threads = max(1, (os.cpu_count() or 1) // jobs)

    def run(cells: Sequence[Cell]) -> Generator[tuple[Cell, Outcome], None, None]:
        pool, live = ThreadPoolExecutor(jobs), set[int]()
        try:
            waiting: dict[Future[Outcome], Cell] = {
                pool.submit(do, cell.spec(), threads, str(scratch), live): cell for cell in cells
            }
            while waiting:
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    yield waiting.pop(future), future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for group in list(live):
                with suppress(ProcessLookupError):
                    os.killpg(group, signal.SIGKILL)
            pool.shutdown()

    yield run


@contextmanager
def over_cluster(address: str) -> Iterator[Runner]:
    """Give what does cells on the Dask cluster whose scheduler is at ``address``; its workers share no folder.

    Raises UsageError without the library and where no scheduler answers; InputError where it is lost on the way.
    """
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError:
        raise UsageError("--cluster needs Dask: pip install 'steel-scan-check[cluster]'") from None
    try:
        client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        why = " ".join(str(error).split())
        raise UsageError(
            f"--cluster {address}: expected the address of a Dask scheduler that answers ({why})"
        ) from error
    with client:

        def run(cells: Sequence[Cell]) -> Generator[tuple[Cell, Outcome], None, None]:
            # Impure: the same cell done tonight must not be taken from the scheduler's memory of last night.
            waiting = {client.submit(do, cell.spec(), 1, pure=False): cell for cell in cells}
            try:
                for future in distributed.as_completed(list(waiting), loop=client.loop):
                    cell = waiting.pop(future)
                    try:
                        outcome: Outcome = future.result()
                    except distributed.CancelledError as error:
                        waiting.clear()
                        raise InputError(f"--cluster {address}: the connection is lost; run again to go on") from error
                    except Exception as error:
                        text = " ".join(str(error).split())
                        outcome = Outcome(failed=f"a worker could not run it ({type(error).__name__}: {text})")
                    yield cell, outcome
            finally:
                client.cancel(list(waiting))

        yield run
