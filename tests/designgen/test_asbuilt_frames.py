"""Frames built otherwise than designed: each error against its closed form, and its truth beside it."""

import numpy as np
import pytest

from designgen import recipe_files
from designgen.asbuilt import imperfections
from designgen.designs import space_frame
from designgen.randomness import generator
from designgen.scanning import sampler
from designgen.scenes.make import make
from processor.model import UsageError

FRAME = space_frame.build(space_frame.Params(nodes_x=3, nodes_y=3, layers=2, radii_mm=(45.0, 60.0)))
EXACT_MM = 1e-6  # mm and mm2 in float64 at 10 m


def frame_with(**params):
    ledger = imperfections.Ledger()
    return imperfections.frame(FRAME, imperfections.FrameParams(**params), generator(1, "x"), ledger), ledger.record()


def test_errors_built_into_a_frame_equal_those_of_the_truth():
    same, truth = frame_with()
    np.testing.assert_array_equal(same.centres, FRAME.centres)
    assert truth.what == ()
    moved, _ = frame_with(node_movement_mm=5.0)
    assert np.std(moved.centres - FRAME.centres) == pytest.approx(5.0, rel=0.4)  # of 39 numbers: sd 0.57
    wrong, truth = frame_with(wrong_sizes=3)
    changed = np.flatnonzero(wrong.radii != FRAME.radii)
    assert {f"ball {i}" for i in changed} == set(truth.where)
    np.testing.assert_array_equal(wrong.radii[changed], [truth.value[truth.where.index(f"ball {i}")] for i in changed])
    bowed, truth = frame_with(bow_share=0.001, eccentricity_mm=2.0)
    for m in range(len(FRAME.members)):
        a, b = FRAME.ends(m)
        assert np.linalg.norm(bowed.bow(m)) <= 0.001 * tube_length(bowed, m)
        assert abs(bowed.bow(m) @ (b - a)) < EXACT_MM
        assert abs(bowed.offsets[m, 0] @ (b - a)) < EXACT_MM
        assert truth.value[truth.where.index(f"member {m}")] == pytest.approx(np.linalg.norm(bowed.bow(m)))
    loose, truth = frame_with(missing_bolts=2)
    assert loose.missing.sum() == 2
    odd, truth = frame_with(temperature_C=40.0, wrong_sizes=3, radius_mm=0.2)
    for where, value in zip(truth.where, truth.value, strict=True):
        assert odd.radii[int(where.removeprefix("ball "))] == value
    with pytest.raises(UsageError, match=r"asbuilt\.bow_share: expected 0 or more"):
        frame_with(bow_share=-1.0)


def tube_length(frame, member):
    """Between the cones: the balls' distance less, at each end, the flat's, a sleeve of 35 and a cone of 50 mm."""
    i, j = frame.members[member]
    offsets = frame.offsets[member] if len(frame.offsets) else np.zeros((2, 3))
    grown = frame.connection.tube_diameter / 60.0
    flats = [np.sqrt(frame.radii[k] ** 2 - (grown * 34.0 / np.sqrt(3.0) + 1.0) ** 2) for k in (i, j)]
    axis = frame.centres[j] + offsets[1] - frame.centres[i] - offsets[0]
    return np.linalg.norm(axis) - sum(flats) - grown * 170.0


def test_tubes_bow_by_a_share_of_their_own_length():
    """Not of the distance between nodes, which is longer by balls, sleeves and cones."""
    short = space_frame.build(
        space_frame.Params(nodes_x=9, nodes_y=9, spacing_mm=800.0, depth_mm=700.0, radii_mm=(60.0,))
    )
    params = imperfections.FrameParams(bow_share=0.001, eccentricity_mm=3.0, node_movement_mm=5.0, temperature_C=60.0)
    bowed = imperfections.frame(short, params, generator(1, "x"), imperfections.Ledger())
    lengths = np.array([tube_length(bowed, m) for m in range(len(bowed.members))])
    np.testing.assert_allclose(bowed.tube_lengths(), lengths, atol=EXACT_MM)
    shares = np.linalg.norm(bowed.bows, axis=1) / lengths
    assert 0.00098 < shares.max() <= 0.001
    assert np.sort(shares)[len(shares) // 2] == pytest.approx(0.0005, abs=0.0001)  # the median of 400 evenly drawn


def test_a_warm_frame_is_larger_in_all_its_parts():
    """At 120 C by 1.2 per mille: its balls, and the tubes, cones and sleeves between them."""
    warm, _ = frame_with(temperature_C=120.0)
    grown = 1.0012
    assert warm.connection.tube_diameter == pytest.approx(60.0 * grown)
    assert warm.connection.across_flats == pytest.approx(34.0 * grown)
    assert (warm.connection.sleeve_length, warm.connection.cone_length) == pytest.approx((35.0 * grown, 50.0 * grown))
    np.testing.assert_allclose(warm.centres, FRAME.centres * grown)
    # The flats' margin of 1 mm does not grow.
    np.testing.assert_allclose(warm.tube_lengths(), FRAME.tube_lengths() * grown, atol=0.002)
    cloud = sampler.scan_frame(warm, sampler.Params(spacing_mm=8.0, sigma_mm=0.0), generator(0, "s"))
    a, b = warm.ends(0)
    unit = (b - a) / np.linalg.norm(b - a)
    arm = cloud.points - a
    along = arm @ unit
    away = np.linalg.norm(arm - np.outer(along, unit), axis=1)
    own = (np.abs(along - 0.5 * np.linalg.norm(b - a)) < 300.0) & (away < 60.0)
    assert own.sum() > 100
    np.testing.assert_allclose(away[own], 30.0 * grown, atol=EXACT_MM)
    # The scene's design stays as it is at 20 C.
    recipe = recipe_files.overridden(
        recipe_files.load("frame-small")[1], ["scan.spacing_mm=50", "asbuilt.temperature_C=120"]
    )
    scene, truth = make("x", recipe)
    assert set(scene.frame.tube_diameters) == {60.0}
    np.testing.assert_allclose(truth.frame.radii, scene.frame.radii * grown)


def test_more_errors_than_there_is_to_build_are_refused():
    balls, members = len(FRAME.centres), len(FRAME.members)
    assert (balls, members) == (13, 12 + 4 + 16)
    with pytest.raises(UsageError, match=r"^asbuilt\.wrong_sizes: expected at most 13, all balls, got 14"):
        frame_with(wrong_sizes=14)
    with pytest.raises(UsageError, match=r"^asbuilt\.missing_bolts: expected at most 64, all bolts, got 65"):
        frame_with(missing_bolts=65)
    assert frame_with(missing_bolts=64)[0].missing.all()
    with pytest.raises(UsageError, match=r"^asbuilt: this frame cannot be built with errors so large: frame\.radii_mm"):
        frame_with(radius_mm=30.0)
    with pytest.raises(UsageError, match=r"^frame\.spacing_mm, depth_mm: expected balls so far apart"):
        space_frame.build(space_frame.Params(spacing_mm=200.0, layers=1))


def test_a_frame_without_a_bolt_shows_no_sleeve():
    loose, _ = frame_with(missing_bolts=1)
    ((member, end),) = np.argwhere(loose.missing)
    clouds = [
        sampler.scan_frame(f, sampler.Params(spacing_mm=4.0, sigma_mm=0.0), generator(0, "s")) for f in (FRAME, loose)
    ]
    a, b = FRAME.ends(member)
    start, unit = (a, b - a) if end == 0 else (b, a - b)
    unit = unit / np.linalg.norm(unit)
    flat = FRAME.ball(int(FRAME.members[member, end])).flat_distance
    counts = []
    for cloud in clouds:
        along = (cloud.points - start) @ unit
        across = np.linalg.norm(cloud.points - start - np.outer(along, unit), axis=1)
        counts.append(((along > flat + 2.0) & (along < flat + 33.0) & (across < 20.0)).sum())
    assert counts[0] > 100
    assert counts[1] == 0
