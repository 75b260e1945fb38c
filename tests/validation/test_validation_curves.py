"""Curves of the history: scenes that differ in one setting alone, pooled, and detection by size."""

import json

import pytest

from processor.validation import curves, night
from processor.validation.curves import Axis, CurveKind
from processor.validation.history import Row
from tests.support.results import validation_nights

NIGHT = "2026-11-20"
NOISE, SPACING = "scan.sigma_mm", "scan.spacing_mm"


def row(case, seed, quantity, statistic, value, unit="mm", night=NIGHT, method="ray", step="spheres"):
    return Row(
        night, case, "frame", seed, True, "0", (step, method, f"{quantity} {statistic}"), value, unit,
        quantity, statistic,
    )  # fmt: skip


def test_an_error_against_noise_is_the_median_over_the_scenes_of_the_last_night():
    cases = {f"c{noise}": ("frame", (f"{NOISE}={noise}", f"{SPACING}=5")) for noise in (2, 1, 4)}
    rows = [
        row(f"c{noise}", seed, "centres", "rms", noise * (1.0 + 0.1 * seed))
        for noise in (1, 2, 4)
        for seed in (0, 1, 5)
    ]
    # The same scene of the night before is replaced; a night of other software is left out.
    old = [row("c1", seed, "centres", "rms", 99.0, night=day) for seed, day in ((0, "2026-11-19"), (7, "2020-01-01"))]
    (found,) = curves.of_history([*old, *rows], {NIGHT, "2026-11-19"}, cases)
    assert (found.shown, found.axis, found.key, found.others) == (CurveKind.ERROR, Axis.NOISE, NOISE, (f"{SPACING}=5",))
    assert found.places == (1.0, 2.0, 4.0)
    assert found.values == pytest.approx((1.1, 2.2, 4.4))
    assert found.scenes == (3, 3, 3)


def test_scenes_that_differ_in_two_settings_are_no_curve():
    cases = {"a": ("frame", (f"{NOISE}=1", f"{SPACING}=5")), "b": ("frame", (f"{NOISE}=2", f"{SPACING}=10"))}
    rows = [row(case, 0, "centres", "rms", 1.0) for case in cases]
    assert curves.of_history(rows, {NIGHT}, cases) == []
    other = {"a": ("frame", (f"{NOISE}=1",)), "b": ("arch", (f"{NOISE}=2",))}
    assert curves.of_history(rows, {NIGHT}, other) == []


def test_coverage_is_that_of_all_errors_together():
    cases = {"a": ("frame", (f"{SPACING}=5",)), "b": ("frame", (f"{SPACING}=10",))}
    rows = []
    for case, shares in (("a", ((100.0, 10), (50.0, 90))), ("b", ((95.0, 40), (90.0, 40)))):
        for seed, (share, number) in enumerate(shares):
            rows += [
                row(case, seed, "centres", "coverage", share, "%"),
                row(case, seed, "centres", "number", number, ""),
            ]
    (found,) = curves.of_history(rows, {NIGHT}, cases)
    assert (found.shown, found.axis) == (CurveKind.COVERAGE, Axis.DENSITY)
    assert found.values == pytest.approx((55.0, 92.5))
    assert found.items == (100, 80)


def test_detection_is_by_size_over_all_scenes_of_a_recipe():
    rows = []
    for seed, (share, number) in enumerate(((0.0, 1), (100.0, 3))):
        rows.append(row("a", seed, "found of depth 0.5 to 1 mm", "share", share, "%", step="defects"))
        rows.append(row("a", seed, "found of depth 0.5 to 1 mm", "number", number, "", step="defects"))
    rows.append(row("a", 0, "found of diameter 100 to 200 mm", "share", 50.0, "%", step="defects"))
    rows.append(row("a", 0, "found of diameter 100 to 200 mm", "number", 2, "", step="defects"))
    depth, diameter = curves.of_history(rows, {NIGHT}, {"a": ("plates", ())})
    assert (depth.axis, diameter.axis) == (Axis.DEPTH, Axis.DIAMETER)
    assert depth.places == pytest.approx((0.5**0.5,))
    assert (depth.values, depth.items) == ((75.0,), (4,))
    assert diameter.values == (50.0,)


def test_a_night_writes_its_curves(tmp_path):
    asked = validation_nights.matrix(
        *(validation_nights.case(settings=(f"{NOISE}={noise}",)) for noise in (1.0, 2.0)), seeds=(1, 2), fresh=0
    )

    def of_cell(cell):
        noise = float(cell.case.settings[0].split("=")[1])
        return {"centres, rms": 0.1 * noise, "centres within their 95 % intervals": (96.0, None, "%"),
                "centres, number": 10.0}  # fmt: skip

    with night.locked_output(tmp_path / "out"):
        runner = validation_nights.runner(of_cell)
        night.run(asked, tmp_path / "out", NIGHT, runner, made_by=validation_nights.SOFTWARE, lang="zh")
    content = json.loads((tmp_path / "out" / "curves.json").read_text("utf-8"))
    error, coverage = content["curves"]
    assert (error["shown"], error["places"], error["values"]) == ("error", [1.0, 2.0], pytest.approx([0.1, 0.2]))
    assert (coverage["values"], coverage["items"]) == ([96.0, 96.0], [20, 20])
    page = (tmp_path / "out" / "curves.html").read_text("utf-8")
    assert page.count("data:image/png;base64,") == 2
    assert "误差随噪声的变化" in page
    assert 'href="curves.html"' in (tmp_path / "out" / "nights.html").read_text("utf-8")
