"""What every step of processor costs: seconds and memory against points, parts, balls, scans and cells.

    python -m tests.bench.cost --output cost.json [--only spheres,stitch/scans,peers] [--quick] [--rounds 2]

Every run is a process of its own with all that a user waits for: start, reading, step, report. The system tells its
processor seconds (user and system, its children's too) and its largest resident memory; tests/bench/cost_run.py tells
the processor seconds of the step alone, and the exponents are of these: the slope of log seconds over log size by least
squares. Of memory, what the smallest scene of the step takes is subtracted first. Libraries of linear algebra get one
thread, the program has the cores. A run of the smallest size goes before each step, so that compiled code is there. Of
several rounds the least seconds count. ``--quick`` takes the two smallest sizes only. docs/scripts/make_cost.py makes
docs/cost.md from the file.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyElement

from docs.scripts import make_cost
from processor.store import store
from tests.bench import cost_peers, cost_series, m3c2
from tests.bench.cost_series import Series, Size

DONE = (0, 1, 4)  # exit codes: 1 is done in part, 4 a missed limit of accuracy: some of these scenes are very coarse
SMALLEST_CLOUD = 2_000
SECONDS = "seconds.json"  # of each step
VERSIONS = ("numpy", "scipy", "numba", "h5py", "open3d")


def exponent(sizes, values):
    """Slope of log values over log sizes by least squares; nan of fewer than two."""
    sizes, values = np.asarray(sizes, float), np.asarray(values, float)
    if len(sizes) < 2 or len(set(sizes)) < 2:
        return float("nan")
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])


# A small process between: the peak of a process counts what that which started it had at that moment.
LAUNCHER = """
import json, os, subprocess, sys, time
started = time.perf_counter()
with open(sys.argv[1], "w") as log:
    process = subprocess.Popen(sys.argv[2:], stdout=log, stderr=log)
    _, status, usage = os.wait4(process.pid, 0)
code, wall = os.waitstatus_to_exitcode(status), time.perf_counter() - started
process.returncode = code
print(json.dumps([code, usage.ru_utime + usage.ru_stime, wall, usage.ru_maxrss / 1024.0]))
"""


def measured(command: list[str], folder: Path, code: Path | None = None) -> dict[str, float]:
    """Run a command, of the ``code`` of another checkout; processor seconds, by the clock, peak memory, exit code.

    Raises RuntimeError if it fails.
    """
    log = folder / "log.txt"
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    launch = [sys.executable, "-S", "-c", LAUNCHER, str(log), *command]
    done = subprocess.run(launch, check=True, capture_output=True, text=True, env=environment, cwd=code)
    exit_code, cpu, wall, peak = json.loads(done.stdout)
    if exit_code not in DONE:
        raise RuntimeError(f"{' '.join(command)}: exit code {exit_code}\n{log.read_text()}")
    return {"cpu": cpu, "wall": wall, "mb": peak, "code": exit_code}


def make(recipe: str, settings: tuple[str, ...], place: Path) -> dict[str, Any]:
    """Make a scene by the command; what it says. Without its truth: a run compares its results with one."""
    command = [sys.executable, "-m", "designgen", "make", recipe, "-o", str(place), "--json"]
    command += [word for setting in settings for word in ("--set", setting)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    store.write_scene(place, store.read_scene(place), None, store.read_provenance(place))
    return dict(json.loads(done.stdout))


def write_clouds(count: int, folder: Path) -> dict[str, Any]:
    """Two clouds for ``compare``, of half the points each, as dense for any count."""
    for number, name in enumerate(("before", "after")):
        points = m3c2.cloud(count // 2, 5.0 * number, number)
        points[:, :2] *= np.sqrt(count / 2_000_000.0)
        rows = np.array([tuple(point) for point in 1e-3 * points], [(axis, "f8") for axis in "xyz"])
        PlyData([PlyElement.describe(rows, "vertex")]).write(folder / f"{name}.ply")
    return {"points": count // 2 * 2, "scans": 2}


def run_of(step: str, parameters: str, folder: Path) -> list[str]:
    """The command that is measured."""
    program = [sys.executable, "-m", "tests.bench.cost_run", str(folder / SECONDS)]
    if step == cost_series.COMPARE:
        return [
            *program,
            "compare",
            *(str(folder / f"{name}.ply") for name in ("before", "after")),
            "-o",
            str(folder / "out"),
        ]
    command = [*program, "run", str(folder / "scene.h5"), "-o", str(folder / "out"), "--quiet"]
    command += ["--steps", cost_series.STEPS.get(step, step)]
    if parameters:
        (folder / "parameters.toml").write_text(parameters)
        command += ["--params", str(folder / "parameters.toml")]
    return command


def size_of(over: str, said: dict[str, Any], size: Size, folder: Path) -> float:
    """The number that the series varies."""
    if over == cost_series.CELLS:
        found = json.loads((folder / "out/results.json").read_text("utf-8"))["steps"]["defects"]
        return float(found["expected_mm2"] / found["cell"] ** 2)
    by_scene = {
        cost_series.POINTS: said["points"],
        cost_series.SCANS: said["scans"],
        cost_series.PER_SCAN: said["points"] / said["scans"],
    }
    return float(by_scene.get(over, size.count))


def row_of(series: Series, size: Size, rounds: int, warm: bool) -> dict[str, float]:
    """Make a scene and run the step on it; the least seconds of the rounds, the most memory."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        if series.step == cost_series.COMPARE:
            said = write_clouds(size.count, folder)
        else:
            said = make(series.recipe, (*series.settings, *size.settings), folder / "scene.h5")
        command = run_of(series.step, size.parameters, folder)
        if not warm:
            measured(command, folder)
        runs = []
        for _ in range(rounds):
            runs.append(measured(command, folder))
            runs[-1]["step"] = json.loads((folder / SECONDS).read_text("utf-8"))[series.step]
        row = {key: min(one[key] for one in runs) for key in ("step", "cpu", "wall")}
        row["mb"] = max(one["mb"] for one in runs)
        return {"size": size_of(series.over, said, size, folder), "points": said["points"], **row}


def start_of(step: str, rounds: int) -> dict[str, float]:
    """What a run of the step on the smallest scene takes."""
    recipe, settings = cost_series.SMALLEST[step]
    smallest = Series(step, cost_series.POINTS, recipe, "", (), settings)
    return row_of(smallest, Size((), count=2 * SMALLEST_CLOUD), rounds, warm=False)


def fitted(series: Series, rows: list[dict[str, float]], start: dict[str, float]) -> dict[str, Any]:
    """A series as it is written: rows, exponents, bytes a point of the largest scene."""
    sizes, points = ([row[key] for row in rows] for key in ("size", "points"))
    mb = [row["mb"] for row in rows]
    grows = len(set(points)) > 1
    return {
        "step": series.step, "over": series.over, "recipe": series.recipe, "held": series.held,
        "rows": rows,
        "exponent": exponent(sizes, [row["step"] for row in rows]),
        "memory exponent": exponent(sizes, make_cost.beyond(mb, start["mb"])),
        "bytes a point": float(np.polyfit(points, mb, 1)[0]) * 2.0**20 if grows else None,
    }  # fmt: skip


def machine() -> dict[str, Any]:
    """Cores and versions; no names."""
    packages = importlib.metadata.packages_distributions()  # open3d is in open3d-cpu, too
    versions = {name: importlib.metadata.version(packages[name][0]) for name in VERSIONS if name in packages}
    return {"cores": len(os.sched_getaffinity(0)), "python": platform.python_version(), **versions}


def show(series: dict[str, Any]) -> None:
    """Print the rows of a series."""
    for row in series["rows"]:
        size = f"{row['size']:12,.0f} {series['over']:14s} {row['points']:12,} points"
        seconds = f"step {row['step']:7.2f}, run {row['cpu']:7.2f} processor s, {row['wall']:7.2f} s"
        print(f"  {size}  {seconds}, {row['mb']:6.0f} MB")
    slopes = f"exponent {series['exponent']:.2f}, of memory {series['memory exponent']:.2f}"
    bytes_ = series["bytes a point"]
    print(f"  {slopes}" + (f", {bytes_:.0f} bytes a point" if bytes_ is not None else ""), flush=True)


def main() -> None:
    """Run, print tables and write JSON after each series."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--only", default="", help="steps or series (step/what), and peers, with commas between")
    parser.add_argument("--quick", action="store_true", help="the two smallest sizes of each series")
    parser.add_argument("--rounds", type=int, default=1)
    given = parser.parse_args()
    only = set(given.only.split(",")) if given.only else set()
    chosen = [one for one in cost_series.SERIES if not only or only & {one.step, one.name}]
    found: dict[str, Any] = {"machine": machine(), "rounds": given.rounds, "start": {}, "series": [], "peers": {}}
    given.output.parent.mkdir(parents=True, exist_ok=True)
    for series in chosen:
        if series.step not in found["start"]:
            found["start"][series.step] = start_of(series.step, given.rounds)
            print(
                "{0}: smallest scene {step:.2f} of {cpu:.2f} processor s, {mb:.0f} MB".format(
                    series.step, **found["start"][series.step]
                )
            )
        print(f"{series.name}: {series.recipe}, {series.held}", flush=True)
        sizes = series.sizes[: 2 if given.quick else None]
        warm = any(one["step"] == series.step for one in found["series"])
        rows = [row_of(series, size, given.rounds, warm or number > 0) for number, size in enumerate(sizes)]
        found["series"].append(fitted(series, rows, found["start"][series.step]))
        show(found["series"][-1])
        given.output.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if not only or "peers" in only:
        found["peers"] = cost_peers.compared(given.quick)
    given.output.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
