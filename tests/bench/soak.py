"""A batch under kills, want of memory and a full disk, for as long as asked, beside one that nothing disturbs.

    python -m tests.bench.soak --minutes 60 --output soak.json

300 inputs, 30 of them bad in ways of their own, are processed once in peace. Then the same batch is disturbed at random
until the time is over: the batch, its job or both are killed, the batch is stopped by SIGTERM, another process takes
the memory of its control group until the system kills one of them, and the disk of the results is filled. It is run
again until it is complete, its files are compared with those of the undisturbed one, and it begins anew. Memory and
disk need root: without, these two are left out, and the output names them.

Exits 1 where a file differs or lacks, something is left over, a process outlives its batch, or the memory of a batch's
process varies by more than 20 MB.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.support.files import bad_inputs

ROOT = Path(__file__).resolve().parents[2]
BATCH = (sys.executable, str(ROOT / "tests/support/processes/failing_job.py"), "batch")
OPTIONS = ("--jobs", "1", "--timeout-s", "60", "--memory-mb", "600")
OPTIONS += ("--steps", "spheres", "--method", "least-squares", "--seed", "3")
GROUPS = Path("/sys/fs/cgroup")
GROUP_MB, HOG_S = 1500, 15.0  # room for a batch, a job at its limit and a process of it at the same limit
CALM_S = (5.0, 40.0)  # between two disturbances
STARTED_S = 10.0  # a batch has imported what it needs
MOST_GROWTH_MB = 20.0
SUMMARY = ("index.html", "summary.csv", "summary.json")
NOT_COMPARED = ("job.json", "timings.csv")  # hold times
HOG = """
import time
held = []
try:
    while True:
        held.append(bytearray(b"x" * 2**22))
        time.sleep(0.01)
except MemoryError:
    time.sleep(60)
"""


class Disk:
    """A file system of its own for the results, which can be filled; an ordinary folder where it cannot be mounted."""

    def __init__(self, place, size_mb):
        self.folder, self.image = place / "disk", place / "disk.img"
        self.folder.mkdir()
        with self.image.open("wb") as file:
            file.truncate(size_mb << 20)
        made = _did("mkfs.ext4", "-q", "-F", str(self.image))
        self.kind = "ext4" if made and _did("mount", "-o", "loop", str(self.image), str(self.folder)) else ""

    @property
    def filler(self):
        return self.folder / "filler"

    def fill(self):
        with contextlib.suppress(OSError), self.filler.open("wb", buffering=0) as file:
            while file.write(b"x" * (1 << 20)):
                pass

    def free(self):
        self.filler.unlink(missing_ok=True)

    def close(self):
        if self.kind:
            _did("umount", str(self.folder))


class Group:
    """A control group with little memory, of version 2 or 1; ``kind`` is "" where none can be made."""

    def __init__(self, limit_mb):
        self.folder, self.kind = None, ""
        for kind, parent, sign, limit in (
            ("cgroup v2", GROUPS, "cgroup.subtree_control", "memory.max"),
            ("cgroup v1", GROUPS / "memory", "memory.use_hierarchy", "memory.limit_in_bytes"),
        ):
            folder = parent / f"soak-{os.getpid()}"
            with contextlib.suppress(OSError):
                if not (parent / sign).is_file() or (
                    kind == "cgroup v2" and "memory" not in (parent / sign).read_text()
                ):
                    continue
                folder.mkdir()
                self.folder = folder
                (folder / limit).write_text(str(limit_mb << 20))
                self.kind = kind
                return

    def enter(self):
        """Put this process, which is about to become another program, into the group."""
        if self.kind:
            (self.folder / "cgroup.procs").write_text(str(os.getpid()))

    def close(self):
        if self.folder is not None:
            with contextlib.suppress(OSError):
                self.folder.rmdir()


def _did(*command):
    try:
        return subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        return False


def make_inputs(root, count, bad):
    """Write the inputs, the bad ones spread among the good ones."""
    ways, step = bad_inputs.ways(), count // max(bad, 1)
    for number in range(count):
        place, which = root / f"{number % 7}" / f"input {number:03}", number // max(step, 1)
        if bad and number % step == step // 2 and which < bad:
            ways[which % len(ways)](place, number)
        else:
            bad_inputs.sphere(place, number)


def files_of(out):
    """Bytes of all files of a complete batch but logs, its own state and times."""
    return {
        str(path.relative_to(out)): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file()
        and not {"logs", ".batch"} & set(path.relative_to(out).parts)
        and path.name not in NOT_COMPARED
    }


def left_over(out):
    """Paths that a complete batch must not have."""
    hidden = [path for path in out.rglob("*") if path.name.startswith(".") and path != out / ".batch"]
    return [str(path.relative_to(out)) for path in hidden] + [
        name for name in os.listdir(out / ".batch") if name not in ("failed", "lock", "params.toml")
    ]


def living(mark):
    """Ids of processes with ``mark`` in their command lines, but this one."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            line = path.read_bytes().decode("utf-8", "replace")
            if mark in line and int(path.parent.name) != os.getpid():
                found.append(int(path.parent.name))
    return found


def memory_mb(pid):
    """Memory of a process that is its own and in use, 0 once it has ended."""
    with contextlib.suppress(OSError, StopIteration):
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon:")) / 1024
    return 0.0


def job_of(pid):
    """Return the process of a batch's current job, None if there is none."""
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                return int(child)
    return None


class Soak:
    """Runs of one batch, what disturbed them and what was found."""

    def __init__(self, root, disk, group, seed):
        self.root, self.disk, self.group = root, disk, group
        self.rng = random.Random(seed)
        self.events, self.ends, self.faults = Counter(), Counter(), []
        self.memory = []  # least and most of each batch's process, MB
        self.passes, self.runs = 0, 0
        self.hog, self.hog_until = None, 0.0

    def disturbances(self):
        """Name the disturbances that are possible here."""
        known = [self.kill_batch, self.kill_job, self.kill_both, self.stop]
        return known + [self.take_memory] * bool(self.group.kind) + [self.fill_disk] * bool(self.disk.kind)

    def kill_batch(self, process):
        os.kill(process.pid, signal.SIGKILL)

    def kill_job(self, process):
        job = job_of(process.pid)
        if job is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(job, signal.SIGKILL)

    def kill_both(self, process):
        self.kill_job(process)
        self.kill_batch(process)

    def stop(self, process):
        process.terminate()

    def take_memory(self, _):
        if self.hog is None:
            self.hog = subprocess.Popen([sys.executable, "-c", HOG], preexec_fn=self.group.enter)
            self.hog_until = time.monotonic() + HOG_S

    def fill_disk(self, _):
        self.disk.fill()

    def run(self, out, until, disturbed):
        """Run the batch to its end, disturbed until a time; returns its exit code and what it said."""
        command = [*BATCH, str(self.root), "-o", str(out), *OPTIONS]
        with tempfile.TemporaryFile() as said:
            process = subprocess.Popen(
                command, stdout=subprocess.DEVNULL, stderr=said, start_new_session=True,
                preexec_fn=self.group.enter if disturbed else None,
                env={**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"},
            )  # fmt: skip
            self._watch(process, until, disturbed)
            said.seek(0)
            text = said.read().decode("utf-8", "replace")
        self._look_for_survivors(out)
        return process.returncode, text

    def _watch(self, process, until, disturbed):
        """Disturb a batch until it ends, and look at its memory."""
        self.runs += 1
        began = time.monotonic()
        then, least, most = began + self.rng.uniform(*CALM_S), float("inf"), 0.0
        while process.poll() is None:
            now = time.monotonic()
            if self.hog is not None and now > self.hog_until:
                self._end_hog()
            if disturbed and then < now < until:
                what = self.rng.choice(self.disturbances())
                self.events[what.__name__] += 1
                what(process)
                then = now + self.rng.uniform(*CALM_S)
            used = memory_mb(process.pid)
            if used and now > began + STARTED_S:
                least, most = min(least, used), max(most, used)
            time.sleep(0.2)
        self._end_hog()
        self.disk.free()
        if most:
            self.memory.append((round(least, 1), round(most, 1)))

    def _end_hog(self):
        if self.hog is not None:
            self.hog.kill()
            self.hog.wait()
            self.hog = None

    def _look_for_survivors(self, out):
        deadline = time.monotonic() + 20.0
        while alive := living(str(out)):
            if time.monotonic() > deadline:
                self.faults.append(f"run {self.runs}: {len(alive)} processes outlive their batch")
                return
            time.sleep(0.2)

    def disturbed_until(self, until, whole, out):
        """Complete the batch again and again; every time its files must be those of the undisturbed one."""
        while time.monotonic() < until:
            complete = False
            while not complete:
                before = sum(self.events.values())
                code, said = self.run(out, until, disturbed=time.monotonic() < until)
                calm = sum(self.events.values()) == before
                self.ends[str(code)] += 1
                if "Traceback" in said or "internal error" in said:
                    self.faults.append(f"run {self.runs}: {said[-300:]}")
                complete = calm or (code == 1 and _is_whole(out, whole))
            self.passes += 1
            self._compare(out, whole)
            _did("rm", "-rf", str(out))

    def _compare(self, out, whole):
        found = files_of(out) if (out / "summary.json").is_file() else {}
        for name in sorted(whole.keys() | found.keys()):
            if whole.get(name) != found.get(name):
                self.faults.append(f"pass {self.passes}: {name}: other bytes than undisturbed")
        self.faults += [f"pass {self.passes}: {name} is left over" for name in left_over(out)]
        mine, theirs = (_ends(files.get("summary.json", b"{}")) for files in (found, whole))
        self.faults += [
            f"pass {self.passes}: {name}: {mine.get(name)}, undisturbed {theirs.get(name)}"
            for name in sorted(mine.keys() | theirs.keys())
            if mine.get(name) != theirs.get(name)
        ]


def _ends(summary):
    """Status and reason of each input of a summary."""
    return {one["input"]: (one["status"], one.get("reason")) for one in json.loads(summary).get("inputs", ())}


def _is_whole(out, whole):
    """Whether the summary says what that of the undisturbed batch says: no job was killed in this run."""
    return all((out / name).is_file() and (out / name).read_bytes() == whole[name] for name in SUMMARY)


def soak(place, minutes, count, bad, seed):
    """Run all and return what was found."""
    root, group = place / "root", Group(GROUP_MB)
    make_inputs(root, count, bad)
    disk = Disk(place, max(200, 4 * count))
    runs = Soak(root, disk, group, seed)
    try:
        began = time.monotonic()
        code, _ = runs.run(place / "whole", 0.0, disturbed=False)
        whole = files_of(place / "whole")
        calm_s = time.monotonic() - began
        statuses = Counter(one["status"] for one in json.loads(whole["summary.json"])["inputs"])
        print(f"undisturbed: {dict(statuses)}, {len(whole)} files, {calm_s:.0f} s, exit code {code}", flush=True)
        if statuses["failed"] != bad:
            runs.faults.append(f"expected {bad} failed inputs, found {statuses['failed']}")
        runs.disturbed_until(time.monotonic() + 60.0 * minutes, whole, disk.folder / "out")
    finally:
        runs._end_hog()
        disk.close()
        group.close()
    used = [value for pair in runs.memory for value in pair]
    varies = max(used) - min(used) if used else 0.0
    if varies > MOST_GROWTH_MB:
        runs.faults.append(f"the memory of the batch's process varies by {varies:.1f} MB")
    return {
        "minutes": minutes, "inputs": count, "bad": bad, "seed": seed, "undisturbed_s": round(calm_s),
        "runs": runs.runs, "passes": runs.passes, "events": dict(runs.events), "exit_codes": dict(runs.ends),
        "memory_pressure": runs.group.kind or "none: needs root", "full_disk": runs.disk.kind or "none: needs root",
        "parent_mb": [min(used, default=0.0), max(used, default=0.0)], "faults": runs.faults,
    }  # fmt: skip


def main():
    """Print and write what was found; exit 1 if there is a fault."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--inputs", type=int, default=300)
    parser.add_argument("--bad", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="soak-") as place:
        found = soak(Path(place), arguments.minutes, arguments.inputs, arguments.bad, arguments.seed)
    print(json.dumps(found, indent=1))
    if arguments.output:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        arguments.output.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    sys.exit(bool(found["faults"]))


if __name__ == "__main__":
    main()
