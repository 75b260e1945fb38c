"""Hold the results of today's code against stored ones of the same scenes, to the last digits.

    python -m tests.bench.comparer references -o out/reference
    python -m tests.bench.comparer compare out/reference [--only NAME]... [-o table.json]

``references`` makes the scenes of recipes.toml and the results of the code as it is: a folder for every recipe and seed
with scene.h5, results.h5 and results.json; reference.json beside them has the commit, versions, arguments and seconds.
``compare`` runs today's code on the stored scenes and compares every number, text, shape and name of the results: see
differences.py. Exit codes: 0 equal, 1 something differs, 2 slower than 1.05 times (with --time alone).

A file of changes (``--changes``, else changes.toml in the reference) names what is meant to differ:

    left_out = ["*/residuals/*"]            # patterns of places
    [renamed]                               # runs of whole names in places
    "balls/centres" = "nodes/centres"

Seconds are of processors, of the run and its children. Beside other work they are a hint alone. ``--time 3`` judges
them: the code of the reference's commit and today's run in turns, three times each, and the least seconds count.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np

from processor import pipeline
from tests.bench import cost
from tests.bench.comparer import differences, runs, scenes, table
from tests.bench.comparer.differences import Comparison, Difference
from tests.bench.comparer.runs import PAIR, ROOT, Run, in_turn, least, measured, runs_of
from tests.support import kernels

REFERENCE, CHANGES = "reference.json", "changes.toml"


# --- references -------------------------------------------------------------------------------------------------------


def references(output: Path, only: list[str], jobs: int) -> int:
    """Make scenes and results in a new folder, or those of ``only`` in one that is there."""
    chosen = {name: recipe for name, recipe in scenes.recipes().items() if not only or name in only}
    path = output / REFERENCE
    content = json.loads(path.read_text("utf-8")) if path.exists() else {"runs": {}}
    if not only and path.exists():
        raise SystemExit(f"{output}: has references; take another folder, or replace some of them with --only")
    here = {"commit": runs.commit(), "software": pipeline.software(), "machine": cost.machine()}
    if content["runs"] and runs.differs_from(content["commit"]):
        raise SystemExit(f"{path}: made by processor of commit {content['commit']}, which differs; make all again")
    every = [run for name, recipe in chosen.items() for run in runs_of(name, recipe)]
    output.mkdir(parents=True, exist_ok=True)
    twice = kernels.discard_stale()

    writing = threading.Lock()

    def made(run: Run) -> None:
        if run.seed != PAIR:
            folder = output / run.place
            shutil.rmtree(folder, ignore_errors=True)
            make = f"from tests.bench.comparer import scenes; scenes.write({run.name!r}, {run.seed}, {str(folder)!r})"
            subprocess.run([sys.executable, "-c", make], check=True, cwd=ROOT)
        found = {"arguments": run.arguments, **least(run, output, output, twice)}
        with writing:
            content["runs"].setdefault(run.name, {})[run.seed] = found
            path.write_text(json.dumps({**here, "runs": content["runs"]}, indent=1) + "\n", encoding="utf-8")
        print(f"{run.place:20s} {found['seconds']:7.1f} s, exit code {found['exit code']:.0f}", flush=True)

    in_turn(every, jobs, made)
    total = sum(one["seconds"] for seeds in content["runs"].values() for one in seeds.values())
    print(f"{len(every)} runs; all runs of the reference take {total:.0f} s of processor time")
    return 0


# --- compare ----------------------------------------------------------------------------------------------------------


def compare(given: argparse.Namespace) -> int:
    """Run today's code on the stored scenes, print what differs and the table; returns the exit code."""
    content = json.loads((given.reference / REFERENCE).read_text("utf-8"))
    if unknown := sorted(set(given.only) - set(content["runs"])):
        raise SystemExit(f"no recipe {unknown[0]!r} in the reference; it has {', '.join(content['runs'])}")
    path = given.changes or given.reference / CHANGES
    changes = scenes.tomllib.loads(path.read_text("utf-8")) if given.changes or path.exists() else {}
    stored = {
        Run(name, seed, tuple(one["arguments"])): one
        for name, seeds in content["runs"].items()
        for seed, one in seeds.items()
        if not given.only or name in given.only
    }
    kernels.discard_stale()
    code = runs.old_code(given.reference, content["commit"].removesuffix("-dirty")) if given.time else ROOT
    with tempfile.TemporaryDirectory() as place:
        results = given.keep or Path(place) / "new"

        def work(run: Run) -> dict[str, Any]:
            old = {**stored[run]}
            try:
                turns = [
                    (measured(run, given.reference, Path(place) / "old", code), measured(run, given.reference, results))
                    for _ in range(given.time)
                ]
                new = turns[-1][1] if turns else least(run, given.reference, results)
            except (RuntimeError, FileNotFoundError) as error:  # a pair lacks what failed before
                failed = Difference("exit code", str(error).splitlines()[-1])
                return table.row(run.name, run.seed, Comparison((failed,), 0.0, ""), {}, {})
            if turns:
                old["seconds"], new["seconds"] = (min(turn[i]["seconds"] for turn in turns) for i in (0, 1))
            values = differences.values_of(given.reference / run.place), differences.values_of(results / run.place)
            for side, one in zip(values, (old, new), strict=True):
                side["exit code"] = np.asarray(int(one["exit code"]))
            before = differences.renamed(values[0], changes.get("renamed", {}))
            left_out = changes.get("left_out", ())
            found = differences.compared(before, values[1], given.tolerance, given.verdicts, left_out)
            return table.row(run.name, run.seed, found, old, new)

        rows = list(in_turn(list(stored), 1 if given.time else given.jobs, work).values())
    return table.reported(
        rows,
        {
            "reference": content["commit"], "commit": runs.commit(), "tolerance": given.tolerance,
            "verdicts alone": given.verdicts, "time judged": bool(given.time),
        },
        given.output,
    )  # fmt: skip


def whole_path(text: str) -> Path:
    """Return a path that another current folder does not change."""
    return Path(text).resolve()


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns its exit code."""
    parser = argparse.ArgumentParser(
        "comparer", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    of_command = parser.add_subparsers(dest="command", required=True)
    make, hold = (of_command.add_parser(name) for name in ("references", "compare"))
    for one in (make, hold):
        one.add_argument("--only", action="append", default=[], metavar="RECIPE", help="repeatable")
        one.add_argument("--jobs", type=int, default=2)
    make.add_argument("-o", "--output", type=whole_path, required=True)
    hold.add_argument("reference", type=whole_path)
    hold.add_argument("-o", "--output", type=Path, help="the table as JSON")
    hold.add_argument("--tolerance", type=float, default=differences.TOLERANCE, help="instead of %(default)g")
    hold.add_argument("--verdicts", action="store_true", help="compare statuses, codes and verdicts alone")
    hold.add_argument("--changes", type=Path, help="TOML file of what is meant to differ")
    hold.add_argument("--time", type=int, default=0, metavar="TURNS", help="judge the time by so many turns")
    hold.add_argument("--keep", type=whole_path, help="folder for the new results")
    given = parser.parse_args(arguments)
    return references(given.output, given.only, given.jobs) if given.command == "references" else compare(given)


if __name__ == "__main__":
    sys.exit(main())
