"""Verdicts on the deviation of each component: the extremes, or the share of the surface within the limits.

A pass of an extreme needs the whole 95 % interval of every core point within the limit, which holds whatever their
errors have in common. A fail needs one core point beyond it by an interval that is widened for the number of points
(Bonferroni), so that of many points within the limit one does not fail by chance. Where a project gives the share of
the surface that is to keep the limit, that share is compared in place of the extremes: at least the points that are
within with their whole intervals, at most those that are not wholly beyond.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from processor.deviation.result import ErrorSource, Result
from processor.geometry import mesh_distance
from processor.limits import judging, limit_bounds, measurands, standards
from processor.limits.judging import Judged, JudgedLimits, Measured
from processor.model import (
    NORMAL_95,
    WORST_FIRST,
    Bools,
    Floats,
    Ints,
    Limit,
    Scene,
    Status,
    StructureDesign,
    Tolerance,
)

WHOLE = "surface"


def judge(scene: Scene, result: Result) -> JudgedLimits | None:
    """Compare the deviations of a result, with its bodies, with the limits of a scene; None where none is given."""
    tolerance = standards.default_for(scene.tolerance)
    if scene.structure is None or not any(limit.measure == measurands.DEVIATION for limit in tolerance.limits):
        return None
    unsure = result.status in (Status.FAILED, Status.AMBIGUOUS)
    unsure |= result.registration_error_from is ErrorSource.UNKNOWN
    rows: list[Judged] = []
    for name, of_it in _components(result).items():
        shares = judging.limits_for(tolerance, measurands.DEVIATION_SHARE, name)
        core = result.core
        values, half = core.distance[of_it], core.lod95[of_it]
        known = np.isfinite(values) & np.isfinite(half)
        values, half = values[known], half[known]
        for limit in judging.limits_for(tolerance, measurands.DEVIATION, name):
            if not len(values):
                rows.append(judging.judge(shares[0] if shares else limit, Measured(name), tolerance))
            elif shares:
                rows.append(judging.judge(shares[0], _share(name, values, half, limit, unsure), tolerance))
            else:
                rows.append(_extreme(name, values, half, limit, tolerance, unsure))
    return judging.table(rows)


def with_bodies(result: Result, design: StructureDesign, vertices: Floats, origin: Floats) -> Result:
    """Return the result with the body of each core point; as it is for a design without bodies.

    ``vertices`` (v, 3) are those of the design less ``origin`` (3,).
    """
    if design.bodies is None or not len(result.core):
        return result
    surface = mesh_distance.of_design(vertices, design.faces)
    facet, _, _ = surface.distances(result.core.points + (result.origin - origin), np.inf)
    of_facet = design.bodies.of_facet[mesh_distance.double_areas(vertices, design.faces)[1] > mesh_distance.LEAST_AREA]
    body: Ints = np.where(facet >= 0, of_facet[np.maximum(facet, 0)], -1)
    return replace(result, bodies=design.bodies.names, core=replace(result.core, body=body.astype(np.int32)))


def _components(result: Result) -> Mapping[str, Bools]:
    """Mark the core points (k,) of each named body of the design, of the whole surface without any."""
    if not result.bodies:
        return {WHOLE: np.ones(len(result.core), bool)}
    return {name: result.core.body == row for row, name in enumerate(result.bodies)}


def _share(name: str, values: Floats, half: Floats, limit: Limit, unsure: bool) -> Measured:
    """Share of core points within a limit: at least, as measured, and at most."""
    low, high = limit_bounds.bounds(limit, {})
    within = float(np.mean((values >= low) & (values <= high)))
    surely = float(np.mean((values - half >= low) & (values + half <= high)))
    beyond = float(np.mean((values + half < low) | (values - half > high)))
    return Measured(name, within, surely, 1.0 - beyond, doubtful=unsure)


def _extreme(name: str, values: Floats, half: Floats, limit: Limit, tolerance: Tolerance, unsure: bool) -> Judged:
    """Judge the least and the greatest deviation; return the one of the worse verdict, then nearer to its bound."""
    low, high = limit_bounds.bounds(limit, {})
    widened = half * float(ndtri(1.0 - 0.025 / len(values))) / NORMAL_95
    sides = []
    for sign, bound in ((-1.0, -low), (1.0, high)):
        signed = sign * values
        most = float((signed + half).max())
        ends = (sign * float((signed - widened).max()), sign * most)
        measured = Measured(name, sign * float(signed.max()), min(ends), max(ends), doubtful=unsure)
        judged = judging.judge(limit, measured, tolerance)
        sides.append((WORST_FIRST.index(judged.verdict), bound - most, judged))
    return min(sides, key=lambda side: side[:2])[2]
