"""Draw mutants of the numeric core, run the nearest tests of each and list those that no test kills.

``python -m tests.mutation --number 200 --seed 1 -o out/mutants``. A survivor is either equivalent to the code, or a
test is missing. The first run records which lines each test runs, in ``OUT/record``; remove that after a change of
tests. Each verdict is a line of ``OUT/mutants.jsonl`` with the test that killed the mutant; a further run tries again
what was not killed, and with ``--again`` what was: by the test that did it, if that is still there.
"""

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from queue import SimpleQueue

from tests.mutation.nearest import Record, record
from tests.mutation.sites import Site, sites
from tests.support import kernels
from tests.support.structure import MODULES, ROOT, module_name

# Where numbers are made. What reads, writes and shows them is tested by examples of files and pages.
CORE = (
    *("geometry", "adjustment", "registration", "limits", "deviation", "defects", "evaluation", "preassembly"),
    *("space_frame", "stitching", "inspection", "compare", "targets", "epochs"),
)
CORE_FOLDERS = (*(f"processor/{name}" for name in CORE), "designgen/scanning", "designgen/designs", "designgen/asbuilt")
LIMIT_S = 600.0  # of one mutant: a loop that no longer ends
KILLED, SURVIVED, TIMEOUT, NO_TESTS = "killed", "survived", "timeout", "no tests"


@dataclass(frozen=True)
class Mutant:
    """A file of the project, by its path from the root, and one change of it."""

    path: str
    digest: str  # of the file: what was killed in another state of it says nothing
    site: Site

    @property
    def key(self) -> str:
        return f"{self.path} {self.digest} {self.site.start} {self.site.new}"

    def __str__(self) -> str:
        old, new = (" ".join(text.split()) for text in (self.site.old, self.site.new))
        return f"{self.path}:{self.site.line}: {self.site.kind}: {old} -> {new}"


def drawn(number: int, seed: int, folders: tuple[str, ...] = CORE_FOLDERS) -> list[Mutant]:
    """Return mutants, every kind as often as another as far as there are as many.

    Each place has its lot by what it says, not by what stands about it: a change of the sources leaves most of those
    drawn before, so that the same seed can be run before and after it.
    """
    by_kind: dict[str, list[tuple[str, Mutant]]] = {}
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            source = path.read_text("utf-8")
            digest = hashlib.sha256(source.encode()).hexdigest()[:12]
            times: Counter[str] = Counter()
            for site in sites(source):
                mutant = Mutant(path=path.relative_to(ROOT).as_posix(), digest=digest, site=site)
                text = f"{seed} {mutant.path} {site.kind} {site.old} {site.new}"
                times[text] += 1
                lot = hashlib.sha256(f"{text} {times[text]}".encode()).hexdigest()
                by_kind.setdefault(site.kind, []).append((lot, mutant))
    for mutants in by_kind.values():
        mutants.sort(key=lambda one: one[0])
    rounds = zip_longest(*(by_kind[kind] for kind in sorted(by_kind)))
    return [one[1] for of_round in rounds for one in of_round if one is not None][:number]


class Copy:
    """A copy of the project in which one mutant at a time stands."""

    def __init__(self, place: Path, known: Record) -> None:
        self.place = place
        self.known = known
        shutil.rmtree(place, ignore_errors=True)  # of an earlier run: its sources may be others
        skipped = shutil.ignore_patterns(".git", ".venv*", "out", ".mypy_cache", ".ruff_cache")  # made scenes go along
        shutil.copytree(ROOT, place, ignore=skipped)

    def verdict(self, mutant: Mutant, killer: str) -> tuple[str, str]:
        """Return the verdict on a mutant and the test that killed it; ``killer`` did so before, or is empty."""
        site = mutant.site
        tests = self.known.tests(mutant.path, range(site.line, site.line + site.old.count("\n") + 1))
        tests = tests or self.known.of_imports(mutant.path)
        if killer in self.known.seconds:
            tests = [killer, *(name for name in tests if name != killer)]
        if not tests:
            return NO_TESTS, ""
        path = self.place / mutant.path
        source = path.read_text("utf-8")
        put_away = self._compiled(mutant)
        for each in put_away:  # compiled code has the old function in it, also where another file calls it
            each.rename(each.with_name(each.name + ".kept"))
        times = path.stat()
        try:
            path.write_text(mutant.site.applied(source), "utf-8")
            return self._run(tests)
        finally:
            path.write_text(source, "utf-8")
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))  # or its kernels would be compiled again
            for each in self._compiled(mutant):
                each.unlink()
            for each in put_away:
                each.with_name(each.name + ".kept").rename(each)

    def _compiled(self, mutant: Mutant) -> list[Path]:
        """Return the files of kernels that a mutant makes stale: of its file, and if it is compiled, of its users."""
        changed = {module_name(ROOT / mutant.path)}
        names = kernels.with_users(changed) if mutant.site.compiled else changed
        sources = [MODULES[name].relative_to(ROOT) for name in sorted(names & MODULES.keys())]
        return [path for source in sources for path in kernels.compiled(self.place / source)]

    def _run(self, tests: list[str]) -> tuple[str, str]:
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", "not slow", *tests]
        env = {**os.environ, "PYTHONPATH": str(self.place), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        env["KERNELS_KEPT"] = "1"  # those of the mutant are away, the others need not be compiled for it
        try:
            done = subprocess.run(
                command, cwd=self.place, env=env, capture_output=True, text=True, timeout=LIMIT_S, check=False
            )
        except subprocess.TimeoutExpired:
            return TIMEOUT, ""
        if done.returncode == 0:
            return SURVIVED, ""
        if "ERROR: not found" in done.stdout + done.stderr:
            raise SystemExit(f"{self.known.place}: the tests have changed since the record was made; remove it")
        failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
        return KILLED, failed[0].split(" ", 1)[1].split(" - ")[0] if failed else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--number", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "out/mutants")
    parser.add_argument("--again", action="store_true", help="also what was killed before")
    options = parser.parse_args()
    place = options.output / "record"
    if not place.exists():
        record(place)
    verdicts = options.output / "mutants.jsonl"
    lines = [json.loads(line) for line in verdicts.read_text("utf-8").splitlines()] if verdicts.exists() else []
    killers = {one["key"]: one["killer"] for one in lines if one["verdict"] == KILLED}
    mutants = drawn(options.number, options.seed)
    known = {} if options.again else dict.fromkeys(killers, KILLED)
    copies: SimpleQueue[Copy] = SimpleQueue()
    for number in range(options.jobs):
        copies.put(Copy(options.output / f"copy-{number}", Record(place)))

    def judge(mutant: Mutant) -> tuple[Mutant, str, str]:
        copy = copies.get()
        try:
            return mutant, *copy.verdict(mutant, killers.get(mutant.key, ""))
        finally:
            copies.put(copy)

    left = [mutant for mutant in mutants if mutant.key not in known]
    with ThreadPoolExecutor(options.jobs) as threads, verdicts.open("a", encoding="utf-8") as file:
        for mutant, verdict, killer in threads.map(judge, left):
            known[mutant.key] = verdict
            one = {"key": mutant.key, "mutant": str(mutant), "verdict": verdict, "killer": killer}
            file.write(json.dumps(one) + "\n")
            file.flush()
            print(f"{verdict:9}  {mutant}  {killer}", flush=True)
    of_drawn = Counter(known[mutant.key] for mutant in mutants)
    print(", ".join(f"{verdict}: {count}" for verdict, count in sorted(of_drawn.items())))
    for mutant in mutants:
        if known[mutant.key] != KILLED:
            print(f"{known[mutant.key]}: {mutant}")


if __name__ == "__main__":
    main()
