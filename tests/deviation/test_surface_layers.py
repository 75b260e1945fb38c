"""What stands against a structure is not measured as its movement: boards, trays, tubes and crates on a box girder."""

import numpy as np
import pytest
import trimesh

from processor.deviation import step as deviation_step
from processor.model import Scan, Scene, StructureDesign

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
