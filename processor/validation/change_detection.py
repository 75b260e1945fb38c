"""What changed in a night, beyond the scatter from night to night.

Two tests a figure (step, method, name), each over all cases together, each for worse and for better:

``paired``: on the fixed seeds. With unchanged software their figures repeat to the last bits: there is no scatter and
no false alarm. Where they changed (relatively by more than 1e-6), the differences from the last night that was not
worse are put to one-sided t tests of their mean against a margin of 2 % (1 point for shares). One test uses the
scatter of the differences, the other that from seed to seed in the history, where it is larger: two values drawn anew
differ by no more than sqrt(2) of it, and the scatter of few scenes is uncertain. The smaller p counts, doubled.
Differences of one recipe and seed are averaged first, as settings share the scene. At least three such pairs are
needed. Cells whose scene has changed are left out: there the generator changed, not the estimator.

``fresh``: on the seeds of this night alone. In every case this night's value is ranked among those of the earlier
nights (at least 5, at most 120), the ranks are turned into normal scores (van der Waerden) and summed over the cases.
On an undisturbed night every order is equally likely, so the distribution of the sum is known exactly, whatever the
tails of the errors; it is computed by convolution. This test also detects slow drift, and changes that the fixed seeds
do not show.

Over all tests of a night together Holm's procedure keeps the chance of any false alarm at ALARM_RATE, however the
figures depend on each other: one night in 200 for worse, and one in 200 for better. For ``fresh`` that is an upper
bound; for ``paired`` it holds as far as the differences are normally distributed, in nights in which figures changed.

With fewer than 5 nights only ``paired`` and the limits are effective; with one night, the limits.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import special, stats

from processor.language.messages import Text, text
from processor.model import Better, Word
from processor.validation.history import Name, Row
from processor.validation.loss import Loss, loss

ALARM_RATE = 0.005  # of a night, for worse and for better each
SAME = 1e-6  # relative: what another library's rounding may move
LEAST_PAIRS = 3  # two have a scatter of one degree of freedom, whose t test finds nothing
LEAST_DOF = 5  # of the scatter from seed to seed
LEAST_NIGHTS, MOST_NIGHTS = 5, 120  # the first of 6 ranks has 1 in 6; four months
GRID = 64  # steps of normal scores in 1
LEAST_SPREAD = 1e-9  # of differences: rounding remains where they agree to the last bit


class ChangeKind(Word):
    """How a figure changed."""

    REGRESSION = "regression"
    IMPROVEMENT = "improvement"
    CHANGED = "changed"  # without a test that calls it worse or better
    LOST = "lost"  # no longer measured


class Direction(Word):
    """Which way a figure changed."""

    WORSE = "worse"
    BETTER = "better"


ALARMS = (ChangeKind.REGRESSION, ChangeKind.LOST)


@dataclass(frozen=True)
class Change:
    """A figure that changed. ``size``: of its loss, in the median over the cases; ``p`` as the test gave it."""

    name: Name
    kind: ChangeKind
    test: str  # paired | fresh | ""
    size: float
    is_ratio: bool
    unit: str
    p: float
    cases: int  # pairs, or cases, that the test rests on
    quantity: str = ""  # "" = of a history without it
    statistic: str = ""

    @property
    def message(self) -> Text:
        """Size and direction of the change."""
        if self.kind == ChangeKind.LOST:
            return text("no longer measured in {cells} {cells:?cell|cells}", cells=self.cases)
        direction = Direction.WORSE if self.size > 0.0 else Direction.BETTER
        if self.is_ratio:
            return text("{size:.3g} % {direction}", size=100.0 * math.expm1(abs(self.size)), direction=direction)
        if self.unit == "%":
            return text("{size:.3g} points {direction}", size=abs(self.size), direction=direction)
        if self.unit:
            return text("{size:.3g} {unit} {direction}", size=abs(self.size), unit=self.unit, direction=direction)
        return text("{size:.3g} {direction}", size=abs(self.size), direction=direction)


@dataclass(frozen=True)
class Detected:
    """Outcome of the tests: changes, and what they rest on."""

    changes: tuple[Change, ...] = ()
    figures: int = 0
    paired: int = 0  # tests made
    fresh: int = 0
    moved_scenes: int = 0  # fixed cells whose scene is another than before
    first: bool = False  # there is nothing to compare with

    def of(self, *kinds: ChangeKind) -> list[Change]:
        """Return the changes of these kinds, those of the least p first."""
        chosen = (change for change in self.changes if change.kind in kinds)
        return sorted(chosen, key=lambda change: (change.p, change.name))


_Outcome = tuple[float, int, float, float]  # size of a change, cases, p of worse and of better
_ByCase = dict[str, dict[str, list[float]]]  # values of the seeds of a night, by case and night


@dataclass
class _Series:
    """All rows of one figure: fixed cells of this night and the last before it, seeds of this night and the earlier."""

    row: Row  # the latest
    last: dict[tuple[str, int], Row] = field(default_factory=dict)
    mine: dict[tuple[str, int], Row] = field(default_factory=dict)
    earlier: _ByCase = field(default_factory=dict)
    fresh: _ByCase = field(default_factory=dict)

    def add(self, row: Row, tonight: bool) -> None:
        self.row = row
        if row.fixed:
            (self.mine if tonight else self.last)[row.case, row.seed] = row
        else:
            of_case = (self.fresh if tonight else self.earlier).setdefault(row.case, {})
            of_case.setdefault(row.night, []).append(row.value)


def find(
    rows: Sequence[Row], night: str, worse: Mapping[Name, set[str]], aims: Mapping[str, str | float] | None = None
) -> Detected:
    """Find what changed in ``night``; ``rows`` hold it and earlier nights.

    ``worse`` names the nights in which a figure was worse and not accepted: these are no level to compare with. So an
    alarm is raised every night until the figure is back or accepted.
    """
    series, present = _by_figure(rows, night, worse)
    tests: list[tuple[Change, float, float]] = []  # with p of worse and of better
    changes: list[Change] = []
    moved: list[Change] = []
    other_scenes: set[tuple[str, int]] = set()
    for name, figure in series.items():
        row = figure.row
        measure = loss(name[2], row.unit, Better(row.better or Better.LOW), aims or {})
        pairs, lost, scenes = _pairs(figure, present, name, measure)
        other_scenes |= scenes
        unchanged = Change(
            name=name, kind=ChangeKind.CHANGED, test="", size=math.inf, is_ratio=measure.is_ratio, unit=row.unit, p=1.0,
            cases=lost, quantity=row.quantity, statistic=row.statistic,
        )  # fmt: skip
        if lost:
            changes.append(replace(unchanged, kind=ChangeKind.LOST, is_ratio=False, p=0.0))
        outcomes: dict[str, _Outcome | None] = {"fresh": _fresh(figure.fresh, figure.earlier, measure)}
        if any(difference != 0.0 for _, difference, _ in pairs):
            outcomes = {"paired": _paired(pairs, figure, measure), **outcomes}
        for test, outcome in outcomes.items():
            if outcome is None:
                continue
            size, cases, p_worse, p_better = outcome
            tested = replace(unchanged, size=size, cases=cases)
            moved += [tested] if test == "paired" else []
            tests += [] if math.isnan(p_worse) else [(replace(tested, test=test), p_worse, p_better)]
    of_worse, of_better = [(one, p) for one, p, _ in tests], [(one, p) for one, _, p in tests]
    for kind, one_sided in ((ChangeKind.REGRESSION, of_worse), (ChangeKind.IMPROVEMENT, of_better)):
        for tested, p in _holm(one_sided):
            if all(known.name != tested.name for known in changes):
                changes.append(replace(tested, kind=kind, p=p))
    known_names = {known.name for known in changes}
    changes += [one for one in moved if one.name not in known_names]
    paired = sum(tested.test == "paired" for tested, *_ in tests)
    return Detected(
        changes=tuple(changes),
        figures=sum(bool(figure.mine or figure.fresh) for figure in series.values()),
        paired=paired,
        fresh=len(tests) - paired,
        moved_scenes=len(other_scenes),
        first=not any(figure.last or figure.earlier for figure in series.values()),
    )


_Present = set[tuple[str, int, tuple[str, str]]]  # case, seed, and step with method


def _by_figure(rows: Sequence[Row], night: str, worse: Mapping[Name, set[str]]) -> tuple[dict[Name, _Series], _Present]:
    """Sort rows by figure, without later nights and those that are no level; also what was measured this night."""
    series: dict[Name, _Series] = {}
    present: _Present = set()
    for row in rows:  # by night, the earliest first
        tonight = row.night == night
        if not tonight and (row.night > night or row.night in worse.get(row.name, ())):
            continue
        series.setdefault(row.name, _Series(row)).add(row, tonight)
        if tonight:
            present.add((row.case, row.seed, row.name[:2]))
    return series, present


# --- on the fixed seeds ---------------------------------------------------------------------------------------------

_Pair = tuple[tuple[str, int], float, float]  # recipe and seed, the difference of loss, its size before


def _pairs(
    figure: _Series, present: _Present, name: Name, measure: Loss
) -> tuple[list[_Pair], int, set[tuple[str, int]]]:
    """Pair fixed cells with the last night's; also how many lost their figure, and those whose scene has changed."""
    pairs: list[_Pair] = []
    lost = 0
    scenes: set[tuple[str, int]] = set()
    for key, before in figure.last.items():
        row = figure.mine.get(key)
        if row is None:
            lost += (*key, name[:2]) in present
        elif row.input_sha256 != before.input_sha256:
            scenes.add(key)
        elif math.isnan(row.value) != math.isnan(before.value):
            lost += math.isnan(row.value)
        elif not math.isnan(row.value):
            same = abs(row.value - before.value) <= SAME * max(abs(row.value), abs(before.value))
            y = measure.of(before.value)
            pairs.append(((row.recipe, row.seed), 0.0 if same else measure.of(row.value) - y, abs(y)))
    return pairs, lost, scenes


def _paired(pairs: Sequence[_Pair], figure: _Series, measure: Loss) -> _Outcome:
    """Test the differences; p is NaN where there are too few."""
    groups: dict[tuple[str, int], list[float]] = defaultdict(list)
    for key, difference, _ in pairs:
        groups[key].append(difference)
    means = np.array([np.mean(group) for group in groups.values()])
    size = float(np.median([difference for _, difference, _ in pairs if difference != 0.0]))
    count = len(means)
    if count < LEAST_PAIRS:
        return size, count, math.nan, math.nan
    margin = measure.margin + measure.margin_share * float(np.sqrt(np.mean([before**2 for *_, before in pairs])))
    spread = max(float(np.std(means, ddof=1)), LEAST_SPREAD)
    scales = [(spread, count - 1)]
    seeds, dof = _between_seeds(figure, measure)
    if dof >= LEAST_DOF and math.sqrt(2.0) * seeds > spread:
        scales.append((math.sqrt(2.0) * seeds, dof))
    mean, root = float(np.mean(means)), math.sqrt(count)
    worse, better = (
        min(1.0, 2.0 * min(float(stats.t.sf((sign * mean - margin) * root / scale, dof)) for scale, dof in scales))
        for sign in (1.0, -1.0)
    )
    return size, count, worse, better


def _between_seeds(figure: _Series, measure: Loss) -> tuple[float, int]:
    """Return the standard deviation of a case's figures from seed to seed before this night; its degrees of freedom."""
    of_case: dict[str, list[float]] = defaultdict(list)
    for (case, _), row in figure.last.items():
        of_case[case].append(measure.of(row.value))
    for case, earlier in figure.earlier.items():
        of_case[case] += [measure.of(value) for night in earlier.values() for value in night]
    squares, dof = 0.0, 0
    for values in of_case.values():
        levels = np.array([level for level in values if math.isfinite(level)])
        if len(levels) > 1:
            squares += float(np.sum((levels - levels.mean()) ** 2))
            dof += len(levels) - 1
    return (math.sqrt(squares / dof), dof) if dof else (math.nan, 0)


# --- on the seeds of the night --------------------------------------------------------------------------------------


def _fresh(now: _ByCase, before: _ByCase, measure: Loss) -> _Outcome | None:
    """Test this night's ranks among the earlier nights', over all cases; None where there is nothing to rank."""
    total, null = 0, np.ones(1)
    offset = 0
    sizes = []
    for case, tonight in now.items():
        ((_, values),) = tonight.items()
        same_size = (each for each in before.get(case, {}).items() if len(each[1]) == len(values))
        earlier = sorted(same_size)[-MOST_NIGHTS:]
        if len(earlier) < LEAST_NIGHTS:
            continue
        levels = np.array([_mean(measure, seeds) for seeds in [values, *(seeds for _, seeds in earlier)]])
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
    return size, len(sizes), worse, better


def _mean(measure: Loss, values: Sequence[float]) -> float:
    """Mean loss of a night's seeds; infinite where a figure could not be measured."""
    mean = sum(map(measure.of, values)) / len(values)
    return mean if math.isfinite(mean) else math.inf


def _holm(tests: Sequence[tuple[Change, float]]) -> list[tuple[Change, float]]:
    """Return the changes, each with its p, that Holm's procedure calls so at ALARM_RATE, those of the least p first."""
    ranked = sorted(tests, key=lambda test: (test[1], test[0].name))
    calls = (i for i, (_, p) in enumerate(ranked) if p > ALARM_RATE / (len(ranked) - i))
    return ranked[: next(calls, len(ranked))]
