"""Nights without processes: cells whose figures are given, or drawn from stored ones."""

import dataclasses
import json
from pathlib import Path

import numpy as np

from processor.validation import cells, change_detection
from processor.validation.cells import Outcome
from processor.validation.history import Row
from processor.validation.matrix import Entry, Matrix
from processor.validation.software_identity import Software
from tests.support.results.metrics import described

STORED = Path(__file__).resolve().parents[3] / "fixtures" / "validation" / "stored-cells.json"
SOFTWARE = Software("code-1", "c0ffee" * 6, {"steel-scan-check": "0.1.0", "numpy": "2"})


def case(
    name="made",
    settings=(),
    methods=("ray",),
    steps=("spheres",),
    text='[scan]\nmode = "surface"\nsigma_mm = 1.0\n',
    origin=cells.Origin.OWN,
):
    return cells.Case(name, name, text, True, tuple(settings), tuple(steps), tuple(methods), origin=origin)


def matrix(*cases, seeds=(1, 2, 3), fresh=1, aim=None):
    return Matrix("made", "0" * 64, tuple(Entry(one, tuple(seeds), fresh) for one in cases), aim or {})


def results(figures, step="spheres", method="ray", digest="abc"):
    """A results.json of figures {name: value} or {name: (value, limit, unit)}; "ransac | radii, bias" is of ransac."""
    checks = []
    for name, given in figures.items():
        value, limit, unit = given if isinstance(given, tuple) else (given, None, "mm")
        other, _, rest = name.rpartition(" | ")
        quantity, statistic, better = described(rest)
        checks.append({
            "step": step, "name": rest, "method": other, "quantity": quantity, "statistic": str(statistic),
            "better": str(better), "value": value, "limit": limit, "unit": unit,
        })  # fmt: skip
    return {"input_sha256": digest, "steps": {step: {"method": method}}, "comparison": {}, "checks": checks}


def runner(figures_of, done=None):
    """Does cells by a function of the cell; ``done`` is told each one's title."""

    def run(asked):
        for cell in asked:
            if done is not None:
                done.append(cell.title)
            found = figures_of(cell)
            yield cell, found if isinstance(found, Outcome) else Outcome("", results(found), 1.5, 200.0)

    return run


def night_name(number):
    return str(np.datetime64("2026-01-01") + number)


class Simulated:
    """Nights drawn from the stored cells: some seeds of each case are the fixed ones, another comes new every night."""

    def __init__(self, seed, fixed=4, worse=None):
        self.rng = np.random.default_rng(seed)
        self.cases = json.loads(STORED.read_text("utf-8"))["cases"]
        self.fixed = [self.rng.choice(self.seeds(one), fixed, replace=False) for one in self.cases]
        self.rows, self.worse, self.alarms = [], {}, []

    @staticmethod
    def seeds(case):
        return len(case["figures"][0]["values"])

    def night(self, number, spoil=lambda row, value: value):
        """Add a night; ``spoil`` may change a figure's value. What the tests find in it."""
        name = night_name(number)
        for i, one in enumerate(self.cases):
            fresh = self.rng.integers(self.seeds(one))
            drawn = [(int(s), True) for s in self.fixed[i]] + [(1000 * number + i, False)]
            for seed, fixed in drawn:
                for figure in one["figures"]:
                    stored = figure["values"][seed if fixed else fresh]
                    if stored is None:
                        continue
                    key = (one["step"], figure["method"], figure["name"])
                    row = Row(
                        name, f"case {i}", one["recipe"], seed, fixed, f"{i} {seed}", key, stored, figure["unit"],
                        *map(str, described(figure["name"])),
                    )  # fmt: skip
                    self.rows.append(dataclasses.replace(row, value=spoil(row, stored)))
        found = change_detection.find(self.rows, name, self.worse)
        for one in found.of(*change_detection.ALARMS):
            self.alarms.append((name, one))
            self.worse.setdefault(one.name, set()).add(name)
        return found
