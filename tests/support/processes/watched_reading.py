"""Reads damaged files in watched processes: what crashes, hangs, takes memory or raises is counted, not suffered."""

import json
import math
import os
import resource
import select
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.support.files.damaged_files import damaged, good_files

MEMORY_BYTES = 2 << 30
HANG_S = 10.0
FAULTS = ("crash", "hang", "memory", "traceback", "empty", "unnamed")


class Watched:
    """A process that reads files one after another, within limits of memory and time."""

    def __init__(self):
        self._start()

    def _start(self):
        command = [sys.executable, "-m", "tests.support.processes.watched_reading"]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        self._line(120.0)

    def _line(self, limit_s):
        ready, _, _ = select.select([self.process.stdout], [], [], limit_s)
        return self.process.stdout.readline() if ready else None

    def read(self, path):
        """What became of a file: one of FAULTS, or "read" or "refused", and what was said."""
        self.process.stdin.write(os.fsencode(path) + b"\n")
        self.process.stdin.flush()
        line = self._line(HANG_S * (4 if path.suffix == ".h5" else 1))  # such a file is read in four ways
        if line:
            return tuple(json.loads(line))
        self.process.kill()
        self.process.communicate()
        code = self.process.returncode
        self._start()
        return ("hang", "") if line is None else ("crash", f"exit code {code}")

    def close(self):
        self.process.communicate()


def run(format_, count, keep=None, say=lambda _: None):
    """Read ``count`` damaged files of a format: how many came to what, and the faults, each with its number.

    Files that are read with fewer points than before the damage count as "fewer", and are kept and said as faults are.
    """
    files = ((f"{format_} {number}", *damaged(format_, number)) for number in range(count))
    return _read_all(files, keep, say, dict(good_files()[format_]))


def run_corpus(folder, suffix, keep=None, say=lambda _: None):
    """Read all files below a folder whose names end in a suffix, as :func:`run` does."""
    files = sorted(path for path in folder.rglob(f"*{suffix}") if path.is_file())
    return _read_all(((str(path.relative_to(folder)), path.name, path.read_bytes()) for path in files), keep, say)


def _read_all(files, keep, say, whole=None):
    found, faults, slowest = Counter(), [], 0.0
    watched = Watched()
    with tempfile.TemporaryDirectory() as folder:
        points = {}
        for name, content in (whole or {}).items():
            (Path(folder) / name).write_bytes(content)
            points[name] = int(watched.read(Path(folder) / name)[1])
        for label, name, content in files:
            path = Path(folder) / name
            path.write_bytes(content)
            began = time.monotonic()
            what, said = watched.read(path)
            slowest = max(slowest, time.monotonic() - began)
            for sign in ("crashed", "took more than", "was killed"):
                if sign in said:
                    found[f"library {sign}"] += 1
            if what == "read" and int(said) < points.get(name, 0):
                what, said = "fewer", f"{said} of {points[name]} points"
            found[what] += 1
            if what in (*FAULTS, "fewer"):
                if what in FAULTS:
                    faults.append((label, what, said))
                say(f"{label}: {what} {said[:300]}")
                if keep is not None:
                    (keep / f"{label.replace('/', '-').replace(' ', '-')}-{name}").write_bytes(content)
            path.unlink()
    watched.close()
    return found, faults, slowest


def _attempt(path):
    from processor.model import InputError
    from processor.pipeline import result_classes
    from processor.scan_folder import folder
    from processor.store import store

    if path.suffix == ".h5":  # it may also be a truth, results, or a file to be verified
        for read in (store.read_truth, lambda file: store.read_results(file, result_classes()), _verified):
            try:
                read(path)
            except InputError as error:
                if not str(error).startswith(str(path)):
                    return "unnamed", str(error)
            except BaseException as error:
                return "traceback", repr(error)
    try:
        scene = folder.read_input(path)
    except InputError as error:
        said = str(error)
        return ("refused" if said.startswith(str(path)) else "unnamed"), said
    except BaseException as error:
        return "traceback", repr(error)
    if not scene.scans or not all(len(scan.points) for scan in scene.scans):
        return "empty", ""
    return "read", str(sum(len(scan.points) for scan in scene.scans))


def _verified(path):
    from processor.model import InputError
    from processor.store import store

    _, problems = store.damage(path)
    if problems:
        raise InputError(problems[0], path=path)


def _mapped(key):
    """Bytes of address space, now or at most so far."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(key))


def _serve():
    import numba  # noqa: F401  is there before the limit is set, as in a run

    from processor import pipeline
    from processor.readers import ascii_rows, sandbox  # noqa: F401
    from processor.store import store  # noqa: F401

    pipeline.result_classes()

    sandbox._running()  # starting is no part of reading
    before = _mapped("VmSize")
    resource.setrlimit(resource.RLIMIT_AS, (before + 4 * MEMORY_BYTES,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    print(flush=True)
    for line in sys.stdin.buffer:
        what, said = _attempt(Path(os.fsdecode(line.rstrip(b"\n"))))
        if _mapped("VmPeak") - before > MEMORY_BYTES:
            what, before = "memory", math.inf  # one such is said once: a peak stays
        print(json.dumps((what, said)), flush=True)


if __name__ == "__main__":
    _serve()
