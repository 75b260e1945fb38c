"""Child processes: start, limits of time and memory, the end of the whole process group.

Every process of this project is started here. Its current folder is the root folder and its interpreter an isolated
one, so that no file of the folder that the user is in, or of an input, is run as a module. Paths given to it are
absolute.
"""

from __future__ import annotations

import atexit
import os
import pickle
import selectors
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TypeVar

from processor.jobs.causes import EXIT_CODES, Cause
from processor.jobs.child import Loss, Lost
from processor.library_settings import ROOT

PERIOD_S = 0.05  # between two looks at a process: memory beyond its limit lasts no longer
LOOK_S = 0.5  # between two looks at what may stop a process, and at the processes that it has started
ANSWER_LOOK_S = 0.1  # between two looks at what may stop the wait for an answer: Ctrl-C is answered at once to a person
LOG_BYTES = 1 << 18  # of one process, from its beginning
TAIL_BYTES = 1 << 14  # of standard error, kept for the reason of an end: a traceback has a few thousand
MB, KB = 2**20, 2**10  # of binary units, as the kernel counts
ATTEMPTS = 2  # at a job whose process dies
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
PROJECT = Path(__file__).resolve().parents[2]  # this checkout: the folder of the packages

J = TypeVar("J")
R = TypeVar("R")


ERROR = "error: "  # begins the line that a program of this project ends with if it fails


@dataclass(frozen=True)
class Ended:
    """How a process ended. ``code`` is the exit code, or the number of the signal."""

    cause: Cause
    code: int
    last_line: str  # of standard error
    seconds: float
    peak_mb: float  # private memory of all its processes together, sampled
    max_rss_mb: float  # resident memory of the largest of its processes

    @property
    def error(self) -> str:
        """The error of a program of this project, the last line of which is ``error: MESSAGE``; "" without one."""
        return self.last_line[len(ERROR) :] if self.last_line.startswith(ERROR) else ""


def never() -> bool:
    """Return False: nothing stops the job."""
    return False


def environment(threads: int, **more: str) -> dict[str, str]:
    """Return this process's environment for a child whose numerical libraries use ``threads`` threads."""
    return {**os.environ, **dict.fromkeys(THREADS, str(threads)), **more}


def isolated(code: str, *arguments: str) -> list[str]:
    """Return the command that runs Python code in an isolated interpreter with the module search path of this one.

    The current folder, and that of the script that this process runs, are no part of the path.
    """
    options = ["-I", *(["-B"] if sys.dont_write_bytecode else []), *(["-X", "utf8"] if sys.flags.utf8_mode else [])]
    script = getattr(sys.modules.get("__main__"), "__file__", None)
    left_out = {_identity("."), _identity(os.path.dirname(os.path.abspath(script)) if script else ".")}
    left_out.discard(_identity(PROJECT))  # a checkout that is not installed
    folders = [folder for folder in sys.path if os.path.isabs(folder) and _identity(folder) not in left_out]
    set_path = f"import sys; sys.path[:] = dict.fromkeys([*{folders!r}, *sys.path]); "
    return [sys.executable, *options, "-c", set_path + code, *arguments]


def _identity(folder: str | Path) -> tuple[int, int] | str:
    """Return what two paths of one folder have in common; a path that does not exist is like no other."""
    with suppress(OSError):
        found = os.stat(folder)
        return found.st_dev, found.st_ino
    return str(folder)


GUARDED = tuple(isolated("from processor.jobs import child; child.main()"))  # MEMORY_MB MODULE ARGUMENT...


def start(
    command: Sequence[str],
    *,
    env: Mapping[str, str] | None = None,
    stdout: int | IO[bytes] | None = subprocess.DEVNULL,
    stderr: int | None = subprocess.PIPE,
    pass_fds: Sequence[int] = (),
    own_group: bool = True,
) -> subprocess.Popen[bytes]:
    """Start a command in the root folder; its standard input is a pipe, which the system closes when this process dies.

    With ``own_group`` it leads a session of its own: Ctrl-C does not reach it, and :func:`end` kills all that it has
    started. Without, it is killed with the group of this process.
    """
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=stdout,
        stderr=stderr,
        env=env,
        cwd=ROOT,
        pass_fds=pass_fds,
        start_new_session=own_group,
    )


def end(process: subprocess.Popen[bytes]) -> float:
    """Kill a process and the group that it leads, and wait for it.

    Returns the resident memory (MB) of the largest of its processes, 0 if it was waited for before.
    """
    max_rss_mb = 0.0
    if process.returncode is None:
        # Not waited for yet, the process still holds its number, so this cannot kill any other.
        with suppress(ProcessLookupError):
            if os.getpgid(process.pid) == process.pid:
                os.killpg(process.pid, signal.SIGKILL)
            else:
                os.kill(process.pid, signal.SIGKILL)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        max_rss_mb = usage.ru_maxrss / KB
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(BrokenPipeError):
                pipe.close()
    return max_rss_mb


# --- one command -----------------------------------------------------------------------------------------------------


def run(
    command: Sequence[str],
    *,
    log: Path | None = None,
    env: Mapping[str, str] | None = None,
    stdout: int | IO[bytes] = subprocess.DEVNULL,
    pass_fds: Sequence[int] = (),
    own_group: bool = True,
    timeout_s: float = float("inf"),
    memory_mb: float = float("inf"),
    stopped: Callable[[], bool] = never,
) -> Ended:
    """Run a command to its end or to a limit; with ``own_group`` nothing that it has started is left.

    The beginning of standard error is appended to ``log``. Raises OSError if that fails.
    """
    started = time.monotonic()
    with log.open("ab") if log else nullcontext() as log_file:
        process = start(command, env=env, stdout=stdout, pass_fds=pass_fds, own_group=own_group)
        stderr = _StandardError(process, log_file)
        try:
            cause, peak_mb = _watch(process, stderr.closed, started + timeout_s, memory_mb, stopped)
        finally:
            max_rss_mb = end(process)
            stderr.close()
        if stderr.error is not None:
            raise stderr.error
    code: int = process.returncode
    if cause is Cause.EXIT:
        # The cause of an exit code
        cause, code = (
            (Cause.SIGNAL, -code)
            if code < 0
            else (next((cause for cause, known in EXIT_CODES.items() if known == code), Cause.EXIT), code)
        )
    return Ended(
        cause=cause,
        code=code,
        last_line=stderr.last_line(),
        seconds=time.monotonic() - started,
        peak_mb=peak_mb,
        max_rss_mb=max_rss_mb,
    )


def _watch(
    process: subprocess.Popen[bytes],
    stderr_closed: threading.Event,
    deadline: float,
    memory_mb: float,
    stopped: Callable[[], bool],
) -> tuple[Cause, float]:
    """Wait for the end of a process or a limit; returns what came first, and the peak of memory used (MB)."""
    look, peak_mb, others_mb = 0.0, 0.0, 0.0
    # Not reaped here: see end().
    while os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None:
        now = time.monotonic()
        if now >= look:
            look = now + LOOK_S
            if stopped():
                return Cause.STOPPED, peak_mb
            others_mb = sum(_used_mb(pid) for pid in _descendants(process.pid))
        used_mb = _used_mb(process.pid) + others_mb
        peak_mb = max(peak_mb, used_mb)
        if now > deadline:
            return Cause.TIME, peak_mb
        if used_mb > memory_mb:
            return Cause.MEMORY, peak_mb
        if stderr_closed.wait(PERIOD_S):
            time.sleep(PERIOD_S / 10)
    return Cause.EXIT, peak_mb


def _used_mb(pid: int) -> float:
    """Private memory of a process in MB; 0 if the system does not provide it."""
    try:
        with open(f"/proc/{pid}/statm", "rb") as file:
            fields = file.read().split()
        return (int(fields[1]) - int(fields[2])) * os.sysconf("SC_PAGE_SIZE") / MB
    except (OSError, IndexError, ValueError):
        return 0.0


def _descendants(pid: int) -> list[int]:
    """Return the processes below a process; none if the system does not provide them."""
    below: list[int] = []
    waiting = [pid]
    while waiting:
        parent = waiting.pop()
        try:
            for task in os.listdir(f"/proc/{parent}/task"):
                with open(f"/proc/{parent}/task/{task}/children", "rb") as file:
                    children = [int(child) for child in file.read().split()]
                below += children
                waiting += children
        except (OSError, ValueError):
            continue
    return below


class _StandardError:
    """Reads the standard error of a process: the beginning goes to the log, the end is kept for its last line."""

    def __init__(self, process: subprocess.Popen[bytes], log: IO[bytes] | None) -> None:
        assert process.stderr
        self.source = process.stderr
        self.log = log
        self.tail = b""
        self.error: OSError | None = None
        self.closed = threading.Event()
        self.thread = threading.Thread(target=self._read, daemon=True)
        self.thread.start()

    def _read(self) -> None:
        room = LOG_BYTES
        while block := os.read(self.source.fileno(), 1 << 16):
            self.tail = (self.tail + block)[-TAIL_BYTES:]
            if self.log is None or self.error is not None:
                continue
            try:
                self.log.write(block[:room])
                if 0 < room <= len(block):
                    self.log.write(b"\n(the rest is not logged)\n")
                self.log.flush()
            except OSError as error:
                self.error = error
            room = max(0, room - len(block))
        self.closed.set()

    def close(self) -> None:
        self.thread.join()
        self.source.close()

    def last_line(self) -> str:
        lines = [line for line in self.tail.decode("utf-8", "replace").splitlines() if line.strip()]
        return lines[-1].strip() if lines else ""


# --- processes that do jobs one after another ------------------------------------------------------------------------


class Pool:
    """Processes of one thread each that do jobs one after another; started when they are needed, safe for threads.

    On a cluster, the worker's own process would not do: its threads sample what runs, which keeps HDF5 datasets open
    for longer and moves their bytes in the file, and they starve while compiled code holds the interpreter.
    """

    def __init__(self) -> None:
        self._idle: deque[subprocess.Popen[bytes]] = deque()

    def do(self, function: Callable[[J], R], job: J, stopped: Callable[[], bool] = never) -> R | Lost:
        """Do one job, a second time if its process dies. The function is pickled by its name."""
        message = pickle.dumps((function, job))
        for _ in range(ATTEMPTS):
            process = self._process()
            try:
                if not _answered(process, message, stopped):
                    end(process)
                    return Lost(Loss.STOPPED)
                assert process.stdout
                result: R | Lost = pickle.load(process.stdout)
            except (EOFError, BrokenPipeError, pickle.UnpicklingError):
                end(process)
                continue
            self._idle.append(process)
            return result
        return Lost(Loss.DIED)

    def close(self) -> None:
        """End the idle processes; those at work end with their jobs."""
        while self._idle:
            end(self._idle.pop())

    def _process(self) -> subprocess.Popen[bytes]:
        with suppress(IndexError):
            return self._idle.pop()
        command = isolated("from processor.jobs import child; child.serve()")
        return start(command, env=environment(1), stdout=subprocess.PIPE, stderr=None)


def _answered(process: subprocess.Popen[bytes], message: bytes, stopped: Callable[[], bool]) -> bool:
    """Send a message and wait for the beginning of the answer, or the end of the process; False if stopped before."""
    assert process.stdin
    assert process.stdout
    pickle.dump(message, process.stdin)
    process.stdin.flush()
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        while not stopped():
            if selector.select(ANSWER_LOOK_S):
                return True
    return False


POOL = Pool()
atexit.register(POOL.close)


def in_process(function: Callable[[Any], R], job: Any, stopped: Callable[[], bool] = never) -> R | Lost:
    """Do a job in the pool of this process, on a cluster in that of its worker."""
    return POOL.do(function, job, stopped)
