"""Runs of a reference, by today's code or that of another checkout, each a process of its own."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.bench import cost
from tests.bench.comparer import differences, scenes

ROOT = Path(__file__).parents[3]
SEEDS = ("1", "2")
PAIR = "pair"  # in place of a seed
SHORT_S = 5.0  # runs below it are done twice


@dataclass(frozen=True)
class Run:
    """One run of a reference: a recipe with a seed, or what is done with both seeds."""

    name: str
    seed: str
    arguments: tuple[str, ...] = ()

    @property
    def place(self) -> str:
        """Its folder in the reference."""
        return f"{self.name}/{self.seed}"


def runs_of(name: str, recipe: dict[str, Any]) -> list[Run]:
    """List the runs of a recipe; the pair comes after its seeds."""
    runs = [Run(name, seed, tuple(recipe["run"])) for seed in SEEDS]
    return runs + ([Run(name, PAIR)] if recipe.get("pair") else [])


def commands(run: Run, reference: Path, results: Path, out: Path) -> list[list[str]]:
    """Return the arguments of processor's commands; a pair needs the ``results`` of its seeds."""
    if run.seed != PAIR:
        scene = reference / run.place / scenes.SCENE
        return [["run", str(scene), "-o", str(out / "results"), "--quiet", *run.arguments]]
    for day, seed in enumerate(SEEDS, 1):
        epoch = out / f"runs/2026-01-{day:02}"
        epoch.mkdir(parents=True)
        shutil.copy(results / run.name / seed / "results.h5", epoch)
    clouds = [str(reference / run.name / seed / scenes.CLOUD) for seed in SEEDS]
    return [
        ["history", str(out / "runs"), "-o", str(out / "history"), "--quiet"],
        ["compare", *clouds, "-o", str(out / "comparison")],
    ]


def measured(run: Run, reference: Path, results: Path, code: Path = ROOT) -> dict[str, float]:
    """Run ``code`` and keep what it found in ``results``; processor seconds and exit code.

    Raises RuntimeError where a command fails.
    """
    with tempfile.TemporaryDirectory() as place:
        out = Path(place)
        program = [sys.executable, "-m", "processor"]
        used = [cost.measured([*program, *one], out, code) for one in commands(run, reference, results, out)]
        (results / run.place).mkdir(parents=True, exist_ok=True)
        for found in sorted(path for path in out.glob("*/*") if path.name in differences.FILES):
            shutil.copyfile(found, results / run.place / found.name)
    return {"seconds": sum(one["cpu"] for one in used), "exit code": max(one["code"] for one in used)}


def least(run: Run, reference: Path, results: Path, twice: bool = False) -> dict[str, float]:
    """Measure a run, a short one ``twice`` in any case; the least seconds count."""
    first = measured(run, reference, results)
    if first["seconds"] >= SHORT_S and not twice:
        return first
    second = measured(run, reference, results)
    return {**second, "seconds": min(first["seconds"], second["seconds"])}


def in_turn(runs: list[Run], jobs: int, work: Callable[[Run], Any]) -> dict[Run, Any]:
    """Do the work of all runs, ``jobs`` at a time; pairs come when all seeds are done."""
    done: dict[Run, Any] = {}
    with ThreadPoolExecutor(jobs) as pool:
        for group in ([run for run in runs if run.seed != PAIR], [run for run in runs if run.seed == PAIR]):
            done |= dict(zip(group, pool.map(work, group), strict=True))
    return done


def commit() -> str:
    """Return the commit of this checkout, with a mark where files differ from it."""
    return subprocess.run(
        ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
        check=True, capture_output=True, text=True, cwd=ROOT,
    ).stdout.strip()  # fmt: skip


def differs_from(name: str) -> bool:
    """Whether processor as it is here differs from that of a commit."""
    compared = ["git", "diff", "--quiet", name.removesuffix("-dirty"), "--", "processor"]
    return name.endswith("-dirty") or subprocess.run(compared, cwd=ROOT).returncode != 0


def old_code(reference: Path, name: str) -> Path:
    """Return a folder with the code of the reference's commit, beside the reference, where it stays compiled."""
    folder = reference / "code"
    if not folder.exists():
        folder.mkdir()
        archive = subprocess.run(["git", "archive", name], check=True, capture_output=True, cwd=ROOT)
        subprocess.run(["tar", "-x", "-C", str(folder)], input=archive.stdout, check=True)
    return folder
