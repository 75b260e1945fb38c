"""What a place that deviates is by its profile: a bump, a bent edge, or a step along a line.

Three models are fitted to the cells about a place and compared by their chi-square. A bump falls off to all sides. A
bent edge is largest at the border of its face and falls off linearly from there, as a plate bent along a line does. A
step jumps along a line and falls off behind it, as plates that were joined out of line do, and the lips of cracks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import least_squares

from processor.adjustment.robust_least_squares import sandwich
from processor.model import Floats, Word

MODEL_SHARE = 0.1  # of the depth, by which a place may deviate from the shape of a model
BLOCK_SHARE = 0.5  # of a place's half size: blocks of residuals that agree
FEWEST_CELLS = 12  # twice the unknowns of a model
MOST_CELLS = 1500  # fitted; of more, an even sample
AT_BORDER = 0.35  # of a place's width, the largest distance from a border of a bent edge
MARGIN_CHI2 = 20.0  # by which a model must be better than a bump
EXPONENTS = (1.0, 5.0)  # of a bump (1 - s^2)^p
LEAST_SIZE, MOST_SIZE = 0.3, 4.0  # of a model, by the half size of the place


class Profile(Word):
    """The shape of a place that deviates."""

    BUMP = "bump"
    EDGE = "bent edge"
    STEP = "step"


@dataclass(frozen=True)
class Fit:
    """A profile; its depth (mm, as the place's sign) and sd, ``reach`` (mm) over which it falls off, and its margin.

    ``margin`` is the chi-square of the best model of another kind less this one's.
    """

    profile: Profile
    depth: float
    sd: float
    reach: float
    margin: float


@dataclass(frozen=True)
class PlaceCells:
    """Cells of a face about a place: ``uv`` (n, 2) on the face, outward deviations (n,) and their noise (n,), mm.

    ``low`` and ``high`` (2,) are the borders of the face there, ``centre`` (2,) and ``half`` (2,) those of the place.
    """

    uv: Floats
    value: Floats
    noise: Floats
    low: Floats
    high: Floats
    centre: Floats
    half: Floats
    cell_mm: float


def fit(cells: PlaceCells, sign: int) -> Fit | None:
    """Return the profile of a place to one side, ``sign`` -1 inward and 1 outward; None with too few cells."""
    if len(cells.value) < FEWEST_CELLS:
        return None
    rows = slice(None, None, max(1, len(cells.value) // MOST_CELLS))
    uv, value, noise = cells.uv[rows], sign * cells.value[rows], cells.noise[rows]
    top = max(float(np.quantile(value, 0.95)), 1e-3)
    sd = np.hypot(noise, MODEL_SHARE * top)
    best: dict[Profile, tuple[float, Fit]] = {}
    inside = True  # a bump has its middle on the face
    for profile, axis, start, model in _models(cells, top):
        least, most = LEAST_SIZE * start[[2, 4]], MOST_SIZE * start[[2, 4]]
        room = np.array([start[2] + cells.cell_mm, start[4] + cells.cell_mm])
        lower = np.array([0.2 * top, start[1] - room[0], least[0], start[3] - room[1], least[1], EXPONENTS[0]])
        upper = np.array([5.0 * top, start[1] + room[0], most[0], start[3] + room[1], most[1], EXPONENTS[1]])
        solved = least_squares(
            lambda x, model=model: (value - model(uv, x)) / sd, np.clip(start, lower, upper), bounds=(lower, upper)
        )
        if profile is Profile.STEP and not _shown(uv, solved.x, axis, cells.cell_mm):
            continue
        chi2 = 2.0 * float(solved.cost)
        if profile not in best or chi2 < best[profile][0]:
            # By blocks, a few across the place: where it is not quite of the model's shape, residuals of a block agree.
            block = np.unique(np.floor(uv / (BLOCK_SHARE * cells.half)), axis=0, return_inverse=True)[1].reshape(-1)
            J, residual = solved.jac * sd[:, None], value - model(uv, solved.x)
            depth_sd = np.sqrt(sandwich(np.linalg.pinv(J.T @ J), J * residual[:, None], block)[0, 0])
            best[profile] = chi2, Fit(profile, float(solved.x[0]), float(depth_sd), float(solved.x[2]), 0.0)
            if profile is Profile.BUMP:
                middle, reach = solved.x[[1, 3]], solved.x[[2, 4]]
                inside = bool((np.minimum(middle - cells.low, cells.high - middle) > AT_BORDER * reach).all())
    bump = best[Profile.BUMP][0]
    known = {profile for profile in best if profile is not Profile.BUMP or inside or Profile.EDGE not in best}
    chosen = min(known, key=lambda profile: (best[profile][0] + MARGIN_CHI2 * (profile is Profile.STEP), profile))
    others = [chi2 for profile, (chi2, _) in best.items() if profile is not chosen]
    fitted = best[chosen][1]
    return replace(fitted, depth=sign * fitted.depth, margin=min(others, default=bump) - best[chosen][0])


Model = Callable[[Floats, Floats], Floats]


def _models(cells: PlaceCells, top: float) -> Iterator[tuple[Profile, int, Floats, Model]]:
    """Yield profiles, axes, starts of the parameters (depth, place, reach, middle across, half width, exponent)."""
    centre, half = cells.centre, cells.half
    yield Profile.BUMP, 0, np.array([top, centre[0], 1.3 * half[0], centre[1], 1.3 * half[1], 2.0]), _bump_model
    for axis, other in ((0, 1), (1, 0)):
        for way, border in ((1.0, cells.low[axis]), (-1.0, cells.high[axis])):
            end = centre[axis] - way * half[axis]
            if abs(end - border) < AT_BORDER * 2.0 * half[axis] + cells.cell_mm:
                start = np.array([top, border, 2.0 * half[axis], centre[other], 1.2 * half[other], 2.0])
                yield Profile.EDGE, axis, start, partial(_edge_model, axis, way, float(border))
            start = np.array([top, end, 2.0 * half[axis], centre[other], 1.1 * half[other], 2.0])
            yield Profile.STEP, axis, start, partial(_step_model, axis, way, cells.cell_mm)


def _bump_model(uv: Floats, x: Floats) -> Floats:
    return np.asarray(x[0] * _bump(np.hypot((uv[:, 0] - x[1]) / x[2], (uv[:, 1] - x[3]) / x[4]), x[5]))


def _edge_model(axis: int, way: float, border: float, uv: Floats, x: Floats) -> Floats:
    lever = np.clip(1.0 - way * (uv[:, axis] - border) / x[2], 0.0, 1.0)
    return np.asarray(x[0] * lever * _bump((uv[:, 1 - axis] - x[3]) / x[4], x[5]))


def _step_model(axis: int, way: float, cell_mm: float, uv: Floats, x: Floats) -> Floats:
    behind = np.clip(way * (uv[:, axis] - x[1]) / cell_mm + 0.5, 0.0, 1.0)  # means of cells on the line
    across = np.maximum(1.0 - ((uv[:, 1 - axis] - x[3]) / x[4]) ** 8, 0.0)
    return np.asarray(x[0] * behind * _bump((uv[:, axis] - x[1]) / x[2], x[5]) * across)


def _shown(uv: Floats, x: Floats, axis: int, cell_mm: float) -> bool:
    """Whether cells on both sides of a step's line are seen along half of it: else a border of what was seen is one."""
    beside = np.abs(uv[:, 1 - axis] - x[3]) < x[4]
    off = (uv[:, axis] - x[1]) / cell_mm
    fewest = x[4] / cell_mm  # of the line's cells, half
    return all(int((beside & (way * off > 0.5) & (way * off < 2.5)).sum()) >= 2.0 * fewest for way in (-1.0, 1.0))


def _bump(s: Floats, exponent: float) -> Floats:
    value: Floats = np.maximum(1.0 - s**2, 0.0) ** exponent
    return value
