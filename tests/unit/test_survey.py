"""Where stations stand: the same places however many they are, and all sides seen."""

import dataclasses

import numpy as np
import pytest

from designgen import recipes, scanner, scene, sequences, structure_scene, survey

AXES = np.eye(3)
HALF = np.array([2200.0, 450.0, 550.0])


def test_sequences_by_hand():
    assert [sequences.van_der_corput(i) for i in range(8)] == [0.0, 0.5, 0.25, 0.75, 0.125, 0.625, 0.375, 0.875]
    np.testing.assert_allclose(sequences.in_square(0), [0.5, 0.5])
    np.testing.assert_allclose(sequences.in_square(1), [0.25487767, 0.06984029], atol=1e-8)
    np.testing.assert_allclose([np.linalg.norm(sequences.on_sphere(i)) for i in range(20)], 1.0)


@pytest.mark.parametrize("count", [1, 3, 8])
def test_a_station_more_leaves_the_others_where_they_are(count):
    low, high = np.array([0.0, 0.0, 6000.0]), np.array([30_000.0, 20_000.0, 8000.0])

    def places(n):
        params = scanner.Params(stations=(n,))
        found = [survey.below(low, high, params, 3), survey.around(AXES, low, HALF, params, 3, "p/")]
        for name in ("stadium-roof", "truss-bridge", "plates-defects"):
            recipe = recipes.load(name)[1]
            components = structure_scene.design(recipe)
            patches, _, _ = structure_scene.BUILDERS[recipe["structure"]["type"]](components, recipe, 1)
            found.append(structure_scene._places(recipe["structure"]["type"], patches, params, 3))
        return found

    for few, more in zip(places(count), places(count + 1), strict=True):
        assert list(few) == list(more)[: len(few)]
        np.testing.assert_array_equal(list(few.values()), list(more.values())[: len(few)])


def test_stations_stand_within_their_area():
    low, high = np.array([0.0, 0.0, 6000.0]), np.array([30_000.0, 20_000.0, 8000.0])
    at = np.array([T[:2, 3] for T in survey.below(low, high, scanner.Params(stations=(12,)), 3).values()])
    assert (at >= low[:2]).all()
    assert (at <= high[:2]).all()
    quarters = (at > high[:2] / 2.0) @ [1, 2]
    assert (np.bincount(quarters, minlength=4) >= 2).all()
    near = np.linalg.norm(at[:, None] - at, axis=2) + 1e9 * np.eye(12)
    assert near.min() > 2000.0  # 600 m2 for 12: 7 m apart were a grid's
    grid = survey.below(low, high, scanner.Params(stations=(2, 3)), 3)
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
    places = np.array([sequences.on_sphere(i) for i in range(count)]) * (half + 4000.0)
    k = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    level = np.sqrt(1.0 - height**2)
    even = np.stack([height, level * np.cos(turn), level * np.sin(turn)], axis=1) * (half + 4000.0)
    found, usual = seen_shares(places, half), seen_shares(even, half)
    assert found.mean() > usual.mean() - 0.03
    assert found.min() > 0.25
    assert seen_shares(places[:2], half)[:2].min() > 0.9  # the first two see both ends


def test_a_station_more_leaves_the_scans_of_the_others():
    settings = ["frame.nodes_x=3", "frame.nodes_y=3", "scan.mode=rays", "scan.step_mrad=8", "scan.clutter=3"]
    table = {key: value for key, value in recipes.load("frame-small")[1].items() if key != "scan"}
    table["asbuilt"] = {"node_movement_mm": 3.0}

    def made(count):
        return scene.make("x", recipes.overridden(table, [*settings, f"scan.stations={count}"]))

    (few, few_truth), (more, more_truth) = made(3), made(4)
    assert [scan.name for scan in more.scans] == ["S1", "S2", "S3", "S4"]
    for one, other in zip([*few.scans, *few_truth.labels], [*more.scans[:3], *more_truth.labels[:3]], strict=True):
        for field in dataclasses.fields(one):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))
