"""Members of frames by hand: lengths of their nodes' centres, bow and diameter of their tubes, with intervals."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from processor.deviation import step as deviation
from processor.inspection import members, step
from processor.language.messages import messages
from processor.limits import project_limits, standards
from processor.model import NORMAL_95, FrameDesign, Scene, Status, Tolerance, UsageError, Verdict
from processor.space_frame.result import Flag
from tests.support.results import ball_results

DESIGN = FrameDesign(
    ids=np.array([10, 11, 12, 13]),
    centres=ball_results.NOMINAL[:4],
    radii=np.array([45.0, 50.0, 50.0, 45.0]),
    member_a=np.array([10, 11, 10]),
    member_b=np.array([11, 13, 12]),
    tube_diameters=np.array([60.0, 60.0, 60.0]),
)


def inspected(scene=None, found=None, tolerance=None):
    found = ball_results.whole() if found is None else found
    if not len(found.tubes.bow_ci95):
        tubes = dataclasses.replace(found.tubes, bow_ci95=np.array([0.3, 0.3]))
        found = dataclasses.replace(found, tubes=tubes)
    scene = scene or Scene("frame", "space-frame", frame=DESIGN, tolerance=tolerance)
    return {one.name: one for one in members.inspect(scene, found, "default").components}


def by_id(component, id_):
    found = component.characteristics
    row = found.id.index(id_)
    names = ("nominal", "actual", "deviation", "ci95", "verdict", "reasons")
    return SimpleNamespace(**{name: getattr(found, name)[row] for name in names})


def test_a_length_is_the_distance_of_its_nodes_centres():
    length = by_id(inspected()["10-11"], "length")
    a, b = (ball_results.NOMINAL + np.nan_to_num(ball_results.MOVED))[:2]
    assert length.nominal == pytest.approx(3000.0)
    assert length.actual == pytest.approx(np.linalg.norm(b - a))
    # Centres have variances of 0.01, 0.04 and 0.09 mm2 along x, y and z; the scanner's scale is 5 ppm.
    along = (b - a) / np.linalg.norm(b - a)
    sd = np.sqrt(2.0 * along**2 @ [0.01, 0.04, 0.09] + (5e-6 * 3000.0) ** 2)
    assert length.ci95 == pytest.approx(NORMAL_95 * sd, rel=1e-3)  # second order: centres of 0.3 mm, 3 m apart


def test_lengths_do_not_depend_on_where_the_frame_lies():
    R = Rotation.from_rotvec([0.2, -0.7, 1.1]).as_matrix()
    before, after = inspected(), inspected(found=ball_results.whole(T=ball_results.pose(R, (5e5, -2e5, 30.0))))
    for name, one in before.items():
        length = by_id(one, "length").deviation
        assert by_id(after[name], "length").deviation == pytest.approx(length, abs=1e-6, nan_ok=True)  # float64


def test_lengths_are_those_at_the_reference_temperature():
    scene = Scene("frame", "space-frame", frame=DESIGN, temperature_C=45.0)
    warm, plain = (by_id(inspected(s)["10-11"], "length") for s in (scene, None))
    # The length is 8 mm off its 3 m: 0.3 %.
    assert warm.actual - plain.actual == pytest.approx(-3000.0 * 12e-6 * 25.0, rel=0.004)


def test_tubes_have_diameter_and_bow():
    member = inspected()["10-11"]
    diameter, bow = by_id(member, "diameter"), by_id(member, "bow")
    assert (diameter.nominal, diameter.actual) == (60.0, pytest.approx(60.0))
    assert diameter.ci95 == pytest.approx(0.4)  # twice that of the radius
    assert (bow.deviation, bow.ci95) == (0.5, pytest.approx(0.3))


def test_unseen_members_have_a_reason():
    found = inspected()
    missing = found["10-12"]  # node 12 was not found, and no tube leads to it
    assert missing.status is Status.FAILED
    assert [one.code for one in by_id(missing, "length").reasons] == ["inspect.node-not-seen"]
    assert [one.code for one in by_id(found["11-13"], "bow").reasons] == ["inspect.tube-not-seen"]
    assert np.isfinite(by_id(found["11-13"], "length").deviation)


@pytest.mark.parametrize(
    ("limit", "matching", "verdict"),
    [(1.0, "ok", "pass"), (0.6, "ok", "indeterminate"), (0.15, "ok", "fail"), (9.0, "ambiguous", "indeterminate")],
)
def test_bow_is_judged_by_the_limit_of_the_project_where_no_other_pose_fits_as_well(limit, matching, verdict):
    tolerance = project_limits.override(Tolerance(), {"part_bow_mm": np.array([-limit, limit])}, "project.toml")
    found = inspected(found=ball_results.whole(matching=matching), tolerance=tolerance)
    assert by_id(found["10-11"], "bow").verdict == verdict


def test_the_step_runs_with_spheres():
    scene = Scene("frame", "space-frame", frame=DESIGN)
    assert step.applies(scene)
    assert step.needed(scene) == ("spheres",)
    result = step.run(scene, step.Params(), {})
    assert [one.code for one in result.reasons] == ["inspect.no-tubes"]


def test_deviation_of_a_frame_needs_spheres():
    with pytest.raises(UsageError, match="spheres"):
        deviation.run(Scene("frame", "space-frame", frame=DESIGN), deviation.Params(), {})


@pytest.mark.parametrize(
    ("flag", "verdict"),
    [("ok", Verdict.PASS), ("low-confidence", Verdict.INDETERMINATE), ("wrong-size", Verdict.INDETERMINATE)],
)
def test_length_to_a_flagged_sphere_is_indeterminate(flag, verdict):
    tolerance = project_limits.override(Tolerance(), {"part_length_mm": np.array([-99.0, 99.0])}, "project.toml")
    found = ball_results.whole()
    flags = (Flag(flag), Flag.OK, *found.balls.flag[2:])
    found = dataclasses.replace(found, balls=dataclasses.replace(found.balls, flag=flags))
    length = by_id(inspected(found=found, tolerance=tolerance)["10-11"], "length")
    assert length.verdict is verdict
    assert [one.code for one in length.reasons] == ([] if flag == "ok" else ["inspect.node-flagged"])
    assert str(messages("zh").text(length.reasons)) != str(messages("en").text(length.reasons)) or flag == "ok"


def test_the_step_is_partial_if_a_member_was_not_seen_and_failed_if_none_was():
    found = ball_results.whole()
    scene = Scene("frame", "space-frame", frame=DESIGN)
    assert members.inspect(scene, found, "default").status is Status.PARTIAL  # node 12 was not found
    hidden = dataclasses.replace(found.balls, evidence=("axes",) * len(found.balls))
    nowhere = dataclasses.replace(found.tubes, a=np.full(len(found.tubes), -1))
    result = members.inspect(scene, dataclasses.replace(found, balls=hidden, tubes=nowhere), "default")
    assert (result.status, result.reasons[0].code) == (Status.FAILED, "inspect.none-seen")


def test_alignment_is_the_difference_of_both_ends_square_to_the_member():
    """Member 10-11 lies along x: of the difference (-3, -4, -12) of its nodes' movements 4 and 12 mm count."""
    whole = ball_results.whole()
    sure = dataclasses.replace(whole, balls=dataclasses.replace(whole.balls, flag=(Flag.OK,) * len(whole.balls)))
    found = inspected(found=sure, tolerance=standards.load("AISC 303"))["10-11"]
    alignment = by_id(found, "alignment")
    assert alignment.actual == pytest.approx(np.hypot(4.0, 12.0))
    row = found.characteristics.id.index("alignment")
    # 1/500 of 3000 mm
    assert (found.characteristics.upper[row], alignment.verdict) == (pytest.approx(6.0), Verdict.FAIL)
    assert found.characteristics.clause[row] == "AISC 303 7.13.1.1"
    assert by_id(inspected(tolerance=standards.load("AISC 303"))["10-11"], "alignment").verdict is Verdict.INDETERMINATE


def test_alignment_of_a_node_without_a_movement_is_not_known():
    unknown = by_id(inspected()["10-12"], "alignment")
    assert np.isnan(unknown.actual)
    assert unknown.reasons[0].code == "inspect.node-not-moved"
