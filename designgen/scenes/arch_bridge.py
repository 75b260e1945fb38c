"""Scenes of arch bridges: parts as designed or as built, each scanned in a separate frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from designgen.asbuilt import imperfections
from designgen.designs import arch_bridge, arch_mesh, arch_part, closed_ring
from designgen.designs.parametric_face import Surface
from designgen.randomness import generator, random_pose
from designgen.recipe_params import filled
from designgen.rigid import inverse, rigid
from designgen.scanning import clutter, sampler, surroundings, survey
from designgen.scanning.scan_settings import ByRays, Scanning
from designgen.scanning.surfaces import Builder
from designgen.scenes import MADE_IN_MM
from processor.model import ArchDesign, ArchTruth, DesignPart, Floats, PointLabels, Scan, Scene, StationTruth, Truth

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
    scans, labels, poses, key_bridge, key_scan = [], [], [], [], []
    registered: list[Floats] = []  # poses of each part's stations in the frame of its scan
    station_truths: list[StationTruth] = []
    for number, part in enumerate(built):
        T_scan_bridge, box = random_pose(generator(seed, f"pose {part.name}")), _box(part)
        if isinstance(scanning, ByRays) and scanning.surroundings is not None:  # by a scanner on the same floor
            T_scan_bridge = box.levelled(T_scan_bridge)
        R, t = T_scan_bridge[:3, :3], T_scan_bridge[:3, 3]
        # The steel expands about the origin of its scan: p_scan = grown (R p_bridge + t).
        T_scan_grown = rigid(R, grown * t)
        if isinstance(scanning, ByRays):
            surveyed = _survey_part(part, box, number, part_names, grown, scanning, seed)
            scan, label = survey.merged(surveyed, part.name, T_scan_grown, sum(map(len, registered)), part.name)
            registered.append(T_scan_grown @ surveyed.registered)
            poses_true = T_scan_grown @ surveyed.truth.T_project_station
            station_truths.append(dataclasses.replace(surveyed.truth, T_project_station=poses_true))
        else:
            cloud = sampler.scan_part(part, number, scanning, generator(seed, f"scan {part.name}"))
            points = (grown * cloud.points) @ R.T + grown * t
            scan = Scan(part.name, points, component=part.name, sigma_mm=scanning.sigma_mm)
            label = PointLabels(part.name, part_names, cloud.part, cloud.source)
        scans.append(scan)
        labels.append(label)
        poses.append(inverse(T_scan_bridge))
        ends = np.array([_end_points(part, "start", part.s0), _end_points(part, "end", part.s1)])
        key_bridge.append(ends)
        key_scan.append(grown * (ends @ R.T + t))
    station_truth = survey.joined_truth(station_truths) if station_truths else None
    scene = Scene(
        name,
        "arch-bridge",
        tuple(scans),
        arch=_design(parts, closed=closed),
        stations=survey.stations_of(station_truth.ids, np.concatenate(registered)) if station_truth else None,
        temperature_C=imperfections.stated(errors.temperature_C),
        units="mm",
        units_reason=MADE_IN_MM,
    )
    edges = np.array([_bottom_edges(part) for part in built])
    return scene, Truth(
        tuple(labels),
        arch=ArchTruth(part_names, np.array(poses), np.array(key_scan), np.array(key_bridge), edges),
        stations=station_truth,
        as_built=ledger.record() if "asbuilt" in recipe else None,
        spacing_mm=scanning.spacing_mm,
        sigma_mm=scanning.sigma_mm,
    )


def _box(part: arch_part.ArchPart) -> surroundings.Box:
    """Return the box about a part's ends, along its chord."""
    ends = np.vstack([part.key_points(part.s0), part.key_points(part.s1)])
    along = ends[8:].mean(axis=0) - ends[:8].mean(axis=0)
    along = along / np.linalg.norm(along)
    axes = np.stack([along, [0.0, 1.0, 0.0], np.cross(along, [0.0, 1.0, 0.0])])
    middle = ends.mean(axis=0)
    return surroundings.Box(axes, middle, np.abs((ends - middle) @ axes.T).max(axis=0), _bottom_edges(part)[0])


def _survey_part(
    part: arch_part.ArchPart,
    box: surroundings.Box,
    number: int,
    part_names: tuple[str, ...],
    grown: float,
    scanning: ByRays,
    seed: int,
) -> survey.Survey:
    """Scan one part, enlarged by ``grown``, from stations around it, in the bridge's frame."""
    params, about = scanning.params, scanning.surroundings
    builder = Builder()
    for patch in arch_part.ray_patches(part):
        builder.patch(number, dataclasses.replace(patch, at=_scaled(patch.at, grown)))
    poses = survey.stations_around_box(box, params, seed, f"{part.name}/", on_floor=about is not None)
    surroundings.add(builder, about, box, poses, seed, part.name)
    places = [T[:3, 3] for T in poses.values()]
    for i in range(params.clutter):
        rng = generator(seed, f"clutter {part.name} {i}")
        clutter.add_pole(builder, places[i % len(places)], box.middle, box.axes[2], (0.3, 0.6), rng, on_ground=False)
    return survey.survey(builder.to_surfaces(), part_names, poses, scanning.device, params, seed)


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
