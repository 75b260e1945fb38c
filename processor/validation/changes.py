"""What changed in a night that the scatter from night to night does not explain.

Two tests a figure (step, method, name), each over all cases together, each for worse and for better:

``paired``: on the fixed seeds. While the software is as it was, their figures are what they were to the last bits, so
there is no scatter and no false alarm. Where they moved (by more than 1e-6 of themselves), the differences from the
last night that was not worse are put to one-sided t tests of their mean against a margin of 2 % (1 point for shares):
by their own scatter, and by that from seed to seed in the history, where it is the larger (two values drawn anew
differ by no more than sqrt(2) of it, and few scenes say little of their own); the smaller p counts, doubled.
Differences of one recipe and seed are averaged first, as settings share the scene. It takes three such pairs. Scenes
that are not the same any more are left out: the generator has changed, not the estimator.

``fresh``: on the seeds of this night alone. In every case this night's value is ranked among those of the earlier
nights (at least 5, at most 120), the ranks are turned into normal scores (van der Waerden) and summed over the cases.
On an undisturbed night every order is as likely as every other, so the sum's distribution is known exactly, whatever
the tails of the errors; it is computed by convolution. It also sees slow drift, and what the fixed seeds do not
touch.

Over all tests of a night together Holm's procedure keeps the chance of any false alarm at ALARM_RATE, however the
figures depend on each other: one night in 200 for worse, and one in 200 for better. For ``fresh`` that is exact at
most, for ``paired`` as good as the normal distribution of the differences, and it counts only in nights in which
figures moved.

Before there are 5 nights ``paired`` and the limits alone watch; with one night, the limits.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import special, stats

from processor.model import Better
from processor.validation.aims import Badness, badness
from processor.validation.history import Name, Row

ALARM_RATE = 0.005  # of a night, for worse and for better each
SAME = 1e-6  # relative: what another library's rounding may move
LEAST_PAIRS = 3
LEAST_FREEDOM = 5  # of the scatter from seed to seed
LEAST_NIGHTS, MOST_NIGHTS = 5, 120
GRID = 64  # steps of normal scores in 1
LEAST_SPREAD = 1e-9  # of differences: those that agree to the last bit still have rounding
REGRESSION, IMPROVEMENT, CHANGED, LOST = "regression", "improvement", "changed", "lost"
ALARMS = (REGRESSION, LOST)


@dataclass(frozen=True)
class Change:
    """A figure that changed. ``size``: of its badness, in the median over the cases; ``p`` as the test gave it."""

    name: Name
    kind: str  # regression | improvement | changed | lost
    test: str  # paired | fresh | ""
    size: float
    is_ratio: bool
    unit: str
    p: float
    cases: int  # pairs, or cases, that the test rests on

    @property
    def said(self) -> str:
        """Say the change in a few words."""
        if self.kind == LOST:
            return f"no longer measured in {self.cases} cell{'' if self.cases == 1 else 's'}"
        worse = "worse" if self.size > 0.0 else "better"
        if self.is_ratio:
            return f"{100.0 * math.expm1(abs(self.size)):.3g} % {worse}"
        unit = "points" if self.unit == "%" else self.unit
        return f"{abs(self.size):.3g} {unit} {worse}".replace("  ", " ")


@dataclass(frozen=True)
class Found:
    """What the tests found: changes, and what they rest on."""

    changes: tuple[Change, ...] = ()
    figures: int = 0
    paired: int = 0  # tests made
    fresh: int = 0
    moved_scenes: int = 0  # fixed cells whose scene is another than before
    first: bool = False  # there is nothing to compare with

    def of(self, *kinds: str) -> list[Change]:
        """Return the changes of these kinds, the surest first."""
        return sorted((one for one in self.changes if one.kind in kinds), key=lambda one: (one.p, one.name))


@dataclass(frozen=True)
class _Test:
    name: Name
    test: str
    size: float
    p_worse: float
    p_better: float
    cases: int


_ByCase = dict[str, dict[str, list[float]]]  # values of the seeds of a night, by case and night


@dataclass
class _Series:
    """All rows of one figure: fixed cells of this night and the last before it, seeds of this night and the earlier."""

    unit: str = ""
    better: str = ""
    last: dict[tuple[str, int], Row] = field(default_factory=dict)
    mine: dict[tuple[str, int], Row] = field(default_factory=dict)
    earlier: _ByCase = field(default_factory=dict)
    fresh: _ByCase = field(default_factory=dict)

    def add(self, row: Row, tonight: bool) -> None:
        self.unit = row.unit
        self.better = row.better or self.better
        if row.fixed:
            (self.mine if tonight else self.last)[row.case, row.seed] = row
        else:
            of_case = (self.fresh if tonight else self.earlier).setdefault(row.case, {})
            of_case.setdefault(row.night, []).append(row.value)


def find(
    rows: Sequence[Row], night: str, worse: Mapping[Name, set[str]], aims: Mapping[str, str | float] | None = None
) -> Found:
    """Find what changed in ``night``; ``rows`` hold it and earlier nights.

    ``worse`` names the nights in which a figure was worse and not accepted: they are no level to go by. So an alarm is
    raised every night until the figure is back or accepted.
    """
    series: dict[Name, _Series] = defaultdict(_Series)
    there: set[tuple[str, int, tuple[str, str]]] = set()
    for row in rows:  # by night, the earliest first
        tonight = row.night == night
        if not tonight and (row.night > night or row.night in worse.get(row.name, ())):
            continue
        series[row.name].add(row, tonight)
        if tonight:
            there.add((row.case, row.seed, row.name[:2]))
    tests: list[_Test] = []
    changes: list[Change] = []
    moved: dict[Name, _Test] = {}
    other_scenes: set[tuple[str, int]] = set()
    judged: dict[Name, tuple[Badness, str]] = {}
    for name, own in series.items():
        measure = badness(name[2], own.unit, Better(own.better or Better.LOW), aims or {})
        judged[name] = measure, own.unit
        pairs, lost, scenes = _pairs(own, there, name, measure)
        other_scenes |= scenes
        if lost:
            changes.append(Change(name, LOST, "", math.inf, False, own.unit, 0.0, lost))
        if any(difference != 0.0 for _, difference, _ in pairs):
            moved[name] = _paired(name, pairs, own, measure)
            tests += [moved[name]] if moved[name].p_worse == moved[name].p_worse else []
        fresh = _fresh(name, own.fresh, own.earlier, measure)
        tests += [] if fresh is None else [fresh]
    for kind, side in ((REGRESSION, "p_worse"), (IMPROVEMENT, "p_better")):
        for test in _holm(tests, side):
            measure, unit = judged[test.name]
            p = getattr(test, side)
            if not any(one.name == test.name for one in changes):
                changes.append(Change(test.name, kind, test.test, test.size, measure.is_ratio, unit, p, test.cases))
    told = {one.name for one in changes}
    changes += [
        Change(name, CHANGED, "", test.size, judged[name][0].is_ratio, judged[name][1], 1.0, test.cases)
        for name, test in moved.items()
        if name not in told
    ]
    count = sum(one.test == "paired" for one in tests)
    figures = sum(bool(own.mine or own.fresh) for own in series.values())
    first = not any(own.last or own.earlier for own in series.values())
    return Found(tuple(changes), figures, count, len(tests) - count, len(other_scenes), first)


# --- on the fixed seeds ---------------------------------------------------------------------------------------------

_Pair = tuple[tuple[str, int], float, float]  # recipe and seed, the difference of badness, its size before


def _pairs(
    own: _Series, there: set[tuple[str, int, tuple[str, str]]], name: Name, measure: Badness
) -> tuple[list[_Pair], int, set[tuple[str, int]]]:
    """Pair fixed cells with the last night's; also how many lost their figure, and whose scene is another."""
    pairs: list[_Pair] = []
    lost = 0
    scenes: set[tuple[str, int]] = set()
    for key, before in own.last.items():
        row = own.mine.get(key)
        if row is None:
            lost += (*key, name[:2]) in there
        elif row.input_sha256 != before.input_sha256:
            scenes.add(key)
        elif math.isnan(row.value) != math.isnan(before.value):
            lost += math.isnan(row.value)
        elif not math.isnan(row.value):
            same = abs(row.value - before.value) <= SAME * max(abs(row.value), abs(before.value))
            y = measure.of(before.value)
            pairs.append(((row.recipe, row.seed), 0.0 if same else measure.of(row.value) - y, abs(y)))
    return pairs, lost, scenes


def _paired(name: Name, pairs: Sequence[_Pair], own: _Series, measure: Badness) -> _Test:
    """Test the differences; p is NaN where there are too few."""
    groups: dict[tuple[str, int], list[float]] = defaultdict(list)
    for key, difference, _ in pairs:
        groups[key].append(difference)
    means = np.array([np.mean(group) for group in groups.values()])
    size = float(np.median([difference for _, difference, _ in pairs if difference != 0.0]))
    count = len(means)
    if count < LEAST_PAIRS:
        return _Test(name, "paired", size, math.nan, math.nan, count)
    margin = measure.margin + measure.share * float(np.sqrt(np.mean([before**2 for *_, before in pairs])))
    spread = max(float(np.std(means, ddof=1)), LEAST_SPREAD)
    scales = [(spread, count - 1)]
    seeds, freedom = _between_seeds(own, measure)
    if freedom >= LEAST_FREEDOM and math.sqrt(2.0) * seeds > spread:
        scales.append((math.sqrt(2.0) * seeds, freedom))
    mean, root = float(np.mean(means)), math.sqrt(count)
    worse, better = (
        min(1.0, 2.0 * min(float(stats.t.sf((sign * mean - margin) * root / scale, dof)) for scale, dof in scales))
        for sign in (1.0, -1.0)
    )
    return _Test(name, "paired", size, worse, better, count)


def _between_seeds(own: _Series, measure: Badness) -> tuple[float, int]:
    """Return the standard deviation of a case's figures from seed to seed, before this night, and its freedom."""
    of_case: dict[str, list[float]] = defaultdict(list)
    for (case, _), row in own.last.items():
        of_case[case].append(measure.of(row.value))
    for case, earlier in own.earlier.items():
        of_case[case] += [measure.of(value) for values in earlier.values() for value in values]
    squares, freedom = 0.0, 0
    for found in of_case.values():
        levels = np.array([level for level in found if math.isfinite(level)])
        if len(levels) > 1:
            squares += float(np.sum((levels - levels.mean()) ** 2))
            freedom += len(levels) - 1
    return (math.sqrt(squares / freedom), freedom) if freedom else (math.nan, 0)


# --- on the seeds of the night --------------------------------------------------------------------------------------


def _fresh(name: Name, now: _ByCase, before: _ByCase, measure: Badness) -> _Test | None:
    """Test this night's ranks among the earlier nights', over all cases; None where there is nothing to rank."""
    total, null = 0, np.ones(1)
    offset = 0
    sizes = []
    for case, tonight in now.items():
        ((_, values),) = tonight.items()
        earlier = sorted((night, found) for night, found in before.get(case, {}).items() if len(found) == len(values))[
            -MOST_NIGHTS:
        ]
        if len(earlier) < LEAST_NIGHTS:
            continue
        levels = np.array([_mean(measure, found) for found in [values, *(found for _, found in earlier)]])
        scores = np.rint(GRID * special.ndtri(stats.rankdata(levels) / (len(levels) + 1))).astype(np.int64)
        if (scores == scores[0]).all():
            continue
        low = int(scores.min())
        null = np.convolve(null, np.bincount(scores - low) / len(scores))
        offset += low
        total += int(scores[0])
        middle = float(np.median(levels[1:]))
        sizes.append(levels[0] - middle if np.isfinite(levels[0] - middle) else 0.0)
    if not sizes:
        return None
    size = float(np.median(sizes))
    at = total - offset
    enough = abs(size) > measure.margin
    worse, better = (float(part.sum()) if enough else 1.0 for part in (null[at:], null[: at + 1]))
    return _Test(name, "fresh", size, worse, better, len(sizes))


def _mean(measure: Badness, values: Sequence[float]) -> float:
    """Mean badness of a night's seeds; what could not be measured is worse than all else."""
    mean = sum(map(measure.of, values)) / len(values)
    return mean if math.isfinite(mean) else math.inf


def _holm(tests: Sequence[_Test], side: str) -> list[_Test]:
    """Return the tests that Holm's procedure calls at ALARM_RATE, the surest first."""
    ranked = sorted(tests, key=lambda test: (getattr(test, side), test.name))
    called = []
    for i, test in enumerate(ranked):
        if getattr(test, side) > ALARM_RATE / (len(ranked) - i):
            break
        called.append(test)
    return called
