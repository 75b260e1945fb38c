"""Scenes of assemblies of prismatic parts, each part scanned in a frame of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from designgen.asbuilt.imperfections import Ledger
from designgen.checks import expect
from designgen.designs import bolt_holes
from designgen.designs import girder_assemblies as design_of
from designgen.designs.prismatic_parts import EndErrors, Part
from designgen.randomness import generator
from designgen.recipe_params import filled
from designgen.rigid import inverse
from designgen.scanning import sampler, surroundings
from designgen.scanning.scan_settings import ByRays, Scanning
from designgen.scenes.separate_parts import SeparateScans
from processor.model import ArchDesign, ArchTruth, DesignPart, Floats, Scene, Truth


@dataclass(frozen=True)
class Errors:
    """Standard deviations of the errors of each end at a joint, and of the place of each bolt hole along its plate."""

    length_mm: float = 0.0
    skew_mrad: float = 0.0
    corner_mm: float = 0.0
    hole_mm: float = 0.0

    def __post_init__(self) -> None:
        for key, value in self.__dict__.items():
            expect(value >= 0.0, f"asbuilt.{key}", value, "0 or more")


def make(name: str, recipe: Mapping[str, Any], scanning: Scanning, seed: int) -> tuple[Scene, Truth]:
    """Make the scene of an assembly, a scan of each part in a separate frame, and its truth."""
    ledger = Ledger()
    nominal, parts = built(recipe, seed, ledger)
    names = tuple(part.name for part in parts)
    apart = SeparateScans(names, scanning, seed)
    poses, ends = [], []
    for number, part in enumerate(parts):
        box = _box(part)
        T = apart.pose(part.name, box)
        if isinstance(scanning, ByRays):
            apart.add_survey(scanning, part.built(), box, T)
        else:
            patches = [(number, patch) for patch in part.built()]
            apart.add_samples(sampler.scan_patches(patches, scanning, generator(seed, f"scan {part.name}")), T)
        poses.append(inverse(T))
        for end in part.ends:
            corners = end.key_points()
            displaced = corners + part.displacement(corners)
            ends.append((number, end.joint, end.outward, displaced @ T[:3, :3].T + T[:3, 3], displaced))
    stations, station_truth = apart.stations()
    scene = Scene(
        name,
        "arch-bridge",
        tuple(apart.scans),
        arch=_design(nominal),
        stations=stations,
        steel=scanning.surroundings.steel if isinstance(scanning, ByRays) and scanning.surroundings else None,
    )
    return scene, Truth(
        tuple(apart.labels),
        arch=_truth(nominal, names, poses, ends),
        stations=station_truth,
        as_built=ledger.record() if "asbuilt" in recipe else None,
    )


def built(recipe: Mapping[str, Any], seed: int, ledger: Ledger) -> tuple[design_of.Assembly, list[Part]]:
    """Return the assembly of a recipe as designed, and its parts as built, whose errors are added to the ledger."""
    sizes = filled(design_of.Params, recipe, "assembly")
    bolts = filled(bolt_holes.Params, recipe, "bolts") if "bolts" in recipe else None
    nominal = design_of.build(sizes, bolts)
    errors = filled(Errors, recipe, "asbuilt")
    shifts = {
        part.name: _drilled(part, errors, generator(seed, f"holes {part.name}"), ledger) for part in nominal.parts
    }
    drilled = design_of.build(sizes, bolts, shifts).parts
    return nominal, [_built(part, errors, generator(seed, f"built {part.name}"), ledger) for part in drilled]


def _drilled(part: Part, errors: Errors, rng: np.random.Generator, ledger: Ledger) -> Floats:
    """Draw by how much each hole (n, 3) of a part lies off its place along its plate, and add it to the ledger."""
    bores = part.girder.bores if part.girder is not None else ()
    shifts = np.zeros((len(bores), 3))
    for k, bore in enumerate(bores):
        depth = np.array([0.0, *(bore.end - bore.start)])
        across = np.cross(depth / np.linalg.norm(depth), [1.0, 0.0, 0.0])
        along, beside = errors.hole_mm * rng.standard_normal(2)
        shifts[k] = [along, 0.0, 0.0] + beside * across
        for axis, value in zip(("along", "left", "up"), shifts[k], strict=True):
            ledger.note(f"hole {k + 1}, {axis}", part.name, value, "mm")
    return shifts


def _box(part: Part) -> surroundings.Box:
    """Return the box about a part as designed, along its axis."""
    points = np.concatenate([end.key_points() for end in part.ends] + [part.mesh()[0]])
    T = part.ends[0].T if part.girder is None else part.girder.T
    local = (points - T[:3, 3]) @ T[:3, :3]
    low, high = local.min(axis=0), local.max(axis=0)
    middle = T[:3, :3] @ (0.5 * (low + high)) + T[:3, 3]
    return surroundings.Box(T[:3, :3].T, middle, 0.5 * (high - low))


def _built(part: Part, errors: Errors, rng: np.random.Generator, ledger: Ledger) -> Part:
    """Draw the errors of a part's ends, and add them to the ledger."""
    scale = np.array([errors.length_mm, 1e-3 * errors.skew_mrad, 1e-3 * errors.skew_mrad])
    drawn = []
    for end in part.ends:
        plane, corners = rng.standard_normal(3) * scale, errors.corner_mm * rng.standard_normal((4, 3))
        drawn.append(EndErrors(plane, corners))
        where = f"{part.name} at {end.joint}"
        for what, value, unit in zip(
            ("length error", "skew about z", "skew about y"), plane, ("mm", "rad", "rad"), strict=True
        ):
            ledger.note(what, where, value, unit)
        ledger.note_corners("corner", where, corners)
    return part.with_errors(drawn)


def _design(nominal: design_of.Assembly) -> ArchDesign:
    ends = [end for part in nominal.parts for end in part.ends]
    return ArchDesign(
        tuple(DesignPart(part.name, *part.mesh()) for part in nominal.parts),
        tuple(joint.name for joint in nominal.joints),
        tuple(joint.left for joint in nominal.joints),
        tuple(joint.right for joint in nominal.joints),
        np.array([next(end for end in ends if end.joint == joint.name).key_points() for joint in nominal.joints]),
    )


def _truth(
    nominal: design_of.Assembly,
    names: tuple[str, ...],
    poses: Sequence[Floats],
    ends: Sequence[tuple[int, str, float, Floats, Floats]],
) -> ArchTruth:
    """Put the key points at start and end, or by joint where a part has several starts or ends."""
    in_scan, in_bridge = np.full((2, len(names), 2, 8, 3), np.nan)
    several = {part for part, _, outward, *_ in ends if sum(o == outward and p == part for p, _, o, *_ in ends) > 1}
    for part, _, outward, of_scan, of_bridge in ends:
        if part not in several:
            in_scan[part, int(outward > 0.0)], in_bridge[part, int(outward > 0.0)] = of_scan, of_bridge
    branched = [end for end in ends if end[0] in several]
    joints = [joint.name for joint in nominal.joints]
    return ArchTruth(
        names,
        np.array(poses),
        in_scan,
        in_bridge,
        np.full((len(names), 2, 1, 3), np.nan),
        branch_component=np.array([end[0] for end in branched], np.int64),
        branch_joint=np.array([joints.index(end[1]) for end in branched], np.int64),
        branch_scan=np.array([end[3] for end in branched]).reshape(-1, 8, 3),
        branch_bridge=np.array([end[4] for end in branched]).reshape(-1, 8, 3),
    )
