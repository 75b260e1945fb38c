"""Inspection of every part: its characteristics against the design, each with a 95 % interval and a verdict.

The parts of an arch bridge are measured by their ends and edges, which preassembly has fitted already, the bodies of a
structure by the deviations of their flat faces and by the bores of their holes, the members of a frame by their spheres
and tubes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from processor.inspection import arch_parts, bridge_holes, members, splices, structure_bodies
from processor.inspection.params import METHODS, Params
from processor.inspection.result import Result
from processor.model import InputError, Scene, Status, UsageError, reason

__all__ = ["METHODS", "NAME", "NEEDS", "Params", "Result", "applies", "needed", "run"]

NAME = "inspect"
NEEDS = ("preassemble", "spheres", "stitch", "deviation")
KIND = "arch-bridge"


def applies(scene: Scene) -> bool:
    """Whether there is a design whose parts can be inspected."""
    return bool(needed(scene))


def needed(scene: Scene) -> tuple[str, ...]:
    """Name the steps whose measurements the inspection of a scene rests on: they run with it."""
    if scene.arch is not None:
        return ("preassemble",)
    if scene.frame is not None and len(scene.frame.member_a):
        return ("spheres",)
    return ("deviation",) if (scene.structure is not None and len(scene.structure.faces) > 0) else ()


def run(scene: Scene, params: Params, earlier: Mapping[str, Any] | None = None) -> Result:
    """Inspect the parts of a scene by what ``earlier`` steps measured.

    Raises InputError for a scene without a design, UsageError for parameters that make no sense.
    """
    if params.method not in METHODS:
        raise UsageError(f"inspect: unknown method {params.method!r}; it has {', '.join(METHODS)}")
    measuring = next(iter(needed(scene)), "")
    if not measuring:
        raise InputError(
            f"{scene.name}: inspection needs a design: design.json of an arch bridge or of a frame with members, or a "
            "mesh named by 'design' in project.toml"
        )
    found = (earlier or {}).get(measuring)
    if found is not None and found.status is Status.FAILED:
        return Result(status=Status.FAILED, method=params.method, reasons=(reason("inspect.failed", step=measuring),))
    if measuring == "spheres":
        return members.inspect(scene, found, params.method)
    if scene.arch is None:
        return structure_bodies.inspect(
            scene, found, (earlier or {}).get("stitch"), params.least_face_mm, params.method
        )
    drilled = [] if found is None else bridge_holes.of_parts(scene, found)
    of_parts, of_joints = bridge_holes.characteristics(drilled), splices.of_joints(scene.arch, drilled)
    return arch_parts.inspect(scene.arch, found, scene.tolerance, params.method, of_parts, of_joints)
