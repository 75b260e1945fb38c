"""The ceiling below a space frame: the length of a hanger from each ball's lowest point, and what is too near to it.

Hangers are vertical. A length is the height of the ball's lowest point above the ceiling; where the ceiling slopes, the
place of ball or tube counts in its interval as well. A tube is measured by its own points: a flag of a ball at its end
does not make it doubtful. Balls and tubes are held against the clearance of the project, hangers
also against their greatest length. The use is that of paper 001, section 4.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from processor.geometry import mesh_distance
from processor.limits import judging, measurands, standards
from processor.limits.judging import Judged, JudgedLimits, Measured
from processor.model import NORMAL_95, Ceiling, Floats, Limit, Scene, worst
from processor.space_frame.result import Balls, Evidence, Flag, Hangers, Result, Tubes

PLACES_OF_A_TUBE = 41  # along it: 100 mm on a tube of 4 m, over which a ceiling does not bend
LEAST_SHARE = 1e-9  # of a facet's area seen from above; less is a wall, which no plumb line meets
SOURCE = "project.toml"


def with_hangers(result: Result, scene: Scene) -> Result:
    """Return the result with hangers and verdicts on them; as it is for a scene without a ceiling."""
    ceiling = scene.ceiling
    if ceiling is None:
        return result
    balls = result.balls
    length, sd, bottom = _lengths(balls, ceiling)
    limits, tolerance = _limits(ceiling), standards.default_for(scene.tolerance)
    of_ball: list[list[Judged]] = []
    for name, flag, evidence, above, error in zip(balls.names, balls.flag, balls.evidence, length, sd, strict=True):
        doubtful = flag is not Flag.OK or evidence is Evidence.AXES
        one = Measured.within(f"ball {name}", float(above), NORMAL_95 * float(error), doubtful=doubtful)
        # Without a length it was not found, or no ceiling is below it.
        of_ball.append([judging.judge(limit, one, tolerance) for limit in limits if math.isfinite(above)])
    hangers = Hangers(
        ids=balls.ids,
        labels=balls.labels,
        top=balls.lowest,
        bottom=bottom,
        length=length,
        ci95=NORMAL_95 * sd,
        verdict=tuple(worst(row.verdict for row in rows) for rows in of_ball),
    )
    of_tubes = (judging.judge(limits[0], one, tolerance) for one in _of_tubes(result.tubes, ceiling))
    rows = [*(row for rows in of_ball for row in rows), *of_tubes]
    return replace(result, hangers=hangers, limits=JudgedLimits.joined((result.limits, judging.table(rows))))


def heights(ceiling: Ceiling, places: Floats) -> tuple[Floats, Floats]:
    """Height (n,) of a ceiling, level or a mesh, and slopes (n, 2) at places (n, 2); NaN where there is none.

    Where surfaces lie above one another the highest counts.
    """
    height, slope = np.full(len(places), np.nan), np.full((len(places), 2), np.nan)
    known = np.flatnonzero(np.isfinite(places).all(axis=1))
    if not len(ceiling.faces):
        height[known], slope[known] = ceiling.level, 0.0
        return height, slope
    cross, double = mesh_distance.double_areas(ceiling.vertices, ceiling.faces)
    plumb = np.abs(cross[:, 2]) > LEAST_SHARE * double
    if not plumb.any():
        return height, slope
    faces, normals = ceiling.faces[plumb], cross[plumb] / double[plumb, None]
    grid = mesh_distance.facet_grid(ceiling.vertices, faces, normals, float(np.sqrt(0.5 * double[plumb].mean())))
    top, bottom = grid.corners[..., 2].max() + 1.0, grid.corners[..., 2].min() - 1.0
    starts, ends = (np.column_stack([places[known], np.full(len(known), z)]) for z in (top, bottom))
    row, facet, share = mesh_distance.crossings(grid, starts, ends, False)
    order = np.lexsort((share, row))
    row, first = np.unique(row[order], return_index=True)
    facet, share = facet[order[first]], share[order[first]]
    height[known[row]] = top - share * (top - bottom)
    slope[known[row]] = -normals[facet, :2] / normals[facet, 2:]
    return height, slope


def _limits(ceiling: Ceiling) -> list[Limit]:
    clearance = Limit(
        "ceiling_clearance_mm", "height above the ceiling", low=ceiling.clearance_mm, high=math.inf,
        measure=measurands.CEILING, source=SOURCE, verified=True,
    )  # fmt: skip
    if math.isnan(ceiling.longest_mm):
        return [clearance]
    longest = Limit(
        "hanger_length_mm", "length of a hanger", low=-math.inf, high=ceiling.longest_mm, measure=measurands.CEILING,
        source=SOURCE, verified=True,
    )  # fmt: skip
    return [clearance, longest]


def _lengths(balls: Balls, ceiling: Ceiling) -> tuple[Floats, Floats, Floats]:
    """Length (k,) of each hanger, its standard deviation (k,), and its lower end (k, 3).

    The lowest point is at the centre in plan and a radius below it, so a length depends on the centre's x and y by the
    slopes there, and on height and radius as the lowest point does.
    """
    height, slope = heights(ceiling, balls.lowest[:, :2])
    slope = np.nan_to_num(slope)
    covariance = balls.covariance
    across = np.einsum("ki,kij,kj->k", slope, covariance[:, :2, :2], slope)
    along = np.einsum("ki,ki->k", slope, covariance[:, :2, 2] - covariance[:, :2, 3])
    variance = balls.lowest_sd**2 + across - 2.0 * along
    bottom = np.column_stack([balls.lowest[:, :2], height])
    return balls.lowest[:, 2] - height, np.sqrt(np.maximum(variance, 0.0)), bottom


def _of_tubes(tubes: Tubes, ceiling: Ceiling) -> Iterator[Measured]:
    """Yield the height of the lowest line of each tube where it is nearest to the ceiling."""
    share = np.linspace(0.0, 1.0, PLACES_OF_A_TUBE)
    along = tubes.end - tubes.start
    axis = tubes.start[:, None] + share[:, None] * along[:, None]
    along = along / np.linalg.norm(along, axis=1)[:, None]
    down = np.array([0.0, 0.0, -1.0]) + along[:, 2:] * along  # across the axis
    size = np.linalg.norm(down, axis=1)[:, None]
    line = axis + (tubes.radii[:, None] * down / np.where(size > 0.0, size, 1.0))[:, None]
    height, slopes = heights(ceiling, line[:, :, :2].reshape(-1, 2))
    above = line[:, :, 2] - height.reshape(line.shape[:2])
    for k, ends in enumerate(tubes.ends):
        if not np.isfinite(above[k]).any():
            continue
        nearest = int(np.nanargmin(above[k]))
        at = float(share[nearest])
        # Along x, y and z; how the errors of the axes are correlated is not known, so they may add up.
        of_axis = (1.0 - at) * tubes.start_ci95[k] + at * tubes.end_ci95[k]
        of_height = of_axis[2] + np.abs(slopes[k * len(share) + nearest]) @ of_axis[:2]
        half = float(np.hypot(of_height, tubes.radius_ci95[k])) + float(np.nan_to_num(tubes.bow[k]))
        yield Measured.within(_name(k, *ends), float(above[k, nearest]), half)


def _name(tube: int, a: int | str, b: int | str) -> str:
    """Name a tube by its row and the balls at its ends; "" = none there."""
    balls = [ball for ball in (a, b) if ball != ""]
    if len(balls) == 2:
        return f"tube {tube}, balls {a} and {b}"
    return f"tube {tube}, ball {balls[0]} and a free end" if balls else f"tube {tube}, no balls"
