"""The turn of a round tube about its axis: what of the design shows it, and poses by what a scan shows of that.

A plain straight tube looks the same whatever it is turned by. A gusset, a hole, a bend show its turn.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry import rigid
from processor.geometry.thinning import thinned
from processor.geometry.thread_ranges import each
from processor.model import Floats
from processor.registration import pose_choice, pose_search
from processor.registration.pose_search import Candidate, DesignSurface
from processor.registration.principal import PrincipalAxes

STEP_RAD = np.radians(5.0)  # of the search: a mark of 200 mm on a tube of 500 mm moves by less than it is seen from
TESTED_RAD = np.radians(30.0)  # between turns by which the surface is compared with itself
MARK_SHARE = 0.5  # of the turns, after which a sample of a mark has no surface beside it
MARKS, LEAST_MARKS = 2_000, 10  # samples of marks that the turn is searched by
SLID_KEPT = 2  # of the poses that differ by a slide along the tube
SLIDE_RAD = np.radians(45.0)  # a pose turned by less has slid along the part: along an arch it turns a little


def about(centre: Floats, axis: Floats, angle: float) -> Floats:
    """Turn by an angle about an axis (3,) through a centre (3,), as (4, 4)."""
    R = rigid.rotation_from_vector(angle * axis)
    return rigid.transform(R, centre - R @ centre)


def tested(tube: PrincipalAxes) -> list[Floats]:
    """Turns (4, 4) by which a tube is compared with itself, without the identity."""
    angles = np.arange(TESTED_RAD, 2.0 * np.pi - 1e-9, TESTED_RAD)
    return [about(tube.centre, tube.axes[:, 0], angle) for angle in angles]


def to_decide(
    points: Floats, surface: DesignSurface, tube: PrincipalAxes, candidates: list[Candidate], least_mm: float
) -> list[Candidate]:
    """Return the poses of a tube between which surface decides, of those that fit and those turned to its marks.

    Marks are samples farther than ``least_mm`` from the surface after most turns.
    """
    axis, seeds, best = tube.axes[:, 0], thinned(points, pose_search.FINE_POINTS), candidates[0]
    between = [c.T @ rigid.invert(best.T) for c in candidates]
    along = [abs(float((rigid.apply(one, tube.centre) - tube.centre) @ axis)) for one in between]
    slid = [
        c
        for c, one, shift in zip(candidates, between, along, strict=True)
        if rigid.rotation_angle(one[:3, :3]) < SLIDE_RAD and shift >= pose_search.SAME_POSE_MM
    ]
    ahead = [float(axis @ one[:3, :3] @ axis) > 0.0 for one in between]
    chosen = [candidates[ahead.index(sense)] for sense in (True, False) if sense in ahead]
    absent = [pose_choice.off_surface(rigid.apply(T, surface.points), surface.mesh, least_mm) for T in tested(tube)]
    marks = surface.points[np.mean(absent, axis=0) >= MARK_SHARE]
    if len(marks) >= LEAST_MARKS:
        starts = [Candidate(T, best.start) for T in _turned_to(thinned(marks, MARKS), seeds, tube, best.T, least_mm)]
        chosen += each(lambda start: pose_search.align(seeds, surface, start), starts)
    return pose_search.distinct([*chosen, *slid[:SLID_KEPT]], pose_search.box_of(points))


def _turned_to(marks: Floats, seeds: Floats, tube: PrincipalAxes, T: Floats, least_mm: float) -> list[Floats]:
    """Return T_bridge_scan (4, 4), turned so that most marks (m, 3) have points (n, 3), in either sense of the tube."""
    tree = cKDTree(seeds, balanced_tree=False)
    spacing = float(np.median(tree.query(thinned(seeds, pose_search.COARSE_POINTS), k=2)[0][:, 1]))
    reach, poses = max(2.0 * least_mm, 4.0 * spacing), []
    for sense in (np.eye(4), about(tube.centre, tube.axes[:, 1], np.pi)):
        angles = np.arange(0.0, 2.0 * np.pi - 1e-9, STEP_RAD)
        turned = [about(tube.centre, tube.axes[:, 0], angle) @ sense @ T for angle in angles]
        near = [tree.query(rigid.apply(rigid.invert(one), marks), distance_upper_bound=reach)[0] for one in turned]
        counts = np.isfinite(near).sum(axis=1)
        # The middle of the turns that show as much.
        first = int(np.argmax(counts))
        best = np.exp(1j * STEP_RAD * (np.flatnonzero(counts >= 0.9 * counts.max()) - first))
        middle = float(np.angle(best[best.real > 0.8].mean()))
        poses.append(about(tube.centre, tube.axes[:, 0], middle) @ turned[first])
    return poses
