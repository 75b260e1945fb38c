"""What stands against a structure is not measured as its movement: boards, trays, tubes and crates on a box girder."""

import numpy as np
import pytest
import trimesh

from processor.deviation import step as deviation_step
from processor.geometry.mesh_distance import Samples
from processor.model import Scan, Scene, StructureDesign
from processor.registration import surface_layers

SIGMA = 0.7  # mm
LENGTH, WIDTH = 6000.0, 400.0


def girder():
    return trimesh.creation.box((LENGTH, WIDTH, WIDTH))


def sag(points, size):
    return size * (1.0 - (points[:, 0] / (0.5 * LENGTH)) ** 2)


def beside(rng):
    """Return what stands against the girder, as boxes (low, high): a board on it, a tray, a crate, an upright post."""
    x, gap, at = rng.uniform(-2000.0, 1000.0), rng.uniform(8.0, 30.0), rng.uniform(-2500.0, 2500.0)
    side = 0.5 * WIDTH
    return np.array(
        [
            [[x, -110.0, side + 1.0], [x + 1500.0, 115.0, side + 39.0]],
            [[-x, side + gap, -100.0], [1200.0 - x, side + gap + 10.0, 60.0]],
            [[-2800.0, side + 3.0, -800.0], [-2300.0, side + 500.0, -50.0]],
            [[at, -side - gap - 48.0, -1000.0], [at + 48.0, -side - gap, 1000.0]],
        ]
    )


def scene_of(seed, *, beside_it, size=8.0, count=60_000):
    rng = np.random.default_rng(seed)
    mesh = girder()
    points = trimesh.sample.sample_surface(mesh, count, seed=seed)[0]
    points = points + np.outer(sag(points, -size), [0.0, 0.0, 1.0])
    if beside_it:
        boxes = beside(rng)
        solids = [trimesh.creation.box(bounds=one) for one in boxes]
        each = [int(solid.area / mesh.area * count) for solid in solids]
        others = [trimesh.sample.sample_surface(one, n, seed=seed)[0] for one, n in zip(solids, each, strict=True)]
        # No beam reaches the side that a solid turns to the girder.
        half = 0.5 * np.array([LENGTH, WIDTH, WIDTH])
        far = [np.linalg.norm((np.abs(one) - half).clip(0.0), axis=1) for one in others]
        others = [one[d > d.min() + 1.0] for one, d in zip(others, far, strict=True)]
        off = np.maximum(boxes[:, None, 0] - points, points - boxes[:, None, 1]).clip(0.0)
        hidden = (np.linalg.norm(off, axis=2) < 12.0).any(axis=0)  # no beam reaches steel so near to a solid
        points = np.concatenate([points[~hidden], *others])
    points = points + rng.normal(0.0, SIGMA, points.shape)
    design = StructureDesign("girder", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return Scene("girder", "structure", (Scan("scan", points),), structure=design, units="mm")


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 11))])
def test_what_stands_against_steel_is_not_its_movement(seed):
    scene = scene_of(seed, beside_it=True)
    result = deviation_step.run(scene, deviation_step.Params(registration_error_mm=0.0))
    core = result.core
    known = np.isfinite(core.lod95)
    error = np.abs(core.distance + core.normals[:, 2] * sag(core.points + result.origin, 8.0))
    assert np.mean(error[known] <= core.lod95[known]) >= 0.92  # a written requirement
    assert (error[known] <= core.lod95[known] + 5.0).all()  # another
    assert known.mean() > 0.85  # what is hidden is a tenth


def of_flange(below, tray=(0.0, 0.0), stray=0.0):
    """Layers of a plate 20 mm thick, its feet (n, 3) and distances (n,); a share ``below`` is of its underside.

    Of that a ``tray`` hides what lies between two places; a share ``stray`` above is seen past an edge, 60 mm behind.
    """
    rng = np.random.default_rng(1)
    x, y, below = rng.uniform(0.0, 3000.0, 20_000), rng.uniform(0.0, 260.0, 20_000), rng.random(20_000) < below
    below |= (x > tray[0] + 400.0) & (x < tray[1] - 700.0)
    of_tray, behind = below & (x > tray[0]) & (x < tray[1]), ~below & (rng.random(len(x)) < stray)
    feet = np.column_stack([x, y, np.where(below, 0.0, 20.0)])
    distance = np.where(of_tray, 66.0, np.where(behind, -60.0, 0.0)) + 0.5 * rng.normal(size=len(x))
    normals = np.where(below, -1.0, 1.0)[:, None] * [0.0, 0.0, 1.0]
    body = np.zeros(len(feet) // 4, np.int64)
    layers = surface_layers.of_points(
        Samples(feet[::4], normals[::4], body), body, feet, distance, normals, diameter_mm=50.0
    )
    return layers, feet, distance, of_tray, behind


def test_a_tray_below_most_of_a_flange_is_told_by_the_other_side():
    layers, feet, distance, tray, _ = of_flange(0.7, tray=(200.0, 2800.0))
    assert tray.mean() > 0.6
    assert np.mean(layers.of_structure(feet, distance)[tray]) < 0.01


def test_what_is_seen_past_an_edge_is_left_out_where_it_is_no_evidence():
    layers, feet, distance, _, behind = of_flange(0.5, stray=0.03)
    assert layers.of_structure(feet, distance)[behind].all()  # as in holes
    kept = layers.of_structure(feet, distance, behind=False)
    assert np.mean(kept[behind]) < 0.01
    assert np.mean(kept[~behind]) > 0.99
