"""Scenes of arch bridges: parts as designed or as built, each scanned in a separate frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from designgen.asbuilt import imperfections
from designgen.designs import arch_bridge, arch_mesh, arch_part, closed_ring
from designgen.designs.parametric_face import Surface
from designgen.randomness import generator
from designgen.recipe_params import filled
from designgen.rigid import inverse, rigid
from designgen.scanning import sampler, surroundings
from designgen.scanning.scan_settings import ByRays, Scanning
from designgen.scenes.separate_parts import SeparateScans
from processor.model import ArchDesign, ArchTruth, DesignPart, Floats, Scene, Truth

EDGE_POINTS = 501  # on each bottom edge in the truth


def make(name: str, recipe: Mapping[str, Any], scanning: Scanning, seed: int) -> tuple[Scene, Truth]:
    """Make the scene of an arch bridge, a scan of each part in a separate frame, and its truth."""
    parts = arch_bridge.build(filled(arch_bridge.Params, recipe, "bridge"))
    return _made(name, recipe, scanning, seed, parts, closed=False)


def make_ring(name: str, recipe: Mapping[str, Any], scanning: Scanning, seed: int) -> tuple[Scene, Truth]:
    """Make the scene of a closed ring of ribs, as of a bridge."""
    parts = closed_ring.build(filled(closed_ring.Params, recipe, "ring"))
    return _made(name, recipe, scanning, seed, parts, closed=True)


Parts = tuple[arch_part.ArchPart, ...]


def _made(
    name: str, recipe: Mapping[str, Any], scanning: Scanning, seed: int, parts: Parts, *, closed: bool
) -> tuple[Scene, Truth]:
    """Make the scene of parts; ``closed``: the last one is joined to the first."""
    errors = filled(imperfections.ArchParams, recipe, "asbuilt")
    ledger = imperfections.Ledger()
    built = list(parts)
    if "asbuilt" in recipe:
        built = imperfections.arch(parts, errors, [generator(seed, f"built {part.name}") for part in parts], ledger)
    grown = imperfections.expansion(errors.temperature_C)
    part_names = tuple(part.name for part in parts)
    apart = SeparateScans(part_names, scanning, seed)
    poses, key_bridge, key_scan = [], [], []
    for number, part in enumerate(built):
        box = _box(part)
        T_scan_bridge = apart.pose(part.name, box)
        R, t = T_scan_bridge[:3, :3], T_scan_bridge[:3, 3]
        # The steel expands about the origin of its scan: p_scan = grown (R p_bridge + t).
        T_scan_grown = rigid(R, grown * t)
        if isinstance(scanning, ByRays):
            patches = [replace(patch, at=_scaled(patch.at, grown)) for patch in arch_part.ray_patches(part)]
            apart.add_survey(scanning, patches, box, T_scan_grown, scanning.params.clutter)
        else:
            cloud = sampler.scan_part(part, number, scanning, generator(seed, f"scan {part.name}"))
            apart.add_samples(replace(cloud, points=grown * cloud.points), T_scan_grown)
        poses.append(inverse(T_scan_bridge))
        ends = np.array([_end_points(part, "start", part.s0), _end_points(part, "end", part.s1)])
        key_bridge.append(ends)
        key_scan.append(grown * (ends @ R.T + t))
    stations, station_truth = apart.stations()
    scene = Scene(
        name,
        "arch-bridge",
        tuple(apart.scans),
        arch=_design(parts, closed=closed),
        stations=stations,
        temperature_C=imperfections.stated(errors.temperature_C),
        steel=scanning.surroundings.steel if isinstance(scanning, ByRays) and scanning.surroundings else None,
    )
    edges = np.array([_bottom_edges(part) for part in built])
    return scene, Truth(
        tuple(apart.labels),
        arch=ArchTruth(part_names, np.array(poses), np.array(key_scan), np.array(key_bridge), edges),
        stations=station_truth,
        as_built=ledger.record() if "asbuilt" in recipe else None,
    )


def _box(part: arch_part.ArchPart) -> surroundings.Box:
    """Return the box about a part's ends, along its chord."""
    ends = np.vstack([part.key_points(part.s0), part.key_points(part.s1)])
    along = ends[8:].mean(axis=0) - ends[:8].mean(axis=0)
    along = along / np.linalg.norm(along)
    axes = np.stack([along, [0.0, 1.0, 0.0], np.cross(along, [0.0, 1.0, 0.0])])
    middle = ends.mean(axis=0)
    return surroundings.Box(axes, middle, np.abs((ends - middle) @ axes.T).max(axis=0), _bottom_edges(part)[0])


def _scaled(at: Surface, factor: float) -> Surface:
    return at if factor == 1.0 else lambda p, q: factor * at(p, q)


def _end_points(part: arch_part.ArchPart, end: str, s: float) -> Floats:
    return np.full((8, 3), np.nan) if part.closed == end else part.key_points(s)


def _bottom_edges(part: arch_part.ArchPart) -> Floats:
    """Return points (2, EDGE_POINTS, 3) along the left and right bottom edges as built."""
    s = np.linspace(part.s0, part.s1, EDGE_POINTS)
    return np.array([part.point(s, side * part.b(s), np.zeros_like(s)) for side in (1.0, -1.0)])


def _design(parts: Parts, *, closed: bool) -> ArchDesign:
    left, right = (parts, (*parts[1:], parts[0])) if closed else (parts[:-1], parts[1:])
    return ArchDesign(
        tuple(DesignPart(part.name, *arch_mesh.triangulate(part), *part.bottom_edges()) for part in parts),
        tuple(f"J{j + 1}" for j in range(len(left))),
        tuple(part.name for part in left),
        tuple(part.name for part in right),
        np.array([part.key_points(part.s1) for part in left]),
    )
