"""Inspection of every part: its characteristics against the design, each with a 95 % interval and a verdict.

The parts of an arch bridge are measured by their ends and edges, which preassembly has fitted already.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from processor.inspection import arch_parts
from processor.inspection.params import METHODS, Params
from processor.inspection.result import Result
from processor.model import InputError, Scene, Status, UsageError, reason

__all__ = ["METHODS", "NAME", "NEEDS", "Params", "Result", "applies", "needed", "run"]

NAME = "inspect"
NEEDS = ("preassemble",)
KIND = "arch-bridge"


def applies(scene: Scene) -> bool:
    """Whether there is a design whose parts can be inspected."""
    return scene.arch is not None


def needed(scene: Scene) -> tuple[str, ...]:
    """Name the steps whose measurements the inspection of a scene rests on: they run with it."""
    return ("preassemble",) if scene.arch is not None else ()


def run(scene: Scene, params: Params, earlier: Mapping[str, Any] | None = None) -> Result:
    """Inspect the parts of a scene by what ``earlier`` steps measured.

    Raises InputError for a scene without a design, UsageError for parameters that make no sense.
    """
    if params.method not in METHODS:
        raise UsageError(f"inspect: unknown method {params.method!r}; it has {', '.join(METHODS)}")
    params.check()
    if scene.arch is None:
        raise InputError(f"{scene.name}: inspection needs the design of an arch bridge (design.json)")
    assembled = (earlier or {}).get("preassemble")
    if assembled is not None and assembled.status is Status.FAILED:
        return Result(status=Status.FAILED, method=params.method, reasons=(reason("inspect.preassembly-failed"),))
    return arch_parts.inspect(scene.arch, assembled, scene.tolerance, params.method)
