"""Balls of a space frame, or of a cloud without a design.

Method ``ray`` takes the whole scan, with or without a design: members first, then the nodes where they meet, then the
balls on them. Where a cloud has no members, balls are searched for by themselves. ``ransac`` and ``least-squares`` are
the source paper's (paper 001), fitted to a crop about every node of the design, or beside ``ray`` to the points that
it took.
"""

from __future__ import annotations

from dataclasses import replace

from processor.geometry.merging import merged
from processor.limits import standards
from processor.model import InputError, Scene, Tolerance
from processor.space_frame import to_result
from processor.space_frame.params import METHODS, Params
from processor.space_frame.points.scene_source import PointReader
from processor.space_frame.result import Result
from processor.space_frame.spheres import isolated

__all__ = ["KIND", "METHODS", "NAME", "NEEDS", "STREAMS", "Params", "Result", "run"]

NAME = "spheres"
NEEDS: tuple[str, ...] = ()
STREAMS = ("ray",)  # methods that take points piece by piece
COMPARES = True  # methods run for comparison are given the answer
KIND = "space-frame"


def run(scene: Scene, params: Params, points: PointReader | None = None, answer_given: Result | None = None) -> Result:
    """Find the balls of a scene: those of its design and what else there is, or those that are in the cloud.

    ``status``: ok = an answer for every ball, partial = for some or ``max_balls`` reached, failed = for none; the flag
    of each ball says what its answer is worth. Where the answer given is a frame's by ``ray``, the paper's methods are
    run on its points, for comparison. ``points`` reads the points of a scene that is larger than memory.
    Raises UsageError for parameters that make no sense, InputError for a cloud without members larger than memory.
    """
    params.check(scene.frame is not None)
    limits = standards.default_for(scene.tolerance)
    if params.method != "ray":
        if answer_given is not None and answer_given.method == "ray" and len(answer_given.tube_radii):
            same = to_result.of_same_points(scene, params)
            if same is not None:
                return same
        if scene.frame is None:
            return _told(scene, isolated.search(merged(scene, with_scanner=True), params))
        return _told(scene, isolated.fit_nodes(merged(scene, with_scanner=False), scene.frame, params, limits))
    found = to_result.of_frame(scene, params, points)
    if found is None and points is not None:
        raise InputError(
            f"{scene.name}: no members that meet were found, and the cloud is too large to search otherwise"
        )
    if found is None:
        return _told(scene, _without_members(scene, params, limits))
    return found


def _told(scene: Scene, result: Result) -> Result:
    """Say of control points that nothing was held by them."""
    if scene.control is None:
        return result
    return replace(result, message="; ".join(filter(None, (result.message, to_result.UNUSED))))


def _without_members(scene: Scene, params: Params, limits: Tolerance) -> Result:
    """Find balls of a cloud without members: those of the design at its nodes, without one those that stand out."""
    if scene.frame is None:
        return isolated.search(merged(scene, with_scanner=True), params)
    found = isolated.fit_nodes(merged(scene, with_scanner=False), scene.frame, replace(params, method="ransac"), limits)
    said = "no members that meet: each ball was fitted at the design's node, by ransac and without its axes"
    return replace(found, method=params.method, message=f"{said}; {found.message}")


# --- evaluation ----------------------------------------------------------------------------------------------------
