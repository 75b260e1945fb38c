"""What software has done to points, against the operations themselves: cells, means, copies, rounding by NumPy."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial import cKDTree

import processor
from processor import fit_sphere, pipeline
from processor.adjustment.processing.point_processing import Processing, agreed, recognised
from processor.geometry.coincident_points import used_once
from processor.language.messages import messages
from processor.model import NORMAL_95, Scan, Scene, Status, Verdict
from processor.model.doubted import doubted
from processor.space_frame.result import Flag

RADIUS, CENTRE = 75.0, np.array([3210.4, -4127.9, 803.3])
SEEDS = [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))]


def ball(seed: int, noise: float = 1.0, count: int = 3000, share: float = 0.3) -> np.ndarray:
    """Points (n, 3), mm, of a cap of a sphere, ``share`` of it, each with its own noise along one direction."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(1.0 - 2.0 * share, 1.0, count)
    turn, side = rng.uniform(0.0, 2.0 * np.pi, count), np.sqrt(1.0 - z**2)
    normals = np.column_stack([side * np.cos(turn), side * np.sin(turn), z])
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    along = axis - np.array([0.0, 0.0, 1.0])
    # A reflection takes the cap's middle to the axis
    normals -= np.outer(normals @ along, along) * 2.0 / (along @ along)
    return CENTRE + RADIUS * normals + noise * rng.normal(size=count)[:, None] * axis


def in_cells(points: np.ndarray, edge: float, nearest: bool) -> np.ndarray:
    """One point of each cell: the centroid, or the one nearest to the cell's centre."""
    cells = {}
    for row, cell in enumerate(map(tuple, np.floor(points / edge).astype(int))):
        cells.setdefault(cell, []).append(row)
    if not nearest:
        return np.array([points[rows].mean(axis=0) for rows in cells.values()])
    return np.array(
        [
            points[min(rows, key=lambda row: np.sum((points[row] / edge - cell - 0.5) ** 2))]
            for cell, rows in cells.items()
        ]
    )


def smoothed(points: np.ndarray, count: int) -> np.ndarray:
    return points[cKDTree(points).query(points, k=count)[1]].mean(axis=1)


def of_sphere(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions (n, 3) and residuals (n,)."""
    distance = np.linalg.norm(points - CENTRE, axis=1)
    return (points - CENTRE) / distance[:, None], distance - RADIUS


@pytest.mark.parametrize("seed", SEEDS)
def test_points_of_a_scanner_have_no_trace(seed):
    trace = recognised(ball(seed))
    assert trace.reasons("scan") == ()
    assert not trace.cell
    assert not trace.smoothed


@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("seed", SEEDS)
def test_edge_of_the_cells_that_hold_one_point(seed, nearest):
    trace = recognised(in_cells(ball(seed), 5.0, nearest))
    assert trace.cell == pytest.approx(5.0, rel=0.02)
    assert not trace.smoothed
    assert [one.code for one in trace.reasons("scan")] == ["points.thinned"]


@pytest.mark.parametrize(("noise", "share", "count"), [(0.2, 0.5, 150), (0.5, 0.5, 400), (2.0, 0.15, 1000)])
@pytest.mark.parametrize("seed", SEEDS)
def test_balls_of_few_points_are_not_smoothed(seed, noise, share, count):
    points = ball(seed, noise, count, share)
    assert not recognised(points).smoothed
    assert not recognised(points, of_sphere(points)).smoothed


@pytest.mark.parametrize("count", [8, 20])
@pytest.mark.parametrize("seed", SEEDS)
def test_means_of_neighbours(seed, count):
    assert recognised(smoothed(ball(seed), count)).smoothed


@pytest.mark.parametrize(("noise", "count", "share"), [(2.0, 500, 0.1), (3.0, 2000, 0.5), (0.5, 500, 0.15)])
def test_means_of_neighbours_of_few_points_on_a_sphere(noise, count, share):
    """White noise has a ratio of 1 with an sd of 0.7 / root(500) = 0.03: none is taken for smoothed; errors that two
    neighbours of four share by half leave 0.75."""
    for seed in range(6):
        raw = ball(seed, noise, count, share)
        assert not recognised(raw, of_sphere(raw)).smoothed
        for means in (8, 20):
            points = smoothed(raw, means)
            assert recognised(points, of_sphere(points)).smoothed


@pytest.mark.parametrize("step", [0.1, 1.0, 5.0])
def test_step_of_rounded_coordinates(step):
    trace = recognised(np.round(ball(1) / step) * step)
    assert trace.step == pytest.approx(step)
    assert not trace.smoothed


@pytest.mark.parametrize("axes", [[2], [0, 1], [0, 1, 2]])
def test_profiles_and_grids_at_even_distances_are_no_rounding(axes):
    """Coordinates of a file have 0.01 mm; of some axes all are multiples of 1.5 mm."""
    points = np.round(ball(1), 2)
    points[:, axes] = np.round(points[:, axes] / 1.5) * 1.5
    assert recognised(points).step == (1.5 if len(axes) == 3 else 0.0)


def test_copies_beside_the_points_count_once():
    points = ball(2)
    used = used_once(np.vstack([points, points + 0.01]))
    assert np.mean(used[: len(points)]) > 0.98
    assert not used[len(points) :].any()
    assert used_once(points) is None


def test_a_cell_counts_where_half_of_the_scans_have_it():
    cells = [5.0, 5.02, 43.0, 43.7, 0.0]
    kept = [trace.cell for trace in agreed([Processing(cell=cell) for cell in cells])]
    assert kept == [0.0] * 5  # two of five
    kept = [trace.cell for trace in agreed([Processing(cell=cell) for cell in cells[:3]])]
    assert kept == [5.0, 5.02, 0.0]
    assert agreed([]) == []


def edges(seed: int) -> np.ndarray:
    """Points (n, 3), mm, 20 mm apart, of girders of plates 150 mm wide: an edge near most points."""
    rng = np.random.default_rng(seed)
    along, across = rng.uniform(0.0, 4000.0, 6000), rng.uniform(-75.0, 75.0, 6000)
    off, side = 0.8 * rng.normal(size=6000), rng.integers(0, 3, 6000)
    web, flange = np.stack([along, off, across], axis=1), np.stack([along, across, off + 75.0], axis=1)
    return np.where((side == 0)[:, None], web, flange - 150.0 * (side == 2)[:, None] * np.array([0.0, 0.0, 1.0]))


@pytest.mark.parametrize("seed", SEEDS[:3])
def test_edges_are_no_smoothing(seed):
    points = edges(seed)
    assert recognised(points) == Processing()
    assert recognised(smoothed(points, 12)).smoothed


@pytest.mark.parametrize(("correlation", "ratio"), [(0.5, 2), (0.7, 1), (0.7, 8), (0.9, 4)])
@pytest.mark.parametrize("seed", SEEDS[:3])
def test_lines_of_a_scanner_that_share_errors_are_no_smoothing(seed, correlation, ratio):
    """Points 2 mm apart along lines that are ``ratio`` times as far apart; errors of a line are autoregressive."""
    rng = np.random.default_rng(seed)
    lines, along = (150, 150) if ratio == 1 else (100, 400)
    white = rng.normal(size=(lines, along))
    off = 0.8 * lfilter([np.sqrt(1.0 - correlation**2)], [1.0, -correlation], white, axis=1)
    u = 2.0 * (np.arange(along) + rng.random((lines, 1)))
    v = np.broadcast_to(2.0 * ratio * np.arange(lines)[:, None], u.shape)
    points = np.stack([u, v, off], axis=-1).reshape(-1, 3) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    assert not recognised(points).smoothed
    if ratio <= 2:
        assert recognised(smoothed(points, 20)).smoothed


def test_points_sampled_from_a_mesh():
    rng, z = np.random.default_rng(3), np.array([0.0, 0.0, 1.0])
    turn, height = np.meshgrid(np.arange(40) * 2.0 * np.pi / 40, np.linspace(0.5, 0.98, 12))
    side = np.sqrt(1.0 - height**2)
    corners = np.stack([side * np.cos(turn), side * np.sin(turn), height], axis=-1) * RADIUS + CENTRE
    corners += rng.normal(size=(*turn.shape, 1)) * z
    row, column = rng.integers(0, 11, 8000), rng.integers(0, 40, 8000)
    a, b = corners[row, column], corners[row, (column + 1) % 40]
    c = np.where(rng.random(8000)[:, None] < 0.5, corners[row + 1, column], corners[row + 1, (column + 1) % 40])
    u, v = rng.random((2, 8000, 1))
    flip = u + v > 1.0
    u, v = np.where(flip, 1.0 - u, u), np.where(flip, 1.0 - v, v)
    trace = recognised(a + u * (b - a) + v * (c - a))
    assert trace.mesh
    assert [one.code for one in trace.reasons("scan")] == ["points.from-mesh"]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_smoothed_sphere_is_weak_and_the_way_out_is_named(seed):
    raw, filtered = fit_sphere(ball(seed)), fit_sphere(smoothed(ball(seed), 12))
    assert raw.status is Status.OK
    assert not any(one.code.startswith("points.") for one in raw.reasons)
    assert filtered.status is Status.WEAK
    [named] = [one for one in filtered.reasons if one.code == "points.smoothed"]
    assert "export the raw cloud" in messages("en").text(named)


def test_radii_of_thinned_spheres_lie_within_their_intervals():
    """Of 12 intervals of 95 % all but 2 hold in 98 of 100 series (binomial)."""
    inside = 0
    for seed in range(12):
        fit = fit_sphere(in_cells(ball(seed, noise=1.5), 5.0, nearest=False))
        assert "points.thinned" in [one.code for one in fit.reasons]
        inside += abs(fit.radius - RADIUS) < NORMAL_95 * np.sqrt(fit.covariance[3, 3])
    assert inside >= 10


@pytest.mark.parametrize(("instrument", "least"), [("", 0.5), ("phase", 0.5), ("pulse", 0.6), ("long-range", 2.5)])
def test_intervals_hold_the_class_of_the_instrument(instrument, least):
    """The offset of a view moves a ball along the rays by as much; a class that is assumed is stated."""
    fit = fit_sphere(ball(3), radius=RADIUS, instrument=instrument)
    assert least < np.sqrt(np.trace(fit.covariance[:3, :3])) < 1.5 * least + 0.2
    assert ("spheres.instrument-assumed" in [one.code for one in fit.reasons]) == (not instrument)


def test_an_instrument_of_no_known_class_is_refused():
    with pytest.raises(
        ValueError, match=r"expected one of phase, pulse, long-range, or a scanner\.toml, found 'total station'"
    ):
        fit_sphere(ball(1), instrument="total station")


def test_the_processing_of_every_scan_is_stated_by_a_run():
    """Two planes at an angle, as one scan of a merged scene: cells along the axes of the file."""
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(0.0, 400.0, (20_000, 2)), rng.normal(3.0, 1.0, 20_000)])
    tilted = flat @ np.linalg.qr(rng.normal(size=(3, 3)))[0] + 300.0
    points = np.vstack([flat, tilted])
    for cloud, codes, weak in (
        (points, [], False),
        (in_cells(points, 6.0, nearest=True), ["points.thinned"], False),
        (in_cells(points, 15.0, nearest=False), ["points.thinned"], True),
        (np.round(points), ["points.rounded"], False),
        (np.round(points / 5.0) * 5.0, ["points.rounded"], True),
        (smoothed(points, 10), ["points.smoothed"], True),
    ):
        scene = Scene(name="planes", kind="structure", scans=(Scan(name="S1", points=cloud),))
        _, reasons, touched = pipeline._with_points_once(scene)
        assert [one.code for one in reasons if one.code != "points.coincident"] == codes
        assert touched is weak


def test_of_a_smoothed_scene_nothing_is_sure_in_any_step():
    """A ball in a scene of one scan: as found, and as a filter left it."""
    for cloud, status, flag in (
        (ball(4), Status.OK, Flag.OK),
        (smoothed(ball(4), 12), Status.WEAK, Flag.LOW_CONFIDENCE),
    ):
        scene = Scene(name="ball", kind="structure", scans=(Scan(name="S1", points=cloud),))
        [result] = processor.run(scene, steps=["spheres"]).steps.values()
        assert result.status is status
        assert result.balls.flag == (flag,)


@dataclasses.dataclass(frozen=True)
class Table:
    verdict: tuple[Verdict, ...]
    doubtful: np.ndarray
    values: np.ndarray


@dataclasses.dataclass(frozen=True)
class Answer:
    status: Status
    table: Table
    parts: tuple[Status, ...]


def test_doubted_results_keep_their_numbers():
    values = np.arange(3.0)
    table = Table((Verdict.PASS, Verdict.FAIL, Verdict.NONE), np.array([False, True, False]), values)
    less = doubted(Answer(Status.OK, table, (Status.OK, Status.FAILED, Status.AMBIGUOUS)))
    assert less.status is Status.WEAK
    assert less.parts == (Status.WEAK, Status.FAILED, Status.AMBIGUOUS)
    assert less.table.verdict == (Verdict.INDETERMINATE, Verdict.INDETERMINATE, Verdict.NONE)
    assert less.table.doubtful.all()
    assert less.table.values is values
