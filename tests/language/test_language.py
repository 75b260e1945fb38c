"""The page in another language."""

import re
import string

import pytest

from processor.batch.record import JobStatus
from processor.defects.result import DefectClass
from processor.deviation.result import Registration
from processor.evaluation.evaluate import ErrorReport
from processor.language import messages as messages_
from processor.language.messages import messages
from processor.language.messages import text as message
from processor.model import Status, Verdict, reason
from processor.preassembly.ends.section import PlateFace
from processor.preassembly.result import Gauge
from processor.registration.surface_registration import Motion
from processor.report import all_figures, page
from processor.report.scripts import page_script
from processor.space_frame.design.matching import FrameRelation
from tests.support.pages.pages import NAMES, STAYS, Visible, latin
from tests.support.results.ball_results import of_frame, whole, with_truth
from tests.support.results.bridge_results import of_bridge
from tests.support.results.metrics import metric

CODES = [code for code in messages_.CODES if code != "en"]


@pytest.mark.parametrize("code", CODES)
def test_texts_of_the_scripts_are_translated(code):
    script, _ = page_script.script()
    said = set(re.findall(r'say\("([^"]+)"\)', script))
    assert len(said) > 20
    assert said - set(messages(code).of_scripts(script)) == set()


def test_names_from_files_are_not_translated():
    execution = of_bridge(names=("top", "rib1", "foot2"), joints=("gap", "J2"))
    seen = Visible(page.html(execution, ErrorReport(), {}, "zh"))
    assert {"top", "gap"} <= set(seen.texts)
    assert "顶" not in seen.texts


def test_live_figures_are_translated_but_for_names():
    found = messages("zh").rendered(
        {"title": message("Balls in space"), "parts": [{"name": "top", "text": Status.OK}], "stops": ("left", 1.0)}
    )
    assert found == {"title": "螺栓球的三维视图", "parts": [{"name": "top", "text": "正常"}], "stops": ["left", 1.0]}


# --- Chinese -------------------------------------------------------------------------------------------------------


def a_frame():
    """A frame whose design was matched, with checks of both methods."""
    relation = reason("spheres.matched", frame=FrameRelation.REGISTERED, nodes=4, nominal=5, missing=1, extra=0)
    metrics = (
        metric("radius error, median", 0.5, 3.0, step="spheres"),
        metric("centres within their 95 % intervals", 93.0, unit="%", step="spheres", method="ransac"),
        metric("balls called ok, lowest point over 3 mm off", 1.0, 0.0, unit="", step="spheres", method="ransac"),
    )
    execution, truth = of_frame(whole(reasons=(relation,)), with_truth()[0])
    return execution, ErrorReport(metrics, truth.true_radii, truth.true_centres)


@pytest.mark.parametrize("made", [lambda: (of_bridge(), ErrorReport()), a_frame], ids=["bridge", "frame"])
def test_chinese_page_has_english_names_and_units_alone(made):
    execution, report = made()
    seen = Visible(page.html(execution, report, all_figures.draw_figures(execution, report), "zh"))
    assert seen.lang == "zh"
    assert len(seen.texts) > 100
    assert latin(seen.texts) == []


# Names of files, keys, options and programs are the same in all languages, and so are those of methods and standards.
CODE = re.compile(
    r"--[a-z-]+|'[^']*'|\"[^\"]*\"|`[^`]*`|\[[^\]]*\]|\w+(\.\w+)+( = \w+)?|\b[A-Z][A-Z0-9]+\b|\w*_\w*|processor \w+"
)
SAME = STAYS | NAMES | {
    "kind", "structure", "space", "design", "units", "mrad", "preassemble", "report", "keep", "false", "bow", "twist",
    "changed", "since", "follows", "Holm", "Huber", "equation", "epsg", "sqrt", "edge", "cal", "Cramer", "Rao", "shape",
}  # fmt: skip


def in_english(template):
    return latin([CODE.sub("", literal) for literal, *_ in string.Formatter().parse(template)], SAME)


@pytest.mark.parametrize("section", ["reasons", "texts"])
def test_no_message_is_left_in_english(section):
    templates = getattr(messages("zh"), section)
    assert len(templates) > 500
    assert {key: words for key, text in templates.items() if (words := in_english(text))} == {}


@pytest.mark.parametrize(
    "vocabulary", [Status, Verdict, DefectClass, Registration, PlateFace, Gauge, Motion, FrameRelation, JobStatus]
)
def test_words_that_reasons_and_tables_hold_are_translated(vocabulary):
    assert latin([messages("zh").text(word) for word in vocabulary], SAME) == []
