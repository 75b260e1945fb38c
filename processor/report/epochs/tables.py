"""The tables of a comparison of epochs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from processor.epochs.change import Component, Finding
from processor.epochs.compare import History
from processor.language.messages import Message, label, text
from processor.report.columns import columns, given
from processor.report.table import NAN, Table

CHANGED = (Finding.CHANGED, Finding.DOUBTFUL)
ORDER: tuple[Finding | None, ...] = (*CHANGED, None, Finding.WITHIN, Finding.UNKNOWN)  # None: what follows others
COMPONENTS, EPOCHS, CHANGES = "history", "epochs", "changes"


def ordered(history: History) -> list[Component]:
    """Return the components, those that changed first, by the strength of their changes.

    What follows others stands after all that changed by itself.
    """
    return sorted(history.components, key=lambda one: (_rank(one), -_strength(one)))


def _rank(component: Component) -> int:
    return len(CHANGED) if component.follows else ORDER.index(component.finding)


def _strength(component: Component) -> float:
    return 0.0 if component.leading is None else component.leading.strength


def tables(history: History) -> list[Table]:
    """Return the tables: components, epochs, and all changes, of which the last is a file alone."""
    return [_components(history), _epochs(history), _changes(history)]


def day(history: History, row: int | None) -> str:
    """Write the day of an epoch; "" for none."""
    return "" if row is None else history.epochs[row].day.isoformat()


def of_page(history: History) -> tuple[list[Table], list[Table]]:
    """Return the tables of the page: what changed, if anything did, and below the figure all else and the epochs."""
    whole = _components(history)
    shown = ordered(history)
    beyond = sum(_rank(one) < len(CHANGED) for one in shown)
    if not 0 < beyond < len(shown):
        return [whole], [_epochs(history)]
    first = replace(whole, title=text("Components that changed, or may have"), rows=whole.rows[:beyond])
    others = replace(whole, title=text("Other components"), rows=whole.rows[beyond:], note="")
    return [first], [others, _epochs(history)]


def _components(history: History) -> Table:
    """Return a row a component: what of it changed most, at each epoch."""
    epochs = range(len(history.epochs))
    days = [day(history, e) for e in epochs]
    names = [one if days.count(one) == 1 else f"{one} {history.epochs[e].folder}" for e, one in enumerate(days)]
    rows = tuple(
        (
            one.name, one.finding, "" if one.leading is None else one.leading.series.quantity,
            *(NAN if one.leading is None else float(one.leading.series.value[e]) for e in epochs),
            *((NAN, NAN) if one.leading is None else (one.leading.value, one.leading.ci95)),
            "" if one.leading is None else one.leading.series.unit, day(history, one.since),
            one.step, ", ".join(one.follows),
        )
        for one in ordered(history)
    )  # fmt: skip
    note = text(
        "A row a component: of its values the one that changed most, by its interval, at the last epoch. Change is "
        "from its first value to its last, ci95 the half-width of the 95 % interval, of both epochs together. Changed: "
        "the change exceeds its interval widened for the number of changes of the component ({changes} in all); of "
        "components that did not change 5 % at most are called so. Since: the first day at which it had changed. "
        "Follows: the balls that moved and, with their places, changed the length of a member.",
        changes=sum(len(one.changes) for one in history.components),
    )
    header = (
        *columns("component", "finding", "quantity"),
        *given(*names),
        *columns("change", "ci95", "unit", "since", "step", "follows"),
    )
    return Table(text("Components over the epochs"), header, rows, COMPONENTS, note)


def _epochs(history: History) -> Table:
    rows = tuple(
        (
            one.day.isoformat(), label(one.day_from), one.folder, one.input, str(one.facts.get("scanner", "")),
            str(one.facts.get("serial", "")), float(one.facts.get("temperature_C", NAN)),
            ", ".join(dict.fromkeys(run.step for run in one.runs)),
        )
        for one in history.epochs
    )  # fmt: skip
    header = columns("day", "day_from", "folder", "input", "scanner", "serial", "temperature_C", "steps")
    return Table(text("Epochs"), header, rows, EPOCHS)


def _changes(history: History) -> Table:
    header = columns(
        "step", "component", "quantity", "unit", "from", "to", "value_from", "value_to", "change", "ci95", "beyond",
        "ci95_widened", "beyond_widened", "doubtful",
    )  # fmt: skip
    return Table(text("All changes"), header, tuple(_rows(history)), CHANGES, on_page=False, on_terminal=False)


def _rows(history: History) -> Iterator[tuple[Any, ...]]:
    for component in ordered(history):
        for one in component.changes:
            yield (
                component.step, component.name, one.series.quantity, one.series.unit, day(history, one.first),
                day(history, one.last), float(one.series.value[one.first]), float(one.series.value[one.last]),
                one.value, one.ci95, _yes(one.beyond), one.widened, _yes(one.surely), _yes(one.doubtful),
            )  # fmt: skip


def _yes(value: bool) -> Message:
    return text("yes") if value else text("no")
