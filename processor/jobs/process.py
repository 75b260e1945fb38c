"""One process, watched: its time, its memory, what it said on standard error, and how it ended."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

PERIOD_S = 0.05
LOOK_S = 0.5  # between two looks at what may stop the job, and at the processes that it has started
LOG_BYTES = 1 << 18  # of one process, from its beginning
TAIL_BYTES = 1 << 14
MB = 2**20


@dataclass(frozen=True)
class Ended:
    """How a process ended: ``why`` is exit | signal | time | memory | stopped, ``code`` the exit code or signal."""

    why: str
    code: int
    last_line: str
    seconds: float
    peak_mb: float


def run(
    command: Sequence[str],
    log: Path,
    env: Mapping[str, str],
    timeout_s: float,
    memory_mb: int,
    stopped: Callable[[], bool],
) -> Ended:
    """Run a command in a process group of its own, to its end or to a limit's; the group is gone afterwards.

    Standard error is appended to ``log``, the beginning of it where it is long. Raises OSError where that fails.
    """
    started = time.monotonic()
    with log.open("ab") as file:
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,  # closed by the system when this process dies: then the child ends itself
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=dict(env),
            start_new_session=True,
        )
        assert process.stdin
        assert process.stderr
        said = _Said(process.stderr, file)
        why, peak, others = "exit", 0.0, 0.0
        look = started
        try:
            while os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None:
                now = time.monotonic()
                if now >= look:
                    look = now + LOOK_S
                    why = "stopped" if stopped() else why
                    others = sum(_used_mb(one) for one in _descendants(process.pid))
                used = _used_mb(process.pid) + others
                peak = max(peak, used)
                if why == "exit" and now - started > timeout_s:
                    why = "time"
                elif why == "exit" and used > memory_mb:
                    why = "memory"
                if why != "exit":
                    break
                if said.ended.wait(PERIOD_S):
                    time.sleep(PERIOD_S / 10)
        finally:
            # Not reaped yet, the process still holds its number, so the group cannot be anybody else's.
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            code = process.wait()
            with suppress(BrokenPipeError):
                process.stdin.close()
            said.thread.join()
            process.stderr.close()
        if said.error is not None:
            raise said.error
    if why == "exit" and code < 0:
        why, code = "signal", -code
    return Ended(why, code, said.last_line(), time.monotonic() - started, peak)


def _used_mb(pid: int) -> float:
    """Memory of a process that is its own, in MB; 0 where the system does not say."""
    try:
        with open(f"/proc/{pid}/statm", "rb") as file:
            fields = file.read().split()
        return (int(fields[1]) - int(fields[2])) * os.sysconf("SC_PAGE_SIZE") / MB
    except (OSError, IndexError, ValueError):
        return 0.0


def _descendants(pid: int) -> list[int]:
    """Return the processes that a process has started, and those that these have; none where the system is silent."""
    found: list[int] = []
    waiting = [pid]
    while waiting:
        try:
            tasks = os.listdir(f"/proc/{(one := waiting.pop())}/task")
            for task in tasks:
                with open(f"/proc/{one}/task/{task}/children", "rb") as file:
                    children = [int(child) for child in file.read().split()]
                found += children
                waiting += children
        except (OSError, ValueError):
            continue
    return found


class _Said:
    """Reads what a process says: the beginning goes to the log, the end is kept."""

    def __init__(self, source: IO[bytes], log: IO[bytes]) -> None:
        self.tail = b""
        self.error: OSError | None = None
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._read, args=(source, log), daemon=True)
        self.thread.start()

    def _read(self, source: IO[bytes], log: IO[bytes]) -> None:
        room = LOG_BYTES
        while block := os.read(source.fileno(), 1 << 16):
            self.tail = (self.tail + block)[-TAIL_BYTES:]
            try:
                log.write(block[:room])
                log.flush()
            except OSError as error:
                self.error = self.error or error
                room = 0
            if room and len(block) >= room:
                with suppress(OSError):
                    log.write(b"\n(more was said than is kept)\n")
            room = max(0, room - len(block))
        self.ended.set()

    def last_line(self) -> str:
        lines = [line for line in self.tail.decode("utf-8", "replace").splitlines() if line.strip()]
        return lines[-1].strip() if lines else ""
