"""Step ``spheres``: the spheres of a space frame, or of a cloud without a design.

Method ``ray`` uses the whole scan, with or without a design: members first, then the nodes where they meet, then the
spheres at them. Where a cloud has no members, spheres are searched for by themselves. ``ransac`` and ``least-squares``
are the source paper's (paper 001), fitted to a crop about every node of the design, or for comparison with ``ray``
about every node that it found.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import count

import numpy as np

from processor.adjustment import scanner_class_errors
from processor.limits import standards
from processor.model import FrameDesign, InputError, Reason, Scene, Tolerance, reason
from processor.scene_cloud import merged
from processor.space_frame import hanger_lengths, to_result
from processor.space_frame.params import METHODS, Params
from processor.space_frame.result import Balls, Result
from processor.space_frame.spheres import baselines, search_without_design
from processor.views import PointReader

__all__ = ["KIND", "METHODS", "NAME", "NEEDS", "STREAMS", "Params", "Result", "run"]

NAME = "spheres"
NEEDS: tuple[str, ...] = ()
STREAMS = ("ray",)  # methods that take points piece by piece
COMPARES = True  # methods run for comparison get the result of the main method
KIND = "space-frame"


def run(scene: Scene, params: Params, points: PointReader | None = None, answer_given: Result | None = None) -> Result:
    """Find the spheres of a scene: those of its design and further ones, or those in the cloud.

    ``status``: ok = an answer for every sphere, partial = for some or ``max_balls`` reached, failed = for none; the
    flag of each sphere grades its answer. Where ``answer_given`` is that of a frame by ``ray``, the paper's methods run
    about its nodes, for comparison. ``points`` reads the points of a scene that is larger than memory.
    Raises UsageError for invalid parameters, InputError for a cloud without members that is larger than memory.
    """
    params.check(scene.frame is not None)
    result = labelled(_spheres(scene, params, points, answer_given), scene.frame)
    return hanger_lengths.with_hangers(result, scene)


def labelled(result: Result, design: FrameDesign | None) -> Result:
    """Name spheres as the design does where its ids are no whole numbers; further ones are extra-1, extra-2, ..."""
    if design is None or not design.labels:
        return result
    label_of = dict(zip(design.ids.tolist(), design.labels, strict=True))
    names = (f"extra-{number}" for number in count(1))
    free = (name for name in names if name not in design.labels)
    label_of |= {id_: next(free) for id_ in result.balls.ids.tolist() if id_ not in label_of}
    tubes, balls = result.tubes, result.balls
    ends = {end: tuple(label_of.get(id_, "") for id_ in getattr(tubes, end).tolist()) for end in ("a", "b")}
    return replace(
        result,
        balls=replace(balls, labels=tuple(label_of[id_] for id_ in balls.ids.tolist())),
        tubes=replace(tubes, label_a=ends["a"], label_b=ends["b"]),
    )


def _spheres(scene: Scene, params: Params, points: PointReader | None, answer_given: Result | None) -> Result:
    limits = standards.default_for(scene.tolerance)
    if params.method != "ray":
        if answer_given is not None and answer_given.method == "ray" and len(answer_given.tubes):
            beside = to_result.beside_ray(scene, params)
            if beside is not None:
                return beside
        if scene.frame is None:
            return _with_unused_control(scene, search_without_design.search(merged(scene, with_scanner=True), params))
        return _with_unused_control(
            scene, baselines.fit_nodes(merged(scene, with_scanner=False), scene.frame, params, limits)
        )
    result = to_result.of_frame(scene, params, points)
    if result is not None:
        return result
    if points is not None:
        raise InputError(
            f"{scene.name}: no members that meet were found, and the cloud is too large to search otherwise"
        )
    return _with_unused_control(scene, _without_members(scene, params, limits))


def _with_unused_control(scene: Scene, result: Result) -> Result:
    """Add the reason that control points were not used, where there are any."""
    if scene.control is None:
        return result
    return replace(result, reasons=(*result.reasons, to_result.UNUSED_CONTROL))


def _without_members(scene: Scene, params: Params, limits: Tolerance) -> Result:
    """Find spheres of a cloud without members: at the design's nodes, or without a design those that stand out."""
    if scene.frame is None:
        result = search_without_design.search(merged(scene, with_scanner=True), params)
        before: tuple[Reason, ...] = ()
    else:
        ransac = replace(params, method="ransac")
        result = baselines.fit_nodes(merged(scene, with_scanner=False), scene.frame, ransac, limits)
        before = (reason("spheres.no-members"),)
    if not len(result.balls):
        return replace(result, method=params.method, reasons=(*before, *result.reasons))
    # Those of a search have it already.
    of_view = scanner_class_errors.known().view_mm
    reasons = (*before, *result.reasons, reason("spheres.by-class", sd=of_view))
    balls = result.balls if scene.frame is None else _with_class(result.balls)
    return replace(result, method=params.method, reasons=reasons, balls=balls)


def _with_class(balls: Balls) -> Balls:
    """Add what the views of a ball have in common, by the scanner's class: a ball alone does not show it."""
    variance = np.full(4, scanner_class_errors.known().view_mm ** 2)
    lowest_sd = np.sqrt(balls.lowest_sd**2 + variance[2:].sum())  # of the centre's height and the radius
    return replace(balls, covariance=balls.covariance + np.diag(variance), lowest_sd=lowest_sd)
