"""Shapes of whole components: moved, bent, twisted, waved or stepped; and a bump, which must not be taken for these.

xi runs along a component, eta across it, zeta out of its largest face, each from -1 to 1 (eta and zeta by the larger).
A shape is a sum of displacements; a scan sees their part along each cell's normal.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from processor.model import Floats

PLATE_RATIO = 3.0  # of width to thickness, from which on a component bends across itself too
STEPS = np.linspace(-0.9, 0.9, 37)  # places of a step along half a component, every twentieth: then searched finer
FEWEST_PERIODS = 1.4  # on the component: a longer wave is a bend
WAVE_BLOCKS = 5.0  # in the shortest wave
BUMP_RADII = 8  # sizes tried, in equal ratios; the best is refined
REFINEMENTS = 3  # each narrows place and radius to 0.6 of the last: 0.2 of a block after three
STEP_REACH, STEP_PLACES = 0.07, 71  # about the best place of a step, by half the component
MOST_BUMPS, MASK_RADII, MOST_MASKED = 3, 1.15, 0.5  # left out; by masks in radii; of all blocks at most
RIGID_SHARE = 0.05  # of the chi-square that a shape explains, from which on the component has moved as well
GOLDEN, GOLDEN_STEPS = 0.6180339887498949, 18  # the golden section's ratio; 18 steps narrow the bounds to 0.02 %
RIGID = "misalignment"
LEAST_OWN = 0.01  # of the square of a shape, that a rigid motion does not explain
WEAK = 1e-6  # of a column's weight: keeps factors without observations at zero


@dataclass(frozen=True)
class Frame:
    """A component's axes: origin (3,), axes (3, 3, rows along, across, out) and half sizes (3,), mm."""

    origin: Floats
    axes: Floats
    half: Floats
    front: float  # half the height of the largest face

    def local(self, points: Floats) -> Floats:
        """Return coordinates (n, 3) along, across and out, mm."""
        coordinates: Floats = (points - self.origin) @ self.axes.T
        return coordinates


At = tuple[float, ...]  # parameters of a shape other than its factors


@dataclass(frozen=True)
class Shape:
    """One shape: its kind, its parameters, its factors (k,) and their covariance (k, k) by the noise of blocks."""

    kind: str
    at: At
    factors: Floats
    covariance: Floats = field(default_factory=lambda: np.empty((0, 0)))

    def values(self, frame: Frame, points: Floats, outward: Floats) -> Floats:
        """Return the shape's deviations (n,) at points (n, 3) with unit normals (n, 3), mm."""
        deviations: Floats = self._columns(frame, points, outward) @ self.factors
        return deviations

    def sd(self, frame: Frame, points: Floats, outward: Floats) -> Floats:
        """Return the standard deviation (n,) of the shape's deviations there by the noise of blocks, mm."""
        columns = self._columns(frame, points, outward)
        deviations: Floats = np.sqrt(np.einsum("ni,ij,nj->n", columns, self.covariance, columns))
        return deviations

    def total_sd(self, frame: Frame, points: Floats, outward: Floats, weight: Floats) -> float:
        """Return the standard deviation of the weighted (n,) sum of the shape's deviations there, by the same noise."""
        total = weight @ self._columns(frame, points, outward)
        return float(np.sqrt(total @ self.covariance @ total))

    def _columns(self, frame: Frame, points: Floats, outward: Floats) -> Floats:
        return BASES[self.kind](frame.local(points), outward @ frame.axes.T, frame.half, self.at)


@dataclass(frozen=True)
class Blocks:
    """Deviations of a component's blocks: places (n, 3), normals, means, weights = 1 / variance, and a block's side."""

    points: Floats
    outward: Floats
    mean: Floats
    weight: Floats
    side_mm: float


@dataclass(frozen=True)
class Fitted:
    """Shapes fitted together; ``gain``: reduction of chi-square by each shape when it was added.

    ``weight`` (n,) of the blocks is nearly zero where there is a bump; ``margin`` is the chi-square of the best fit of
    another kind less that of the first shape.
    """

    shapes: tuple[Shape, ...]
    gain: tuple[float, ...]
    weight: Floats
    margin: float


@dataclass(frozen=True)
class Observations:
    """Blocks in a component's frame: places (n, 3), normals (n, 3)."""

    blocks: Blocks
    frame: Frame
    p: Floats
    n: Floats

    def basis(self, kind: str, at: At) -> Floats:
        """Return the columns (n, k) of a shape."""
        return BASES[kind](self.p, self.n, self.frame.half, at)

    def columns(self, chosen: list[tuple[str, At]]) -> Floats:
        """Return the columns (n, k) of several shapes side by side."""
        return np.hstack([np.empty((len(self.p), 0)), *(self.basis(kind, at) for kind, at in chosen)])

    def factors(self, columns: Floats) -> Floats:
        """Return the factors (k,) of columns (n, k) by weighted least squares."""
        if not columns.shape[1]:
            return np.empty(0)
        top = columns.T @ (self.blocks.weight * self.blocks.mean)
        factors: Floats = np.linalg.solve(self._normal_matrix(columns), top)
        return factors

    def _normal_matrix(self, columns: Floats) -> Floats:
        A: Floats = columns.T @ (self.blocks.weight[:, None] * columns)
        A += (WEAK * np.trace(A) / len(A) + 1e-12) * np.eye(len(A))
        return A

    def residual(self, columns: Floats) -> tuple[Floats, float]:
        """Return the residuals (n,) of the fit of columns (n, k), and their chi-square."""
        residual = self.blocks.mean - columns @ self.factors(columns)
        return residual, float((self.blocks.weight * residual**2).sum())

    def shapes(self, chosen: list[tuple[str, At]]) -> tuple[Shape, ...]:
        """Return shapes fitted together."""
        if not chosen:
            return ()
        columns = self.columns(chosen)
        factors = self.factors(columns)
        covariance: Floats = np.asarray(np.linalg.inv(self._normal_matrix(columns)), np.float64)
        shapes, start = [], 0
        for kind, at in chosen:
            own = slice(start, start + BASES[kind](self.p[:1], self.n[:1], self.frame.half, at).shape[1])
            shapes.append(Shape(kind, at, factors[own], covariance[own, own]))
            start = own.stop
        return tuple(shapes)

    def weighted(self, weight: Floats) -> Observations:
        """Return the observations with other weights (n,)."""
        return dataclasses.replace(self, blocks=dataclasses.replace(self.blocks, weight=weight))


# --- The shapes: columns (n, k) of deviations at p (n, 3) with normals n (n, 3) in the component's frame.

Basis = Callable[[Floats, Floats, Floats, At], Floats]


def _rigid(p: Floats, n: Floats, half: Floats, at: At) -> Floats:
    span = float(half.max())
    return np.hstack([n, np.cross(p / span, n)])


def _bend(p: Floats, n: Floats, half: Floats, at: At) -> Floats:
    axis, order = int(at[0]), int(at[1])
    x = p[:, axis] / half[axis]
    return _sideways(x**2 if order == 2 else np.cos(0.5 * np.pi * x), n, half, axis)


def _step(p: Floats, n: Floats, half: Floats, at: At) -> Floats:
    axis = int(at[0])
    return _sideways((p[:, axis] / half[axis] > at[1]).astype(float), n, half, axis)


def _sideways(profile: Floats, n: Floats, half: Floats, axis: int) -> Floats:
    """Return displacements by a profile (n,) along an axis: outward, and of a slender component across as well."""
    if axis == 1 or half[1] > PLATE_RATIO * half[2]:
        return np.stack([profile * n[:, 2]], axis=1)
    return np.stack([profile * n[:, 2], profile * n[:, 1]], axis=1)


def _twist(p: Floats, n: Floats, half: Floats, at: At) -> Floats:
    x, span = p[:, 0] / half[0], max(half[1], half[2])
    column: Floats = (x * (p[:, 1] * n[:, 2] - p[:, 2] * n[:, 1]) / span)[:, None]
    return column


def _wave(p: Floats, n: Floats, half: Floats, at: At) -> Floats:
    axis, length, fading = int(at[0]), at[1], at[2]  # zero at ``fading`` to either side; 0 = does not fade
    phase = 2.0 * np.pi * p[:, axis] / length
    amplitude = n[:, 2]
    if fading:
        amplitude = np.cos(0.5 * np.pi * np.clip(p[:, 1 - axis] / fading, -1.0, 1.0)) ** 2 * amplitude
    return np.stack([amplitude * np.sin(phase), amplitude * np.cos(phase)], axis=1)


def _bump(p: Floats, n: Floats, half: Floats, at: At) -> Floats:
    square = ((p[:, 0] - at[0]) ** 2 + (p[:, 1] - at[1]) ** 2) / at[2] ** 2
    return (np.maximum(1.0 - square, 0.0) ** 2 * n[:, 2])[:, None]


BASES: dict[str, Basis] = {
    "misalignment": _rigid, "bend": _bend, "twist": _twist, "step": _step, "waviness": _wave, "bump": _bump,
}  # fmt: skip


# --- The fit


def fit(blocks: Blocks, frame: Frame, most: int = 2, least_gain: float = 30.0) -> Fitted:
    """Add the best shape by the Bayesian information criterion, as long as it explains ``least_gain`` of chi-square.

    If that is a bump, it is local: its place is left out from then on. Moves of the component are added beside another
    shape where they explain more than RIGID_SHARE.
    """
    seen = Observations(blocks, frame, frame.local(blocks.points), blocks.outward @ frame.axes.T)
    chosen: list[tuple[str, At]] = []
    gains: list[float] = []
    margin, masked = np.inf, 0
    residual, before = blocks.mean, float((blocks.weight * blocks.mean**2).sum())
    while len(chosen) < most and masked < MOST_BUMPS:
        base = seen.columns(chosen)
        best, squares = _best_candidate(seen, chosen, base, residual)
        if best is None or before - squares[best[0]] < least_gain:
            break
        kind, at = best
        square = squares[kind]
        if kind == "bump":
            apart2 = (seen.p[:, 0] - at[0]) ** 2 + (seen.p[:, 1] - at[1]) ** 2
            near: np.typing.NDArray[np.bool_] = apart2 < (MASK_RADII * at[2] + seen.blocks.side_mm) ** 2
            if near.mean() > MOST_MASKED:
                break
            seen = seen.weighted(np.where(near, WEAK * seen.blocks.weight, seen.blocks.weight))
            masked += 1
            residual, before = seen.residual(base)
            continue
        if not chosen:
            # Other shapes were tried with a rigid motion beside them: a motion alone competes with a bump only.
            others = [value for other, value in squares.items() if other == "bump" or kind not in (other, RIGID)]
            margin = min(others, default=np.inf) - square
        if kind != RIGID and RIGID not in [name for name, _ in chosen]:
            alone = seen.residual(np.hstack([base, seen.basis(kind, at)]))[1]
            if alone - square > RIGID_SHARE * (before - square) + least_gain:
                chosen.append((RIGID, ()))
                gains.append(alone - square)
                most += 1
            else:
                square = alone
        chosen.append((kind, at))
        gains.append(before - square)
        residual, before = seen.residual(seen.columns(chosen))
    return Fitted(seen.shapes(chosen), tuple(gains), seen.blocks.weight, margin)


def _best_candidate(
    seen: Observations, chosen: list[tuple[str, At]], base: Floats, residual: Floats
) -> tuple[tuple[str, At] | None, dict[str, float]]:
    """Return the best next shape by the information criterion, and the least chi-square of each kind.

    A rigid motion is free beside each shape but a bump.
    """
    kinds = [kind for kind, _ in chosen]
    weight = seen.blocks.weight
    used = np.count_nonzero(weight > WEAK * weight.max())
    squares: dict[str, float] = {}
    best: tuple[float, tuple[str, At]] | None = None
    for kind, at in _candidates(seen, residual):
        if kind in kinds:
            continue
        columns = np.hstack([base, seen.basis(kind, at)])
        if kind not in (RIGID, "bump") and RIGID not in kinds:
            columns = np.hstack([columns, seen.basis(RIGID, ())])
        square = seen.residual(columns)[1]
        squares[kind] = min(square, squares.get(kind, np.inf))
        score = used * np.log(square / used + 1.0) + columns.shape[1] * np.log(used)
        if best is None or score < best[0]:
            best = (score, (kind, at))
    return best and best[1], squares


def refitted(fitted: Fitted, fine: Blocks, frame: Frame) -> Fitted:
    """Fit the shapes again to finer blocks: a mean over a large share of a wave's length reduces its amplitude."""
    if not fitted.shapes:
        return fitted
    seen = Observations(fine, frame, frame.local(fine.points), fine.outward @ frame.axes.T)
    chosen = [(shape.kind, shape.at) for shape in fitted.shapes]
    for row, (kind, at) in enumerate(chosen):
        if kind in ("waviness", "step"):
            columns = seen.columns([other for k, other in enumerate(chosen) if k != row])
            chosen[row] = (kind, _refined(kind, at, _gain_of(kind, seen, seen.residual(columns)[0])))
    gains = list(fitted.gain)
    kinds = [kind for kind, _ in chosen]
    if len(chosen) > 1 and RIGID in kinds:
        # A rigid motion may have compensated for a shape that was not at its best place yet.
        row = kinds.index(RIGID)
        others = [other for k, other in enumerate(chosen) if k != row]
        without, with_rigid = (seen.residual(seen.columns(shapes))[1] for shapes in (others, chosen))
        if without - with_rigid < RIGID_SHARE * (float((fine.weight * fine.mean**2).sum()) - with_rigid):
            del chosen[row], gains[row]
    return dataclasses.replace(fitted, shapes=seen.shapes(chosen), gain=tuple(gains))


def rigid_motion(blocks: Blocks, frame: Frame) -> Shape:
    """Return the rigid motion that fits the blocks' deviations."""
    seen = Observations(blocks, frame, frame.local(blocks.points), blocks.outward @ frame.axes.T)
    return seen.shapes([(RIGID, ())])[0]


def _refined(kind: str, at: At, gain: Callable[[At], float]) -> At:
    """Return the parameters of a step or a wave near given ones that explain most."""
    if kind == "step":  # not continuous
        places = [(at[0], float(x)) for x in at[1] + STEP_REACH * np.linspace(-1.0, 1.0, STEP_PLACES)]
        refined: At = max(places, key=gain)
    else:
        refined = _golden_section(at, 0.9 * at[1], 1.1 * at[1], gain)
    return refined if gain(refined) > gain(at) else at


def _golden_section(at: At, low: float, high: float, gain: Callable[[At], float]) -> At:
    """Return parameters whose second lies between two bounds where a function is largest."""
    for _ in range(GOLDEN_STEPS):
        a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        if gain((at[0], a, *at[2:])) > gain((at[0], b, *at[2:])):
            high = b
        else:
            low = a
    return (at[0], 0.5 * (low + high), *at[2:])


def _candidates(seen: Observations, residual: Floats) -> Iterator[tuple[str, At]]:
    """Yield the shapes to try; steps, waves and bumps where they explain most of the residuals (n,)."""
    frame, blocks = seen.frame, seen.blocks
    half = frame.half
    axes = (0.0, 1.0) if half[1] > PLATE_RATIO * half[2] else (0.0,)
    yield RIGID, ()
    for axis in axes:
        yield "bend", (axis, 2.0)
        yield "bend", (axis, 1.0)
    yield "twist", ()
    yield from _best("step", [(axis, float(at)) for axis in axes for at in STEPS], seen, residual)
    waves: list[At] = []
    for axis in axes:
        shortest, longest = WAVE_BLOCKS * blocks.side_mm, 2.0 * half[int(axis)] / FEWEST_PERIODS
        if longest <= shortest:
            continue
        waves += [
            (axis, float(length), fading)
            for length in np.geomspace(shortest, longest, 2 + int(24 * np.log2(longest / shortest)))
            for fading in (0.0, half[1 - int(axis)] if axis else frame.front)
        ]
    yield from _best("waviness", waves, seen, residual)
    yield from _best_bump(seen, residual)


def _best(kind: str, places: list[At], seen: Observations, residual: Floats) -> Iterator[tuple[str, At]]:
    """Yield the parameters that explain most, refined between those tried; nothing without any."""
    if not places:
        return
    gain = _gain_of(kind, seen, residual)
    best = max(places, key=gain)
    tried = sorted({place[1] for place in places})
    index = tried.index(best[1])
    refined = _golden_section(best, tried[max(0, index - 1)], tried[min(len(tried) - 1, index + 1)], gain)
    yield kind, refined if gain(refined) > gain(best) else best


def _gain_of(kind: str, seen: Observations, residual: Floats) -> Callable[[At], float]:
    """Return the function of a shape's parameters: reduction of chi-square, a rigid motion free beside the shape.

    It is 0 for a shape that is nearly such a motion where blocks were seen, as a step with none before it: the two
    would be fitted against each other, by any amount.
    """
    rigid = seen.basis(RIGID, ())
    w = seen.blocks.weight
    A = rigid.T @ (w[:, None] * rigid)
    A += WEAK * np.trace(A) / len(A) * np.eye(len(A))
    projected = np.linalg.solve(A, (w[:, None] * rigid).T)
    rest = residual - rigid @ (projected @ residual)

    def gain(at: At) -> float:
        columns = seen.basis(kind, at)
        whole = w @ columns**2
        columns = columns - rigid @ (projected @ columns)
        B = columns.T @ (w[:, None] * columns)
        if (np.diag(B) < LEAST_OWN * whole).any():
            return 0.0
        b = columns.T @ (w * rest)
        return float(b @ np.linalg.solve(B + (WEAK * np.trace(B) + 1e-12) * np.eye(len(B)), b))

    return gain


def _best_bump(seen: Observations, residual: Floats) -> Iterator[tuple[str, At]]:
    """Yield the bump on the front that explains most; nothing without enough blocks there."""
    p, n, frame, blocks = seen.p, seen.n, seen.frame, seen.blocks
    front = np.flatnonzero(np.abs(n[:, 2]) > 0.9)
    if len(front) < 20:
        return
    radii = np.geomspace(2.0 * blocks.side_mm, 1.2 * max(frame.half[1], 3.0 * blocks.side_mm), BUMP_RADII)
    strongest = front[np.argsort(-np.abs(residual[front]), kind="stable")[:40]]
    rows = np.concatenate([strongest, front[:: max(1, len(front) // 400)]])
    places = np.column_stack([np.repeat(p[rows, :2], len(radii), axis=0), np.tile(radii, len(rows))])
    a, b, out, values = (np.ascontiguousarray(x) for x in (p[:, 0], p[:, 1], n[:, 2], residual))
    gains = bump_gains(a, b, out, blocks.weight, values, places)
    best, largest = places[int(np.argmax(gains))], float(gains.max())
    step = blocks.side_mm
    around = np.array([(x, y, k) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0) for k in (0.85, 1.0, 1.18)])
    for _ in range(REFINEMENTS):
        places = np.column_stack([best[:2] + step * around[:, :2], best[2] * around[:, 2]])
        gains = bump_gains(a, b, out, blocks.weight, values, places)
        if float(gains.max()) > largest:
            best, largest = places[int(np.argmax(gains))], float(gains.max())
        step *= 0.6
    yield "bump", (float(best[0]), float(best[1]), float(best[2]))


@njit(cache=True, nogil=True)
def bump_gains(a: Floats, b: Floats, n: Floats, weight: Floats, residual: Floats, places: Floats) -> Floats:
    """Return the reduction of chi-square by bumps at places (k, 3) = a, b, radius.

    ``a``, ``b`` (m,) are the places of the residuals (m,), ``n`` (m,) their normals' outward part.
    """
    gains = np.zeros(len(places))
    for k in range(len(places)):
        radius_2 = places[k, 2] ** 2
        top, below = 0.0, 1e-12
        for i in range(len(a)):
            square = ((a[i] - places[k, 0]) ** 2 + (b[i] - places[k, 1]) ** 2) / radius_2
            if square < 1.0:
                height = (1.0 - square) ** 2 * n[i]
                top += weight[i] * height * residual[i]
                below += weight[i] * height * height
        gains[k] = top * top / below
    return gains
