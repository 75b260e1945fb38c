"""Recipes of one part alone: scanned, and processed to a result that agrees with the truth."""

import numpy as np
import pytest

import designgen
from designgen import recipe_files
from designgen.scanning import scanner
from designgen.scenes import make
from processor.defects import step as defects_step
from processor.deviation import step as deviation_step
from processor.model import UsageError


def test_balls_alone_and_in_a_row_with_members_between_them():
    scene, truth = designgen.make("bolt-ball", settings={"scan.step_mrad": 8.0})
    assert truth.frame.radii.tolist() == [60.0]
    positions = np.array([scan.T_project_scan[:3, 3] for scan in scene.scans])
    assert np.ptp(positions[:, :2], axis=0).max() > 1000.0, "stations below it stand apart"
    settings = {"frame.nodes_x": 3, "scan.step_mrad": 8.0, "scan.stations": 1}
    scene, truth = designgen.make("bolt-ball", settings=settings)
    assert len(truth.frame.centres) == 3
    np.testing.assert_array_equal(np.stack([scene.frame.member_a, scene.frame.member_b], axis=1), [[0, 1], [1, 2]])
    with pytest.raises(UsageError, match="2 or more, or with one layer 1 or more"):
        designgen.make("bolt-ball", settings={"frame.layers": 2})


@pytest.mark.parametrize(
    ("recipe", "expected"),
    [pytest.param("arch-foot", [], marks=pytest.mark.slow), pytest.param("arch-rib", ["dent"], marks=pytest.mark.slow)],
)
def test_a_part_of_an_arch_alone(recipe, expected):
    """A foot has no place on one side of a step near its base: nothing may be taken for a movement there."""
    scene, truth = designgen.make(recipe, settings={"scan.step_mrad": 3.0})
    (name,) = scene.structure.bodies.names
    assert truth.structure.bodies.names == (name,)
    deviation = deviation_step.run(scene, deviation_step.Params(register="none"))
    assert abs(deviation.mean) < np.ptp(deviation.mean_ci95)
    found = defects_step.run(scene, defects_step.Params(), {"deviation": deviation}).defects
    # Faces that one station alone saw may be found shifted by its range offset, within their intervals and 3 sd of it.
    sure = np.abs(found.depth_max) > found.depth_ci95
    assert [str(kind) for kind, one in zip(found.defect_class, sure, strict=True) if one] == expected
    assert np.abs(found.depth_max[~sure]).max(initial=0.0) < 3.0 * scanner.preset("phase")["offset_mm"]
    if expected:
        (row,) = np.flatnonzero(sure)
        assert found.component[row] == name
        assert abs(found.depth_max[row] - 5.0) < max(0.5, found.depth_ci95[row])  # mm, of a dent of 5


def test_unknown_part_or_conflicting_keys_of_a_recipe_are_refused(tmp_path):
    recipe = recipe_files.load("arch-rib")[1]
    for settings, message in (
        ({"model.part": "rib9"}, 'model.part: expected one of foot1, .*, got "rib9"'),
        ({"model.file": "a.step"}, "expected a file, or a part in its place"),
        ({"model.part": "", "model.file": "a.step"}, "unknown key 'bridge'"),
    ):
        with pytest.raises(UsageError, match=message):
            make.make("part", recipe_files.overridden(recipe, settings))
