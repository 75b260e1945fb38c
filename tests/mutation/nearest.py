"""Which tests to run for a mutant: those that run its lines, where a record of the suite says so, else by imports.

The record is made once by running the suite (:func:`record`): the lines that each test runs, and its processor time.
Compiled kernels run no lines that a record could see: for those, and for constants of modules, imports decide.
"""

import json
import os
import shutil
import sqlite3
import subprocess
import sys
from collections import deque
from functools import cache
from pathlib import Path

from coverage import CoverageData

from tests.support.structure import MODULES, ROOT, imports, module_name

NEAREST_FILES = 8  # of tests, by the distance of imports: beyond these the whole suite would be run for each mutant
FARTHEST = 3  # imports between a file of tests and the mutant
TESTS_S = 60.0  # processor time of the tests of one mutant: two hundred mutants in the hours of a night


@cache
def importers() -> dict[str, set[str]]:
    """Names of modules and of files of tests, by the module that they import."""
    files = {**MODULES, **{module_name(path): path for path in (ROOT / "tests").rglob("*.py")}}
    users: dict[str, set[str]] = {}
    for name, path in files.items():
        for imported in imports(path):
            users.setdefault(imported, set()).add(name)
    return users


def distances(module: str) -> dict[str, int]:
    """Return the number of imports between a module and each of those that use it, directly or through others."""
    away = {module: 0}
    waiting = deque([module])
    while waiting:
        name = waiting.popleft()
        for user in sorted(importers().get(name, ())):
            if user not in away:
                away[user] = away[name] + 1
                waiting.append(user)
    return away


def nearest_files(path: str) -> list[str]:
    """Return the files of tests that are next to a file by imports, those in folders of its name first."""
    folders = set(Path(path).parts)
    away = distances(module_name(ROOT / path))
    tests = [(steps, name) for name, steps in away.items() if name.rpartition(".")[2].startswith("test_")]
    order = sorted(tests, key=lambda one: (one[0], not folders & set(one[1].split(".")), one[1]))
    return [name.replace(".", "/") + ".py" for steps, name in order if steps <= FARTHEST][:NEAREST_FILES]


def record(place: Path) -> None:
    """Run the suite once and keep in a new folder which lines each test runs and its processor time.

    The folder has its name when the suite has ended: of one that was stopped nothing is taken for a record.
    """
    making = place.with_name(place.name + ".making").absolute()
    shutil.rmtree(making, ignore_errors=True)
    making.mkdir(parents=True)
    env = {**os.environ, "COVERAGE_FILE": str(making / "lines.sqlite"), "SUITE_TIMES": str(making / "times")}
    env |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    plugins = ["-p", "tests.bench.suite", "--cov", "--cov-context=test", "--cov-report="]
    command = [sys.executable, "-m", "pytest", "-q", "-n", "2", "--dist", "worksteal", "-m", "not slow", *plugins]
    subprocess.run(command, cwd=ROOT, env=env, check=False)
    making.rename(place)


class Record:
    """Lines and seconds of each test, as :func:`record` left them."""

    def __init__(self, place: Path) -> None:
        self.place = place
        self._data = CoverageData(str(place / "lines.sqlite"))
        self._data.read()
        self.seconds: dict[str, float] = {}
        for path in sorted((place / "times").glob("*.jsonl")):
            for line in path.read_text("utf-8").splitlines():
                kind, name, own, children = json.loads(line)
                if kind == "test":
                    self.seconds[name] = own + children
        self._of_file: dict[str, list[str]] = {}
        for name in self.seconds:
            self._of_file.setdefault(name.partition("::")[0], []).append(name)

    def tests(self, path: str, lines: range) -> list[str]:
        """Return the tests to run for lines of a file, the quickest first, then others of the same files.

        A scene that several tests share is made in the first of them alone: so the others of its file follow.
        """
        try:
            contexts = self._data.contexts_by_lineno(str(ROOT / path))
        except sqlite3.Error:
            return []
        running = {context.partition("|")[0] for line in lines for context in contexts.get(line, ())} - {""}
        files = sorted({name.partition("::")[0] for name in running})
        others = {name for file in files for name in self._of_file.get(file, ())} - running
        near = set(Path(path).parts)

        def rank(name: str) -> tuple[bool, bool, float]:
            return name in others, not near & set(Path(name.partition("::")[0]).parts), self.seconds.get(name, 1.0)

        return self._in_time(sorted((running | others) & self.seconds.keys(), key=rank))

    def of_imports(self, path: str) -> list[str]:
        """Return the tests of the nearest files by imports, the quickest of each first."""
        ordered = [
            name
            for file in nearest_files(path)
            for name in sorted(self._of_file.get(file, ()), key=self.seconds.__getitem__)
        ]
        return self._in_time(ordered)

    def _in_time(self, names: list[str]) -> list[str]:
        """Return the first of the tests, as many as take TESTS_S together, and one in any case."""
        chosen: list[str] = []
        total = 0.0
        for name in names:
            total += self.seconds[name]
            if total > TESTS_S and chosen:
                break
            chosen.append(name)
        return chosen
