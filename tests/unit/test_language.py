"""The page in another language."""

import dataclasses
import re
import string

import numpy as np
import pytest

from processor import language
from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import messages
from processor.language.messages import text as message
from processor.model import Status, reason
from processor.preassembly.verdicts import joint_measures, trim_and_shim
from processor.report import all_figures, page, view
from processor.space_frame.design.matching import FrameRelation
from tests.support.metrics import metric
from tests.support.pages import Visible, latin
from tests.unit.test_report_adjusted import LIMITS, SECTION, of_bridge
from tests.unit.test_report_balls import of_frame, whole, with_truth


@pytest.fixture
def spoken(monkeypatch):
    found = language.Language("en")
    found.words = {"pass": "合格", "fail": "不合格", "gap": "间隙", "a turn": "转动", "a shift": "平移"}
    found._patterns = [
        (language._pattern(key), text)
        for key, text in {
            "{} of {} parts": "{1}件中{0}件",
            "{#} mm": "{0}毫米",
            "all of: {;}": "全部{0}",
            "joint {}: {}": "接头{0}：{1}",
        }.items()
    ]
    return found


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("pass", "合格"),
        ("3 of 5 parts", "5件中3件"),
        ("joint J1: pass", "接头J1：合格"),
        ("joint fail", "joint fail"),
        ("pass; 3 of 5 parts", "合格；5件中3件"),
        ("pass, gap.", "合格，间隙。"),
        ("rib1, x", "rib1, x"),
        ("<b>3</b> of {0} parts", "{0}件中<b>3</b>件"),
        ("", ""),
        ("-1.5e+02 mm.", "-1.5e+02毫米。"),
        ("– mm", "–毫米"),
        ("some mm", "some mm"),
        ("all of: fail; b: gap", "全部不合格；b：间隙"),
        ("J1: all of: pass; fail", "J1：全部合格；不合格"),
        ("a turn and a shift", "转动、平移"),
        ("rib1 and gap", "rib1 and gap"),
    ],
)
def test_texts_are_looked_up_matched_or_taken_apart(spoken, text, said):
    assert spoken.say(text) == said


def test_english_says_what_it_is_given():
    assert language.language("en").say("pass; fail.") == "pass; fail."
    assert language.language("en").of_scripts("pass") == {}


CODES = [code for code in language.CODES if code != "en"]


@pytest.mark.parametrize("code", CODES)
def test_a_catalogue_fills_all_its_places(code):
    found = language.Language(code)
    for pattern, template in found._patterns:
        template.format(*range(pattern.groups))
        assert all(f"{{{i}}}" in template for i in range(pattern.groups)), template


@pytest.mark.parametrize("code", CODES)
def test_a_text_stands_in_one_section_only(code):
    for kind in ("words", "sentences"):
        keys = [key for section in language.catalogue(code).values() for key in section.get(kind, {})]
        assert len(keys) == len(set(keys))


@pytest.mark.parametrize("code", CODES)
def test_all_that_the_scripts_say_is_known(code):
    script, _ = view.script()
    said = set(re.findall(r'say\("([^"]+)"\)', script))
    assert len(said) > 20
    assert said - set(messages(code).of_scripts(script)) == set()


def test_names_from_files_are_left_alone():
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


def chinese_page(execution, report):
    return page.html(execution, report, all_figures.of_run(execution, report), "zh")


def a_bridge():
    """Return the bridge of the report's tests, saying what the adjustment says."""
    execution = of_bridge()
    first, *others = execution.runs
    result = dataclasses.replace(
        first.result,
        component_message=(
            "the part fits its design as well when turned by 180 deg; a mark on it would tell",
            "J1: the bottom and the right face may be the plate's inner side",
            "what the scan shows does not hold a shift along its length and a turn sideways",
        ),
        component_status=("ambiguous", "weak", "ok"),
        limiting="J1 P1: +-0.087 mm (95 %), 69% of the variance from the end face at the end of rib1",
        advice="no answer at J2: scan both ends there; a scan of rib1 that shows more of the end face at its end: "
        "four times the points halve its part",
        budget_source=("ends as measured, median", "scanner offset"),
        message="lambda 0.1; no temperature given: taken as the reference; limits of GB 50205-2020, not verified",
        gauge="all joints and the design's curve at once, lambda 0.1",
    )
    other = dataclasses.replace(
        others[0].result,
        gauge="Foot 1 at its principal-axes attitude, its joint corners on the design's",
        message="bands are what this method makes of parts as designed; key points lie on the plates' inner edges",
        errors_ci95=np.full(6, 9.0),
        linear_ci95=np.full(len(others[0].result.linear_station), 9.0),
    )
    runs = (dataclasses.replace(first, result=result), dataclasses.replace(others[0], result=other))
    return dataclasses.replace(
        execution, runs=runs, scene=dataclasses.replace(execution.scene, units_reason="made in millimetres")
    )


def a_frame():
    result = whole(
        reasons=(
            reason("spheres.ranges"),
            reason("spheres.unverified-catalogue", catalogue="plausible"),
            reason("spheres.matched", frame=FrameRelation.REGISTERED, nodes=4, nominal=5, missing=1, extra=0),
        ),
        changed={
            "reasons": (
                (),
                (reason("spheres.other-size", size=60.0, nominal=50.0),),
                (reason("spheres.axes-alone", axes=2), reason("spheres.nominal-radius")),
                (
                    reason("spheres.few-points", points=12, least=20),
                    reason("spheres.uncertain-radius", sd=2.5),
                ),
                (reason("spheres.not-in-design"),),
            )
        },
        datum=(reason("spheres.datum-stations", stations=2, sd=0.5),),
    )
    metrics = (
        metric("radius error, median", 0.5, 3.0, step="spheres"),
        metric("centres within their 95 % intervals", 93.0, unit="%", step="spheres", method="ransac"),
        metric("balls called ok, lowest point over 3 mm off", 1.0, 0.0, unit="", step="spheres", method="ransac"),
    )
    execution, truth = of_frame(result, with_truth()[0])
    scene = dataclasses.replace(execution.scene, units_reason="given in project.toml")
    return dataclasses.replace(execution, scene=scene), ErrorReport(metrics, truth.true_radii, truth.true_centres)


@pytest.mark.parametrize("made", [lambda: (a_bridge(), ErrorReport()), a_frame], ids=["bridge", "frame"])
def test_nothing_but_names_and_units_is_left_in_english(made):
    seen = Visible(chinese_page(*made()))
    assert seen.lang == "zh"
    assert len(seen.texts) > 100
    assert latin(seen.texts) == []


@pytest.mark.parametrize("size_mm", [0.2, 1.0, 4.0])
def test_no_proposal_keeps_a_word_of_english(size_mm):
    say = language.language("zh").say
    rng = np.random.default_rng(int(10 * size_mm))
    said = set()
    for sd in np.repeat([0.05, 0.6], 5):
        tilt = np.outer(SECTION[:, 1] / 450.0, rng.normal(0.0, [size_mm, 0.0, 0.0]))
        gaps = rng.normal(0.0, size_mm, 3) + tilt + rng.normal(0.0, 0.3, (8, 3))
        found = joint_measures.measure(gaps, sd**2 * np.eye(24), np.eye(4), SECTION)
        said.add(say(trim_and_shim.propose("J1", found, LIMITS).sentence))
    assert len(said) > 1
    assert latin(said) == []


@pytest.mark.parametrize("code", [code for code in messages("zh").reasons if code.startswith("spheres.")])
def test_what_is_said_of_balls_is_known(code):
    assert latin([literal for literal, *_ in string.Formatter().parse(messages("zh").reasons[code])]) == []
