"""Deviation of a scanned structure from its design, with a level of detection at every core point.

Method ``default`` holds each scanned point against the design's surface; ``paper`` is the source paper's chain (paper
002): sampled design, principal axes, iterative closest point, M3C2 between two clouds with the paper's scales.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from processor.deviation import against_truth, clouds, measuring, paper
from processor.deviation.params import METHODS, Params
from processor.deviation.result import Result
from processor.model import InputError, Metric, Scene, Truth, UsageError

__all__ = ["KIND", "METHODS", "NEEDS", "Params", "Result", "applies", "check", "run"]

NEEDS = ("stitch",)
KIND = "structure"


def applies(scene: Scene) -> bool:
    """Whether there is a design to hold the scan against."""
    return scene.kind == KIND and scene.structure is not None and len(scene.structure.faces) > 0


def run(scene: Scene, params: Params, earlier: Mapping[str, Any] | None = None) -> Result:
    """Hold the scan of a scene against its design; scans that were stitched ``earlier`` are placed as found there.

    Raises InputError without a design or points, UsageError for parameters that make no sense.
    """
    if params.method not in METHODS:
        raise UsageError(f"deviation: unknown method {params.method!r}; it has {', '.join(METHODS)}")
    params.check()
    if scene.structure is None:
        raise InputError(
            f"{scene.name}: deviation needs a design, a mesh named by 'design' in project.toml; without one, "
            "processor compare holds one scan against another"
        )
    vertices, origin = clouds.local_design(scene.structure)
    scan = clouds.of_scene(scene, params.neighbours, params.outlier_ratio, (earlier or {}).get("stitch"))
    if params.method == "paper":
        return paper.measure(scene, scan, vertices, origin, params)
    return measuring.measure(scene, scan, vertices, origin, params)


def check(scene: Scene, result: Result, truth: Truth) -> list[Metric]:
    """Hold deviations against a known movement; see :mod:`processor.deviation.against_truth`."""
    return against_truth.check(scene, result, truth)
