"""From a recipe to a scene and its truth."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np

from designgen import mesh, sampler
from designgen.designs import arch_bridge, arch_part, space_frame
from processor.model import (
    KINDS,
    ArchDesign,
    ArchTruth,
    DesignPart,
    Floats,
    FrameDesign,
    FrameTruth,
    PointLabels,
    Scan,
    Scene,
    Truth,
    UsageError,
)

P = TypeVar("P")
POSE_REACH_MM = 5000.0  # scan frames lie this far apart at most, along each axis


def make(name: str, recipe: Mapping[str, Any], seed: int | None = None) -> tuple[Scene, Truth]:
    """Make the scene of a recipe and its truth; ``seed`` replaces the recipe's own.

    Raises UsageError that names the key for an unknown kind or key, a wrong type or an impossible size.
    """
    kind = recipe.get("kind")
    makers = {"arch-bridge": ("bridge", _bridge), "space-frame": ("frame", _frame)}
    if kind not in makers:
        raise UsageError(f"recipe {name}: kind: expected one of {', '.join(makers)}, got {kind!r}")
    section, maker = makers[kind]
    known = {"about", "kind", "seed", "scan", section}
    if unknown := sorted(set(recipe) - known):
        raise UsageError(f"recipe {name}: unknown key {unknown[0]!r}; there are {', '.join(sorted(known))}")
    used = recipe.get("seed", 0) if seed is None else seed
    if not isinstance(used, int) or isinstance(used, bool) or used < 0:
        raise UsageError(f"recipe {name}: seed: expected a whole number from 0, got {used!r}")
    return maker(name, recipe, _params(sampler.Params, recipe, "scan"), used)


def generator(seed: int, purpose: str) -> np.random.Generator:
    """One stream of random numbers a purpose, so that what is added elsewhere leaves it as it was."""
    digest = hashlib.sha256(purpose.encode()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "little")])


def _params(cls: type[P], recipe: Mapping[str, Any], section: str) -> P:
    """Fill a Params record from a section of the recipe, with every key and type checked."""
    table = recipe.get(section, {})
    if not isinstance(table, Mapping):
        raise UsageError(f"{section}: expected a section, got {table!r}")
    fields = {f.name: f.default for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in fields:
            raise UsageError(f"{section}.{key}: unknown key; there are {', '.join(fields)}")
        values[key] = _like(fields[key], value, f"{section}.{key}")
    return cls(**values)


def _like(default: Any, value: Any, where: str) -> Any:
    """Check a value against the type of a key's default; the value, as a tuple where the default is one."""
    if isinstance(default, tuple):
        items = value if isinstance(value, list) else [value]
        return tuple(_like(default[0], item, where) for item in items)
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not type(default):
        raise UsageError(f"{where}: expected a {type(default).__name__}, got {value!r}")
    if isinstance(value, float) and not math.isfinite(value):
        raise UsageError(f"{where}: expected a finite number, got {value!r}")
    return value


def _bridge(name: str, recipe: Mapping[str, Any], scan: sampler.Params, seed: int) -> tuple[Scene, Truth]:
    parts = arch_bridge.build(_params(arch_bridge.Params, recipe, "bridge"))
    part_names = tuple(part.name for part in parts)
    scans, labels, poses, key_bridge, key_scan = [], [], [], [], []
    for number, part in enumerate(parts):
        cloud = sampler.scan_part(part, number, scan, generator(seed, f"scan {part.name}"))
        T_scan_bridge = random_pose(generator(seed, f"pose {part.name}"))
        R, t = T_scan_bridge[:3, :3], T_scan_bridge[:3, 3]
        scans.append(Scan(part.name, cloud.points @ R.T + t, component=part.name, sigma_mm=scan.sigma_mm))
        labels.append(PointLabels(part.name, part_names, cloud.part, cloud.source))
        T_bridge_scan = np.eye(4)
        T_bridge_scan[:3, :3], T_bridge_scan[:3, 3] = R.T, -R.T @ t
        poses.append(T_bridge_scan)
        ends = np.array([_end_points(part, "start", part.s0), _end_points(part, "end", part.s1)])
        key_bridge.append(ends)
        key_scan.append(ends @ R.T + t)
    design = ArchDesign(
        tuple(_design_part(part) for part in parts),
        tuple(f"J{j + 1}" for j in range(len(parts) - 1)),
        part_names[:-1],
        part_names[1:],
        np.array([part.key_points(part.s1) for part in parts[:-1]]),
    )
    truth = ArchTruth(part_names, np.array(poses), np.array(key_scan), np.array(key_bridge))
    scene = Scene(name, KINDS[0], tuple(scans), arch=design, units="mm", units_reason="made in millimetres")
    return scene, Truth(tuple(labels), arch=truth, spacing_mm=scan.spacing_mm, sigma_mm=scan.sigma_mm)


def _end_points(part: arch_part.ArchPart, end: str, s: float) -> Floats:
    return np.full((8, 3), np.nan) if part.closed == end else part.key_points(s)


def _design_part(part: arch_part.ArchPart) -> DesignPart:
    vertices, faces = mesh.triangulate(arch_part.solid(part), arch_part.TESSELLATION_MM)
    return DesignPart(part.name, vertices, faces, *part.bottom_edges())


def random_pose(rng: np.random.Generator) -> Floats:
    """Draw a rigid T (4, 4): a rotation uniform over all, a translation within POSE_REACH_MM."""
    w, x, y, z = (q := rng.standard_normal(4)) / np.linalg.norm(q)
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = rng.uniform(-POSE_REACH_MM, POSE_REACH_MM, 3)
    return T


def _frame(name: str, recipe: Mapping[str, Any], scan: sampler.Params, seed: int) -> tuple[Scene, Truth]:
    frame = space_frame.build(_params(space_frame.Params, recipe, "frame"))
    cloud = sampler.scan_frame(frame, scan, generator(seed, "scan"))
    ids = np.arange(len(frame.centres))
    diameters = np.full(len(frame.members), frame.connection.tube_diameter)
    design = FrameDesign(ids, frame.centres, frame.radii, frame.members[:, 0], frame.members[:, 1], diameters)
    lowest = frame.centres - frame.radii[:, None] * np.array([0.0, 0.0, 1.0])
    names = tuple(f"ball {i}" for i in ids)
    scene = Scene(
        name,
        KINDS[1],
        (Scan("scan", cloud.points, sigma_mm=scan.sigma_mm),),
        frame=design,
        units="mm",
        units_reason="made in millimetres",
    )
    truth = Truth(
        (PointLabels("scan", names, cloud.part, cloud.source),),
        frame=FrameTruth(ids, frame.centres, frame.radii, lowest),
        spacing_mm=scan.spacing_mm,
        sigma_mm=scan.sigma_mm,
    )
    return scene, truth
