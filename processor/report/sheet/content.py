"""What stands on the sheet: verdict and answer, the picture, what to do, characteristics, lists, notes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from processor.language.messages import Message, text
from processor.limits.judging import Judged
from processor.model import Status, StepRun, Verdict, worst
from processor.pipeline import Execution
from processor.report import characteristics, headline
from processor.report.columns import columns
from processor.report.reports_of_steps import characteristics_of, step_report
from processor.report.sheet import picture
from processor.report.table import Table

COLUMNS = columns("id", "deviation", "ci95", "allowed", "verdict", "nominal", "actual", "unit", "risk", "note")
NEAREST, UNLIMITED = 5, 5  # rows of those that pass, and of those without a limit, on the first page
MOST_ON_FIRST = 14  # characteristics that are all on the first page
MOST_REMARKS = 4  # of a step, in the words of its reasons
MOST_OPEN, MOST_ROWS = 30, 120  # of those that do not pass, and of all lists: two pages and a half
LEAST_RISK, SURE_RISK = 1e-3, 0.999  # beyond which a probability is not written
RISK = text("Risk: the probability that the verdict is wrong; of an indeterminate one, that it is wrong to accept.")
INTERVALS = text("± is the half-width of the 95 % interval. Deviation is actual less nominal, lengths in mm.")


@dataclass(frozen=True)
class Sheet:
    """The content of the sheet; ``answer`` are sentences, the first of what fails."""

    verdict: Verdict
    answer: tuple[Message, ...]
    picture: bytes  # PNG, empty where nothing can be drawn
    to_do: tuple[Message, ...]
    remarks: tuple[Message, ...]
    first: tuple[Table, ...]  # on the first page
    further: tuple[Table, ...]
    notes: tuple[Message, ...]


def of(execution: Execution) -> Sheet:
    """Return the sheet of a run."""
    scene, runs = execution.scene, [run for run, _ in execution.by_step()]
    held = characteristics.worst_first(one for run in runs for one in characteristics_of(scene, run))
    clauses = list(dict.fromkeys(one.clause for one in held if str(one.clause)))
    passing = sorted((one for one in held if one.verdict is Verdict.PASS), key=characteristics.nearness, reverse=True)
    few = len(held) <= MOST_ON_FIRST
    open_ = [one for one in held if one.verdict is not Verdict.PASS]
    first = open_[:MOST_OPEN] + passing[: None if few else NEAREST]
    unlimited = [one for run in runs for one in step_report(run.step).unlimited(run.result)][:UNLIMITED]
    worst_of = text("Characteristics: failing, indeterminate, nearest to their limits")
    tables = [_table(text("Characteristics") if few else worst_of, first, clauses)]
    tables.append(_table(text("Largest deviations that no limit is stated for"), unlimited, clauses))
    lists = [table for run in runs for table in step_report(run.step).sheet_tables(scene, run)]
    room = MOST_ROWS - sum(len(table.rows) for table in lists)
    others = [] if few else passing[NEAREST:][: max(room, 0)]
    lists = [_table(text("Further characteristics, which pass"), others, clauses), *lists]
    left_out = len(held) - len(first) - len(others)
    notes: list[Message] = [text("{number}) {clause}", number=k, clause=clause) for k, clause in enumerate(clauses, 1)]
    if left_out:
        notes.append(text("{count} further characteristics are in characteristics.csv.", count=left_out))
    to_confirm = headline.to_confirm(execution)
    return Sheet(
        verdict=worst(run.verdict for run in runs),
        answer=tuple(headline.answer(execution, word=False)),
        picture=picture.draw(scene, [one for run in runs for one in step_report(run.step).callouts(scene, run)]),
        to_do=tuple(sentence for run in runs for sentence in step_report(run.step).to_do(run.result)),
        remarks=tuple(text("{step}: {reason}", step=step_report(run.step).title, reason=reason)
                      for run in runs if run.result.status != Status.OK for reason in _why(run)),
        first=tuple(table for table in tables if table.rows),
        further=tuple(table for table in lists if table.rows),
        notes=(INTERVALS, *([RISK] if held else []), *notes, *([] if to_confirm is None else [to_confirm])),
    )  # fmt: skip


def _why(run: StepRun) -> list[Message]:
    return list(step_report(run.step).why(run.result))[:MOST_REMARKS]


def _table(title: Message, judged: Sequence[Judged], clauses: Sequence[Message]) -> Table:
    rows = tuple(
        (
            characteristics.name_of(one), one.value, one.ci95, characteristics.allowed(one.low, one.high), one.verdict,
            one.nominal, one.actual, one.unit, _risk(one),
            str(clauses.index(one.clause) + 1) if one.clause in clauses else "",
        )
        for one in judged
    )  # fmt: skip
    kept = [k for k in range(len(COLUMNS)) if any(row[k] not in ("", Verdict.NONE) for row in rows)]
    return Table(title, tuple(COLUMNS[k] for k in kept), tuple(tuple(row[k] for k in kept) for row in rows))


def _risk(one: Judged) -> str:
    risk = one.risk_reject if one.verdict is Verdict.FAIL else one.risk_accept
    if one.verdict is Verdict.NONE or math.isnan(risk):
        return ""
    return "< 0.1 %" if risk < LEAST_RISK else "> 99.9 %" if risk > SURE_RISK else f"{100.0 * risk:.2g} %"
