"""The report of step ``defects``."""

from __future__ import annotations

import collections

from processor.defects.result import DefectClass, Result
from processor.language.messages import Message, text
from processor.model import Status
from processor.report.defects import figures, interactive_view, tables
from processor.report.step_report import StepReport
from processor.report.style import Drawn


def _summary(result: Result) -> tuple[Message, Message]:
    if result.status is Status.FAILED:
        return result.status, text("{reasons}", reasons=result.reasons)
    doubtful = int(result.defects.doubtful.sum())
    certain = len(result.defects) - doubtful
    number = text("{count} {count:?defect|defects} found", count=certain) if certain else text("no defects found")
    head = text("{status}, {found}", status=result.status, found=number)
    if doubtful:
        head = text("{status}, {found} and {doubtful} doubtful", status=result.status, found=number, doubtful=doubtful)
    counts = collections.Counter(result.defects.defect_class)
    classes = tuple(text("{count} {kind}", count=counts[kind], kind=kind) for kind in DefectClass if counts[kind])
    body = text("{area:.1f} m2 examined", area=result.examined_mm2 / 1e6)
    if len(result.least_depth):
        middle = len(result.least_depth) // 2
        body = text(
            "{examined}; a place {side:.0f} mm wide is found from a mean depth of {depth} mm",
            examined=body,
            side=float(result.least_depth.side[middle]),
            depth=float(result.least_depth.depth[middle]),
        )
    return head, text("{classes}. {body}.", classes=classes, body=body) if classes else text("{body}.", body=body)


REPORT = StepReport(
    title=text("Defects"),
    summary=_summary,
    tables=tables.step_tables,
    figures=lambda _, runs, __: Drawn(figures.draw(runs[0].result)),
    files=lambda _, run: figures.files(run.result),
    callouts=tables.callouts,
    sheet_tables=tables.listed,
    interactive_data=interactive_view.interactive_data,
)
