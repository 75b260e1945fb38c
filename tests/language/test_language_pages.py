"""Pages other than of a bridge or a frame in Chinese: steps for structures, a batch, a comparison, the nights."""

import dataclasses
import re

import numpy as np
import pytest

from processor.compare import compare
from processor.defects.result import DefectClass
from processor.evaluation.evaluate import ErrorReport
from processor.geometry.normal_orientation import Turned
from processor.language.messages import label, messages
from processor.model import reason
from processor.report import all_figures, cloud_comparison, page
from processor.stitching.result import ControlPoints, ControlSightings
from processor.validation import change_detection
from processor.validation import summary as nights_summary
from tests.support.pages.pages import (
    REASONS,
    STAYS,
    STITCH_CHECKS,
    Visible,
    checks_of,
    indexed,
    latin,
    left_in_english,
    searched,
    two_nights,
)
from tests.support.results import step_results, validation_nights
from tests.support.results.metrics import metric

# --- steps ----------------------------------------------------------------------------------------------------------


def stitched():
    first = step_results.stitching()
    other = dataclasses.replace(first, method="three-point")
    made = step_results.execution(("stitch", "automatic", "{}", first), ("stitch", "three-point", "{}", other),
                                  names=first.scans.name)  # fmt: skip
    of_other = metric("scans not placed", 1.0, step="stitch", method="three-point")
    return made, ErrorReport((*checks_of("stitch", *STITCH_CHECKS), of_other))


def controlled():
    """Scans fixed by control points."""
    first = step_results.stitching()
    sightings = ControlSightings(
        point=("P1", "P2", "P2"), scan=("S1", "S1", "S2"), off=np.ones((3, 3)), sd=np.ones((3, 3)),
        share=np.full(3, 0.4), used=[True, True, False],
    )  # fmt: skip
    control = ControlPoints(holds=True, redundancy=3, ratio=0.9, sightings=sightings)
    first = dataclasses.replace(first, control=control)
    made = step_results.execution(("stitch", "automatic", "{}", first), names=first.scans.name)
    return made, ErrorReport(checks_of("stitch", *STITCH_CHECKS))


def given():
    """Scans in the frame that the reference's given pose leads to."""
    first = step_results.stitching()
    pose = np.array(first.scans.T_project_scan)
    pose[:, :3, 3] += 5e5
    scans = dataclasses.replace(first.scans, T_project_scan=pose)
    result = dataclasses.replace(first, scans=scans, frame="GLCS", T_GLCS_PRCS=pose[0])
    return step_results.execution(("stitch", "automatic", "{}", result), names=scans.name), ErrorReport()


@pytest.mark.parametrize("made", [stitched, controlled, given, searched])
def test_chinese_page_has_english_names_and_units_alone(made):
    execution, report = made()
    text = page.html(execution, report, all_figures.draw_figures(execution, report), "zh")
    assert left_in_english(text) == []


def test_ambiguous_word_is_translated_by_its_vocabulary_or_column():
    say = messages("zh").text
    assert (say(label("step")), say(DefectClass.STEP), say(label("missed: step"))) == ("步骤", "错台", "漏检：错台")
    assert (say(label("misalignment")), say(DefectClass.MISALIGNMENT)) == ("接口错边", "整体偏位")
    assert (say(label("side")), messages("zh").heading("side")) == ("立面", "边长")


# --- a batch --------------------------------------------------------------------------------------------------------


def test_the_index_of_a_batch_in_chinese(tmp_path):
    more = {"csv", "json", "SIGSEGV", "timeout", "memory", "MB", "mb", "numpy", "not", "Permission", "denied"}
    assert left_in_english(indexed(tmp_path, "zh"), *more) == []


def test_errors_of_inputs_are_marked_as_english(tmp_path):
    error = "scan.ply: expected 1000 points, found 50; export it again"
    text = indexed(tmp_path, "zh", (reason("batch.error", message=error), *REASONS))
    assert f'lang="en">{error}</td>' in text
    assert "错误信息与命令行一致" in text
    assert text.count('lang="en"') == 1
    assert "错误信息与命令行一致" not in indexed(tmp_path, "zh")


# --- a comparison ---------------------------------------------------------------------------------------------------


def test_a_comparison_in_chinese(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("前", "后"):
        np.savetxt(tmp_path / f"{name}.xyz", rng.uniform(0.0, [3.0, 3.0, 0.01], (2000, 3)))
    first = compare.compare(compare.Request(tmp_path / "前.xyz", tmp_path / "后.xyz", tmp_path / "前.xyz"))
    found = dataclasses.replace(
        first,
        turned=Turned(np.empty((0, 3)), 1, 2, 3, 4, 2),
        units={"reference": "m", "compared": "", "core": ""},
    )
    without = dataclasses.replace(first.summary, without_lod=first.summary.core_points)
    for unit in ("mm", ""):
        for summary_ in (first.summary, without):
            cloud_comparison.write(tmp_path / "out", dataclasses.replace(found, summary=summary_, unit=unit), "zh")
            seen = Visible((tmp_path / "out" / "report.html").read_text("utf-8"))
            assert seen.lang == "zh"
            assert "由 前.xyz 至 后.xyz" in seen.texts
            assert latin(seen.texts, STAYS | {"xyz", "LOD95"}) == []


# --- nights ---------------------------------------------------------------------------------------------------------


def a_night(failed=1, missed=2, kinds=tuple(change_detection.ChangeKind), **more):
    found = tuple(
        change_detection.Change(
            ("spheres", "ray", "radii, bias"), kind, "paired", 0.2, True, "mm", 0.001, 3, quantity="radii",
            statistic="bias",
        )
        for kind in kinds
    )  # fmt: skip
    cells = tuple({"failed": "x" if i < failed else ""} for i in range(3))
    of = change_detection.Detected(found, 12, 3, 4, **more)
    return nights_summary.Summary("2026-11-21", validation_nights.SOFTWARE, cells, [{}] * missed, of)


@pytest.mark.parametrize(
    "found", [a_night(), a_night(0, 0, (), first=True), a_night(2, 1, (), moved_scenes=2)],
    ids=["changes", "first", "moved"],
)  # fmt: skip
def test_the_line_of_a_night_in_chinese(found):
    line = messages("zh").text(found.line)
    assert latin([line.replace("ray", "").replace("c0ffeec0", "")]) == []


def test_pages_of_nights_in_chinese(tmp_path):
    two_nights(tmp_path, "zh")
    more = {"ray", "phase", "mrad", "steel", "numpy", "ISO", "Holm", "sqrt", "cal", "Cramer", "Rao",
            "c0ffee", "check", "rms"}  # fmt: skip
    for name in ("nights.html", "certificate.html"):
        text = (tmp_path / name).read_text("utf-8")
        text = re.sub(r"<code>[0-9a-f]+</code>|c0ffee\w*", "", text)
        assert left_in_english(text, *more) == []
    assert "2026-11-20 异常" in (tmp_path / "nights.html").read_text("utf-8")  # the line of an earlier night
    assert 'lang="zh"' in (tmp_path / "nights/2026-11-20/certificate.html").read_text("utf-8")
