"""A whole ray-cast roof by method ray: blind, with its design, with one of another frame or of other nodes."""

import dataclasses

import numpy as np
import pytest

from designgen import recipes
from designgen.scene import make
from processor.bolt_balls import answer, threads
from processor.bolt_balls.scene_source import of_scene
from processor.geometry import rigid
from processor.steps import spheres

ROOF = ["frame.nodes_x=6", "frame.nodes_y=5", "scan.stations=[2,2]", "scan.clutter=6", "scan.step_mrad=2.2"]


@pytest.fixture(scope="module")
def roof():
    return make("roof", recipes.overridden(recipes.load("frame-1040")[1], ROOF), 3)


def errors(result, truth, rows=slice(None)):
    """Distances (k,) of the balls of the design's nodes, in its order, from the true ones."""
    return np.linalg.norm(result.centres[rows] - truth.frame.centres[rows], axis=1)


def test_every_ball_is_found_blind(roof):
    scene, truth = roof
    result = spheres.run(dataclasses.replace(scene, frame=None), spheres.Params())
    assert result.status == "ok"
    assert len(result.ids) == len(truth.frame.ids)
    checks = {metric.name: metric for metric in spheres.check(dataclasses.replace(scene, frame=None), result, truth)}
    assert all(metric.passed for metric in checks.values())
    assert checks["nodes found within 3 mm"].value == 100.0
    assert checks["nodes that are none"].value == 0.0
    assert 0.7 < checks["centres, rms of error by standard deviation"].value < 1.3


def test_rows_are_the_designs_nodes_in_its_order(roof):
    scene, truth = roof
    result = spheres.run(scene, spheres.Params())
    assert result.ids.tolist() == scene.frame.ids.tolist()
    assert result.gauge == "design frame"
    assert errors(result, truth).max() < 1.5
    true = truth.frame.centres - scene.frame.centres
    pull = (result.movement - true) / (result.movement_ci95 / 1.96)
    assert 0.7 < np.sqrt(np.mean(pull**2)) < 1.3


def test_a_design_of_another_frame_is_found(roof):
    scene, truth = roof
    R, t = rigid.rotation_from_vector(np.array([0.02, -0.01, 0.7])), np.array([5.0e8, 4.3e9, 1e3])
    moved = dataclasses.replace(scene.frame, centres=scene.frame.centres @ R.T + t)
    result = spheres.run(dataclasses.replace(scene, frame=moved), spheres.Params())
    assert result.matching == "ok"
    assert result.gauge == "best fit"
    assert errors(result, truth).max() < 1.5
    turn = result.T_design_scan[:3, :3] @ R.T
    assert np.degrees(rigid.rotation_angle(turn)) < 0.1  # nodes move by 5 mm over 12 m
    back = rigid.apply(result.T_design_scan, result.centres) - moved.centres
    assert np.linalg.norm(back, axis=1).max() < 30.0


def test_a_node_that_was_not_built_is_not_found_and_one_that_was_not_designed_is_told(roof):
    scene, truth = roof
    frame = scene.frame
    centres, ids = frame.centres.copy(), frame.ids.copy()
    centres[7] += [0.0, 0.0, -900.0]  # nothing is there
    own = (frame.member_a != frame.ids[7]) & (frame.member_b != frame.ids[7])
    other = dataclasses.replace(
        frame,
        centres=centres,
        ids=ids,
        member_a=frame.member_a[own],
        member_b=frame.member_b[own],
        tube_diameters=frame.tube_diameters[own],
    )
    result = spheres.run(dataclasses.replace(scene, frame=other), spheres.Params())
    assert result.flag[7] == "not-found"
    assert np.isnan(result.centres[7]).all()
    rest = np.arange(len(ids)) != 7
    assert errors(result, truth, rest).max() < 1.5
    assert result.status == "partial"


def test_a_ball_of_another_size_is_named(roof):
    scene, _ = roof
    radii = scene.frame.radii.copy()
    radii[3] += 10.0
    result = spheres.run(
        dataclasses.replace(scene, frame=dataclasses.replace(scene.frame, radii=radii)), spheres.Params()
    )
    assert [i for i, flag in enumerate(result.flag) if flag == "wrong-size"] == [3]


@pytest.mark.parametrize(("chunk", "threads_used"), [(1 << 20, 2), (70_001, 1), (12_345, 3)])
def test_order_chunks_and_threads_give_the_same_bytes(roof, chunk, threads_used, monkeypatch):
    scene, _ = roof
    first = spheres.run(scene, spheres.Params())
    monkeypatch.setattr(threads, "usable", lambda: threads_used)
    monkeypatch.setattr(answer, "of_scene", lambda *given: dataclasses.replace(of_scene(*given), chunk_size=chunk))
    rng = np.random.default_rng(1)
    scans = []
    for scan in scene.scans:
        order = rng.permutation(len(scan.points))
        columns = {name: getattr(scan, name) for name in ("points", "intensity", "grid_row", "grid_column")}
        scans.append(dataclasses.replace(scan, **{k: v[order] if len(v) else v for k, v in columns.items()}))
    again = spheres.run(dataclasses.replace(scene, scans=tuple(scans)), spheres.Params())
    for field in dataclasses.fields(first):
        one, other = getattr(first, field.name), getattr(again, field.name)
        same = one.tobytes() == other.tobytes() if isinstance(one, np.ndarray) else repr(one) == repr(other)
        assert same, field.name
