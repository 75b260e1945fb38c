"""A straight box built otherwise than designed, in closed form, seen by stations with errors of their own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh

from processor.model import Scan, Scene, StructureDesign

SIZE = np.array([3000.0, 400.0, 300.0])
STATIONS = np.array(
    [[-5000.0, -4000.0, 2500.0], [5000.0, -4000.0, -2500.0], [5000.0, 4500.0, 2500.0], [-5000.0, 4500.0, -2500.0]]
)


class Built(NamedTuple):
    """How the box is built: longer, wider and bowed sideways and up in mm; twisted and skewed in rad."""

    longer: float = 0.0
    wider: float = 0.0
    bow: float = 0.0
    camber: float = 0.0
    twist: float = 0.0
    skew: float = 0.0  # of the end face, about the upright axis


def moved(points, built):
    """Where points (n, 3) of the box as designed really are; the middle of the box is the origin."""
    x, y, _ = (points / (0.5 * SIZE)).T
    bend = np.cos(0.5 * np.pi * x)
    angle = 0.5 * built.twist * x
    off = np.stack([0.5 * built.longer * x, 0.5 * built.wider * y, 0.0 * x], axis=1)
    off[:, 0] += built.skew * points[:, 1] * 0.5 * (1.0 + x)
    off[:, 1] += built.bow * bend - angle * points[:, 2]
    off[:, 2] += built.camber * bend + angle * points[:, 1]
    return points + off


def beam(built, seed, sigma=1.0, registration=0.3, count=60_000, named=True, T=None):
    """A scene of the box from four stations; T (4, 4) moves what was built, not the design."""
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.box(SIZE)
    points, facet = trimesh.sample.sample_surface(mesh, count, seed=seed)
    points, normals = np.asarray(points), mesh.face_normals[facet]
    sees = np.einsum("nki,ni->nk", STATIONS - points[:, None], normals) > 0.0
    chosen = np.argmax(sees * rng.random(sees.shape), axis=1)
    real = moved(points, built)
    if T is not None:
        real = real @ T[:3, :3].T + T[:3, 3]
    scans = []
    for k, station in enumerate(STATIONS):
        some = real[sees.any(axis=1) & (chosen == k)]
        ray = (some - station) / np.linalg.norm(some - station, axis=1)[:, None]
        off = registration * rng.standard_normal(3)
        place = {"position": station} if named else {}
        scans.append(Scan(f"s{k}", some + rng.normal(0.0, sigma, len(some))[:, None] * ray + off, **place))
    design = StructureDesign("beam", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return Scene("beam", "structure", tuple(scans), structure=design, units="mm")
