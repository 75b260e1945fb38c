"""Balls at nodes from whole clouds: sizes, flags, evidence, and the same bytes for any order, chunks and threads."""

import dataclasses

import numpy as np
import pytest

from processor.geometry import thread_ranges
from processor.limits import standards
from processor.model import UsageError, reason
from processor.space_frame import ball_catalogue
from processor.space_frame.members.records import Members, Nodes
from processor.space_frame.params import Params
from processor.space_frame.points import sphere_crops
from processor.space_frame.spheres import alternating_fit, baselines
from processor.space_frame.spheres.alternating_fit import RayFitParams, fit_spheres
from processor.space_frame.spheres.records import SizeChoice
from tests.support.clouds.ball_clouds import frame, grid_of_balls
from tests.support.clouds.memory_source import InMemory

# Largest errors of twelve balls: noise of 2 mm, of hundreds of points on a third of a ball.
FIXED_MM, FREE_MM = 2.0, 3.0  # with the size of the catalogue, and with a free radius
STATIONS = np.array([[1000.0, 500.0, 0.0], [9000.0, 1000.0, 0.0], [5000.0, 7000.0, 0.0]])
SIZES = (45.0, 50.0, 60.0, 80.0)


@pytest.fixture(scope="module")
def roof():
    rng = np.random.default_rng(5)
    centres, sizes = grid_of_balls(12, SIZES)
    radii = sizes + rng.normal(0.0, 0.3, 12)
    return centres, radii, sizes, *frame(rng, centres, radii, STATIONS)


@pytest.fixture(scope="module")
def found(roof):
    _, _, _, source, nodes, tubes = roof
    return fit_spheres(source, nodes, tubes, ball_catalogue.load())


def same_bytes(a, b):
    fields = [f.name for f in dataclasses.fields(a)]
    return all(
        getattr(a, f).tobytes() == getattr(b, f).tobytes() if hasattr(getattr(a, f), "tobytes") else
        repr(getattr(a, f)) == repr(getattr(b, f)) for f in fields
    )  # fmt: skip


def off_lowest(found, of_roof):
    return found.lowest[:, 2] - (of_roof[0][:, 2] - of_roof[1])


def test_every_ball_has_its_size_and_its_place(roof, found):
    centres, _, sizes, *_ = roof
    assert found.flag == ("ok",) * 12, found.reasons
    assert found.evidence == ("fused",) * 12
    assert found.sizes.tolist() == sizes.tolist()
    lowest = off_lowest(found, roof)
    assert np.abs(lowest).max() < FIXED_MM
    assert np.abs(lowest / found.lowest_sd).max() < 3.5  # of twelve: one in two hundred
    assert np.sqrt(np.mean((lowest / found.lowest_sd) ** 2)) < 1.6  # of twelve: one in a thousand
    assert np.linalg.norm(found.centres - centres, axis=1).max() < FIXED_MM
    assert (found.stations >= 2).all()
    assert (found.efficiency_lowest > 0.9).all()  # of the biweight 0.95
    assert (found.efficiency_centre <= 1.0).all()
    assert found.noise[0] + found.noise[2] == pytest.approx(4.0, rel=0.2)  # by thousands of points: some per cent


def test_fit_spheres_gives_the_same_bytes_for_any_order_chunks_threads_and_origin(roof, found, monkeypatch):
    _, _, _, source, nodes, tubes = roof
    order = np.random.default_rng(1).permutation(source.count)
    mixed = InMemory(source.points[order], source.station[order], source.scanners, chunk_size=3001)
    assert same_bytes(found, fit_spheres(mixed, nodes, tubes, ball_catalogue.load()))
    moved = dataclasses.replace(source, origin=np.array([5e8, 4.3e9, 1e5]))
    assert same_bytes(found, fit_spheres(moved, nodes, tubes, ball_catalogue.load()))
    monkeypatch.delattr(thread_ranges, "_pool")  # one thread starts no others
    alone = fit_spheres(source, nodes, tubes, ball_catalogue.load(), params=RayFitParams(threads=1))
    assert same_bytes(found, alone)


def test_a_free_radius_is_found_too(roof):
    _, radii, _, source, nodes, tubes = roof
    found = fit_spheres(source, nodes, tubes, ball_catalogue.of_radii([]))
    good = np.array(found.flag) == "ok"
    assert good.sum() >= 9
    # Of twelve: one in a thousand.
    assert np.abs((found.radii - radii) / np.sqrt(found.covariance[:, 3, 3]))[good].max() < 4.0
    assert np.abs(off_lowest(found, roof))[good].max() < FREE_MM


def test_wrong_sizes_are_named_and_the_right_ones_are_not(roof):
    _centres, _, sizes, source, nodes, tubes = roof
    nominal = sizes.copy()
    nominal[[2, 7]] += 10.0
    found = fit_spheres(source, nodes, tubes, ball_catalogue.load(), nominal_mm=nominal)
    assert np.flatnonzero(np.array(found.flag) == "wrong-size").tolist() == [2, 7]
    assert found.reasons[2] == (reason("spheres.other-size", size=60.0, nominal=70.0),)
    assert np.array(found.flag)[np.delete(np.arange(12), [2, 7])].tolist() == ["ok"] * 10


def test_nominal_size_is_kept_against_a_doubtful_other_size():
    nan = np.nan
    choice = SizeChoice(
        states=np.tile([0.0, 0.0, 0.0, 50.0], (4, 1)),
        sizes=np.full(4, 50.0),
        energy=np.array([10.0, 10.0, 10.0, np.inf]),
        second=np.array([55.0, 55.0, 60.0, nan]),
        second_energy=np.array([20.0, 40.0, 20.0, np.inf]),
    )
    alternating_fit.keep_nominal(choice, np.array([55.0, 55.0, 55.0, nan]))
    assert choice.sizes.tolist() == [55.0, 50.0, 50.0, 50.0]
    assert choice.states[:, 3].tolist() == [55.0, 50.0, 50.0, 50.0]
    assert choice.second[:3].tolist() == [50.0, 55.0, 60.0]


def test_bias_without_scanner_positions_is_reported(roof):
    _, _, _, source, nodes, tubes = roof
    unknown = InMemory(source.points)
    found = fit_spheres(unknown, nodes, tubes, ball_catalogue.load())
    assert reason("spheres.orthogonal-distances") in found.messages
    good = np.array(found.flag) == "ok"
    assert good.sum() >= 10
    assert np.abs(off_lowest(found, roof))[good].max() < FREE_MM


def test_node_without_points_is_placed_by_its_axes_alone(roof):
    _, _, _, source, nodes, tubes = roof
    away = dataclasses.replace(
        nodes,
        positions=np.vstack([nodes.positions, [50000.0, 0.0, 6000.0]]),
        covariance=np.concatenate([nodes.covariance, nodes.covariance[:1]]),
        axis_count=np.append(nodes.axis_count, 4),
        scatter=np.append(nodes.scatter, 0.5),
    )
    found = fit_spheres(source, away, tubes, ball_catalogue.load())
    assert (found.evidence[-1], found.flag[-1]) == ("axes", "low-confidence")
    assert np.isnan(found.radii[-1])
    assert found.reasons[-1][0].code == "spheres.axes-alone"
    known = fit_spheres(source, away, tubes, ball_catalogue.load(), nominal_mm=np.append(np.full(12, np.nan), 60.0))
    assert known.radii[-1] == 60.0
    assert known.lowest[-1, 2] == pytest.approx(6000.0 - 60.0)
    assert known.lowest_sd[-1] > 0.5  # node_sd of its axes


def test_a_target_on_a_mount_needs_no_member_and_no_catalogue():
    rng = np.random.default_rng(6)
    centre = np.array([[0.0, 0.0, 1500.0]])
    source, _, _ = frame(
        rng, centre, [70.0], np.array([[0.0, -5000.0, 1500.0]]), 0.8, 1.0, members=np.empty((0, 3)), hole=0.0
    )
    start = Nodes(centre + np.array([3.0, -4.0, 2.0]), np.full((1, 3, 3), np.nan), np.zeros(1, int), np.full(1, np.nan))
    found = fit_spheres(source, start, Members(), ball_catalogue.of_radii([]))
    assert found.evidence == ("ball",)
    assert found.flag == ("ok",)
    error = np.append(found.centres[0] - centre[0], found.radii[0] - 70.0)
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(found.covariance[0])) + 1e-9).all()  # four sds
    assert np.abs(error).max() < 0.2  # 0.8 mm of 956 points is 0.026; 0.04 and 0.05 came


def test_stations_that_moved_are_noticed_and_enter_the_covariance():
    rng = np.random.default_rng(7)
    centres, radii = grid_of_balls(12, SIZES)
    stations = np.vstack([STATIONS, [[0.0, 8000.0, 0.0]]])
    shifts = rng.normal(0.0, 2.0, (4, 3))
    source, nodes, tubes = frame(rng, centres, radii, stations, shifts=shifts)
    found = fit_spheres(source, nodes, tubes, ball_catalogue.load())
    assert 0.7 < found.station_sd < 4.0  # 2 mm, of 3 stations' motions against the fourth
    assert "spheres.stations-disagree" in [one.code for one in found.messages]
    pull = (found.lowest[:, 2] - centres[:, 2] + radii) / found.lowest_sd
    still = fit_spheres(source, nodes, tubes, ball_catalogue.load(), station_covariance=np.zeros((4, 3, 3)))
    assert (still.lowest_sd < 0.6 * found.lowest_sd).mean() > 0.7  # by shifts of 2 mm: all of them came
    assert np.sqrt(np.mean(pull**2)) < 1.6  # as above


def test_crops_hold_exactly_the_points_within_their_radius(roof):
    _, _, _, source, nodes, _ = roof
    positions = np.vstack([nodes.positions, nodes.positions[:1] + np.array([100.0, 0.0, 0.0])])  # two that share points
    got = sphere_crops.gather(source, positions, 150.0)
    for i, node in enumerate(positions):
        near = np.linalg.norm(source.points - node, axis=1) <= 150.0
        mine = slice(got.start[i], got.start[i + 1])
        assert got.start[i + 1] - got.start[i] == near.sum()
        expected = np.column_stack([source.station[near], np.rint((source.points[near] - node) * 1000.0)])
        expected = expected[np.lexsort(expected.T[[3, 2, 1, 0]])]
        assert np.column_stack([got.station[mine], got.points[mine] * 1000.0]).round(3).tolist() == expected.tolist()
    with pytest.raises(UsageError, match="reach"):
        sphere_crops.gather(source, positions, 0.0)
    assert sphere_crops.gather(source, np.empty((0, 3)), 100.0).start.tolist() == [0]


def test_crops_of_many_points_keep_an_even_share_whatever_the_order():
    rng = np.random.default_rng(8)
    nodes = np.array([[0.0, 0.0, 0.0], [900.0, 0.0, 0.0], [0.0, 5000.0, 0.0]])
    counts = (60_000, 3000, 200)
    cloud = np.vstack([n + rng.uniform(-110.0, 110.0, (c, 3)) for n, c in zip(nodes, counts, strict=True)])
    station = rng.integers(0, 3, len(cloud)).astype(np.int32)
    most = 6000  # 2000 each
    answers = []
    for seed, chunk_size, threads in ((0, 1 << 20, 1), (1, 1000, 2), (2, 7777, 3)):
        order = np.random.default_rng(seed).permutation(len(cloud))
        source = InMemory(cloud[order], station[order], np.zeros((3, 3)), chunk_size=chunk_size)
        answers.append(sphere_crops.gather(source, nodes, 100.0, threads, most))
    for other in answers[1:]:
        for field in ("start", "points", "station"):
            assert getattr(answers[0], field).tobytes() == getattr(other, field).tobytes()
    got = answers[0]
    within = [int((np.linalg.norm(cloud - node, axis=1) <= 100.0).sum()) for node in nodes]
    kept = np.diff(got.start)
    assert kept[2] == within[2]
    assert kept[1] == within[1] < 2000
    assert 0.8 * 2000 < kept[0] <= 2000 < within[0]  # a step is a factor of 2^(1/4), and what it lets by is chance's
    some = got.points[: kept[0]]
    assert np.abs(some.mean(axis=0)).max() < 4.0 * 45.0 / np.sqrt(kept[0])  # sd a coordinate in a sphere: r / root 5
    assert np.bincount(got.station[: kept[0]]).min() > 0.29 * kept[0]  # a third less four sds of a share of 2000


def test_methods_of_the_paper_use_the_points_of_method_ray(roof, found):
    _, radii, _, source, nodes, tubes = roof
    limits = standards.default_for(None)
    plain, drawn = (
        baselines.fit_beside(
            source, nodes, tubes, found, np.arange(12), Params(method, seed=1, raw_crops=False), limits
        )
        for method in ("least-squares", "ransac")
    )
    assert (drawn.balls.points <= plain.balls.points).all()  # those that consent
    assert (plain.balls.points >= 0.8 * found.points).all()
    ours = np.median(np.abs(found.radii - radii))
    for other in (plain, drawn):
        assert np.isfinite(other.balls.radii).all()
        assert ours < np.median(np.abs(other.balls.radii - radii))
    with pytest.raises(UsageError, match="ransac"):
        Params("magic").check(True)


def test_on_raw_crops_consensus_is_far_better_than_least_squares(roof, found):
    # The order of paper 001: a raw crop holds the sleeves and tubes, to which least squares gives full weight.
    _, radii, _, source, nodes, tubes = roof
    limits = standards.default_for(None)
    plain, drawn = (
        baselines.fit_beside(source, nodes, tubes, found, np.arange(12), Params(method, seed=1), limits)
        for method in ("least-squares", "ransac")
    )
    assert drawn.reasons == plain.reasons == (baselines.RAW,)
    errors = [np.median(np.abs(result.balls.radii - radii)) for result in (drawn, plain)]
    assert errors[0] < 0.5 * errors[1]  # "far better"
    assert (plain.balls.points > found.points).all()


def test_catalogues_state_their_verification_and_bad_ones_are_refused():
    assert ball_catalogue.load().verified is False
    assert ball_catalogue.of_radii([60, 45.0, 60]).radii.tolist() == [45.0, 60.0]
    with pytest.raises(UsageError, match="plausible"):
        ball_catalogue.load("nowhere")
    with pytest.raises(UsageError, match="above 0"):
        ball_catalogue.of_radii([45.0, -1.0])
