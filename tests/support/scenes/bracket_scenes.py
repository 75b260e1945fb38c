"""Scans of a bracket that moved: of a few thousand points, for tests that take these for many."""

import numpy as np
import trimesh

from processor.geometry import rigid
from processor.model import Scan, Scene, Stations, StructureDesign
from tests.support.solids.meshes import bracket

COUNT = 12_000


def scene_of(seed=1, scans=1, stations=False, outliers=200, count=COUNT):
    """A bracket that moved by 4 mm, some points about it, in scans or in one cloud of two stations."""
    mesh, rng = bracket(), np.random.default_rng(seed)
    points = np.asarray(trimesh.sample.sample_surface(mesh, count - outliers, seed=seed)[0])
    points = points + np.array([0.0, 4.0, 0.0]) + rng.normal(0.0, 1.0, points.shape)
    low, high = points.min(axis=0) - 300.0, points.max(axis=0) + 300.0
    points = rng.permutation(np.vstack([points, rng.uniform(low, high, (outliers, 3))]))
    design = StructureDesign("bracket", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    places = np.array([[0.0, -8000.0, 4000.0], [3000.0, 9000.0, 5000.0]])
    if stations:
        named = rng.integers(0, 2, count).astype(np.int32)
        both, scan = Stations(("A", "B"), places), Scan("scan", points, point_station=named)
        return Scene("bracket", "structure", (scan,), structure=design, stations=both, units="mm")
    T = [rigid.transform(rigid.rotation_from_vector(np.array([0.0, 0.0, 0.3 * k])), places[k]) for k in range(2)]
    parts = np.array_split(points, scans)
    posed = tuple(
        Scan(f"S{k}", rigid.apply(rigid.invert(T[k]), part), position=np.zeros(3), T_project_scan=T[k])
        for k, part in enumerate(parts)
    )
    return Scene("bracket", "structure", posed, structure=design, units="mm")
