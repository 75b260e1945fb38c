"""Limits as data: content of the files, limits of a project, and messages on mistakes."""

import dataclasses
import math

import numpy as np
import pytest

from processor.clouds import scan_folder
from processor.inspection.result import Quantity
from processor.limits import limit_bounds, measurands, standards
from processor.model import MEASURES, InputError, Limit, Scan, Scene, Tolerance
from processor.model.scene import LIMITED_SIZES
from processor.preassembly.verdicts import chain, joints
from processor.scan_folder import folder
from processor.space_frame import supports_and_deflections
from processor.space_frame.spheres import assessment
from processor.stitching import verdicts as network
from processor.store import store


def limit(standard, key):
    return standards.find(standards.load(standard), key)


def write_project(place, text):
    np.savetxt(place / "scan.xyz", np.random.default_rng(0).uniform(size=(5, 3)))
    (place / "project.toml").write_text(text)
    return place


def test_every_limit_has_a_meaning_source_and_measure():
    assert len(standards.standards()) >= 6
    for name, standard in standards.standards().items():
        keys = [row.key for row in standard.limits]
        assert len(set(keys)) == len(keys), name
        for row in standard.limits:
            assert row.what, row.key
            assert row.source, row.key
            assert row.key.endswith({"mm": "_mm", "arcmin": "_arcmin", "deg": "_deg", "1": "_ratio"}[row.unit])
            assert (row.rule in ("smaller", "sum")) == (not math.isnan(row.high_ratio) and not math.isnan(row.high)), (
                row.key
            )
            assert bool(row.of) == (not all(map(math.isnan, (row.high_ratio, row.above_mm, row.up_to_mm))))
            low, high = limit_bounds.bounds(row, dict.fromkeys(LIMITED_SIZES, 1000.0))
            assert low < high < math.inf
            assert not (row.verified and not row.clause), "a verified row has its clause"


def test_measures_are_those_that_the_steps_give():
    assert (*joints.MEASURES, *chain.MEASURES) == MEASURES["preassemble"]
    assert tuple(f"{measurands.PART}{quantity}" for quantity in Quantity) == MEASURES["inspect"]
    of_nodes = {"node_place", "ball_size", measurands.CEILING}  # compared node by node, and hanger by hanger
    assert {*supports_and_deflections.QUANTITIES, *of_nodes} == set(MEASURES["spheres"])
    assert set(network.QUANTITIES) == set(MEASURES["stitch"])


@pytest.mark.parametrize(
    ("key", "value", "like"),
    [
        ("measure", "support_hieght", "support_height"),
        ("of", "lenght", "length"),
        ("rule", "smaler", "smaller"),
    ],
)
def test_a_limit_of_what_no_step_gives_is_refused_with_the_nearest_name(tmp_path, monkeypatch, key, value, like):
    row = {"key": "twist_mm", "what": "twist", "high": 3.0, "of": "length", "measure": "part twist", "source": "x"}
    content = {"standard": "S 1", "edition": "1", "limit": [{**row, key: value}]}
    monkeypatch.setattr(standards, "files", lambda: iter([content]))
    said = f"limits of S 1: limits.0000.{key}: expected one of .*found '{value}' \\(did you mean '{like}'"
    with pytest.raises(InputError, match=said):
        standards.standards.__wrapped__()
    scene = Scene(
        "s", "structure", (Scan("s", np.eye(3)),), tolerance=Tolerance(limits=(Limit(**{**row, key: value}),))
    )
    store.write_scene(tmp_path / "s.h5", scene, None, {})
    with pytest.raises(InputError, match=f"expected one of .*found '{value}' \\(did you mean '{like}'"):
        store.read_scene(tmp_path / "s.h5")


def test_only_limits_checked_in_print_are_verified():
    seen = {(name, row.clause) for name, one in standards.standards().items() for row in one.limits if row.verified}
    assert seen == {("GB 50205-2020", "11.3.6"), ("JGJ 7-2010", "6.11"), ("AWS D1.1", "7.22.9")}


def test_numbers_by_hand():
    assert limit_bounds.bounds(limit("GB 50205-2020", "misalignment_mm"), {}) == (-math.inf, 2.0)
    assert limit_bounds.bounds(limit("GB 50205-2020", "groove_gap_mm"), {}) == (-1.0, 2.0)
    bow = limit("GB 50205-2020", "bow_mm")  # l/1500 and 10
    assert limit_bounds.bounds(bow, {"length": 12_000.0})[1] == pytest.approx(8.0)
    assert limit_bounds.bounds(bow, {"length": 30_000.0})[1] == 10.0
    assert math.isnan(limit_bounds.bounds(bow, {})[1])
    for name, expected in (("EN 1090-2", 4.0), ("EN 1090-2 class 1", 4.0), ("EN 1090-2 class 2", 3.0)):
        # At 10 m: 10000/5000 + 2 = 4 and 10000/10000 + 2 = 3.
        bounds = limit_bounds.bounds(limit(name, "length_mm"), {"length": 10_000.0})
        assert bounds == pytest.approx((-expected, expected))
    edge = limit("JTG arch rib", "misalignment_mm")  # 0.2 t and 2
    assert limit_bounds.bounds(edge, {"thickness": 8.0})[1] == pytest.approx(1.6)
    assert limit_bounds.bounds(edge, {"thickness": 24.0})[1] == 2.0
    camber = limit("GB 50205-2020", "camber_not_specified_mm")  # +l/2000, -0
    assert limit_bounds.bounds(camber, {"length": 40_000.0}) == pytest.approx((0.0, 20.0))


def test_unknown_standard_names_those_there_are():
    with pytest.raises(InputError, match=r"'GB 50205'.*GB 50205-2020, JGJ 7-2010"):
        standards.load("GB 50205")


def test_a_projects_own_limits_win_and_go_through_the_store(tmp_path):
    text = '[tolerance]\nstandard = "GB 50205-2020"\nmisalignment_mm = 1.5\ngroove_gap_mm = [-2, 3]\nroot_gap_mm = 6\n'
    scene = folder.read_input(write_project(tmp_path, text))
    found = scene.tolerance
    own = standards.find(found, "misalignment_mm")
    assert (own.high, own.verified, own.clause, own.source) == (1.5, True, "", "project.toml")
    assert limit_bounds.bounds(standards.find(found, "groove_gap_mm"), {}) == (-2.0, 3.0)
    assert standards.find(found, "span_mm").high == 5.0
    assert len(found.limits) == len(standards.load("GB 50205-2020").limits)
    assert found.root_gap_mm == 6.0
    text = '[tolerance]\nmisalignment_mm = 1.5\nagreed_by = "A. Owner and B. Contractor, 2026-11-20"\n'
    agreed = standards.find(folder.read_input(write_project(tmp_path, text)).tolerance, "misalignment_mm")
    assert (agreed.source, agreed.clause) == ("project.toml, agreed by A. Owner and B. Contractor, 2026-11-20", "")
    assert limits_of_export(agreed) == ["misalignment_mm = 1.5", 'agreed_by = "A. Owner and B. Contractor, 2026-11-20"']
    store.write_scene(tmp_path / "s.h5", scene, None, {})
    assert store.problems(tmp_path / "s.h5") == []
    back = store.read_scene(tmp_path / "s.h5").tolerance
    assert repr(back) == repr(found)
    assert store.scene_hash(scene) != store.scene_hash(dataclasses.replace(scene, tolerance=None))


def limits_of_export(limit):
    """The lines of project.toml that an exported folder has of a limit."""
    return scan_folder._tolerance(Tolerance(limits=(limit,)))[2:]


def test_the_decision_rule_goes_through_the_store_and_leaves_other_scenes_as_they_were(tmp_path):
    before = folder.read_input(write_project(tmp_path, '[tolerance]\nstandard = "GB 50205-2020"\n'))
    scene = folder.read_input(write_project(tmp_path, '[tolerance]\nrule = "risk"\nrisk = 0.1\n'))
    assert (scene.tolerance.decision, scene.tolerance.largest_risk) == ("risk", 0.1)
    assert (before.tolerance.decision, before.tolerance.largest_risk) == ("guarded", 0.05)
    assert scene.tolerance.limits == before.tolerance.limits  # no limits of its own: those of the default standard
    assert store.scene_hash(scene) != store.scene_hash(before)
    unstated = dataclasses.replace(scene.tolerance, rule=None, risk=None)
    assert store.scene_hash(dataclasses.replace(scene, tolerance=unstated)) == store.scene_hash(before)
    store.write_scene(tmp_path / "s.h5", scene, None, {})
    assert repr(store.read_scene(tmp_path / "s.h5").tolerance) == repr(scene.tolerance)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('rule = "shared"', "expected one of simple, guarded, risk"),
        ("risk = 0.1", 'add rule = "risk"'),
        ('rule = "guarded"\nrisk = 0.1', 'add rule = "risk"'),
        ('rule = "risk"\nrisk = 0.5', "below 0.5"),
    ],
)
def test_a_decision_rule_that_is_none_is_refused(tmp_path, text, said):
    with pytest.raises(InputError, match=said):
        folder.read_input(write_project(tmp_path, f"[tolerance]\n{text}\n"))


def test_project_without_a_standard_has_its_own_limits_alone(tmp_path):
    scene = folder.read_input(write_project(tmp_path, "[tolerance]\nsplice_eccentricity_mm = 4.0\n"))
    assert [row.key for row in scene.tolerance.limits] == ["splice_eccentricity_mm"]
    assert limit_bounds.bounds(scene.tolerance.limits[0], {}) == (-math.inf, 4.0)


def test_project_may_set_a_limit_that_no_standard_has(tmp_path):
    for name in standards.standards():
        assert standards.find(standards.load(name), measurands.NODE_PLACE) is None
    for text in ("", 'standard = "JGJ 7-2010"\n'):
        scene = folder.read_input(write_project(tmp_path, f"[tolerance]\n{text}node_place_mm = 15\n"))
        own = standards.find(scene.tolerance, measurands.NODE_PLACE)
        assert (own.high, own.verified, own.source) == (15.0, True, "project.toml")


def test_empty_tolerance_table_gives_no_limits(tmp_path):
    assert folder.read_input(write_project(tmp_path, "[tolerance]\n")).tolerance is None
    assert standards.default_for(None).standard == "GB 50205-2020"
    empty = Scene("e", "structure", (Scan("s", np.eye(3)),), tolerance=Tolerance())
    store.write_scene(tmp_path / "e.h5", empty, None, {})
    assert store.read_scene(tmp_path / "e.h5").tolerance == Tolerance()


def test_blank_tolerances_of_balls_follow_their_diameters():
    # Half of +2/-1 up to a diameter of 120 and of +3/-1.5 above.
    gb = standards.load("GB 50205-2020")
    for limits in (gb, Tolerance(), standards.load("JGJ 7-2010")):
        assert assessment.blank_tolerance(60.0, limits) == (0.5, 1.0)
        assert assessment.blank_tolerance(60.001, limits) == (0.75, 1.5)
    own = Tolerance(limits=(Limit("ball_blank_diameter_small_mm", "x", low=-4.0, high=6.0, up_to_mm=120.0),))
    assert assessment.blank_tolerance(50.0, own) == (2.0, 3.0)
    assert assessment.blank_tolerance(75.0, own) == (0.75, 1.5)
