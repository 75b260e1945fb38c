"""The report as a document and as a workbook: what is in them, read by other programs, and the same bytes again."""

import dataclasses
import io
import math
import re
import zlib

import numpy as np
import pytest

from processor.evaluation.evaluate import ErrorReport
from processor.model import TitleBlock
from processor.report import all_tables, pdf, workbook
from processor.report.style import default_settings
from tests.support.bridge_results import of_bridge
from tests.support.report_pages import drawn

FORMULAS = ("=1+1", "+1", "-1", "@SUM(A1)")


def signed(names=("foot1", "rib1", "foot2")):
    execution = of_bridge(names=names)
    block = TitleBlock(("company", "scanned", "approved"), ("=cmd|' /C calc'!A0", "2011-02-03", "桥 Meyer"))
    return dataclasses.replace(execution, scene=dataclasses.replace(execution.scene, title_block=block))


def written(execution):
    with default_settings():
        return pdf.document(execution, drawn(execution))


def test_the_document_has_a_page_a_figure_and_the_same_bytes_again():
    execution = signed()
    first = written(execution)
    assert first == written(execution)
    pages = len(re.findall(rb"/Type /Page\b(?!s)", first))
    assert pages >= 2 + len(drawn(execution)["preassemble"])
    assert not re.search(rb"/(CreationDate|ModDate)", first)
    content = b"".join(zlib.decompress(part) for part in re.findall(rb"stream\r?\n(x.*?)\r?\nendstream", first, re.S))
    assert b"CreationDate" not in content


def test_a_workbook_holds_the_tables_as_numbers_and_text():
    openpyxl, _ = pytest.importorskip("openpyxl"), pytest.importorskip("xlsxwriter")
    execution = signed((FORMULAS[0], "rib1", FORMULAS[3]))
    data = workbook.workbook(execution, ErrorReport())
    assert data == workbook.workbook(execution, ErrorReport())
    book = openpyxl.load_workbook(io.BytesIO(data))
    front = {row[0].value: row[1] for row in book["report"].iter_rows()}
    assert (front["company"].value, front["company"].data_type) == ("=cmd|' /C calc'!A0", "s")
    assert front["verdict"].value == "fail"
    assert front["approved"].value == "桥 Meyer"
    tables = [table for table in all_tables.tables_of_run(execution, ErrorReport()) if table.file]
    assert book.sheetnames == ["report", *(table.file[:31] for table in tables)]
    seen = set()
    for table in tables:
        rows = list(book[table.file[:31]].iter_rows(min_row=2, max_col=len(table.columns)))
        assert len(rows) == len(table.rows)
        for cells, wanted in zip(rows, table.rows, strict=True):
            for cell, value in zip(cells, wanted, strict=True):
                assert cell.data_type != "f"
                if isinstance(value, float | np.floating):
                    assert cell.value == (pytest.approx(value, abs=1e-6) if math.isfinite(value) else None)
                elif isinstance(value, str) and value in FORMULAS:
                    assert (cell.value, cell.data_type) == (value, "s")
                    seen.add(value)
    assert seen == {FORMULAS[0], FORMULAS[3]}
    assert book.properties.created.year == 1980
