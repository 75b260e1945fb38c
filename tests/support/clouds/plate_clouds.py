"""A plate exactly as designed, seen by stations with noise along the rays."""

import numpy as np
import trimesh

from processor.deviation import step as deviation_step
from processor.model import Scan, Scene, StructureDesign

STATIONS = np.array([[2500.0, 1800.0, 2500.0], [-2200.0, -2600.0, -2400.0]])
SIGMA = 0.5
AS_IT_LIES = deviation_step.Params(register="none")  # as by default, but for the search for other attitudes


def plate(thickness, seed, stations, positions, count=60_000):
    """A plate as designed, with noise along the rays of the stations that see each place, one scan a station."""
    mesh = trimesh.creation.box((300.0, 300.0, thickness))
    rng = np.random.default_rng(seed)
    points, facet = trimesh.sample.sample_surface(mesh, count, seed=seed)
    points, normals = np.asarray(points), mesh.face_normals[facet]
    sees = np.einsum("nki,ni->nk", stations - points[:, None], normals) > 0.0
    chosen = np.argmax(sees * rng.random(sees.shape), axis=1)
    scans = []
    for k, station in enumerate(stations):
        some = points[sees.any(axis=1) & (chosen == k)]
        ray = (some - station) / np.linalg.norm(some - station, axis=1)[:, None]
        place = {"position": station} if positions else {}
        scans.append(Scan(f"s{k}", some + rng.normal(0.0, SIGMA, len(some))[:, None] * ray, **place))
    design = StructureDesign("plate", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return Scene("plate", "structure", tuple(scans), structure=design, units="mm")
