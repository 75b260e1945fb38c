"""Virtual preassembly of an arch bridge from scans of its parts: ``adjustment``, or the source paper's three methods.

``adjustment`` registers every part to its design and adjusts the whole chain at once, with an interval for every gap,
see :mod:`processor.preassembly.assemble`. The paper's methods are baselines, see
:mod:`processor.preassembly.baselines.methods`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from processor import diagnostics
from processor.adjustment import thermal
from processor.model import ArchDesign, InputError, Scan, Scene, UsageError, reason
from processor.preassembly import assemble
from processor.preassembly.baselines import methods
from processor.preassembly.params import METHODS, Params
from processor.preassembly.result import Result
from processor.preassembly.verdicts import part_failures

__all__ = ["KIND", "METHODS", "NAME", "NEEDS", "Params", "Result", "run"]

NAME = "preassemble"
NEEDS: tuple[str, ...] = ()
KEEPS = True  # methods share intermediate results
KIND = "arch-bridge"


def run(scene: Scene, params: Params, kept: dict[str, Any] | None = None) -> Result:
    """Assemble the bridge of a scene by one of METHODS.

    The attitudes of the scans, and the features of the parts, common to the paper's three methods, are ``kept`` for the
    next of them.
    Raises InputError without an arch design or scans of its parts, UsageError for an unknown method.
    """
    if params.method not in METHODS:
        raise UsageError(f"preassemble: unknown method {params.method!r}; it has {', '.join(METHODS)}")
    design = scene.arch
    if design is None or len(design.parts) < 2:
        raise InputError(f"{scene.name}: preassembly needs an arch-bridge design of at least two parts (design.json)")
    scans = scans_in_order(scene, design)
    unused = tuple(scan.name for scan in scene.scans if not any(scan is one for of_part in scans for one in of_part))
    kept = {} if kept is None else kept
    attitudes = kept.setdefault("attitudes", {})
    if params.method == "adjustment":
        result = assemble.assemble(scans, scene, design, params, attitudes)
        remarks = (reason("preassemble.scans-without-part", scans=unused),) if unused else ()
        return replace(result, reasons=(*remarks, *result.reasons))
    if not design.in_row:
        raise InputError(
            f"{scene.name}: method {params.method} takes components in a row, here the joints form another graph; use "
            "method adjustment"
        )
    if not all(len(part.bottom_edge_left) for part in design.parts):
        raise InputError(
            f"{scene.name}: method {params.method} needs the bottom edges of all components; use adjustment"
        )
    missing = [part.name for part, (first, *_) in zip(design.parts, scans, strict=True) if not len(first.points)]
    if missing:
        raise InputError(
            f"{scene.name}: method {params.method} needs scans of all components, {missing[0]} has none; use adjustment"
        )
    several = [part.name for part, of_part in zip(design.parts, scans, strict=True) if len(of_part) > 1]
    if several:
        raise InputError(f"{scene.name}: method {params.method} takes one scan per part, {several[0]} has several")
    if "parts" not in kept:
        with diagnostics.recording() as kept["notes"]:
            kept["parts"] = methods.extract([of_part[0] for of_part in scans], design, params, attitudes)
    diagnostics.replay(kept["notes"])
    result = methods.assemble(kept["parts"], design, params)
    if np.isfinite(scene.temperature_C) and scene.temperature_C != thermal.REFERENCE_C:
        remark = reason("preassemble.temperature-not-corrected", temperature=scene.temperature_C)
        result = replace(result, reasons=(*result.reasons, remark))
    return result


def completed(result: Result, answers: Mapping[str, Any]) -> Result:
    """Return a result whose proposals name the parts beside the joint that fail limits of their own."""
    inspected = answers.get("inspect")
    return result if inspected is None else part_failures.named_at_joints(result, inspected.components)


def scans_in_order(scene: Scene, design: ArchDesign) -> list[list[Scan]]:
    """Return the scans of each part in the design's order, one without points of a part that has none.

    Raises InputError where no part has any.
    """
    scans = [[scan for scan in scene.scans if scan.component == part.name] for part in design.parts]
    if not any(scans):
        named = ", ".join(sorted(scan.component or scan.name for scan in scene.scans))
        raise InputError(
            f"{scene.name}: expected scans of components {', '.join(part.name for part in design.parts)}, found none "
            f"(scans are of: {named}); name them by 'component' in project.toml"
        )
    nothing = np.empty((0, 3))
    return [found or [Scan("", nothing, component=part.name)] for part, found in zip(design.parts, scans, strict=True)]
