"""Cells of tables: what a spreadsheet would execute is text, and numbers stay numbers."""

import pytest

from processor.plain_text import spreadsheet_text


@pytest.mark.parametrize("cell", ["-0.25", "+3", "-1e-05", "12.5", "-7.", "S1", ""])
def test_numbers_and_names_are_written_as_they_are(cell):
    assert spreadsheet_text(cell) == cell


@pytest.mark.parametrize("cell", ["=1+1", "-1+cmd|' /C calc'!A0", "+A1", "@SUM(A1)", "-", "-1;2", "-1\n=2", "＝1"])
def test_what_a_spreadsheet_executes_gets_an_apostrophe(cell):
    assert spreadsheet_text(cell).startswith("'")
