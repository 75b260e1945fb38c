"""The report as a document and as a workbook: what is in them, read by other programs, and the same bytes again."""

import dataclasses
import io
import math
import re
import zlib

import numpy as np
import pytest
from matplotlib import font_manager
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import messages
from processor.model import TitleBlock
from processor.report import all_tables, pdf_report, style, workbook
from processor.report.columns import columns
from processor.report.sheet import content
from processor.report.style import default_settings
from processor.report.table import Table, shown_rows
from tests.support.results.bridge_results import of_bridge

NAN = float("nan")
FORMULAS = ("=1+1", "+1", "-1", "@SUM(A1)")


def signed(names=("foot1", "rib1", "foot2")):
    execution = of_bridge(names=names)
    block = TitleBlock(("company", "scanned", "approved"), ("=cmd|' /C calc'!A0", "2011-02-03", "桥 Meyer"))
    return dataclasses.replace(execution, scene=dataclasses.replace(execution.scene, title_block=block))


def written(execution, lang="en"):
    """The sheet of an execution."""
    with default_settings():
        return pdf_report.document(execution, content.of(execution), lang)


def test_the_sheet_has_few_pages_and_the_same_bytes_again(drawn_pictures):
    execution = signed()
    first = written(execution)
    assert first == written(execution)
    assert 1 <= len(re.findall(rb"/Type /Page\b(?!s)", first)) <= 4
    assert not re.search(rb"/(CreationDate|ModDate)", first)
    parts = re.findall(rb"stream\r?\n(x.*?)\r?\nendstream", first, re.S)
    streams = b"".join(zlib.decompressobj().decompress(part) for part in parts)
    assert b"CreationDate" not in streams


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


def pages_of(execution, lang="en"):
    """The pages of the sheet as figures."""
    pages = pdf_report.Pages(messages(lang))
    sheet = content.of(execution)
    pdf_report._front(pages, execution, sheet)
    for table in (*sheet.first, *sheet.further):
        pages.table(table, lang)
    pdf_report._end(pages, execution, sheet)
    return pages.pages


def texts_of(page):
    return [one.get_text() for one in page.texts]


def test_document_is_chinese_if_a_font_is_installed(a_chinese_font, drawn_pictures):
    execution = signed()
    seen = [said for page in pages_of(execution, "zh") for said in texts_of(page)]
    assert any("桥 Meyer" in one for one in seen)
    assert any(one.startswith("批准") for one in seen)
    assert not any("?" in one for one in seen)
    assert b"LastResort" in written(execution, "zh")


def test_document_without_a_font_is_english_with_question_marks(monkeypatch, drawn_pictures):
    for module in (style, pdf_report):
        monkeypatch.setattr(module, "chinese_font", lambda: "")
    style._has.cache_clear()
    execution = signed()
    assert written(execution, "zh") == written(execution, "en")
    assert any("? Meyer" in one for page in pages_of(execution) for one in texts_of(page))
    style._has.cache_clear()


def test_the_logo_stands_on_the_first_page_in_its_proportions():
    execution = signed()
    (picture,) = pages_of(execution)[0].axes
    out = io.BytesIO()
    Image.new("RGB", (300, 60), "navy").save(out, "PNG")
    block = dataclasses.replace(execution.scene.title_block, logo=np.frombuffer(out.getvalue(), np.uint8))
    execution = dataclasses.replace(execution, scene=dataclasses.replace(execution.scene, title_block=block))
    logo, again = (one.get_position() for one in pages_of(execution)[0].axes)
    wide, high = pdf_report.PAGE
    assert logo.width * wide / (logo.height * high) == pytest.approx(5.0)
    assert logo.x1 * wide == pytest.approx(pdf_report.LEFT + pdf_report.WIDTH)
    assert again.width == pytest.approx(picture.get_position().width)


@pytest.mark.parametrize("scale", [1.0, 400.0])
def test_nothing_on_a_page_lies_over_anything_else_or_beyond_the_edge(scale, drawn_pictures):
    """Texts as drawn, of names of usual and of any length: each within the margins, and clear of the others."""
    names = ("foot1", "rib1 " * int(scale), "end-diagonal-difference-of-the-second-end")
    for page in pages_of(signed(names=names)):
        FigureCanvasAgg(page).draw()
        width, height = page.canvas.get_width_height()
        boxes = [one.get_window_extent() for one in page.texts if one.get_text().strip()]
        for k, box in enumerate(boxes):
            assert box.x0 > 0.04 * width
            assert box.x1 < 0.96 * width
            assert box.y0 > 0.02 * height
            inner = box.padded(-1.0)  # of a pixel: descenders touch the line below
            for other in boxes[:k]:
                assert not inner.overlaps(other.padded(-1.0)), (page.texts[k].get_text(), scale)


@pytest.mark.parametrize(
    ("half", "wanted"), [(0.10, "0.06"), (0.0996, "0.06"), (0.14, "0.06"), (15.0, "0"), (1.5, "0.1"), (NAN, "0.06")]
)
def test_digits_follow_the_interval(half, wanted):
    table = Table("t", columns("deviation", "ci95"), ((0.06, half),))
    assert next(iter(shown_rows(table)))[0] == wanted


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
    wide = 4.2 * 8.0 * 25.4 / 72.0  # mm: four characters of full width at 8 points
    assert pdf_report.lines_of(text, wide, 8.0) == lines
