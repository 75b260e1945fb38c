"""Hollow round faces, of which the steel lies outside: bores, and undersides of curved plates."""

import numpy as np
import pytest
import trimesh

from processor.defects import alignment, observations, surface_charts
from processor.defects import step as defects_step
from processor.model import Scan, Scene, StructureDesign
from tests.support.scenes.at_design import AT_DESIGN

INNER, OUTER, LENGTH = 400.0, 412.0, 1500.0
STATIONS = {"S1": np.array([300.0, -4000.0, 100.0]), "S2": np.array([1200.0, -4500.0, -200.0])}
NOISE, DENT, WIDE = 0.4, 4.0, 90.0


def half_pipe():
    """Mesh of half a pipe along x that opens to -y: a curved plate whose inner face looks to the stations."""
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 181)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)  # y, z
    ring = np.vstack([INNER * arc, OUTER * arc[::-1]])
    n = len(ring)
    i, j = np.arange(n), (np.arange(n) + 1) % n
    sides = np.vstack([np.stack([i, j, j + n], axis=1), np.stack([i, j + n, i + n], axis=1)])
    k, m = np.arange(n // 2 - 1), n - 1 - np.arange(n // 2 - 1)
    caps = np.vstack([np.stack([k, k + 1, m], axis=1), np.stack([k + 1, m - 1, m], axis=1)])
    vertices = np.vstack([np.hstack([np.full((n, 1), x), ring]) for x in (0.0, LENGTH)])
    mesh = trimesh.Trimesh(vertices, np.vstack([sides, caps[:, ::-1], caps + n]), process=False)
    mesh.fix_normals()
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(0.5 * np.pi * (OUTER**2 - INNER**2) * LENGTH, rel=1e-3)  # of 180 chords
    return np.array(mesh.vertices), np.array(mesh.faces, np.int64)


def scene_of(offset_mm, dent=DENT):
    """Scans of the inner face, pushed into its steel by a dent at its middle; the ranges of S2 have an offset."""
    vertices, faces = half_pipe()
    rng, scans = np.random.default_rng(1), []
    for name, position in STATIONS.items():
        n = 30_000
        x, angle = rng.uniform(0.0, LENGTH, n), rng.uniform(-0.45 * np.pi, 0.45 * np.pi, n)
        away = (x - 0.5 * LENGTH) ** 2 + (INNER * angle) ** 2
        radius = INNER + dent * np.maximum(1.0 - away / WIDE**2, 0.0) ** 2
        points = np.stack([x, radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        ray = points - position
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        points += ray * (rng.normal(0.0, NOISE, n) + (offset_mm if name == "S2" else 0.0))[:, None]
        scans.append(Scan(name, points, position=position, T_project_scan=np.eye(4)))
    return Scene("half-pipe", "structure", tuple(scans), structure=StructureDesign("half-pipe", vertices, faces))


def test_normals_of_cells_are_those_of_their_facets():
    """The normals of the pipe by its centre line: away from it outside, towards it inside."""
    pipe = trimesh.creation.annulus(INNER, OUTER, LENGTH, sections=180)
    surface = surface_charts.of_mesh(np.array(pipe.vertices), np.array(pipe.faces, np.int64), 20.0)
    ways = {}
    for chart in np.flatnonzero(surface.charts.kind == surface_charts.CYLINDER):
        rows = surface.charts.cells(int(chart))
        away = surface.centres[rows] * [1.0, 1.0, 0.0]
        cosine = np.einsum("ni,ni->n", away, surface.outward[rows]) / np.linalg.norm(away, axis=1)
        assert np.ptp(cosine) < 1e-6
        ways[round(surface.charts.radius[chart])] = round(float(cosine.mean()), 6)
    assert ways == {400: -1.0, 412: 1.0}


def test_the_offset_of_a_station_that_saw_a_hollow_face():
    """Ranges of one station are 1 mm too long: the movements of the two differ by that, with its sign."""
    scene = scene_of(1.0, dent=0.0)
    vertices, faces = half_pipe()
    surface = surface_charts.of_mesh(vertices, faces, 20.0)
    observed = observations.observe(scene, np.eye(4), surface, 60.0)
    pairs = observations.paired(observed, surface)
    aligned = alignment.align(pairs, surface, observed.stations, 1.0)
    normals = surface.outward[pairs.cell]
    rays = alignment.rays_to(surface.centres[pairs.cell], observed.stations.positions[pairs.station])
    corrected = aligned.corrections(surface.centres[pairs.cell], normals, rays, pairs.station)
    # A range too long by 1 mm lies deeper in the steel: cos of the angle between ray and normal is negative.
    of_offset = np.einsum("ni,ni->n", rays, normals) * (pairs.station == 1)
    left = pairs.mean - corrected
    apart = [np.average((x * np.where(pairs.station == 1, 1.0, -1.0)), weights=pairs.count) for x in (of_offset, left)]
    assert apart[0] < -0.3
    assert abs(apart[1]) < 0.02 * abs(apart[0])


def test_a_dent_of_a_hollow_face_is_found():
    result = defects_step.run(scene_of(0.3), defects_step.Params(), AT_DESIGN)
    assert result.examined_mm2 > 0.8 * 0.9 * np.pi * INNER * LENGTH
    assert [str(kind) for kind in result.defects.defect_class] == ["dent"]
    assert abs(abs(result.defects.depth_max[0]) - DENT) < max(0.4, result.defects.depth_ci95[0])
    np.testing.assert_allclose(result.defects.centre[0], [0.5 * LENGTH, INNER, 0.0], atol=20.0)  # about a cell
