"""Step ``defects``: defects of a structure against its design, found, measured and classified.

``default`` assigns points to cells of the design's surface, aligns the stations with each other and the whole with the
design, and searches for shapes of whole components, for places of any size that deviate and for missing places, at a
given rate of false alarms. ``paper`` follows paper 004 as far as its one available page describes the method.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from processor.components import bridge_parts, frame_members
from processor.defects import baseline, detect
from processor.defects.bridges import parts
from processor.defects.params import METHODS, Params
from processor.defects.result import Result
from processor.defects.verdicts import depths_and_areas
from processor.model import InputError, Scene, UsageError

__all__ = ["KIND", "METHODS", "NAME", "NEEDS", "Params", "Result", "applies", "needed", "run"]

NAME = "defects"
NEEDS = ("stitch", "preassemble", "spheres", "deviation")
KIND = "structure"


def applies(scene: Scene) -> bool:
    """Return whether the step runs by itself: a structure with a design, its scans in one frame."""
    one_frame = len(scene.scans) == 1 or all(scan.T_project_scan.size for scan in scene.scans)
    return scene.kind == KIND and scene.structure is not None and bool(scene.scans) and one_frame


def needed(scene: Scene) -> tuple[str, ...]:
    """Name the steps that run with this one: those that place the parts of a bridge, or balls and tubes of a frame."""
    if scene.arch is not None:
        return ("preassemble", "deviation")
    return ("spheres", "deviation") if scene.frame is not None else ()


def run(scene: Scene, params: Params, earlier: Mapping[str, Any] | None = None) -> Result:
    """Find the defects of a scene's structure; ``earlier`` are results of steps in NEEDS that ran before.

    Raises UsageError for parameters out of range, InputError without a design or points.
    """
    if params.method not in METHODS:
        raise UsageError(f"defects: unknown method {params.method!r}; it has {', '.join(METHODS)}")
    method = baseline.defects if params.method == "paper" else detect.defects
    if scene.arch is not None:
        found, before = bridge_parts.of_bridge(scene, (earlier or {}).get("preassemble"), NAME), earlier or {}
        return parts.defects(
            scene, list(found), params.method, before.get("deviation"), lambda part, pose: method(part, params, pose)
        )
    if scene.frame is not None:
        scene = frame_members.of_frame(scene, (earlier or {}).get("spheres"), NAME)
    if scene.structure is None or not len(scene.structure.faces):
        raise InputError(f"{scene.name}: defects need the structure's design (a mesh or STEP, see project.toml)")
    if not any(len(scan.points) for scan in scene.scans):
        raise InputError(f"{scene.name}: expected scans of the structure, found no points")
    result = method(scene, params, dict(earlier or {}))
    return replace(result, limits=depths_and_areas.judge(scene, result))
