"""Changes of values between epochs, with their 95 % intervals, and whether a component changed.

The errors of two epochs are taken as independent: the half-width of a change is the root of the sum of both squares.
Errors common to both epochs cancel in the change; where both intervals include them, that of the change is too wide.
Errors that neither interval includes are not in that of the change either: the expansion of steel by a temperature that
was not stated, scale and offset of another scanner; the remarks of a comparison name them. A component has many values,
of which one in twenty leaves its interval by chance: a component is called changed where a change exceeds its interval
widened for the number of changes that were looked at (Bonferroni), so that of all components that did not change 5 % at
most are called so, as far as the intervals hold all errors.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from processor.epochs.quantity_series import Kind, Series
from processor.model import NORMAL_95, Word


class Finding(Word):
    """Whether a component changed between epochs."""

    CHANGED = "changed"
    DOUBTFUL = "doubtful"  # it would have changed, but a value of it may be wrong beyond its interval
    WITHIN = "within interval"
    UNKNOWN = "unknown"  # no value with an interval at two epochs


@dataclass(frozen=True, kw_only=True)
class Change:
    """The change of a series from its first epoch with a value to a later one, with the half-width of its interval.

    ``beyond``: it exceeds its interval. ``surely``: it also exceeds the interval widened for all changes of the
    component.
    """

    series: Series
    first: int  # row of the epoch
    last: int
    value: float
    ci95: float
    widened: float
    doubtful: bool

    @property
    def beyond(self) -> bool:
        """Whether the change exceeds its interval; false without one."""
        return abs(self.value) > self.ci95

    @property
    def surely(self) -> bool:
        """Whether the change exceeds its widened interval; false without one."""
        return abs(self.value) > self.widened

    @property
    def strength(self) -> float:
        """The change over its widened interval; 0 without one."""
        return abs(self.value) / self.widened if self.widened > 0.0 else 0.0


@dataclass(frozen=True, kw_only=True)
class Component:
    """A component over the epochs: all changes of its values, and the strongest one at the last epoch that has any."""

    step: str
    name: str
    kind: Kind
    finding: Finding
    changes: tuple[Change, ...]
    leading: Change | None  # None where nothing is known
    since: int | None  # row of the first epoch at which it had changed
    follows: tuple[str, ...] = ()  # balls that changed, and whose places alone changed it


def of_component(step: str, name: str, found: Sequence[Series]) -> Component:
    """Compare the values of one component over the epochs."""
    looked_at = sum(
        max(len(_rows(series)) - 1, 0) for series in found if np.isfinite(series.ci95[_rows(series)]).sum() > 1
    )
    changes = [change for series in found for change in _changes(series, looked_at)]
    sure = [change for change in changes if change.surely and not change.doubtful]
    doubtful = [change for change in changes if change.surely and change.doubtful]
    known = [change for change in changes if np.isfinite(change.ci95)]
    finding = (
        Finding.CHANGED if sure else Finding.DOUBTFUL if doubtful else Finding.WITHIN if known else Finding.UNKNOWN
    )
    return Component(
        step=step,
        name=name,
        kind=found[0].kind,
        finding=finding,
        changes=tuple(changes),
        leading=leading(sure or doubtful or known),
        since=min((change.last for change in sure or doubtful), default=None),
    )


def leading(changes: Sequence[Change]) -> Change | None:
    """Return the strongest change up to the last epoch that has one."""
    last = max((change.last for change in changes), default=0)
    return max((change for change in changes if change.last == last), key=lambda one: one.strength, default=None)


def _rows(series: Series) -> list[int]:
    """Return the epochs that are compared: those with a value and an interval; if fewer than two, with a value."""
    value = np.isfinite(series.value)
    with_interval = value & np.isfinite(series.ci95)
    rows: list[int] = np.flatnonzero(with_interval if with_interval.sum() > 1 else value).tolist()
    return rows


def _changes(series: Series, looked_at: int) -> Iterable[Change]:
    rows = _rows(series)
    factor = float(ndtri(1.0 - 0.025 / (max(looked_at, 1) * series.chosen_from))) / NORMAL_95
    alone = float(ndtri(1.0 - 0.025 / series.chosen_from)) / NORMAL_95
    for row in rows[1:]:
        half = float(np.hypot(series.ci95[rows[0]], series.ci95[row]))
        yield Change(
            series=series,
            first=rows[0],
            last=row,
            value=float(series.value[row] - series.value[rows[0]]),
            ci95=alone * half,
            widened=factor * half,
            doubtful=bool(series.doubtful[rows[0]] or series.doubtful[row]),
        )
