"""The tables of a run as a workbook (XLSX): a sheet with title block and verdicts, then a sheet a table."""

from __future__ import annotations

import datetime
import io
import math
from typing import Any

import numpy as np

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import messages
from processor.model import UsageError, worst
from processor.pipeline import Execution
from processor.plain_text import printable
from processor.report import all_tables, headline, title_block
from processor.report.table import Table, full_headings, shown

NAME = "report.xlsx"
EPOCH = datetime.datetime(1980, 1, 1, tzinfo=None)  # of a file without a date of its own
LONGEST_NAME, WIDEST = 31, 60  # characters of a sheet's name, and of a column


def workbook(execution: Execution, report: ErrorReport) -> bytes:
    """Write the workbook; the same run gives the same bytes. Raises UsageError where XlsxWriter is not installed."""
    xlsxwriter = _library()
    out = io.BytesIO()
    with xlsxwriter.Workbook(out, {"in_memory": True, "nan_inf_to_errors": False}) as book:
        book.set_properties({"created": EPOCH, "title": execution.scene.name})
        bold = book.add_format({"bold": True, "text_wrap": True, "valign": "top"})
        front = book.add_worksheet("report")
        for row, (name, value) in enumerate(_front(execution)):
            front.write_string(row, 0, name, bold)
            front.write_string(row, 1, value)
        front.set_column(0, 0, 24)
        front.set_column(1, 1, WIDEST)
        for table in all_tables.tables_of_run(execution, report):
            if table.file:
                _sheet(book.add_worksheet(table.file[:LONGEST_NAME]), table, bold)
    return out.getvalue()


def check() -> None:
    """Raise UsageError where workbooks cannot be written."""
    _library()


def _library() -> Any:
    try:
        import xlsxwriter
    except ImportError:
        raise UsageError("--xlsx needs XlsxWriter; install it: pip install 'steel-scan-check[xlsx]'") from None
    return xlsxwriter


def _front(execution: Execution) -> list[tuple[str, str]]:
    rows = [("name", execution.scene.name), ("verdict", str(worst(run.verdict for run, _ in execution.by_step())))]
    rows += [(run.step, str(headline.of_step(run))) for run, _ in execution.by_step()]
    rows += [*title_block.entries(execution.scene).items()]
    rows.append(("instrument", messages("en").text(title_block.instrument(execution.scene))))
    rows += [(str(name), value) for name, value in title_block.facts(execution.provenance)]
    return [(printable(name), printable(value)) for name, value in rows]


def _sheet(sheet: Any, table: Table, bold: Any) -> None:
    """Write a table: numbers as numbers, all else as text, which no spreadsheet takes for a formula."""
    headings = full_headings(table, messages("en"))
    for column, heading in enumerate(headings):
        sheet.write_string(0, column, heading, bold)
    for row, cells in enumerate(table.rows, 1):
        for column, cell in enumerate(cells):
            if isinstance(cell, bool | np.bool_) or not isinstance(cell, int | float | np.number):
                sheet.write_string(row, column, shown(cell))
            elif math.isfinite(cell):
                sheet.write_number(row, column, round(float(cell), 6))
    sheet.freeze_panes(1, 1)
    for column, heading in enumerate(headings):
        widest = max([len(heading), *(len(shown(row[column])) for row in table.rows[:200])])
        sheet.set_column(column, column, min(WIDEST, 2 + widest))
