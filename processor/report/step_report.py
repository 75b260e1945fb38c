"""What the report of a step consists of; :mod:`.reports_of_steps` finds that of each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import Message, text
from processor.limits.judging import Judged
from processor.model import Scene, Status, StepRun
from processor.pipeline import Execution
from processor.report.sheet.picture import Callout
from processor.report.style import Drawn
from processor.report.table import Table


@dataclass(frozen=True)
class StepReport:
    """Functions that make the report of a step.

    ``to_do`` are the sentences of what is to be done first, ``why`` the reasons of a status that is not ok, ``limits``
    records with columns ``clause`` and ``verified`` beside ``result.limits``. ``runs`` are its result, then those of
    other methods on the same scene for comparison.
    """

    title: str | Message
    summary: Callable[[Any], tuple[Any, Any]]  # of a result: the verdict's heading, and the sentences below it
    tables: Callable[[Sequence[StepRun], ErrorReport], list[Table]]
    figures: Callable[[Execution, Sequence[StepRun], ErrorReport], Drawn]  # file names are the step's own
    to_do: Callable[[Any], Iterable[Any]] = lambda _: ()
    why: Callable[[Any], Iterable[Any]] = lambda result: result.reasons
    limits: Callable[[Any], Iterable[Any]] = lambda _: ()
    characteristics: Callable[[Scene, StepRun], list[Any]] = lambda *_: []  # what is compared with limits
    unlimited: Callable[[Any], Sequence[Judged]] = lambda _: ()  # the largest deviations that nothing limits
    callouts: Callable[[Scene, StepRun], Sequence[Callout]] = lambda *_: ()  # on the picture of the sheet
    sheet_tables: Callable[[Scene, StepRun], list[Table]] = lambda *_: []  # further lists of the sheet
    files: Callable[[Execution, StepRun], dict[str, bytes]] = lambda *_: {}  # further files in OUT by name
    interactive_data: Callable[[Scene, Sequence[StepRun]], dict[str, Any] | None] = lambda *_: None


def not_ok(result: Any, table: Any) -> list[Message]:
    """Return the reasons of the rows of a table (name, status, reasons) that are not ok; without any, the result's."""
    rows = zip(table.name, table.status, table.reasons, strict=True)
    found: list[Message] = [
        text("{name} {status}: {reasons}", name=name, status=status, reasons=reasons)
        for name, status, reasons in rows
        if status != Status.OK
    ]
    return found or list(result.reasons)
