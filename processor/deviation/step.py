"""Deviation of a scanned structure from its design, with a level of detection at every core point.

Method ``default`` holds each scanned point against the design's surface; ``paper`` is the source paper's chain (paper
002): sampled design, principal axes, iterative closest point, M3C2 between two clouds with the paper's scales.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from processor import scene_cloud
from processor.components import bridge_parts, frame_members
from processor.deviation import baseline, cloud, measure, parts, verdicts
from processor.deviation.params import METHODS, Params
from processor.deviation.result import Result
from processor.model import InputError, Scene, Status, UsageError, reason

__all__ = ["KIND", "METHODS", "NAME", "NEEDS", "Params", "Result", "applies", "needed", "run"]

NAME = "deviation"
NEEDS = ("stitch", "preassemble", "spheres")
KIND = "structure"


def applies(scene: Scene) -> bool:
    """Whether there is a design to hold the scan against."""
    return scene.kind == KIND and scene.structure is not None and len(scene.structure.faces) > 0


def needed(scene: Scene) -> tuple[str, ...]:
    """Name the steps that run with this one: those that place the parts of a bridge, or balls and tubes of a frame."""
    if scene.arch is not None:
        return ("preassemble",)
    return ("spheres",) if scene.frame is not None else ()


def run(scene: Scene, params: Params, earlier: Mapping[str, Any] | None = None) -> Result:
    """Compare the scan of a scene with its design; scans stitched ``earlier`` have the poses of that result.

    Each part of a bridge is compared with its own design, from where step preassemble placed it, balls and tubes of a
    frame with their nominal sizes where step spheres measured them. Raises InputError without a design or points,
    UsageError for parameters that make no sense.
    """
    if params.method not in METHODS:
        raise UsageError(f"deviation: unknown method {params.method!r}; it has {', '.join(METHODS)}")
    if scene.arch is not None:
        register = "fine" if params.register == "auto" else params.register
        of_parts = replace(params, register=register)
        found = bridge_parts.of_bridge(scene, (earlier or {}).get("preassemble"), NAME)
        return parts.deviations(list(found), params.method, lambda part: _of_structure(part, of_parts, None))
    if scene.frame is not None:
        # Each ball and tube lies where it was measured: there is nothing to register.
        scene = frame_members.of_frame(scene, (earlier or {}).get("spheres"), NAME)
        return _of_structure(scene, replace(params, register="none"), None)
    return _of_structure(scene, params, (earlier or {}).get("stitch"))


def _of_structure(scene: Scene, params: Params, stitched: Any) -> Result:
    if scene.structure is None:
        raise InputError(
            f"{scene.name}: deviation needs a design, a mesh named by 'design' in project.toml; without one, "
            "processor compare holds one scan against another"
        )
    vertices, origin = scene_cloud.local_design(scene.structure)
    scan = cloud.of_scene(scene, params.neighbours, params.outlier_ratio, stitched, params.most_points)
    method = baseline.measure if params.method == "paper" else measure.measure
    result = method(scene, scan, vertices, origin, params)
    result = replace(result, reasons=(*result.reasons, *scene_cloud.design_faults(scene.structure.faults)))
    if scan.unplaced:
        first = reason("deviation.scans-unplaced", scans=", ".join(scan.unplaced))
        status = Status.WEAK if result.status is Status.OK else result.status
        result = replace(result, status=status, reasons=(first, *result.reasons))
    result = verdicts.with_bodies(result, scene.structure, vertices, origin)
    return replace(result, limits=verdicts.judge(scene, result))
