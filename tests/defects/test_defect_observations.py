"""Points of a scan on the cells of a design: effect of noise on places of points and means of cells."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from processor import large_arrays
from processor.adjustment import mixed_pixels
from processor.defects import alignment, measures, observations, surface_charts
from processor.defects.alignment import rays_to
from processor.model import Scan, Scene, Stations
from tests.support import arrays_in_files

RADIUS, NOISE = 60.0, 1.0
SCANNER = np.array([1000.0, -5000.0, 0.0])


def rays_through(low, high, step):
    """Unit vectors of a scanner's rays to a grid of places (x, z) in the plane y = 0."""
    x, z = np.meshgrid(np.arange(low[0], high[0], step), np.arange(low[1], high[1], step))
    ray = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1) - SCANNER
    return ray / np.linalg.norm(ray, axis=1)[:, None]


def scan_of(ray, away, rng):
    points = SCANNER + ray * (away + rng.normal(0.0, NOISE, len(away)))[:, None]
    return Scene("tube", "structure", (Scan("S1", points, position=SCANNER, T_project_scan=np.eye(4)),))


@pytest.mark.parametrize("hollow", [False, True])
def test_cells_at_the_outline_of_a_tube_do_not_deviate_by_noise(hollow):
    """Noise along a ray moves a point around the tube; by its nearest place it would gather with others too far."""
    to_x = trimesh.transformations.rotation_matrix(0.5 * np.pi, [0, 1, 0])
    tube = trimesh.creation.cylinder(RADIUS, 2000.0, sections=360).apply_transform(to_x)
    tube.apply_translation([1000.0, 0.0, 0.0])
    side = np.abs(tube.face_normals[:, 0]) < 0.5
    faces = np.array(tube.faces, np.int64)[side][:, :: -1 if hollow else 1]
    surface = surface_charts.of_mesh(np.array(tube.vertices), faces, 43.3)
    ray = rays_through((200.0, -70.0), (1800.0, 70.0), 4.0)
    # Where a ray meets the tube about the x axis, in front or, seen from within its ends, at the back.
    a, b = ray[:, 1] ** 2 + ray[:, 2] ** 2, ray[:, 1:] @ SCANNER[1:]
    inside = b**2 - a * (SCANNER[1:] @ SCANNER[1:] - RADIUS**2)
    ray, a, b, inside = (x[inside > 0.0] for x in (ray, a, b, inside))
    away = (-b + (1.0 if hollow else -1.0) * np.sqrt(inside)) / a
    top, weight = 0.0, 0
    for seed in range(3):
        scene = scan_of(ray, away, np.random.default_rng(seed))
        observed = observations.observe(scene, np.eye(4), surface, 60.0)
        pairs = observations.paired(observed, surface)
        rays = rays_to(surface.centres[pairs.cell], SCANNER[None])
        cosine = np.abs(np.einsum("ni,ni->n", rays, surface.outward[pairs.cell]))
        oblique = cosine < 0.2  # cells of which the scanner sees the nearer part
        top += float((pairs.count * pairs.mean)[oblique].sum())
        weight += int(pairs.count[oblique].sum())
    assert weight > 1000
    assert abs(top / weight) < 4.0 * 0.5 * NOISE / np.sqrt(weight)  # half of the noise is along the normal there


def test_points_of_a_noisy_station_are_not_stray():
    """Of four points in a cell the nearest three often agree by chance, which makes the fourth no stray one."""
    box = trimesh.creation.box(bounds=np.array([[0.0, 0.0, 0.0], [2000.0, 20.0, 1000.0]]))
    surface = surface_charts.of_mesh(np.array(box.vertices), np.array(box.faces, np.int64), 40.0)
    ray = rays_through((0.0, 0.0), (2000.0, 1000.0), 20.0)
    away = -SCANNER[1] / ray[:, 1]
    scene = scan_of(ray, away, np.random.default_rng(5))
    pairs = observations.paired(observations.observe(scene, np.eye(4), surface, 60.0), surface)
    assert (pairs.stray - pairs.mixed).sum() < 0.002 * len(away)  # beyond 4 sd of their cell, which is known by four
    sd = np.sqrt(pairs.square.sum() / (pairs.count - 1.0).clip(0.0).sum())
    assert sd == pytest.approx(NOISE, rel=4.0 / np.sqrt(2.0 * len(away)))  # four sds of a standard deviation


def test_points_in_blocks_and_parts_are_those_at_once(monkeypatch, tmp_path):
    """Of a box seen from two stations and an unknown one, in one merged scan; all arrays in files."""
    box = trimesh.creation.box(bounds=np.array([[0.0, 0.0, 0.0], [2000.0, 20.0, 1000.0]]))
    surface = surface_charts.of_mesh(np.array(box.vertices), np.array(box.faces, np.int64), 40.0)
    ray, rng = rays_through((-50.0, -50.0), (2050.0, 1050.0), 20.0), np.random.default_rng(6)
    post = np.abs(ray[:, 0] / ray[:, 1] - 0.02) < 0.01  # before the box
    away = np.where(post, -SCANNER[1] - 400.0, -SCANNER[1]) / ray[:, 1]
    points = SCANNER + ray * (away + rng.normal(0.0, NOISE, len(away)))[:, None]
    stations = Stations(("A", "B"), np.array([SCANNER, SCANNER + np.array([300.0, 0.0, 0.0])]))
    named = rng.integers(-1, 2, len(points)).astype(np.int32)
    scene = Scene("box", "structure", (Scan("s", points, point_station=named),), stations=stations)

    def found():
        observed = observations.observe(scene, np.eye(4), surface, 60.0)
        pairs = observations.paired(observed, surface)
        by_cell = measures.points_by_cell(observed, SimpleNamespace(surface=surface, deviation=surface.share))
        cell_mm = observations.fitting_cell(observed, surface, 12.0, (5.0, 60.0))
        aligned = alignment.align(pairs, surface, observed.stations, 1.0)
        variance = alignment.station_variance(pairs, surface, observed.stations, aligned)
        of_points = list(vars(observed).values())[:5]
        return (*of_points, *vars(pairs).values(), by_cell.order, by_cell.cell, cell_mm, variance)

    whole = found()
    assert whole[4].any()
    monkeypatch.setattr(observations, "CHUNK", 500)
    monkeypatch.setattr(observations, "PART_POINTS", 300)
    monkeypatch.setattr(alignment, "PAIRS_AT_ONCE", 70)
    monkeypatch.setattr(mixed_pixels, "AT_ONCE", 400)
    monkeypatch.setattr(mixed_pixels, "BAND_POINTS", 200)
    arrays_in_files.limit(monkeypatch, 333, 100)
    with large_arrays.in_files(tmp_path):
        for ours, theirs in zip(found(), whole, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-9)  # sums of blocks in another order


def test_a_quantile_in_files_is_that_of_numpy(monkeypatch):
    values = np.random.default_rng(7).normal(0.0, 1.0, 1001)
    expected = [np.quantile(values, share) for share in (0.0, 0.05, 0.333, 0.5, 1.0)]
    monkeypatch.setattr(large_arrays, "AT_ONCE", 10)
    monkeypatch.setattr(large_arrays, "BLOCK_ROWS", 97)
    assert [large_arrays.quantile(values, share) for share in (0.0, 0.05, 0.333, 0.5, 1.0)] == expected
