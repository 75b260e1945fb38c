"""The report of step ``inspect``."""

from __future__ import annotations

from collections.abc import Iterator

from processor.inspection.result import InspectedComponent, Result
from processor.language.messages import Message, label, text
from processor.limits.judging import Judged
from processor.model import Scene, Status, StepRun, Verdict
from processor.report import verdict_counts
from processor.report.characteristics import RISKS, with_interval
from processor.report.inspection import tables
from processor.report.sheet import picture
from processor.report.sheet.picture import Callout
from processor.report.step_report import StepReport
from processor.report.style import Drawn

MOST_NAMED = 2  # of a headline


def _summary(result: Result) -> tuple[Message, Message]:
    if not result.components:
        return result.status, text("{reasons}", reasons=result.reasons)
    rows = [component.characteristics for component in result.components]
    every = [verdict for found in rows for verdict in found.verdict]
    head = text(
        "{status}, {measured} of {number} characteristics of {components} components measured",
        status=result.status,
        measured=sum(int((found.ci95 >= 0.0).sum()) for found in rows),
        number=sum(len(found) for found in rows),
        components=len(result.components),
    )
    if off := _unlimited(result)[:MOST_NAMED]:
        of = [text("{what} {size}", what=one.of, size=with_interval(one.value, one.ci95, one.unit)) for one in off]
        head = text("{head}; largest deviation: {named}", head=head, named=of)
    verdicts = verdict_counts.each(every)
    body: list[Message] = [text("Limits: {verdicts}.", verdicts=verdicts)] if verdicts else []
    body += [text("{name}: {reasons}.", name=c.name, reasons=c.reasons) for c in result.components if c.reasons]
    if result.status is Status.OK or not result.reasons:
        body += [text("{reasons:.}", reasons=result.reasons)] if result.reasons else []
    return head, text("{sentences:.}", sentences=body) if body else text("")


def _unlimited(result: Result) -> list[Judged]:
    """Return the sizes of whole components that are beyond their intervals and have no limit, the largest first."""
    rows = [one for component in result.components for one in _judged(component)
            if one.verdict is Verdict.NONE and one.of == f"{component.name} {one.what}" and one.unit == "mm"
            and abs(one.value) > one.ci95]  # fmt: skip
    return sorted(rows, key=lambda one: one.ci95 - abs(one.value))


def _judged(component: InspectedComponent) -> list[Judged]:
    return [
        Judged(
            of=f"{component.name} {row['id']}",
            what=row["quantity"],
            value=row["deviation"],
            low=row["lower"],
            high=row["upper"],
            clause=label(row["clause"]),
            **{name: row[name] for name in ("nominal", "ci95", "unit", "verdict", *RISKS) if name in row},
        )
        for row in component.characteristics.items()
    ]


def _callouts(scene: Scene, run: StepRun) -> list[Callout]:
    """Say at the parts of a bridge what fails, is indeterminate, or is off most where nothing limits it."""
    if scene.arch is None:
        return []
    centres = {part.name: 0.5 * (part.vertices.min(axis=0) + part.vertices.max(axis=0))
               for part in scene.arch.parts if len(part.vertices)}  # fmt: skip
    named = [str(one.of) for one in _unlimited(run.result)[:MOST_NAMED]]
    return [
        picture.of_judged(centres[component.name], rows, "", component.name)
        for component in run.result.components
        if component.name in centres
        for rows in [[one for one in _judged(component)
                      if one.verdict in (Verdict.FAIL, Verdict.INDETERMINATE) or one.of in named]]
        if rows
    ]  # fmt: skip


def _beyond(result: Result) -> Iterator[Message]:
    """Yield for each component the characteristics that fail their limits."""
    for component in result.components:
        failing = [
            text("{what} {size}", what=row["id"], size=with_interval(row["deviation"], row["ci95"], row["unit"]))
            for row in component.characteristics.items()
            if row["verdict"] is Verdict.FAIL
        ]
        if failing:
            yield text("correct {component}: {failing}", component=component.name, failing=failing)


def _characteristics(_: Scene, run: StepRun) -> list[Judged]:
    """Return what of the components is compared with limits."""
    every = [one for component in run.result.components for one in _judged(component)]
    return [one for one in every if one.verdict is not Verdict.NONE]


REPORT = StepReport(
    title=text("Inspection of components"),
    summary=_summary,
    tables=tables.step_tables,
    figures=lambda *_: Drawn({}),
    to_do=_beyond,
    limits=lambda result: [component.characteristics for component in result.components],
    characteristics=_characteristics,
    unlimited=_unlimited,
    callouts=_callouts,
)
