"""Processor time of the tests: by folder, by test, by fixture, of collection and of the processes that tests start.

``make profile``, or ``python -m pytest -p tests.bench.suite -n 2 --dist worksteal -m "not slow"`` and then
``python -m tests.bench.suite``. Each worker writes its own lines into ``SUITE_TIMES`` (``out/suite-times``).
"""

import json
import os
import sys
from collections import defaultdict
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(os.environ.get("SUITE_TIMES", "out/suite-times"))


def _seconds() -> tuple[float, float]:
    """Processor time of this process and of its ended children."""
    times = os.times()
    return times.user + times.system, times.children_user + times.children_system


def _write(kind: str, name: str, before: tuple[float, float]) -> None:
    own, children = (round(now - then, 3) for now, then in zip(_seconds(), before, strict=True))
    FOLDER.mkdir(parents=True, exist_ok=True)
    with (FOLDER / f"{os.getpid()}.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps([kind, name, own, children]) + "\n")


def pytest_collection_finish(session: pytest.Session) -> None:
    """Record the start of a process: imports and collection."""
    _write("collection", "collection", (0.0, 0.0))


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, Any, None]:
    """Record a test with its fixtures."""
    before = _seconds()
    yield
    _write("test", item.nodeid, before)


@pytest.hookimpl(hookwrapper=True)
def pytest_fixture_setup(fixturedef: Any, request: Any) -> Generator[None, Any, None]:
    """Record a fixture that is made, those that it needs not among it."""
    before = _seconds()
    yield
    if fixturedef.scope != "function":
        _write("fixture", f"{fixturedef.baseid}::{fixturedef.argname}", before)


def _print(title: str, seconds: dict[str, list[float]], rows: int) -> None:
    print(f"\n{title:80} count    own  children")
    order = sorted(seconds.items(), key=lambda one: -one[1][1] - one[1][2])
    for name, (count, own, children) in order[:rows]:
        print(f"{name[-80:]:80} {count:5.0f} {own:6.1f} {children:9.1f}")


def main() -> None:
    """Print the tables of the records of one run."""
    by: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(lambda: [0.0, 0.0, 0.0]))
    for path in FOLDER.glob("*.jsonl"):
        for line in path.read_text("utf-8").splitlines():
            kind, name, own, children = json.loads(line)
            file, _, function = name.partition("::")
            names = {"all": kind, kind: name}
            if kind == "test":
                names |= {"folder": "/".join(file.split("/")[:2]), "file": file}
                names |= {"function": f"{file}::{function.partition('[')[0]}"}
            for table, row in names.items():
                total = by[table][row]
                total[:] = total[0] + 1, total[1] + own, total[2] + children
    rows = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    for table in ("all", "folder", "file", "function", "fixture"):
        _print(table, by[table], rows)


if __name__ == "__main__":
    main()
