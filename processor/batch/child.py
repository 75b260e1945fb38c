"""The process of one job: ``processor`` with its memory limited, which ends when the process that started it does.

``python -m processor.batch.child MEMORY_MB ARGUMENT...``; standard input is a pipe that nothing is written to.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
import threading
from contextlib import suppress

# Who watches sees the memory used and kills; the kernel's limit, on what is asked for, is for what grows too fast.
ASKED_PER_USED, ASKED_BEYOND_MB = 2, 1024


def _end_with_parent() -> None:
    """Kill this process group when the other end of standard input is closed, as it is after any death."""
    with suppress(OSError):
        while os.read(0, 1):
            pass
    os.killpg(0, signal.SIGKILL)


def guard(memory_mb: int) -> None:
    """Limit this process's memory, and let it end with the process that started it."""
    limit = (ASKED_PER_USED * memory_mb + ASKED_BEYOND_MB) * 2**20
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
    with suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    threading.Thread(target=_end_with_parent, daemon=True).start()


def main() -> None:
    """Run the command line of the arguments."""
    guard(int(sys.argv[1]))
    sys.argv[:] = ["processor", *sys.argv[2:]]
    from processor.__main__ import main as processor

    processor()


if __name__ == "__main__":
    main()
