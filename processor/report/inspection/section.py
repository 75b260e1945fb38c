"""The report of step ``inspect``."""

from __future__ import annotations

from collections.abc import Iterator

from processor.inspection.result import Result
from processor.language.messages import Message, label, text
from processor.limits.judging import Judged
from processor.model import Scene, Status, StepRun, Verdict
from processor.report import verdict_counts
from processor.report.characteristics import RISKS
from processor.report.inspection import tables
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
    if Verdict.FAIL in every:
        compared = [
            (f"{component.name} {of}", verdict)
            for component, found in zip(result.components, rows, strict=True)
            for of, verdict in zip(found.id, found.verdict, strict=True)
            if verdict is not Verdict.NONE
        ]
        named, judged = zip(*compared, strict=True)
        limits = verdict_counts.summary(verdict_counts.LIMITS, named, judged)
        head = text("{head}; {verdicts}", head=head, verdicts=limits)
    elif off := sorted(_off(result), key=lambda one: -one[0])[:MOST_NAMED]:
        head = text("{head}; largest deviation: {named}", head=head, named=[named for _, named in off])
    verdicts = verdict_counts.each(every)
    body: list[Message] = [text("Limits: {verdicts}.", verdicts=verdicts)] if verdicts else []
    body += [text("{name}: {reasons}.", name=c.name, reasons=c.reasons) for c in result.components if c.reasons]
    if result.status is Status.OK or not result.reasons:
        body += [text("{reasons:.}", reasons=result.reasons)] if result.reasons else []
    return head, text("{sentences:.}", sentences=body) if body else text("")


def _off(result: Result) -> Iterator[tuple[float, Message]]:
    """Yield by how much the sizes of whole components are beyond their intervals, mm, with words for each."""
    for component in result.components:
        for row in component.characteristics.items():
            beyond = abs(row["deviation"]) - row["ci95"]
            if row["id"] == str(row["quantity"]) and row["unit"] == "mm" and beyond > 0.0:
                yield beyond, text(
                    "{component} {quantity} {deviation:+.1f} ± {ci95:.1f} mm",
                    component=component.name, quantity=label(row["quantity"]), deviation=row["deviation"],
                    ci95=row["ci95"],
                )  # fmt: skip


def _beyond(result: Result) -> Iterator[Message]:
    """Yield the characteristics that fail their limits."""
    for component in result.components:
        for row in component.characteristics.items():
            if row["verdict"] is Verdict.FAIL:
                yield text(
                    "correct {component}: {quantity} is off by {deviation} ± {ci95} mm",
                    component=component.name, quantity=label(row["quantity"]), deviation=row["deviation"],
                    ci95=row["ci95"],
                )  # fmt: skip


def _characteristics(_: Scene, run: StepRun) -> list[Judged]:
    """Return what of the components is compared with limits."""
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
        for component in run.result.components
        for row in component.characteristics.items()
        if row["verdict"] is not Verdict.NONE
    ]


REPORT = StepReport(
    title=text("Inspection of components"),
    summary=_summary,
    tables=tables.step_tables,
    figures=lambda *_: Drawn({}),
    to_do=_beyond,
    limits=lambda result: [component.characteristics for component in result.components],
    characteristics=_characteristics,
    own_table=True,
)
