"""Which processes live, by /proc."""

import os
import time


def alive(pid):
    """Whether a process runs: one that has ended and is not waited for yet does not."""
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def ends_soon(pid, seconds=10.0):
    """Wait for the end of a process; whether it came."""
    deadline = time.monotonic() + seconds
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.01)
    return not alive(pid)


def children(pid):
    """Processes that a process has started and that are not waited for."""
    found = []
    for task in os.listdir(f"/proc/{pid}/task"):
        with open(f"/proc/{pid}/task/{task}/children", encoding="ascii") as file:
            found += [int(one) for one in file.read().split()]
    return found
