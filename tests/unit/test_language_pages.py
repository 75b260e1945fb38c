"""Pages other than of a bridge or a frame in Chinese: steps for structures, a batch, a comparison, the nights."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from processor import language
from processor.batch import figures as batch_figures
from processor.batch import summary
from processor.batch.job import Job
from processor.batch.record import Record
from processor.compare import compare
from processor.defects.result import DefectClass
from processor.defects.result import Result as Defects
from processor.deviation.result import Registration
from processor.evaluation.evaluate import ErrorReport
from processor.geometry.normal_orientation import Turned
from processor.language.messages import label, messages
from processor.model import reason
from processor.report import all_figures, comparison, page
from processor.stitching.result import ControlPoints, ControlSightings
from processor.validation import changes, night
from processor.validation import summary as nights_summary
from tests.support import step_results, validation_nights
from tests.support.metrics import metric
from tests.unit.test_language import STAYS, Visible, latin

SOURCES = Path(language.__file__).parents[1]
NAMES = {
    *(f"S{i}" for i in range(9)),
    *("site", "scan", "made", "component", "ply", "summary", "timings"),
    *("automatic", "default", "paper", "three", "point", "stitch", "deviation", "spheres", "defects", "pdf"),
    *("PRCS", "SOCS", "GLCS", "T_PRCS_SOCS", "GLCS_PRCS", "LOD95", "lod95", "ppm", "rms"),
}


def left_in_english(text, *more):
    seen = Visible(re.sub(r"T_(PR|GL)CS_SOCS\(.*?\)", "", text))
    assert seen.lang == "zh"
    assert len(seen.texts) > 20
    return latin(seen.texts, STAYS | NAMES | set(more))


# --- steps ----------------------------------------------------------------------------------------------------------


def checks_of(step, *names):
    return tuple(metric(name, 1.0, 0.0 if i % 2 else float("nan"), step=step) for i, name in enumerate(names))


STITCH_CHECKS = (
    "scans not placed", "station positions after datum fit, max", "station positions after datum fit, rms",
    "rotations after datum fit, max", "scans called ok, over 50 mm off", "pose components within their 95 % intervals",
    "station positions by control points, max",
)  # fmt: skip
DEFECT_CHECKS = (
    *(f"missed: {kind}" for kind in DefectClass), "false alarms", "surface examined",
    "class wrong", "depths off by more than a tenth and 2 LOD95", "depth error, median", "depth error, max",
    "depths that are bounds alone",
)  # fmt: skip


def stitched():
    first = step_results.stitching()
    other = dataclasses.replace(first, method="three-point")
    made = step_results.execution(("stitch", "automatic", "{}", first), ("stitch", "three-point", "{}", other),
                                  names=first.scans.name)  # fmt: skip
    of_other = metric("scans not placed", 1.0, step="stitch", method="three-point")
    return made, ErrorReport((*checks_of("stitch", *STITCH_CHECKS), of_other))


def controlled():
    """Scans fixed by control points, with all reasons about these."""
    first = step_results.stitching()
    sightings = ControlSightings(
        point=("P1", "P2", "P2"), scan=("S1", "S1", "S2"), off=np.ones((3, 3)), sd=np.ones((3, 3)),
        share=np.full(3, 0.4), used=[True, True, False],
    )  # fmt: skip
    suspects = (
        reason("stitch.suspect-point", point="P2"),
        reason("stitch.suspect-sighting", point="P2", scan="S2"),
        reason("stitch.suspect-pose", scan="S2"),
    )
    reasons = (
        reason("stitch.control-used", points=2, sightings=3, rms_mm=1.2, redundancy=3),
        reason("stitch.control-sd-assumed", sd_mm=2.1),
        *(reason("stitch.control-left-out", suspect=suspect, size_mm=52.0) for suspect in suspects[:2]),
        reason("stitch.control-undecided", suspects=suspects, factor=5.1),
        reason("stitch.control-scatters", factor=1.7),
        reason("stitch.control-not-used", shortage=reason("stitch.control-few", points=2)),
        reason("stitch.control-not-used", shortage=reason("stitch.control-on-a-line")),
    )
    few, line = reason("stitch.few-points", points=2), reason("stitch.points-on-a-line")
    shortages = tuple(
        reason("stitch.shortage-with-scan", shortage=shortage, scan=scan)
        for shortage, scan in ((few, "S1"), (line, "S2"))
    )
    of_scans = (
        *first.scans.reasons[:4],
        first.scans.reasons[-1],
        (reason("stitch.control-contradicts", shift_mm=170.0),),
        (reason("stitch.too-few-picks", shortages=shortages),),
        (reason("stitch.no-picks"),),
        (reason("stitch.picks-of-unplaced"),),
    )
    control = ControlPoints(holds=True, redundancy=3, ratio=0.9, sightings=sightings)
    scans = dataclasses.replace(first.scans, reasons=of_scans)
    first = dataclasses.replace(first, control=control, reasons=reasons, scans=scans)
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


PAPER = (
    reason("defects.paper-clusters", points=2000, spacing=4.5),
    reason("defects.paper-fit", rms=1.2, share=87.0),
    reason("defects.paper-threshold", threshold=3.1),
)


def searched():
    placed = reason("defects.placed-by-deviation", registration=Registration.AS_GIVEN)
    first = step_results.defects(reasons=(placed, *step_results.EXAMINED))
    paper = step_results.defects(3, PAPER, method="paper")
    made = step_results.execution(("defects", "default", "{}", first), ("defects", "paper", "{}", paper))
    of_paper = metric("missed: step", 1.0, step="defects", method="paper")
    return made, ErrorReport((*checks_of("defects", *DEFECT_CHECKS), of_paper))


@pytest.mark.parametrize("made", [stitched, controlled, given, searched])
def test_nothing_but_names_and_units_is_left_in_english(made):
    execution, report = made()
    text = page.html(execution, report, all_figures.of_run(execution, report), "zh")
    assert left_in_english(text) == []


@pytest.mark.parametrize(
    "code", ["no-point", "too-few-points", "not-placed", "paper-too-few-points", "paper-not-placed"]
)
def test_a_search_that_failed_has_its_reason_in_chinese(code):
    failed = Defects(status="failed", method="default", reasons=(reason(f"defects.{code}"),))
    execution = step_results.execution(("defects", "default", "{}", failed))
    assert left_in_english(page.html(execution, ErrorReport(), {}, "zh")) == []


@pytest.mark.parametrize(
    "reasons",
    [
        (*step_results.EXAMINED, reason("defects.not-fitted")),
        (reason("defects.best-fit"), reason("defects.ambiguous"), *step_results.EXAMINED),
        (reason("defects.placed-by-deviation", registration=Registration.COARSE), *step_results.EXAMINED),
        PAPER,
    ],
)
def test_reasons_of_the_search_are_in_chinese(reasons):
    assert latin([messages("zh").sentences(reasons)], STAYS | NAMES) == []


def test_a_word_of_two_senses_has_that_of_its_vocabulary_or_column():
    say = language.language("zh").say
    assert (say("step"), say(DefectClass.STEP), say("missed: step")) == ("步骤", "错台", "漏检：错台")
    assert (say("misalignment"), say(DefectClass.MISALIGNMENT)) == ("接口错边", "整体偏位")
    assert (say("side"), say(label("side"))) == ("立面", "边长")


# --- a batch --------------------------------------------------------------------------------------------------------

REASONS = (
    "stopped before it ended",
    "took longer than 3.5 s (--timeout-s)",
    "needs more memory than 200 MB (--memory-mb)",
    "crashed: SIGSEGV (signal 11)",
    "crashed: signal 70",
    "ended with exit code 9 and without results",
    "ended with exit code 9 and without results: 坏",
    "the input changed while it was processed, so nothing is kept; run again when it is complete",
    "done, but not in this folder: all workers must share it, and the inputs, under the same path",
    "every worker that did it died (out of memory?); run again, with fewer jobs at a time",
    "a worker has other software: numpy 1.0, not 2.0; install the same everywhere",
)
LEFT_OUT = (
    "cannot be read (Permission denied)",
    "holds results of an earlier run",
    "a link; the batch follows none",
    "holds no rows of coordinates, so it is taken for no scan",
    "lies within the scan folder 桥",
    "has the name of one of the batch's own files; rename it",
)


LEFT = dict(zip("一二三四五六", LEFT_OUT, strict=True))


def job(out, name):
    (out / f"{name}.log").touch()
    return Job(name, out, out, out, out / name, out / f"{name}.log", out, out, out, "", (), {}, {}, 1.0, 1, 1)


def indexed(out, lang, reasons=REASONS):
    everything = dict.fromkeys(batch_figures.COLUMNS, 3)
    everything |= {"steps": "preassemble, spheres (partial), stitch (failed), deviation (ambiguous), defects (weak)"}
    done = [
        Record(f"扫描 {i}", "", status, figures={**everything, "verdict": verdict})
        for i, (status, verdict) in enumerate(
            [("done", "pass"), ("in-part", "indeterminate"), ("limit-missed", "fail"), ("done", None)]
        )
    ]
    done += [Record(f"坏 {i}", "", "failed", reason) for i, reason in enumerate(reasons)]
    found = summary.write(out, [(job(out, one.input), one) for one in done], LEFT, lang)
    return found.page.read_text("utf-8")


def test_the_index_of_a_batch_in_chinese(tmp_path):
    more = {"csv", "json", "SIGSEGV", "timeout", "memory", "MB", "mb", "numpy", "not", "Permission", "denied"}
    assert left_in_english(indexed(tmp_path, "zh"), *more) == []


def test_errors_of_inputs_are_marked_as_english(tmp_path):
    error = "scan.ply: expected 1000 points, found 50; export it again"
    text = indexed(tmp_path, "zh", (error, *REASONS))
    assert f'lang="en">{error}</td>' in text
    assert "错误信息与命令行一致" in text
    assert text.count('lang="en"') == 1
    assert "错误信息与命令行一致" not in indexed(tmp_path, "zh")


# --- a comparison ---------------------------------------------------------------------------------------------------


def test_a_comparison_in_chinese():
    share = {"core_points": 10, "without_lod": 2, "significant": 3, "significant_share": 0.375, "mean": -0.1,
             "significant_share_ci95": [0.1, 0.6], "median": 1e-5, "sd": 0.2, "min": None, "max": 1.0,
             "lod95_median": 0.01}  # fmt: skip
    inputs = {name: {"file": f"{file}.ply"} for name, file in (("reference", "前"), ("compared", "后"))}
    for unit in ("mm", "that of the files, which do not say it"):
        for known in (2, 10):
            record = {"summary": {**share, "without_lod": known}, "unit": unit, "inputs": inputs}
            record["normals_note"] = compare.turned_note(Turned(np.empty((0, 3)), 1, 2, 3, 4, 2))
            record["unit_note"] = compare.unit_note(
                {"reference": "m", "compared": "", "core": ""}, dict.fromkeys(compare.CLOUDS, "a.ply")
            )
            drawn = [("Deviations; the outermost bars hold all beyond", b"")]
            seen = Visible(comparison._page(record, drawn, "zh"))
            assert seen.lang == "zh"
            assert "由 前.ply 至 后.ply" in seen.texts
            assert [one for one in latin(seen.texts) if "ply" not in one] == []


# --- nights ---------------------------------------------------------------------------------------------------------


def change(kind, size, is_ratio=True, unit="mm", cases=3, name=("spheres", "ray", "radii, bias")):
    return changes.Change(name, kind, "paired", size, is_ratio, unit, 0.001, cases)


CHANGES = (
    change("regression", 0.2), change("improvement", -0.2), change("changed", 0.1, False),
    change("regression", -1.0, False), change("regression", 3.0, False, "%"), change("improvement", -3.0, False, "%"),
    change("improvement", -3.0, False, ""), change("regression", 3.0, False, ""),
    change("lost", float("inf"), False, cases=1), change("lost", float("inf"), False, cases=2),
)  # fmt: skip


def a_night(failed=1, missed=2, found=CHANGES, **more):
    cells = tuple({"failed": "x" if i < failed else ""} for i in range(3))
    figure = nights_summary.Figure("spheres", "ray", "radii, bias", 1.0, 0.5, "mm")
    of = changes.Found(found, 12, 3, 4, **more)
    return nights_summary.Summary(
        "2026-11-21", validation_nights.SOFTWARE, cells, {"a": [figure] * missed} if missed else {}, of
    )


@pytest.mark.parametrize(
    "told",
    [
        *(a_night(found=(one,)) for one in CHANGES),
        a_night(),
        a_night(0, 0, (), first=True),
        a_night(2, 1, (), moved_scenes=2),
        a_night(2, 0, CHANGES[:1]),
    ],
)
def test_the_line_of_a_night_in_chinese(told):
    said = language.language("zh").say(told.line)
    assert latin([said.replace("ray", "").replace("c0ffeec0", "")]) == []


def two_nights(out, lang):
    stored = {figure["name"] for case in validation_nights.Simulated(1).cases for figure in case["figures"]}
    figures_of = {name: (0.5, 0.2 if "bias" in name else None, "mm") for name in stored}
    figures_of |= dict.fromkeys((*STITCH_CHECKS, *DEFECT_CHECKS), (1.0, None, "mm"))
    rays = '[scan]\nmode = "rays"\nscanner = "phase"\nstep_mrad = 1.5\n'
    cases = (
        validation_nights.case(),
        validation_nights.case("scan", text=rays),
        validation_nights.case(steps=("defects",), methods=("default",)),
    )
    asked = validation_nights.matrix(*cases)
    for day in ("2026-11-20", "2026-11-21"):
        runner = validation_nights.runner(lambda cell: dict(figures_of))
        night.run(asked, out, day, runner, made_by=validation_nights.SOFTWARE, lang=lang)


def test_pages_of_nights_in_chinese(tmp_path):
    two_nights(tmp_path, "zh")
    more = {"ray", "phase", "mrad", "steel", "numpy", "ISO", "Holm", "sqrt", "cal", "Cramer", "Rao",
            "c0ffee", "check", "rms"}  # fmt: skip
    for name in ("nights.html", "certificate.html"):
        text = (tmp_path / name).read_text("utf-8")
        text = re.sub(r"<code>[0-9a-f]+</code>|c0ffee\w*", "", text)
        assert left_in_english(text, *more) == []
    assert 'lang="zh"' in (tmp_path / "nights/2026-11-20/certificate.html").read_text("utf-8")
