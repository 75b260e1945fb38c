"""The page in another language."""

import dataclasses
import re
import string

import numpy as np
import pytest

from processor.evaluation.evaluate import ErrorReport
from processor.language import messages as messages_
from processor.language.messages import messages
from processor.language.messages import text as message
from processor.model import Status, reason
from processor.preassembly.ends.section import PlateFace
from processor.preassembly.result import Gauge
from processor.preassembly.verdicts import joint_measures, trim_and_build_up
from processor.registration.surface_registration import Motion
from processor.report import all_figures, page
from processor.report.scripts import page_script
from processor.scan_folder import units
from processor.space_frame.design.matching import FrameRelation
from tests.support.pages.pages import STAYS, Visible, latin
from tests.support.results.ball_results import of_frame, whole, with_truth
from tests.support.results.bridge_results import LIMITS, SECTION, of_bridge, with_band
from tests.support.results.metrics import metric

pytestmark = pytest.mark.usefixtures("blank_pictures")

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


def why_mm():
    """The reasons for scans without a unit that would be too large in metres, and too sparse in metres."""
    line = np.zeros((2000, 3))
    line[:, 0] = np.arange(2000.0)
    return units.not_metres(10.0 * line), units.not_metres(line)


def chinese_page(execution, report):
    return page.html(execution, report, all_figures.draw_figures(execution, report), "zh")


def a_bridge():
    """Return the bridge of the report's tests, with remarks of every kind."""
    execution = of_bridge()
    first, *others = execution.runs
    scan_both, at_joint = (
        reason("preassemble.scan-both-ends", joints=("J2",)),
        reason("preassemble.inner-side", faces=(PlateFace.BOTTOM, PlateFace.RIGHT)),
    )
    result = dataclasses.replace(
        first.result,
        reasons=(
            reason("preassemble.weight", weight=0.1),
            reason("preassemble.reference-temperature"),
            reason("preassemble.limits-not-verified", standard="GB 50205-2020"),
        ),
        components=dataclasses.replace(
            first.result.components,
            reasons=(
                (reason("preassemble.rival-rotation", degrees=180.0),),
                (reason("preassemble.at", place="J1", reasons=(at_joint,)),),
                (reason("preassemble.weak", motions=(Motion.ALONG, Motion.YAW)),),
            ),
            status=("ambiguous", "weak", "ok"),
        ),
        adjustment=dataclasses.replace(first.result.adjustment, advice=(scan_both, *first.result.adjustment.advice)),
        linear=dataclasses.replace(first.result.linear, gauge=Gauge.ALL),
    )
    other = others[0].result
    other = dataclasses.replace(
        other,
        reasons=(reason("preassemble.bands-as-designed"), reason("preassemble.inner-edges")),
        splicing=dataclasses.replace(other.splicing, ci95=[9.0, 9.0]),
        linear=dataclasses.replace(
            other.linear,
            gauge=Gauge.PRINCIPAL_AXES,
            assembled=with_band(other.linear.assembled, 9.0, [9.0, 9.0]),
            best_fit=dataclasses.replace(
                other.linear.best_fit, error=dataclasses.replace(other.linear.best_fit.error, ci95=[9.0, 9.0])
            ),
        ),
    )
    runs = (dataclasses.replace(first, result=result), dataclasses.replace(others[0], result=other))
    return dataclasses.replace(execution, runs=runs, scene=dataclasses.replace(execution.scene, units_reason=why_mm()))


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
    scene = dataclasses.replace(execution.scene, units_reason=(reason("units.by-project", file="project.toml"),))
    return dataclasses.replace(execution, scene=scene), ErrorReport(metrics, truth.true_radii, truth.true_centres)


@pytest.mark.parametrize("made", [lambda: (a_bridge(), ErrorReport()), a_frame], ids=["bridge", "frame"])
def test_chinese_page_has_english_names_and_units_alone(made):
    seen = Visible(chinese_page(*made()))
    assert seen.lang == "zh"
    assert len(seen.texts) > 100
    assert latin(seen.texts) == []


@pytest.mark.parametrize("size_mm", [0.2, 1.0, 4.0])
def test_proposals_are_translated_completely(size_mm):
    chinese = messages("zh")
    rng = np.random.default_rng(int(10 * size_mm))
    said = set()
    for sd in np.repeat([0.05, 0.6], 5):
        tilt = np.outer(SECTION[:, 1] / 450.0, rng.normal(0.0, [size_mm, 0.0, 0.0]))
        gaps = rng.normal(0.0, size_mm, 3) + tilt + rng.normal(0.0, 0.3, (8, 3))
        found = joint_measures.measure(gaps, sd**2 * np.eye(24), np.eye(4), SECTION)
        said.add(chinese.sentences(trim_and_build_up.propose(found, LIMITS).reasons))
    assert len(said) > 1
    assert latin(said) == []


# What init writes has the names of keys and kinds of project.toml.
KEYS = {"kind", "design", "units", "design_units", "structure", "space", "frame", "json", "CAD"}


def test_reasons_are_translated_completely():
    left = {}
    for code, text in messages("zh").reasons.items():
        if code.startswith(("spheres.", "init.")):
            stays = STAYS | KEYS if code.startswith("init.") else STAYS
            left[code] = latin([literal for literal, *_ in string.Formatter().parse(text)], stays)
    assert len(left) > 100
    assert {code: words for code, words in left.items() if words} == {}
