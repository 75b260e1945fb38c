"""Results compared with a truth, and results without one."""

import dataclasses

import numpy as np
import pytest

from processor import pipeline
from processor.evaluation.evaluate import ErrorReport, evaluate
from processor.evaluation.space_frame import true_rows
from processor.model import ArchTruth, FrameDesign, FrameTruth, InputError, Scan, Scene, StepRun, Truth
from processor.space_frame import step as space_frame_step
from processor.space_frame.result import Balls
from processor.store import store
from tests.support.results.metrics import metric

NAN = float("nan")
TRUE = FrameTruth(np.array([3, 5, 8]), np.array([[0.0, 0, 0], [1000, 0, 0], [2000, 0, 0]]), np.array([45.0, 50, 60]))


def result(ids, centres, radii, method="ransac"):
    k = len(ids)
    found = Balls(
        ids=np.array(ids),
        centres=np.array(centres, np.float64).reshape(k, 3),
        radii=np.array(radii, np.float64),
        lowest=np.array(centres, np.float64).reshape(k, 3) - np.array(radii)[:, None] * [0.0, 0.0, 1.0],
        covariance=np.tile(np.eye(4), (k, 1, 1)),
        lowest_sd=np.ones(k),
        points=np.full(k, 100),
        visible_fraction=np.full(k, 0.5),
        rms=np.ones(k),
        nominal_radii=np.full(k, NAN),
        evidence=("ball",) * k,
        flag=("ok",) * k,
        reasons=((),) * k,
        verdict=("none",) * k,
    )
    return space_frame_step.Result("ok", method, balls=found)


def scene(with_design=True):
    design = FrameDesign(TRUE.ids, TRUE.centres, TRUE.radii) if with_design else None
    return Scene("f", "space-frame", (Scan("s", np.eye(3)),), frame=design)


def execution(made_of, *runs):
    return pipeline.Execution(made_of, tuple(StepRun("spheres", r.method, "{}", r) for r in runs), {})


def test_balls_with_a_design_are_matched_with_the_truth_by_id():
    found = result([8, 3, 99], [[0.0, 0, 0], [0, 0, 0], [0, 0, 0]], [1.0, 1.0, 1.0])
    np.testing.assert_array_equal(true_rows(scene(), found.balls, TRUE), [2, 0, -1])


def test_balls_without_a_design_are_matched_with_the_truth_by_position():
    found = result([3, 5, 8], [[1990.0, 0, 10], [1049, 0, 0], [500, 0, 0]], [60.0, 50.0, 45.0])
    np.testing.assert_array_equal(true_rows(scene(False), found.balls, TRUE), [2, 1, -1])
    lost = result([0], [[NAN] * 3], [NAN])
    np.testing.assert_array_equal(true_rows(scene(False), lost.balls, TRUE), [-1])
    np.testing.assert_array_equal(true_rows(scene(False), found.balls, FrameTruth()), [-1] * 3)
    assert true_rows(scene(False), result([], [], []).balls, TRUE).shape == (0,)


def test_checks_of_comparison_runs_bear_the_methods_name(tmp_path):
    store.write_scene(tmp_path / "f.h5", scene(), Truth(frame=dataclasses.replace(TRUE, lowest=TRUE.centres)), {})
    good = result(TRUE.ids, TRUE.centres, TRUE.radii)
    poor = result(TRUE.ids, TRUE.centres, TRUE.radii + 2.0, "least-squares")
    report = evaluate(tmp_path / "f.h5", execution(scene(), good, poor))
    values = {metric.name: metric.value for metric in report.metrics}
    assert values["radius error, median"] == 0.0
    assert values["least-squares: radius error, median"] == 2.0
    assert set(report.true_radii) == set(report.true_centres) == {"ransac", "least-squares"}
    np.testing.assert_array_equal(report.true_radii["ransac"], TRUE.radii)
    np.testing.assert_array_equal(report.true_centres["ransac"], TRUE.centres)
    one = evaluate(tmp_path / "f.h5", execution(scene(), result([99, 5], TRUE.centres[:2], [1.0, 1.0])))
    np.testing.assert_array_equal(one.true_radii["ransac"], [NAN, 50.0])
    np.testing.assert_array_equal(one.true_centres["ransac"], [[NAN] * 3, [1000.0, 0.0, 0.0]])
    assert len(values) == len(report.metrics)


def test_input_without_a_truth_gives_an_empty_error_report(tmp_path):
    store.write_scene(tmp_path / "f.h5", scene(), None, {})
    found = execution(scene(), result(TRUE.ids, TRUE.centres, TRUE.radii))
    assert evaluate(tmp_path / "f.h5", found) == ErrorReport()
    (tmp_path / "scans").mkdir()
    assert evaluate(tmp_path / "scans", found) == ErrorReport()


def test_the_truth_may_lie_beside_a_folder_of_scans(tmp_path):
    store.write_truth(tmp_path / "truth.h5", Truth(frame=dataclasses.replace(TRUE, lowest=TRUE.centres)))
    report = evaluate(tmp_path, execution(scene(), result(TRUE.ids, TRUE.centres, TRUE.radii)))
    assert report.metrics
    assert report.passed


def test_the_truth_of_another_scene_is_refused(tmp_path):
    from tests.support.results.bridge_results import arch_scene, assembled

    ends = np.zeros((1, 2, 8, 3))
    truth = Truth(arch=ArchTruth(("other",), np.eye(4)[None], ends, ends, np.zeros((1, 2, 5, 3))))
    store.write_truth(tmp_path / "truth.h5", truth)
    run = StepRun("preassemble", "line", "{}", assembled("line"))
    with pytest.raises(InputError, match="of another scene"):
        evaluate(tmp_path, pipeline.Execution(arch_scene(), (run,), {}))


def test_a_report_passes_when_every_limit_is_kept():
    kept, missed = metric("a", 1.0, 2.0), metric("a", 3.0, 2.0)
    unknown, free = metric("a", NAN, 2.0), metric("a", NAN)
    assert ErrorReport((kept, free)).passed
    assert not ErrorReport((kept, missed)).passed
    assert not ErrorReport((kept, unknown)).passed
