"""Run a command of processor, and tell the processor seconds of each of its steps: for tests/bench/cost.py.

python -m tests.bench.cost_run SECONDS.json run SCENE.h5 -o OUT --steps spheres
"""

from __future__ import annotations

import json
import resource
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from processor import __main__ as program
from processor import pipeline
from processor.compare import compare
from tests.bench.cost_series import COMPARE


def processor_seconds() -> float:
    """User and system seconds of this process and of its children that ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def timed(function: Callable[..., Any], name: str, seconds: dict[str, float]) -> Callable[..., Any]:
    """The same function, whose processor seconds are added to those of its name."""

    def run(*arguments: Any, **named: Any) -> Any:
        started = processor_seconds()
        try:
            return function(*arguments, **named)
        finally:
            seconds[name] = seconds.get(name, 0.0) + processor_seconds() - started

    return run


def main(path: Path, arguments: list[str]) -> None:
    """Run the command; exits as it does."""
    seconds: dict[str, float] = {}
    for name, module in pipeline.step_modules().items():
        module.run = timed(module.run, name, seconds)
    compare.compare = timed(compare.compare, COMPARE, seconds)
    sys.argv = ["processor", *arguments]
    try:
        program.main()
    finally:
        path.write_text(json.dumps(seconds), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
