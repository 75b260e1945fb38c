"""Shapes of whole components: moved, bent, twisted, waved or stepped; and a bump, that none of these be taken for.

Along a component runs xi, across it eta, out of its largest face zeta, each from -1 to 1 (eta and zeta by the larger).
A shape is a sum of displacements; what a scan sees of it is their part along each cell's normal.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit

from processor.model import Floats

PLATE_RATIO = 3.0  # of width to thickness, from which on a component bends across itself too
STEPS = np.linspace(-0.9, 0.9, 37)
FEWEST_PERIODS = 1.4
WAVE_BLOCKS = 5.0  # in the shortest wave
BUMP_RADII = 8
REFINING = 3
STEP_REACH, STEP_PLACES = 0.07, 71  # about the best place so far, of half the component
MOST_BUMPS, MASK_RADII, MOST_MASKED = 3, 1.15, 0.5
RIGID_SHARE = 0.05  # of what a shape explains, from which on the component has moved as well
GOLDEN, GOLDEN_STEPS = 0.6180339887498949, 18
WEAK = 1e-6  # of a column's weight: keeps what is not seen at nothing


@dataclass(frozen=True)
class Frame:
    """A component's own axes: origin (3,), axes (3, 3, rows along, across, out) and half sizes (3,), mm."""

    origin: Floats
    axes: Floats
    half: Floats
    front: float  # half the height of the largest face

    def local(self, points: Floats) -> Floats:
        """Coordinates (n, 3) along, across and out, mm."""
        found: Floats = (points - self.origin) @ self.axes.T
        return found


@dataclass(frozen=True)
class Shape:
    """One shape: its kind, where it depends on more than factors the ``at`` of these, and the factors (k,)."""

    kind: str
    at: tuple[float, ...]
    factors: Floats

    def values(self, frame: Frame, points: Floats, outward: Floats) -> Floats:
        """Return what the shape adds to deviations (n,) at points (n, 3) with unit normals (n, 3), mm."""
        columns = BASES[self.kind](frame.local(points), outward @ frame.axes.T, frame.half, self.at)
        found: Floats = columns @ self.factors
        return found


Basis = Callable[[Floats, Floats, Floats, tuple[float, ...]], Floats]


def _rigid(p: Floats, n: Floats, half: Floats, at: tuple[float, ...]) -> Floats:
    span = float(half.max())
    return np.hstack([n, np.cross(p / span, n)])


def _bend(p: Floats, n: Floats, half: Floats, at: tuple[float, ...]) -> Floats:
    axis, order = int(at[0]), int(at[1])
    x = p[:, axis] / half[axis]
    shape = x**2 if order == 2 else np.cos(0.5 * np.pi * x)
    if axis == 1 or half[1] > PLATE_RATIO * half[2]:
        return np.stack([shape * n[:, 2]], axis=1)
    return np.stack([shape * n[:, 2], shape * n[:, 1]], axis=1)


def _twist(p: Floats, n: Floats, half: Floats, at: tuple[float, ...]) -> Floats:
    x, span = p[:, 0] / half[0], max(half[1], half[2])
    found: Floats = (x * (p[:, 1] * n[:, 2] - p[:, 2] * n[:, 1]) / span)[:, None]
    return found


def _step(p: Floats, n: Floats, half: Floats, at: tuple[float, ...]) -> Floats:
    axis = int(at[0])
    beyond = (p[:, axis] / half[axis] > at[1]).astype(float)
    if axis == 1 or half[1] > PLATE_RATIO * half[2]:
        return np.stack([beyond * n[:, 2]], axis=1)
    return np.stack([beyond * n[:, 2], beyond * n[:, 1]], axis=1)


def _wave(p: Floats, n: Floats, half: Floats, at: tuple[float, ...]) -> Floats:
    axis, length, fading = int(at[0]), at[1], at[2]  # to nothing at ``fading`` to either side, 0 = nowhere
    turn = 2.0 * np.pi * p[:, axis] / length
    other = np.clip(p[:, 1 - axis] / fading, -1.0, 1.0) if fading else np.zeros(len(p))
    high = np.cos(0.5 * np.pi * other) ** 2 * n[:, 2]
    return np.stack([high * np.sin(turn), high * np.cos(turn)], axis=1)


def _bump(p: Floats, n: Floats, half: Floats, at: tuple[float, ...]) -> Floats:
    away = ((p[:, 0] - at[0]) ** 2 + (p[:, 1] - at[1]) ** 2) / at[2] ** 2
    return (np.maximum(1.0 - away, 0.0) ** 2 * n[:, 2])[:, None]


BASES: dict[str, Basis] = {
    "misalignment": _rigid, "bend": _bend, "twist": _twist, "step": _step, "waviness": _wave, "bump": _bump,
}  # fmt: skip


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
    """Shapes fitted together; ``gain`` is by how much each made the weighted sum of squares less when it was added.

    ``weight`` (n,) is what counted of the blocks, next to nothing where a bump is; ``margin`` is by how much more the
    best of all other kinds leaves of the weighted sum of squares.
    """

    shapes: tuple[Shape, ...]
    gain: tuple[float, ...]
    weight: Floats
    margin: float


def fit(blocks: Blocks, frame: Frame, most: int = 2, least_gain: float = 30.0) -> Fitted:
    """Add the shape that explains most for its number of factors, again and again while it explains enough.

    Where that is a bump, its place is local, and is left out from then on.
    """
    p, n = frame.local(blocks.points), blocks.outward @ frame.axes.T
    chosen: list[tuple[str, tuple[float, ...]]] = []
    gains: list[float] = []
    margin, masked = np.inf, 0
    left, before = blocks.mean, float((blocks.weight * blocks.mean**2).sum())
    while len(chosen) < most and masked < MOST_BUMPS:
        squares: dict[str, float] = {}
        best: tuple[float, str, tuple[float, ...]] | None = None
        base = _columns(chosen, p, n, frame)
        free = "misalignment" in [kind for kind, _ in chosen]
        used = np.count_nonzero(blocks.weight > WEAK * blocks.weight.max())
        for kind, at in _offers(blocks, frame, p, n, left):
            if kind in [one for one, _ in chosen]:
                continue
            columns = np.hstack([base, BASES[kind](p, n, frame.half, at)])
            if kind not in ("misalignment", "bump") and not free:
                columns = np.hstack([columns, _rigid(p, n, frame.half, ())])
            square = _left(columns, blocks)[1]
            squares[kind] = min(square, squares.get(kind, np.inf))
            score = used * np.log(square / used + 1.0) + columns.shape[1] * np.log(used)
            if best is None or score < best[0]:
                best = (score, kind, at)
        if best is None or before - squares[best[1]] < least_gain:
            break
        _, kind, at = best
        square = squares[kind]
        if kind == "bump":
            away = (p[:, 0] - at[0]) ** 2 + (p[:, 1] - at[1]) ** 2
            near = away < (MASK_RADII * at[2] + blocks.side_mm) ** 2
            if near.mean() > MOST_MASKED:
                break
            blocks = dataclasses.replace(blocks, weight=np.where(near, WEAK * blocks.weight, blocks.weight))
            masked += 1
            left, before = _left(base, blocks)
            continue
        if not chosen:
            # Every other whole shape was tried with a rigid motion beside it: against that alone a bump stands.
            others = [value for one, value in squares.items() if one == "bump" or kind not in (one, "misalignment")]
            margin = min(others, default=np.inf) - square
        if kind != "misalignment" and not free:
            alone = _left(np.hstack([base, BASES[kind](p, n, frame.half, at)]), blocks)[1]
            if alone - square > RIGID_SHARE * (before - square) + least_gain:
                chosen.append(("misalignment", ()))
                gains.append(alone - square)
                most += 1
            else:
                square = alone
        chosen.append((kind, at))
        gains.append(before - square)
        left, before = _left(_columns(chosen, p, n, frame), blocks)
    shapes = _split(chosen, _solve(_columns(chosen, p, n, frame), blocks), p, n, frame)
    return Fitted(shapes, tuple(gains), blocks.weight, margin)


def refitted(fitted: Fitted, fine: Blocks, frame: Frame) -> Fitted:
    """Fit the shapes again to finer blocks: a wave is less high when averaged over a large share of its length."""
    if not fitted.shapes:
        return fitted
    p, n = frame.local(fine.points), fine.outward @ frame.axes.T
    chosen = [(shape.kind, shape.at) for shape in fitted.shapes]
    for row, (kind, at) in enumerate(chosen):
        if kind not in ("waviness", "step"):
            continue
        others = [one for k, one in enumerate(chosen) if k != row]
        left = fine.mean - _columns(others, p, n, frame) @ _solve(_columns(others, p, n, frame), fine)
        gain = _gains(kind, fine, frame, p, n, left)
        if kind == "step":  # jumps from block to block
            places = [(at[0], float(x)) for x in at[1] + STEP_REACH * np.linspace(-1.0, 1.0, STEP_PLACES)]
            refined: tuple[float, ...] = max(places, key=gain)
        else:
            low, high = 0.9 * at[1], 1.1 * at[1]
            for _ in range(GOLDEN_STEPS):
                one, two = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
                low, high = (low, two) if gain((at[0], one, *at[2:])) > gain((at[0], two, *at[2:])) else (one, high)
            refined = (at[0], 0.5 * (low + high), *at[2:])
        if gain(refined) > gain(at):
            chosen[row] = (kind, refined)
    gains = list(fitted.gain)
    kinds = [kind for kind, _ in chosen]
    if len(chosen) > 1 and "misalignment" in kinds:
        # Where a shape was not at its best place yet, a motion of the whole made up for some of it.
        row = kinds.index("misalignment")
        others = [one for k, one in enumerate(chosen) if k != row]
        without, with_ = (_left(_columns(some, p, n, frame), fine)[1] for some in (others, chosen))
        if without - with_ < RIGID_SHARE * (float((fine.weight * fine.mean**2).sum()) - with_):
            del chosen[row], gains[row]
    factors = _solve(_columns(chosen, p, n, frame), fine)
    return dataclasses.replace(fitted, shapes=_split(chosen, factors, p, n, frame), gain=tuple(gains))


def _split(
    chosen: list[tuple[str, tuple[float, ...]]], factors: Floats, p: Floats, n: Floats, frame: Frame
) -> tuple[Shape, ...]:
    shapes, start = [], 0
    for kind, at in chosen:
        width = BASES[kind](p[:1], n[:1], frame.half, at).shape[1]
        shapes.append(Shape(kind, at, factors[start : start + width]))
        start += width
    return tuple(shapes)


def _columns(chosen: list[tuple[str, tuple[float, ...]]], p: Floats, n: Floats, frame: Frame) -> Floats:
    return np.hstack([np.empty((len(p), 0)), *(BASES[kind](p, n, frame.half, at) for kind, at in chosen)])


def _solve(columns: Floats, blocks: Blocks) -> Floats:
    if not columns.shape[1]:
        return np.empty(0)
    A = columns.T @ (blocks.weight[:, None] * columns)
    ridge = WEAK * np.trace(A) / len(A) + 1e-12
    found: Floats = np.linalg.solve(A + ridge * np.eye(len(A)), columns.T @ (blocks.weight * blocks.mean))
    return found


def _left(columns: Floats, blocks: Blocks) -> tuple[Floats, float]:
    left = blocks.mean - columns @ _solve(columns, blocks)
    return left, float((blocks.weight * left**2).sum())


def _offers(
    blocks: Blocks, frame: Frame, p: Floats, n: Floats, left: Floats
) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Give the shapes to try, those with places at the best of them for what is left so far."""
    half = frame.half
    wide = half[1] > PLATE_RATIO * half[2]
    axes = (0.0, 1.0) if wide else (0.0,)
    yield "misalignment", ()
    for axis in axes:
        yield "bend", (axis, 2.0)
        yield "bend", (axis, 1.0)
    yield "twist", ()
    yield from _best("step", [(axis, float(at)) for axis in axes for at in STEPS], blocks, frame, p, n, left)
    waves: list[tuple[float, ...]] = []
    for axis in axes:
        shortest, longest = WAVE_BLOCKS * blocks.side_mm, 2.0 * half[int(axis)] / FEWEST_PERIODS
        if longest <= shortest:
            continue
        waves += [
            (axis, float(length), fades)
            for length in np.geomspace(shortest, longest, 2 + int(24 * np.log2(longest / shortest)))
            for fades in (0.0, half[1 - int(axis)] if axis else frame.front)
        ]
    yield from _best("waviness", waves, blocks, frame, p, n, left)
    yield from _bumps(blocks, frame, p, n, left)


def _best(
    kind: str, places: list[tuple[float, ...]], blocks: Blocks, frame: Frame, p: Floats, n: Floats, left: Floats
) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Give the one of many places of a shape that explains most, the rigid motion of the component free beside it."""
    if not places:
        return
    gain = _gains(kind, blocks, frame, p, n, left)
    best = max(places, key=gain)
    # Between the places tried: by golden sections of the number that is not an axis.
    tried = sorted({one[1] for one in places})
    where = tried.index(best[1])
    low, high = tried[max(0, where - 1)], tried[min(len(tried) - 1, where + 1)]
    for _ in range(GOLDEN_STEPS):
        one, two = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        if gain((best[0], one, *best[2:])) > gain((best[0], two, *best[2:])):
            high = two
        else:
            low = one
    refined = (best[0], 0.5 * (low + high), *best[2:])
    yield kind, refined if gain(refined) > gain(best) else best


def _gains(
    kind: str, blocks: Blocks, frame: Frame, p: Floats, n: Floats, left: Floats
) -> Callable[[tuple[float, ...]], float]:
    """Return a function: how much a shape at a place explains of what is left, a rigid motion free beside it."""
    rigid = _rigid(p, n, frame.half, ())
    w = blocks.weight
    A = rigid.T @ (w[:, None] * rigid)
    A += WEAK * np.trace(A) / len(A) * np.eye(len(A))
    projected = np.linalg.solve(A, (w[:, None] * rigid).T)
    rest = left - rigid @ (projected @ left)

    def gain(at: tuple[float, ...]) -> float:
        columns = BASES[kind](p, n, frame.half, at)
        columns = columns - rigid @ (projected @ columns)
        B = columns.T @ (w[:, None] * columns)
        b = columns.T @ (w * rest)
        return float(b @ np.linalg.solve(B + (WEAK * np.trace(B) + 1e-12) * np.eye(len(B)), b))

    return gain


def _bumps(blocks: Blocks, frame: Frame, p: Floats, n: Floats, left: Floats) -> Iterator[tuple[str, tuple[float, ...]]]:
    front = np.flatnonzero(np.abs(n[:, 2]) > 0.9)
    if len(front) < 20:
        return
    w = blocks.weight
    radii = np.geomspace(2.0 * blocks.side_mm, 1.2 * max(frame.half[1], 3.0 * blocks.side_mm), BUMP_RADII)
    candidates = front[:: max(1, len(front) // 400)]
    strongest = front[np.argsort(-np.abs(left[front]), kind="stable")[:40]]
    rows = np.concatenate([strongest, candidates])
    places = np.column_stack([np.repeat(p[rows, :2], len(radii), axis=0), np.tile(radii, len(rows))])
    a, b, out, flat = (np.ascontiguousarray(x) for x in (p[:, 0], p[:, 1], n[:, 2], left))
    gains = bump_gains(a, b, out, w, flat, places)
    found, best = places[int(np.argmax(gains))], float(gains.max())
    step = blocks.side_mm
    around = np.array([(x, y, k) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0) for k in (0.85, 1.0, 1.18)])
    for _ in range(REFINING):
        places = np.column_stack([found[:2] + step * around[:, :2], found[2] * around[:, 2]])
        gains = bump_gains(a, b, out, w, flat, places)
        if float(gains.max()) > best:
            found, best = places[int(np.argmax(gains))], float(gains.max())
        step *= 0.6
    yield "bump", (float(found[0]), float(found[1]), float(found[2]))


# --- Compiled: how much a bump at many places explains.


@njit(cache=True, nogil=True)
def bump_gains(a: Floats, b: Floats, n: Floats, weight: Floats, left: Floats, places: Floats) -> Floats:
    """Return by how much bumps at places (k, 3) = a, b, radius make the weighted sum of squares of left (m,) less.

    ``a``, ``b`` (m,) are where the values are, ``n`` (m,) how much of a movement outward shows there.
    """
    found = np.zeros(len(places))
    for k in range(len(places)):
        square = places[k, 2] ** 2
        top, below = 0.0, 1e-12
        for i in range(len(a)):
            away = ((a[i] - places[k, 0]) ** 2 + (b[i] - places[k, 1]) ** 2) / square
            if away < 1.0:
                high = (1.0 - away) ** 2 * n[i]
                top += weight[i] * high * left[i]
                below += weight[i] * high * high
        found[k] = top * top / below
    return found
