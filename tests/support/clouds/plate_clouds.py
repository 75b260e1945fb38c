"""Bodies seen by stations with noise along the rays, and a plate exactly as designed."""

import numpy as np
import trimesh

from processor.deviation import step as deviation_step
from processor.model import Scan, Scene, StructureDesign

STATIONS = np.array([[2500.0, 1800.0, 2500.0], [-2200.0, -2600.0, -2400.0]])
SIGMA = 0.5
AS_IT_LIES = deviation_step.Params(register="none")  # as by default, but for the search for other attitudes


def seen(size, built, stations, positions, count, seed, sigma, shift=0.0):
    """A scene of a box: each place, by ``built`` where it really is, is in the scan of one station that sees it.

    ``sigma`` is that of the ranges, ``shift`` that of a scan's place along each axis.
    """
    mesh = trimesh.creation.box(size)
    rng = np.random.default_rng(seed)
    points, facet = trimesh.sample.sample_surface(mesh, count, seed=seed)
    points, normals = np.asarray(points), mesh.face_normals[facet]
    sees = np.einsum("nki,ni->nk", stations - points[:, None], normals) > 0.0
    chosen = np.argmax(sees * rng.random(sees.shape), axis=1)
    real, scans = built(points), []
    for k, station in enumerate(stations):
        some = real[sees.any(axis=1) & (chosen == k)]
        ray = (some - station) / np.linalg.norm(some - station, axis=1)[:, None]
        off = shift * rng.standard_normal(3) if shift else 0.0
        place = {"position": station} if positions else {}
        scans.append(Scan(f"s{k}", some + rng.normal(0.0, sigma, len(some))[:, None] * ray + off, **place))
    design = StructureDesign("box", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return Scene("box", "structure", tuple(scans), structure=design, units="mm")


def plate(thickness, seed, stations, positions, count=60_000):
    return seen((300.0, 300.0, thickness), lambda points: points, stations, positions, count, seed, SIGMA)
