"""Compiled choice of a ball's size: radii are voted for, then fitted, and the fit of least energy wins.

A consensus count would choose the largest ball, for sleeves stand outside of it; the energy of a fit is its chi-square
with that of its priors, less a reward for each point it explains.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.geometry.parallel import over_ranges
from processor.model import Floats, Ints, Labels
from processor.space_frame.spheres.gauss_newton import residual, select, solve, variance

Bools = npt.NDArray[np.bool_]

REWARD = 9.0  # of a point on the ball, in chi-square: residuals of 3 sd are as likely stray as not
THROUGH = 9.0  # for a ray that was measured beyond the ball it meets: steel cannot be seen through
SQUARE_ON = 0.5  # cosine from which on that holds; nearer the limb a beam may be split
GATE_MM = 40.0
CATCH_MM = 12.0  # what the first steps of a fit reach
NEIGHBOURS_MM = 12.0
TRIED = 8
MANY = 30.0  # votes from which on a neighbour that has next to none is out of the question
AROUND_MM = 25.0  # points farther out than this from a ball's surface say nothing of it
COARSE_MM, FINE_MM = 1e-3, 1e-4
SHARE, NEAR_SHARE = 0.4, 0.15  # of the best vote, which makes a radius worth a fit; next to the best


@njit(cache=True, nogil=True, error_model="numpy")
def energy(  # type: ignore[no-untyped-def]
    points, rays, ranges, station, chosen, noise, centre, centre_weight, radius, radius_weight, state, shifts
):
    """Chi-square of the points, each at most its reward, less the rewards, with the priors' chi-square.

    A ray that goes through the ball costs; what stands in front of it does not.
    """
    total = radius_weight * (state[3] - radius) ** 2
    for i in range(3):
        for j in range(3):
            total += (state[i] - centre[i]) * centre_weight[i, j] * (state[j] - centre[j])
    segment = 0
    for i in range(len(points)):
        if chosen[i] == 1:
            e, cosine, _, _, _, _ = residual(
                points[i, 0], points[i, 1], points[i, 2], rays[i, 0], rays[i, 1], rays[i, 2],
                state[0] + shifts[segment, 0], state[1] + shifts[segment, 1], state[2] + shifts[segment, 2], state[3],
            )  # fmt: skip
            if cosine > 0.0:
                gain = e * e / variance(noise, ranges[i], max(cosine, 0.1)) - REWARD
                if gain < 0.0:
                    total += gain
                elif e > 0.0 and cosine > SQUARE_ON:
                    total += min(gain, THROUGH)
        if i + 1 < len(points) and station[i + 1] != station[i]:
            segment += 1
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def segments(station):  # type: ignore[no-untyped-def]
    """Count the runs of one station among points sorted by station, at least 1."""
    found = 1
    for i in range(1, len(station)):
        if station[i] != station[i - 1]:
            found += 1
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def fit_one(  # type: ignore[no-untyped-def]
    points, rays, ranges, station, axis_points, axes, keep_off, hole, least_cosine, noise, centre, centre_weight,
    radius, radius_weight, shift_covariance, catch, settled, state, shifts, chosen, covariance,
):  # fmt: skip
    """Fit from ``state``: choose points, solve, and choose again as the cut closes in; returns points used or -1."""
    gains = np.zeros((len(shifts), 3, 8))
    far = 0.0
    for i in range(len(ranges)):
        far += ranges[i] / len(ranges)
    typical = np.sqrt(noise[0] + noise[1] * far * far)
    first = max(1.0, catch / (4.5 * typical))
    used = -1
    turns = 3 if settled > FINE_MM else 4
    for turn in range(turns):
        last = turn + 1 == turns
        stretch = first if turn == 0 else np.sqrt(first) if turn == 1 else 1.0
        gate = GATE_MM if turn == 0 else max(GATE_MM * 0.5, 30.0 * typical)
        if select(points, rays, axis_points, axes, keep_off, hole, state, least_cosine, gate, chosen) == 0:
            return -1
        used = solve(
            points, rays, ranges, station, chosen, noise, stretch, centre, centre_weight, radius, radius_weight,
            shift_covariance, settled if last else max(settled, COARSE_MM), state, shifts, gains,
            12 if last else 6, covariance,
        )  # fmt: skip
        if used < 0:
            return -1
    return used


@njit(cache=True, nogil=True, error_model="numpy")
def choose_at(  # type: ignore[no-untyped-def]
    k, start, points, rays, ranges, station, end_start, axis_points, axes, keep_off, hole, least_cosine, noise,
    tube_off, centre_weight, sizes, size_weight, expected, surprise, free, kernel, catch, shift_covariance,
    wanted_nodes, states, size, energies, second, second_energy,
):  # fmt: skip
    """Choose the size of node ``k``; see :func:`choose`."""
    if not wanted_nodes[k]:
        return
    p, u = points[start[k] : start[k + 1]], rays[start[k] : start[k + 1]]
    L, s = ranges[start[k] : start[k + 1]], station[start[k] : start[k + 1]]
    ap, ad = axis_points[end_start[k] : end_start[k + 1]], axes[end_start[k] : end_start[k + 1]]
    off, wide = keep_off[end_start[k] : end_start[k + 1]], tube_off[end_start[k] : end_start[k + 1]]
    known = not np.isnan(expected[k])
    tried = with_expected(sizes, expected[k])
    vote = np.empty(len(tried))
    votes(p, u, ap, ad, off, wide, hole, tried, kernel, vote)
    order = by_votes(vote)
    most = vote[order[0]]
    worth, widest = np.zeros(len(tried), np.uint8), 0.0
    for j in order:
        near = abs(tried[j] - tried[order[0]]) <= NEIGHBOURS_MM and (most < MANY or vote[j] >= NEAR_SHARE * most)
        worth[j] = near or (vote[j] >= SHARE * most and vote[j] >= 3.0) or (known and tried[j] == expected[k])
        if worth[j]:
            widest = max(widest, tried[j])
    rows = rows_within(p, 0.0, widest + AROUND_MM)
    p, u, L, s = taken(rows, p, u, L, s)
    n = len(p)
    if n == 0:
        return
    origin = np.zeros(3)
    all_shifts = np.zeros((TRIED + 1, segments(s), 3))
    all_states, found, own = np.zeros((TRIED + 1, 4)), np.empty(TRIED + 1), np.empty(TRIED + 1)
    codes, covariance = np.zeros((TRIED + 1, n), np.uint8), np.zeros((4, 4))
    done = 0
    w = 0.0 if free else size_weight
    for j in order:
        wanted = known and tried[j] == expected[k]
        if not worth[j]:
            continue
        if done >= (TRIED + 1 if wanted else TRIED):
            continue
        state, shifts, code = all_states[done], all_shifts[done], codes[done]
        state[0], state[1], state[2], state[3] = 0.0, 0.0, 0.0, tried[j]
        clear(shifts)
        used = fit_one(
            p, u, L, s, ap, ad, off, hole, least_cosine, noise, origin, centre_weight[k], tried[j], w,
            shift_covariance, catch, COARSE_MM, state, shifts, code, covariance,
        )  # fmt: skip
        if used < 1:
            if free:
                continue
            # all of it may be hidden: as a size it stands until points that are not hidden speak against it
            state[0], state[1], state[2], state[3] = 0.0, 0.0, 0.0, tried[j]
            clear(shifts)
        again = False
        for i in range(done):
            again = again or (free and abs(all_states[i, 3] - state[3]) < 0.5)
        if again:
            continue
        select(p, u, ap, ad, off, hole, state, least_cosine, np.inf, code)
        own[done] = tried[j]
        found[done] = energy(p, u, L, s, code, noise, origin, centre_weight[k], tried[j], w, state, shifts)
        if known and not wanted:
            found[done] += surprise
        done += 1
    if done == 0:
        return
    best = least_of(found, done)
    fair = np.ones(n, np.uint8)
    for j in range(done):
        if abs(own[j] - own[best]) <= NEIGHBOURS_MM:
            for i in range(n):
                if codes[j, i] == 2:
                    fair[i] = 0
    for j in range(done):
        for i in range(n):
            codes[j, i] *= fair[i]
        found[j] = energy(
            p, u, L, s, codes[j], noise, origin, centre_weight[k], own[j], w, all_states[j], all_shifts[j]
        )
        if known and own[j] != expected[k]:
            found[j] += surprise
    best = least_of(found, done)
    energies[k], size[k] = found[best], all_states[best, 3] if free else own[best]
    for i in range(4):
        states[k, i] = all_states[best, i]
    found[best] = np.inf
    if done > 1:
        then = least_of(found, done)
        second[k], second_energy[k] = all_states[then, 3] if free else own[then], found[then]


def choose(
    crops: tuple[Ints, Floats, Floats, Floats, Labels],
    ends: tuple[Ints, Floats, Floats, Floats, Floats],
    limits: tuple[float, float],
    noise: Floats,
    centre_weight: Floats,
    sizes: Floats,
    size_weight: float,
    expected: Floats,
    surprise: float,
    free: bool,
    kernel: float,
    catch: float,
    shift_covariance: Floats,
    wanted: Bools,
    threads: int = 0,
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Best state (k, 4), its size (k,) and energy (k,), the runner-up's size (k,) and energy (k,) of every node.

    ``crops``: start, points, rays, ranges and stations; ``ends``: start, points and directions of the members' axes,
    and how far from them sleeves and tubes reach; ``limits``: radius of the process hole's cap and least cosine.
    ``sizes`` (m,) are tried with weight ``size_weight``, and where ``free`` only as starts; energies of sizes other
    than the node's ``expected`` (k,) one (NaN = none) are raised by ``surprise``. NaN and infinite where nothing fits,
    and where the answer is not ``wanted`` (k,).

    Sleeves hide more of a small ball than of a large one: sizes near the best are compared by the points that are
    kept off none of them, or the size with the most points would win.
    """
    nodes = len(expected)
    states = np.full((nodes, 4), np.nan)
    size, energies = np.full(nodes, np.nan), np.full(nodes, np.inf)
    second, second_energy = np.full(nodes, np.nan), np.full(nodes, np.inf)
    over_ranges(
        lambda a, b: _choose_range(
            a, b, *crops, *ends, *limits, noise, centre_weight, sizes, size_weight, expected, surprise, free, kernel,
            catch, shift_covariance, wanted, states, size, energies, second, second_energy,
        ),
        nodes,
        threads,
    )  # fmt: skip
    return states, size, energies, second, second_energy


@njit(cache=True, nogil=True, error_model="numpy")
def _choose_range(  # type: ignore[no-untyped-def]
    begin, end, start, points, rays, ranges, station, end_start, axis_points, axes, keep_off, tube_off, hole,
    least_cosine, noise, centre_weight, sizes, size_weight, expected, surprise, free, kernel, catch, shift_covariance,
    wanted_nodes, states, size, energies, second, second_energy,
):  # fmt: skip
    """Choose the sizes of nodes ``begin`` to ``end``; see :func:`choose`."""
    for k in range(begin, end):
        choose_at(
            k, start, points, rays, ranges, station, end_start, axis_points, axes, keep_off, hole, least_cosine, noise,
            tube_off, centre_weight, sizes, size_weight, expected, surprise, free, kernel, catch, shift_covariance,
            wanted_nodes, states, size, energies, second, second_energy,
        )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def clear(shifts):  # type: ignore[no-untyped-def]
    """Set shifts (m, 3) to 0."""
    for k in range(len(shifts)):
        for i in range(3):
            shifts[k, i] = 0.0


# --- Compiled votes for a ball's radius, and the small lists that the choice of a size keeps.


@njit(cache=True, nogil=True, error_model="numpy")
def votes(  # type: ignore[no-untyped-def]
    points, rays, axis_points, axes, keep_off, tube_off, hole, radii, kernel, found
):
    """Votes (m,) for radii: points in the shell less those deeper than two kernels inside, which no ball allows.

    Points within ``keep_off`` of an axis are sleeves. Cones are wider than sleeves and stand where a large ball would
    be: radii from twice ``tube_off`` on are denied the points within that of an axis too.
    """
    n = len(points)
    depth, slim = np.empty(n), np.empty(n, np.uint8)
    widest, farthest = 0.0, 0.0
    for m in range(len(axes)):
        widest = max(widest, tube_off[m])
    for k in range(len(radii)):
        farthest = max(farthest, radii[k] + kernel)
    kept = 0
    for i in range(n):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        d2 = x * x + y * y + z * z
        if d2 > farthest * farthest:
            continue
        d = np.sqrt(d2)
        facing = x * rays[i, 0] + y * rays[i, 1] + z * rays[i, 2]
        if facing > 0.0 or (z < 0.0 and x * x + y * y < hole * hole):
            continue
        masked, tube = False, False
        for m in range(len(axes)):
            sx, sy, sz = x - axis_points[m, 0], y - axis_points[m, 1], z - axis_points[m, 2]
            along = sx * axes[m, 0] + sy * axes[m, 1] + sz * axes[m, 2]
            if along <= 0.0:
                continue
            across = sx * sx + sy * sy + sz * sz - along * along
            if across < keep_off[m] * keep_off[m]:
                masked = True
                break
            tube = tube or across < tube_off[m] * tube_off[m]
        if not masked:
            depth[kept] = d
            slim[kept] = tube
            kept += 1
    for k in range(len(radii)):
        found[k] = 0.0
        for i in range(kept):
            off = depth[i] - radii[k]
            if abs(off) < kernel:
                if not slim[i] or radii[k] < 2.0 * widest:
                    found[k] += 1.0
            elif off < -2.0 * kernel:
                found[k] -= 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def with_expected(sizes, expected):  # type: ignore[no-untyped-def]
    """Return the sizes, and the expected one if it is none of them."""
    count = len(sizes)
    found = np.empty(count + 1)
    fresh = not np.isnan(expected)
    for j in range(count):
        found[j] = sizes[j]
        fresh = fresh and sizes[j] != expected
    found[count] = expected
    return found[: count + 1] if fresh else found[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def by_votes(vote):  # type: ignore[no-untyped-def]
    """Return the rows from the most votes to the least; equal ones keep their order."""
    order = np.arange(len(vote))
    for i in range(1, len(order)):
        j = i
        while j > 0 and vote[order[j]] > vote[order[j - 1]]:
            order[j], order[j - 1] = order[j - 1], order[j]
            j -= 1
    return order


@njit(cache=True, nogil=True, error_model="numpy")
def least_of(values, count):  # type: ignore[no-untyped-def]
    """Return the row of the least of the first values."""
    best = 0
    for i in range(1, count):
        if values[i] < values[best]:
            best = i
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def rows_within(points, near, far):  # type: ignore[no-untyped-def]
    """Rows of points whose distance from the origin is ``near`` to ``far``."""
    rows = np.empty(len(points), np.int64)
    kept = 0
    for i in range(len(points)):
        d2 = points[i, 0] ** 2 + points[i, 1] ** 2 + points[i, 2] ** 2
        if near * near <= d2 <= far * far:
            rows[kept] = i
            kept += 1
    return rows[:kept]


@njit(cache=True, nogil=True, error_model="numpy")
def taken(rows, points, rays, ranges, station):  # type: ignore[no-untyped-def]
    """Return the rows of points, rays, ranges and stations."""
    n = len(rows)
    p, u, L, s = np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n, np.int32)
    for j in range(n):
        i = rows[j]
        for axis in range(3):
            p[j, axis] = points[i, axis]
            u[j, axis] = rays[i, axis]
        L[j] = ranges[i]
        s[j] = station[i]
    return p, u, L, s
