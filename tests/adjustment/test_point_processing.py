"""What software has done to points, against the operations themselves: cells, means, copies, rounding by NumPy."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from processor import fit_sphere, pipeline
from processor.adjustment.processing.point_processing import recognised
from processor.language.messages import messages
from processor.model import NORMAL_95, Scan, Scene, Status

RADIUS, CENTRE = 75.0, np.array([3210.4, -4127.9, 803.3])
SEEDS = range(6)


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


def trace_of(points: np.ndarray):
    away = points - CENTRE
    distance = np.linalg.norm(away, axis=1)
    return recognised(points, distance - RADIUS, away / distance[:, None])


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


@pytest.mark.parametrize("seed", SEEDS)
def test_points_of_a_scanner_have_no_trace(seed):
    trace = trace_of(ball(seed))
    assert trace.reasons("scan") == ()
    assert not trace.cell
    assert not trace.kernel


@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("seed", SEEDS)
def test_edge_of_the_cells_that_hold_one_point(seed, nearest):
    trace = trace_of(in_cells(ball(seed), 5.0, nearest))
    assert trace.cell == pytest.approx(5.0, rel=0.02)
    assert not trace.kernel
    assert [one.code for one in trace.reasons("scan")] == ["points.thinned"]


@pytest.mark.parametrize("count", [8, 20])
@pytest.mark.parametrize("seed", SEEDS)
def test_means_of_neighbours(seed, count):
    trace = trace_of(smoothed(ball(seed), count))
    # Of evenly scattered points: a disc that holds as many, within a factor of two
    disc = np.sqrt(count * 4.0 * RADIUS**2 * 0.3 / 3000)
    assert 0.5 * disc < trace.kernel < 2.0 * disc


@pytest.mark.parametrize("step", [0.1, 1.0, 5.0])
def test_step_of_rounded_coordinates(step):
    trace = trace_of(np.round(ball(1) / step) * step)
    assert trace.step == pytest.approx(step)
    assert not trace.kernel


def test_copies_beside_the_points():
    points = ball(2)
    trace = trace_of(np.vstack([points, points + 0.01]))
    assert trace.copies == pytest.approx(1.0)
    assert not trace.kernel


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
    trace = trace_of(a + u * (b - a) + v * (c - a))
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


def test_the_processing_of_every_scan_is_stated_by_a_run():
    """Two planes at an angle, as one scan of a merged scene: cells along the axes of the file."""
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(0.0, 400.0, (20_000, 2)), rng.normal(0.0, 1.0, 20_000)])
    tilted = flat @ np.linalg.qr(rng.normal(size=(3, 3)))[0] + 300.0
    points = np.vstack([flat, tilted])
    for cloud, codes in ((points, []), (in_cells(points, 6.0, nearest=True), ["points.thinned"])):
        scan = Scan(name="S1", points=cloud)
        scene = Scene(name="planes", kind="structure", scans=(scan,))
        assert [one.code for one in pipeline._with_points_once(scene)[1]] == codes
