"""The report as a document and as a workbook: what is in them, read by other programs, and the same bytes again."""

import dataclasses
import io
import math
import re
import zlib

import numpy as np
import pytest
from matplotlib import font_manager
from PIL import Image

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import messages
from processor.model import TitleBlock
from processor.report import all_tables, pdf_report, style, workbook
from processor.report.style import Drawn, default_settings
from tests.support.results.bridge_results import of_bridge

FORMULAS = ("=1+1", "+1", "-1", "@SUM(A1)")


def signed(names=("foot1", "rib1", "foot2")):
    execution = of_bridge(names=names)
    block = TitleBlock(("company", "scanned", "approved"), ("=cmd|' /C calc'!A0", "2011-02-03", "桥 Meyer"))
    return dataclasses.replace(execution, scene=dataclasses.replace(execution.scene, title_block=block))


def written(execution):
    """The document of an execution, with two figures of a pixel."""
    one = io.BytesIO()
    Image.new("RGB", (1, 1)).save(one, "PNG")
    figures = {"preassemble": Drawn({f"{name}.png": (f"Caption of {name}", one.getvalue()) for name in "ab"})}
    with default_settings():
        return pdf_report.document(execution, figures)


def test_the_document_has_a_page_a_figure_and_the_same_bytes_again(drawn_pictures):
    execution = signed()
    first = written(execution)
    assert first == written(execution)
    assert len(re.findall(rb"/Type /Page\b(?!s)", first)) == 2 + 2  # two of text, and one a figure
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
                    # Six decimals are written.
                    assert cell.value == (pytest.approx(value, abs=1e-6) if math.isfinite(value) else None)
                elif isinstance(value, str) and value in FORMULAS:
                    assert (cell.value, cell.data_type) == (value, "s")
                    seen.add(value)
    assert seen == {FORMULAS[0], FORMULAS[3]}
    assert book.properties.created.year == 1980


STAND_IN = "Last Resort High-Efficiency"  # comes with newer versions of Matplotlib, has a glyph for every character


@pytest.fixture
def a_chinese_font(monkeypatch):
    if STAND_IN not in font_manager.get_font_names():
        pytest.skip(f"Matplotlib has no font {STAND_IN}")
    for module in (style, pdf_report):
        monkeypatch.setattr(module, "chinese_font", lambda: STAND_IN)
    style._has.cache_clear()
    yield
    style._has.cache_clear()


def front(execution, lang):
    return next(iter(pdf_report._front(execution, messages(lang))))


def texts_of(page):
    return [one.get_text() for one in page.texts]


def test_document_is_chinese_if_a_font_is_installed(a_chinese_font, drawn_pictures):
    execution = signed()
    seen = texts_of(front(execution, "zh"))
    assert any("桥 Meyer" in one for one in seen)
    assert any(one.startswith("批准") for one in seen)
    assert not any("?" in one for one in seen)
    with default_settings():
        data = pdf_report.document(execution, {}, "zh")
    assert b"LastResort" in data


def test_document_without_a_font_is_english_with_question_marks(monkeypatch, drawn_pictures):
    for module in (style, pdf_report):
        monkeypatch.setattr(module, "chinese_font", lambda: "")
    style._has.cache_clear()
    execution = signed()
    with default_settings():
        assert pdf_report.document(execution, {}, "zh") == pdf_report.document(execution, {}, "en")
    assert any("? Meyer" in one for one in texts_of(front(execution, "en")))
    style._has.cache_clear()


def test_the_logo_stands_on_the_first_page_in_its_proportions():
    execution = signed()
    assert front(execution, "en").axes == []
    out = io.BytesIO()
    Image.new("RGB", (300, 60), "navy").save(out, "PNG")
    block = dataclasses.replace(execution.scene.title_block, logo=np.frombuffer(out.getvalue(), np.uint8))
    page = front(dataclasses.replace(execution, scene=dataclasses.replace(execution.scene, title_block=block)), "en")
    (axes,) = page.axes
    box = axes.get_position()
    assert box.width * pdf_report.A4[0] / (box.height * pdf_report.A4[1]) == pytest.approx(5.0)
    assert box.x1 == pytest.approx(pdf_report.RIGHT)


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("one two three", ["one two", "three"]),
        ("一二三四五六", ["一二三四", "五六"]),
        ("ab 一二三 cd", ["ab 一二", "三 cd"]),
        ("", []),
    ],
)
def test_lines_are_broken_at_spaces_and_between_chinese_characters(text, lines):
    assert pdf_report.lines_of(text, 8) == lines
