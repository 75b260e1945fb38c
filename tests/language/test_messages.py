"""The catalogues of messages: complete in every language, without unused messages."""

import ast
import functools
import re
import string
from pathlib import Path

import pytest

import processor
from processor import pipeline
from processor.batch import record, summary_values
from processor.epochs.change import Finding
from processor.language.messages import CODES, Text, catalogue, messages, text
from processor.model import VOCABULARIES, Status, reason
from processor.report.columns import COLUMNS
from processor.validation import change_detection, coverage, curves
from tests.bench.papers import rows
from tests.support import structure

PAPERS = structure.ROOT / "tests/bench/papers"  # the comparison with them has its texts in the catalogues as well
SOURCES = (Path(processor.__file__).parent, PAPERS)
OTHERS = [code for code in CODES if code != "en"]


@functools.cache
def all_calls():
    """Every call in the sources that have texts, with its file."""
    return [
        (path.name, node)
        for path in (*structure.SOURCES, *PAPERS.glob("*.py"))
        if re.search(r"\b(reason|text|figures_of)\(|\bheading=", path.read_text("utf-8"))
        for node in structure.nodes(path)
        if isinstance(node, ast.Call)
    ]


def calls(*names):
    """The first arguments of calls of the functions of these names, with the keywords given: constant texts."""
    for file, node in all_calls():
        if node.args and getattr(node.func, "id", "") in names and isinstance(node.args[0], ast.Constant):
            yield file, node.args[0].value, {word.arg for word in node.keywords}


def headings():
    """The headings of records' fields, which are looked up as texts."""
    for _, node in all_calls():
        yield from (
            word.value.value for word in node.keywords if word.arg == "heading" and isinstance(word.value, ast.Constant)
        )


def in_templates():
    """The texts of the pages' templates."""
    for path in sorted(page for folder in SOURCES for page in folder.rglob("*.html")):
        yield from re.findall(r'\btext\("([^"]+)"', path.read_text("utf-8"))


def fields(template):
    return {name for _, name, _, _ in string.Formatter().parse(template) if name}


@pytest.mark.parametrize("code", CODES)
def test_every_code_of_the_sources_has_a_template_with_its_values(code):
    known = messages(code).reasons
    used = list(calls("reason"))
    assert used
    for path, name, values in used:
        assert name in known, f"{path}: no message {name!r} in {code}"
        assert fields(known[name]) <= values or None in values, f"{path}: {name} lacks {fields(known[name]) - values}"


@pytest.mark.parametrize("code", CODES)
def test_every_code_of_a_catalogue_is_used(code):
    assert set(messages(code).reasons) == {name for _, name, _ in calls("reason")}


@pytest.mark.parametrize("code", OTHERS)
def test_every_text_of_the_sources_is_translated_with_the_same_values(code):
    known = messages(code).texts
    assert len(set(in_templates())) > 20
    for template in {*(name for _, name, _ in calls("text", "figures_of")), *headings(), *in_templates()}:
        if all(not literal.strip(" ,.;:") for literal, *_ in string.Formatter().parse(template)):
            continue  # nothing but values
        assert template in known, f"not in {code}: {template!r}"
        assert fields(known[template]) == fields(template), template


SYMBOL = re.compile(r"lambda|lod95|[a-z]\d?|d[xyz]|n[xyz]|[xyz][xyzt]|m\d\d")  # the same in all languages


@pytest.mark.parametrize("code", OTHERS)
def test_every_column_has_a_heading_in_every_language(code):
    catalogue, every = messages(code), [*COLUMNS.values(), *summary_values.COLUMNS.values()]
    assert len(every) > 250
    words = {column.heading for column in every if not SYMBOL.fullmatch(column.heading)}
    assert sorted(word for word in words if word and catalogue.heading(word) == word) == []
    known = {*words, *(column.unit for column in every)}
    assert sorted(set(catalogue.headings) - known - {"a", "b"}) == []


@pytest.mark.parametrize("code", OTHERS)
def test_words_of_a_catalogue_belong_to_their_vocabulary(code):
    assert pipeline.step_modules()
    assert (
        len({record.JobStatus, change_detection.ChangeKind, coverage.Holds, curves.CurveKind, rows.Outcome, Finding})
        == 6
    )  # vocabularies are known once they are imported
    for key in messages(code).words:
        name, _, word = key.rpartition(".")
        if name:
            assert word in [str(one) for one in VOCABULARIES[name]], key


def test_no_message_of_a_catalogue_is_defined_twice():
    for code in CODES:
        for section in ("reasons", "texts", "words", "headings"):
            every = [key for file in catalogue(code).values() for key in file.get(section, {})]
            assert len(every) == len(set(every)), sorted({key for key in every if every.count(key) > 1})


def test_values_are_written_by_their_kind():
    english, chinese = messages("en"), messages("zh")
    made = Text(
        "{a} {b:.1f} {c} {d} {n} {n:?scan|scans}", {"a": 1.23456, "b": float("nan"), "c": (1, 2), "d": "<x>", "n": 2}
    )
    assert english.text(made) == "1.235 – 1, 2 <x> 2 scans"
    assert english.text(Text("{n:?scan|scans}", {"n": 1})) == "scan"
    assert chinese.text(Text("{c}", {"c": ("a", "b")})) == "a、b"
    assert english.text(Status.OK) == "ok"
    assert str(text("{status}", status=Status.WEAK)) == "weak"
    nested = reason("deviation.weak", motions=(Status.OK,))
    assert "ok" in english.text(nested)
    assert english.sentences((nested, nested)).count(".") == 2


def test_an_unknown_code_is_shown_as_it_is():
    assert messages("en").text(reason("no.such-code", x=1)) == "no.such-code"
