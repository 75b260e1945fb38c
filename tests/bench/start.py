"""Seconds until a process has done its first work: ``import processor``, a first sphere, the help of every command.

``python -m tests.bench.start --output start.json``. Each is the least of five processes, of the clock and of the
processor, with compiled kernels.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

IMPORT = "import processor"
SPHERE = """
import numpy as np, processor
z, turn = np.linspace(0.0, 0.999, 2000), 2.399963 * np.arange(2000)
side = np.sqrt(1.0 - z**2)
points = 75.0 * np.column_stack([side * np.cos(turn), side * np.sin(turn), z])
points += np.random.default_rng(0).normal(0.0, 0.5, points.shape)
assert processor.fit_sphere(points).status.value == "ok"
"""
COMMANDS = {
    "processor": (
        "run",
        "init",
        "check",
        "compare",
        "convert",
        "export",
        "report",
        "batch",
        "validate",
        "verify",
        "history",
        "papers",
    ),
    "designgen": ("make", "scan", "import", "export", "list"),
}


def least(command: list[str], rounds: int = 5) -> dict[str, float]:
    """Return the least seconds of the clock and of the processor of a command."""
    wall, processor = [], []
    for _ in range(rounds):
        before, began = os.times(), time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        after = os.times()
        wall.append(time.perf_counter() - began)
        own = after.children_user + after.children_system - before.children_user - before.children_system
        processor.append(own)
    return {"wall_s": round(min(wall), 3), "processor_s": round(min(processor), 3)}


def main() -> None:
    """Print a line a command and write them as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    work = {"import processor": [sys.executable, "-c", IMPORT], "a first sphere": [sys.executable, "-c", SPHERE]}
    for program, names in COMMANDS.items():
        work |= {f"{program} {name} --help": [sys.executable, "-m", program, name, "--help"] for name in names}
    subprocess.run(work["a first sphere"], check=True)  # compiles
    table = {}
    for name, command in work.items():
        table[name] = least(command)
        print(f"{name:30} {table[name]['wall_s']:7.3f} s  processor {table[name]['processor_s']:7.3f} s", flush=True)
    if options.output:
        options.output.write_text(json.dumps(table, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
