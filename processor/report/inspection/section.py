"""The report of step ``inspect``."""

from __future__ import annotations

import collections
from collections.abc import Iterator

from processor.inspection.result import Result
from processor.language.messages import Message, Text, label, text
from processor.model import Scene, Status, StepRun, Verdict
from processor.report import verdict_counts
from processor.report.characteristics import Characteristic
from processor.report.inspection import tables
from processor.report.step_report import StepReport
from processor.report.style import Drawn

VERDICTS = {
    Verdict.PASS: text("{count} pass"),
    Verdict.FAIL: text("{count} fail"),
    Verdict.INDETERMINATE: text("{count} indeterminate"),
}


def _summary(result: Result) -> tuple[Message, Message]:
    if not result.components:
        return result.status, text("{reasons}", reasons=result.reasons)
    rows = [component.characteristics for component in result.components]
    counts = collections.Counter(verdict for found in rows for verdict in found.verdict)
    head = text(
        "{status}, {measured} of {number} characteristics of {components} components measured",
        status=result.status,
        measured=sum(int((found.ci95 >= 0.0).sum()) for found in rows),
        number=sum(len(found) for found in rows),
        components=len(result.components),
    )
    if counts[Verdict.FAIL]:
        compared = [
            (f"{component.name} {of}", verdict)
            for component, found in zip(result.components, rows, strict=True)
            for of, verdict in zip(found.id, found.verdict, strict=True)
            if verdict is not Verdict.NONE
        ]
        named, judged = zip(*compared, strict=True)
        limits = verdict_counts.summary(verdict_counts.LIMITS, named, judged)
        head = text("{head}; {verdicts}", head=head, verdicts=limits)
    verdicts = [Text(said.template, {"count": counts[name]}) for name, said in VERDICTS.items() if counts[name]]
    body: list[Message] = [text("Limits: {verdicts}.", verdicts=verdicts)] if verdicts else []
    if any(verdict is not Verdict.NONE and not known for found in rows for verdict, known in _compared(found)):
        body.insert(0, text("Limits not checked against the standard: verdicts are provisional."))
    body += [text("{name}: {reasons}.", name=c.name, reasons=c.reasons) for c in result.components if c.reasons]
    if result.status is Status.OK or not result.reasons:
        body += [text("{reasons:.}", reasons=result.reasons)] if result.reasons else []
    return head, text("{sentences:.}", sentences=body) if body else text("")


def _compared(found: tables.Characteristics) -> list[tuple[Verdict, bool]]:
    return list(zip(found.verdict, found.verified.tolist(), strict=True))


def _beyond(result: Result) -> Iterator[Message]:
    """Yield the characteristics that fail their limits."""
    for component in result.components:
        found = component.characteristics
        for k, verdict in enumerate(found.verdict):
            if verdict is Verdict.FAIL:
                yield text(
                    "correct {component}: {quantity} is off by {deviation} ± {ci95} mm",
                    component=component.name, quantity=label(found.quantity[k]), deviation=float(found.deviation[k]),
                    ci95=float(found.ci95[k]),
                )  # fmt: skip


def _characteristics(_: Scene, run: StepRun) -> list[Characteristic]:
    """Return what of the components is compared with limits."""
    return [
        Characteristic(
            id=f"{component.name} {found.id[i]}",
            quantity=found.quantity[i],
            nominal=float(found.nominal[i]),
            deviation=float(found.deviation[i]),
            ci95=float(found.ci95[i]),
            lower=float(found.lower[i]),
            upper=float(found.upper[i]),
            unit=found.unit[i],
            verdict=found.verdict[i],
            limit_from=label(found.clause[i]),
        )
        for component in run.result.components
        for found in (component.characteristics,)
        for i in range(len(found))
        if found.verdict[i] is not Verdict.NONE
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
