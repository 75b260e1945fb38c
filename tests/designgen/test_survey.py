"""Where stations stand: the same places however many they are, and all sides seen."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from designgen import low_discrepancy, recipe_files
from designgen.designs import structure_registry
from designgen.randomness import generator
from designgen.scanning import scanner, survey
from designgen.scanning.surfaces import Builder
from designgen.scanning.surroundings import Box
from designgen.scenes import make, structure
from processor.model import UsageError

AXES = np.eye(3)
HALF = np.array([2200.0, 450.0, 550.0])


def test_sequences_by_hand():
    assert [low_discrepancy.van_der_corput(i) for i in range(8)] == [0.0, 0.5, 0.25, 0.75, 0.125, 0.625, 0.375, 0.875]
    np.testing.assert_allclose(low_discrepancy.in_square(0), [0.5, 0.5])
    # As many digits by hand.
    np.testing.assert_allclose(low_discrepancy.in_square(1), [0.25487767, 0.06984029], atol=1e-8)
    np.testing.assert_allclose([np.linalg.norm(low_discrepancy.on_sphere(i)) for i in range(20)], 1.0)


@pytest.mark.parametrize("count", [1, 8])
def test_a_station_more_leaves_the_others_where_they_are(count):
    low, high = np.array([0.0, 0.0, 6000.0]), np.array([30_000.0, 20_000.0, 8000.0])

    def places(n):
        params = scanner.Params(stations=(n,))
        found = [
            survey.stations_below_box(low, high, params, 3),
            survey.stations_around_box(Box(AXES, low, HALF), params, 3, "p/"),
        ]
        for name in ("stadium-roof", "truss-bridge", "plates-defects"):
            recipe = recipe_files.load(name)[1]
            components = structure_registry.design(recipe)
            patches = structure.built_faces(recipe["structure"]["type"], components, recipe, 1).patches
            found.append(structure._places(recipe["structure"]["type"], patches, params, 3))
        return found

    for few, more in zip(places(count), places(count + 1), strict=True):
        assert list(few) == list(more)[: len(few)]
        np.testing.assert_array_equal(list(few.values()), list(more.values())[: len(few)])


def test_a_registered_pose_is_off_by_a_turn_about_its_station_in_mrad_and_a_shift_in_mm():
    T = survey.levelled_pose(np.array([3e4, -2e4, 1500.0]), 0.7)
    params = scanner.Params(step_mrad=50.0, registration_mrad=2.0, registration_mm=3.0)
    builder = Builder()
    builder.sphere(-1, "ball", T[:3, 3] + 4000.0, 500.0, [])
    (found,) = survey.survey(builder.to_surfaces(), (), {"S1": T}, scanner.Scanner(), params, 5).registered
    turn, shift = generator(5, "registration S1").standard_normal((2, 3))  # as drawn, in standard deviations
    np.testing.assert_allclose(found[:3, :3], Rotation.from_rotvec(2e-3 * turn).as_matrix() @ T[:3, :3], atol=1e-12)
    np.testing.assert_allclose(found[:3, 3], T[:3, 3] + 3.0 * shift, atol=1e-9)  # float64 at 30 m


def test_stations_stand_within_their_area():
    low, high = np.array([0.0, 0.0, 6000.0]), np.array([30_000.0, 20_000.0, 8000.0])
    at = np.array([T[:2, 3] for T in survey.stations_below_box(low, high, scanner.Params(stations=(12,)), 3).values()])
    assert (at >= low[:2]).all()
    assert (at <= high[:2]).all()
    quarters = (at > high[:2] / 2.0) @ [1, 2]
    assert (np.bincount(quarters, minlength=4) >= 2).all()
    near = np.linalg.norm(at[:, None] - at, axis=2) + 1e9 * np.eye(12)
    assert near.min() > 2000.0  # 600 m2 for 12: 7 m apart were a grid's
    grid = survey.stations_below_box(low, high, scanner.Params(stations=(2, 3)), 3)
    cells = [(int(T[0, 3] // 15_000.0), int(T[1, 3] // (20_000.0 / 3.0))) for T in grid.values()]
    assert cells == [(i, j) for i in range(2) for j in range(3)]


def seen_shares(places, half):
    """Share of each face of a box that is seen within 60 degrees of its normal from one of some places at least."""
    x = np.linspace(-0.975, 0.975, 40)
    shares = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            points = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
            points = np.insert(points, axis, sign, axis=1) * half
            view = places[None] - points[:, None]
            cosine = sign * view[:, :, axis] / np.linalg.norm(view, axis=2)
            shares.append((cosine > 0.5).any(axis=1).mean())
    return np.array(shares)


@pytest.mark.parametrize("half", [HALF, [6000.0, 700.0, 900.0]])
@pytest.mark.parametrize("count", [4, 6, 8, 12])
def test_all_sides_are_seen_as_well_as_from_evenly_spread_places(count, half):
    half = np.array(half)
    places = np.array([low_discrepancy.on_sphere(i) for i in range(count)]) * (half + 4000.0)
    k = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    level = np.sqrt(1.0 - height**2)
    even = np.stack([height, level * np.cos(turn), level * np.sin(turn)], axis=1) * (half + 4000.0)
    found, usual = seen_shares(places, half), seen_shares(even, half)
    assert found.mean() > usual.mean() - 0.03
    assert found.min() > 0.25
    assert seen_shares(places[:2], half)[:2].min() > 0.9  # the first two see both ends


def test_a_station_more_leaves_the_scans_of_the_others():
    settings = ["frame.nodes_x=3", "frame.nodes_y=3", "scan.mode=rays", "scan.step_mrad=16", "scan.clutter=3"]
    table = {key: value for key, value in recipe_files.load("frame-small")[1].items() if key != "scan"}
    table["asbuilt"] = {"node_movement_mm": 3.0}

    def made(count):
        return make.make("x", recipe_files.overridden(table, [*settings, f"scan.stations={count}"]))

    (few, few_truth), (more, more_truth) = made(3), made(4)
    assert [scan.name for scan in more.scans] == ["S1", "S2", "S3", "S4"]
    for one, other in zip([*few.scans, *few_truth.labels], [*more.scans[:3], *more_truth.labels[:3]], strict=True):
        for field in dataclasses.fields(one):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))


@pytest.mark.parametrize(
    ("name", "setting", "said"),
    [
        *(("arch-s1-rays", f"scan.{setting}", "not used for kind arch-bridge; there are mode, scanner, step_mrad")
          for setting in ("origin_mm=[1.0,2.0,3.0]", "merged=true", "registered=false", "repeated=1",
                          "scans_at_first=3", "height_mm=1000.0")),
        *(("frame-as-built", f"scan.{setting}", "not used for kind space-frame; there are")
          for setting in ("distance_mm=1000.0", "registered=false", "repeated=1", "scans_at_first=3")),
        ("stadium-roof", "scan.inner_depth_mm=5.0", "not used for kind stadium-roof"),
        ("frame-small", "scan.inner_depth_mm=5.0", "not used for kind space-frame; there are mode, spacing_mm"),
        ("arch-s1", "scan.member_reach_mm=5.0", "not used for kind arch-bridge"),
        ("truss-bridge", "scan.merged=true", "expected false with registered = false"),
        ("truss-bridge", "scan.repeated=7", "expected no more than the 6 stations, got 7"),
    ],
)  # fmt: skip
def test_keys_that_a_kind_does_not_use_are_refused(name, setting, said):
    key = setting.partition("=")[0]
    with pytest.raises(UsageError) as refused:
        make.make("x", recipe_files.overridden(recipe_files.load(name)[1], [setting]))
    assert str(refused.value).startswith(f"{key}: ")
    assert said in str(refused.value)
    assert f" {key.removeprefix('scan.')}," not in str(refused.value).partition("there are")[2] + ","


def poles_of(monkeypatch, name, settings):
    """The poles (start, axis, radius, length) that a scene has, and the positions of its stations."""
    poles = []
    cone = Builder.cone

    def noting(builder, part, surface, start, axis, radii, length, *rest):
        if surface == "pole":
            assert part == -1
            poles.append((start, axis, radii[0], length))
        cone(builder, part, surface, start, axis, radii, length, *rest)

    monkeypatch.setattr(Builder, "cone", noting)
    made, truth = make.make("x", recipe_files.overridden(recipe_files.load(name)[1], settings))
    return made, truth, poles


def test_poles_stand_between_stations_and_a_structure(monkeypatch):
    settings = ["scan.step_mrad=6", "scan.stations=2", "scan.clutter=5", 'structure.components=["none", "dent"]']
    made, truth, poles = poles_of(monkeypatch, "plates-defects", settings)
    assert len(poles) == 5
    places = truth.stations.T_project_station[:, :3, 3]
    for i, (start, axis, _, length) in enumerate(poles):
        np.testing.assert_array_equal(axis, [0.0, 0.0, 1.0])
        assert start[2] == 0.0
        assert places[i % 2, 1] < start[1] < -500.0  # before the plates' fronts, which are at y = 0
        assert 1500.0 < length < 3500.0
    pole = truth.labels[0].surface_names.index("pole")
    hits = np.concatenate([(label.surface == pole).nonzero()[0] for label in truth.labels])
    assert len(hits) > 50
    for scan, label in zip(made.scans, truth.labels, strict=True):
        T, own = scan.T_project_scan, (label.surface == pole) & (label.source == 0)
        points = scan.points[own] @ T[:3, :3].T + T[:3, 3]
        off = [np.linalg.norm(points[:, :2] - start[:2], axis=1) - radius for start, _, radius, _ in poles]
        assert np.abs(off).min(axis=0).max(initial=0.0) < 20.0  # ranges of 2 mm and more along the pole


def test_more_poles_than_stations_go_round_them(monkeypatch):
    settings = ["scan.step_mrad=45", "scan.stations=2", "scan.clutter=5"]
    _, _, poles = poles_of(monkeypatch, "arch-s1-rays", settings)
    assert len(poles) == 5 * 5
    assert all(length == 2000.0 for _, _, _, length in poles)
    assert len({tuple(start) for start, _, _, _ in poles}) == 25
