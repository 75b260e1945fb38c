"""A comparison of epochs for the terminal, at most 15 lines, and its headline."""

from __future__ import annotations

from processor.epochs.change import Component, Finding
from processor.epochs.compare import History
from processor.epochs.quantity_series import Kind
from processor.language.messages import Message, text
from processor.report.epochs.tables import day, ordered

MOST_LINES, FEWEST_CHANGES = 15, 3  # of a terminal of 24; of remarks some give way to changes
WITH_KIND = (Kind.JOINT, Kind.BALL, Kind.PART, Kind.MEMBER)  # names that alone do not say what they are of
COUNTED = {
    Kind.JOINT: "{changed} of {total} {total:?joint|joints}",
    Kind.SPAN: "{changed} of {total} {total:?span|spans}",
    Kind.BALL: "{changed} of {total} {total:?ball|balls}",
    Kind.SURFACE: "{changed} of {total} {total:?surface|surfaces}",
    Kind.WITH_DEFECTS: "{changed} of {total} {total:?body with defects|bodies with defects}",
    Kind.PART: "{changed} of {total} {total:?part|parts}",
    Kind.MEMBER: "{changed} of {total} {total:?member|members}",
}


def headline(history: History) -> Message:
    """Say how many epochs there are, and how many components changed."""
    return text(
        "{name}: {epochs} epochs, {first} to {last}: {counts}",
        name=history.name,
        epochs=len(history.epochs),
        first=day(history, 0),
        last=day(history, -1),
        counts=counts(history),
    )


def counts(history: History) -> list[Message]:
    """Return how many components of each kind changed, and how many have another finding.

    Members whose length changed by their balls are counted by themselves: it is the balls' movement once more.
    """
    changed = []
    for kind, template in COUNTED.items():
        if own := history.of_kind(kind):
            number = sum(one.finding is Finding.CHANGED and not one.follows for one in own)
            changed.append(text(template, changed=number, total=len(own)))
    said: list[Message] = [text("{changed} changed beyond the interval", changed=changed)]
    if count := sum(bool(one.follows) for one in history.components):
        said.append(text("{count} more {count:?member|members} by {count:?its|their} balls", count=count))
    for finding, template in ((Finding.DOUBTFUL, "{count} doubtful"), (Finding.UNKNOWN, "{count} not known")):
        if count := history.count(finding):
            said.append(text(template, count=count))
    return said


def lines(history: History, page: str) -> list[Message]:
    """Return the headline, what changed, what the epochs have in common, and where the page is."""
    changed = [
        _line(history, one)
        for one in ordered(history)
        if one.finding in (Finding.CHANGED, Finding.DOUBTFUL) and not one.follows and one.leading is not None
    ]
    room = MOST_LINES - 2
    remarks: list[Message] = [text("note: {remark}", remark=remark) for remark in history.remarks]
    remarks = remarks[: room - min(len(changed), FEWEST_CHANGES)]
    left = room - len(remarks)
    if len(changed) > left:
        more = text("... and {count} more; --verbose prints the tables", count=len(changed) - left + 1)
        changed = [*changed[: left - 1], more]
    return [headline(history), *changed, *remarks, text("report: {page}", page=page)]


def _line(history: History, one: Component) -> Message:
    assert one.leading is not None
    leading = one.leading
    return text(
        "{finding}: {component}, {quantity}: {first:.2f} to {last:.2f} {unit}, by {change:+.2f} ± {ci95:.2f} {unit}, "
        "since {day} ({step})",
        finding=one.finding,
        component=text("{kind} {name}", kind=one.kind, name=one.name) if one.kind in WITH_KIND else one.name,
        quantity=leading.series.quantity,
        first=float(leading.series.value[leading.first]),
        last=float(leading.series.value[leading.last]),
        unit=leading.series.unit,
        change=leading.value,
        ci95=leading.ci95,
        day=day(history, one.since),
        step=one.step,
    )
