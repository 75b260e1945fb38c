"""Compiled selection of a sphere's size: radii are voted for, the best are fitted, and the fit of least energy wins.

A consensus count would choose the largest sphere, because sleeves lie outside of the right one. The energy of a fit is
its chi-square with that of its priors, less a reward for each point that it explains.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit

from processor.geometry.sphere_fit import residual
from processor.geometry.thread_ranges import over_ranges
from processor.inner_kernels import inner_ieee
from processor.model import Bools
from processor.space_frame.points.sphere_crops import CropsWithRays
from processor.space_frame.spheres.ball_fit import (
    AROUND_MM,
    COARSE_MM,
    MASKED,
    VISIBLE,
    Prior,
    fit_one,
    mask_of,
    segments,
    select,
    variance,
    within,
)
from processor.space_frame.spheres.records import Masks, SizeChoice, Sizes, StochasticModel

REWARD = 9.0  # of a point on the sphere, in chi-square: at 3 sd a residual is as likely an outlier as not
THROUGH = 9.0  # cost of a ray that ends beyond the sphere it meets: steel is opaque
SQUARE_ON = 0.5  # least cosine for that cost: nearer the limb a beam may be split
NEIGHBOURS_MM = 12.0  # sizes within this are compared with each other
TRIED = 8  # sizes fitted at most
MANY = 30.0  # votes of the best radius from which on a neighbour with few votes is not fitted
SHARE, NEAR_SHARE = 0.4, 0.15  # of the best vote, for a radius to be fitted; and for a neighbour of the best


class NodesToChoose(NamedTuple):
    """Nodes (k,) whose sizes are to be chosen, those ``wanted`` (k,): their points and what is tried.

    ``vote_half_width`` and ``first_reach_mm``, the reach of the first steps, are in mm.
    """

    crops: CropsWithRays
    masks: Masks
    model: StochasticModel
    sizes: Sizes
    vote_half_width: float
    first_reach_mm: float
    wanted: Bools
    threads: int = 0

    def of_nodes(self, nodes: slice) -> NodesToChoose:
        """Return some of the nodes."""
        sizes = self.sizes
        return self._replace(
            crops=self.crops.of_nodes(nodes),
            masks=self.masks.of_nodes(nodes),
            sizes=sizes._replace(nominal=sizes.nominal[nodes], centre_weight=sizes.centre_weight[nodes]),
            wanted=self.wanted[nodes],
        )


def choose(nodes_to_choose: NodesToChoose) -> SizeChoice:
    """Choose the size of each node's sphere, and fit it.

    States are NaN and energies infinite where nothing fits, and where a node is not wanted.

    Sleeves hide more of a small sphere than of a large one. Sizes near the best are therefore compared by the points
    that are masked for none of them; otherwise the size with the most points would win.
    """
    nodes = len(nodes_to_choose.wanted)
    choice = SizeChoice(
        states=np.full((nodes, 4), np.nan),
        sizes=np.full(nodes, np.nan),
        energy=np.full(nodes, np.inf),
        second=np.full(nodes, np.nan),
        second_energy=np.full(nodes, np.inf),
    )
    over_ranges(partial(_choose_range, *nodes_to_choose[:-1], choice), nodes, nodes_to_choose.threads)
    return choice


@njit(cache=True, nogil=True, error_model="numpy")
def _choose_range(crops, masks, model, sizes, vote_half_width, first_reach_mm, wanted, choice, first, last):  # type: ignore[no-untyped-def]
    for k in range(first, last):
        if wanted[k]:
            _choose_at(k, crops, masks, model, sizes, vote_half_width, first_reach_mm, choice)


@inner_ieee
def _choose_at(k, crops, masks, model, sizes, vote_half_width, first_reach_mm, choice):  # type: ignore[no-untyped-def]
    """Choose the size of node ``k``; see :func:`choose`."""
    mask, nominal = mask_of(masks, k), sizes.nominal[k]
    known = not np.isnan(nominal)
    tried = with_nominal(sizes.sizes, nominal)
    vote = np.empty(len(tried))
    ends = slice(masks.start[k], masks.start[k + 1])
    rows = slice(crops.start[k], crops.start[k + 1])
    votes(crops.points[rows], crops.rays[rows], mask, masks.tube_off[ends], tried, vote_half_width, vote)
    order = by_votes(vote)
    worth, widest = _worth(tried, vote, order, nominal)
    _, observations = within(crops, k, 0.0, widest + AROUND_MM)
    points, rays = observations.points, observations.rays
    n = len(points)
    if n == 0:
        return
    all_shifts = np.zeros((TRIED + 1, segments(observations.station), 3))
    all_states, energies, radii = np.zeros((TRIED + 1, 4)), np.empty(TRIED + 1), np.empty(TRIED + 1)
    codes, covariance = np.zeros((TRIED + 1, n), np.uint8), np.zeros((4, 4))
    count = 0
    w = 0.0 if sizes.free else sizes.weight
    for j in order:
        is_nominal = known and tried[j] == nominal
        if not worth[j] or count >= (TRIED + 1 if is_nominal else TRIED):
            continue
        state, shifts, code = all_states[count], all_shifts[count], codes[count]
        restart(state, shifts, tried[j])
        prior = Prior(sizes.centre_weight[k], tried[j], w)
        used = fit_one(observations, mask, model, prior, first_reach_mm, COARSE_MM, state, shifts, code, covariance)
        if used < 1:
            if sizes.free:
                continue
            # the sphere may be hidden altogether: the size stays until visible points contradict it
            restart(state, shifts, tried[j])
        repeated = False
        for i in range(count):
            repeated = repeated or (sizes.free and abs(all_states[i, 3] - state[3]) < 0.5)
        if repeated:
            continue
        select(points, rays, mask, state, np.inf, code)
        radii[count] = tried[j]
        energies[count] = energy(observations, code, model.noise, prior, state, shifts)
        if known and not is_nominal:
            energies[count] += sizes.other_size_penalty
        count += 1
    if count == 0:
        return
    _compare_alike(k, observations, mask, model.noise, sizes, all_states, all_shifts, radii, codes, energies[:count])
    best = least_of(energies, count)
    choice.energy[k], choice.sizes[k] = energies[best], all_states[best, 3] if sizes.free else radii[best]
    for i in range(4):
        choice.states[k, i] = all_states[best, i]
    energies[best] = np.inf
    if count > 1:
        runner_up = least_of(energies, count)
        choice.second[k] = all_states[runner_up, 3] if sizes.free else radii[runner_up]
        choice.second_energy[k] = energies[runner_up]


@inner_ieee
def _compare_alike(k, observations, mask, noise, sizes, states, shifts, radii, codes, energies):  # type: ignore[no-untyped-def]
    """Compute the energies (m,) again without the points that are masked for any of the sizes near the best.

    Points near the limb of any of these sizes are left out as well: a beam that a sphere cuts in part returns from
    there also where its centre misses the sphere, and such points fit a sphere that is one size too large.
    """
    nominal = sizes.nominal[k]
    best = least_of(energies, len(energies))
    comparable = np.ones(codes.shape[1], np.uint8)
    for j in range(len(energies)):
        if abs(radii[j] - radii[best]) <= NEIGHBOURS_MM:
            for i in range(len(comparable)):
                if codes[j, i] == MASKED:
                    comparable[i] = 0
            _leave_out_limb(observations.points, observations.rays, states[j], mask.least_cosine, comparable)
    for j in range(len(energies)):
        for i in range(len(comparable)):
            codes[j, i] *= comparable[i]
        prior = Prior(sizes.centre_weight[k], radii[j], 0.0 if sizes.free else sizes.weight)
        energies[j] = energy(observations, codes[j], noise, prior, states[j], shifts[j])
        if not np.isnan(nominal) and radii[j] != nominal:
            energies[j] += sizes.other_size_penalty


@inner_ieee
def _leave_out_limb(points, rays, state, least_cosine, kept):  # type: ignore[no-untyped-def]
    """Clear ``kept`` (n,) where a ray passes the limb of a sphere as near as the incidence below ``least_cosine`` does.

    That incidence tells how far inside of the limb a beam is cut; it is cut as far outside.
    """
    r = state[3]
    width = r - r * np.sqrt(1.0 - least_cosine * least_cosine)
    for i in range(len(points)):
        ux, uy, uz = rays[i, 0], rays[i, 1], rays[i, 2]
        x, y, z = points[i, 0] - state[0], points[i, 1] - state[1], points[i, 2] - state[2]
        along = x * ux + y * uy + z * uz
        beside = np.sqrt(max(0.0, x * x + y * y + z * z - along * along))
        if abs(beside - r) < width and (ux != 0.0 or uy != 0.0 or uz != 0.0):
            kept[i] = 0


# --- one fit and its energy ------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def energy(observations, surface, noise, prior, state, shifts):  # type: ignore[no-untyped-def]
    """Chi-square of the points, each at most its reward, less the rewards, with the priors' chi-square.

    A ray that passes through the sphere adds a cost; a point in front of it does not.
    """
    points, rays, ranges, station = observations
    total = prior.radius_weight * (state[3] - prior.radius) ** 2
    for i in range(3):
        for j in range(3):
            total += state[i] * prior.centre_weight[i, j] * state[j]
    segment = 0
    for i in range(len(points)):
        if surface[i] == VISIBLE:
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


# --- votes for radii -------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def votes(points, rays, mask, tube_off, radii, vote_half_width, count):  # type: ignore[no-untyped-def]
    """Fill votes (m,) for radii: points in the shell less those deeper than two half-widths of a vote inside it.

    Points within ``keep_off`` of an axis are sleeves. Cones are wider than sleeves and stand where a large sphere would
    be: radii from twice ``tube_off`` on do not count the points within that of an axis either.
    """
    n = len(points)
    distance, near_tube = np.empty(n), np.empty(n, np.uint8)
    widest, farthest = 0.0, 0.0
    for m in range(len(mask.axes)):
        widest = max(widest, tube_off[m])
    for k in range(len(radii)):
        farthest = max(farthest, radii[k] + vote_half_width)
    number = 0
    for i in range(n):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        d2 = x * x + y * y + z * z
        if d2 > farthest * farthest:
            continue
        d = np.sqrt(d2)
        facing = x * rays[i, 0] + y * rays[i, 1] + z * rays[i, 2]
        if facing > 0.0 or (z < 0.0 and x * x + y * y < mask.hole * mask.hole):
            continue
        masked, tube = False, False
        for m in range(len(mask.axes)):
            ax, ay, az = mask.axes[m, 0], mask.axes[m, 1], mask.axes[m, 2]
            sx, sy, sz = x - mask.axis_points[m, 0], y - mask.axis_points[m, 1], z - mask.axis_points[m, 2]
            along = sx * ax + sy * ay + sz * az
            if along <= 0.0:
                continue
            across = sx * sx + sy * sy + sz * sz - along * along
            if across < mask.keep_off[m] * mask.keep_off[m]:
                masked = True
                break
            tube = tube or across < tube_off[m] * tube_off[m]
        if not masked:
            distance[number] = d
            near_tube[number] = tube
            number += 1
    for k in range(len(radii)):
        count[k] = 0.0
        for i in range(number):
            off = distance[i] - radii[k]
            if abs(off) < vote_half_width:
                if not near_tube[i] or radii[k] < 2.0 * widest:
                    count[k] += 1.0
            elif off < -2.0 * vote_half_width:
                count[k] -= 1.0


@inner_ieee
def _worth(tried, vote, order, nominal):  # type: ignore[no-untyped-def]
    """Which radii (m,) have enough votes to be fitted, and the largest of them; the nominal one always is."""
    most = vote[order[0]]
    worth, widest = np.zeros(len(tried), np.uint8), 0.0
    for j in order:
        near = abs(tried[j] - tried[order[0]]) <= NEIGHBOURS_MM and (most < MANY or vote[j] >= NEAR_SHARE * most)
        worth[j] = near or (vote[j] >= SHARE * most and vote[j] >= 3.0) or tried[j] == nominal
        if worth[j]:
            widest = max(widest, tried[j])
    return worth, widest


@inner_ieee
def with_nominal(sizes, nominal):  # type: ignore[no-untyped-def]
    """Return the sizes, with the nominal one appended if it is none of them."""
    count = len(sizes)
    tried = np.empty(count + 1)
    fresh = not np.isnan(nominal)
    for j in range(count):
        tried[j] = sizes[j]
        fresh = fresh and sizes[j] != nominal
    tried[count] = nominal
    return tried[: count + 1] if fresh else tried[:count]


@inner_ieee
def by_votes(vote):  # type: ignore[no-untyped-def]
    """Return the rows from the most votes to the fewest; equal ones keep their order."""
    order = np.arange(len(vote))
    for i in range(1, len(order)):
        j = i
        while j > 0 and vote[order[j]] > vote[order[j - 1]]:
            order[j], order[j - 1] = order[j - 1], order[j]
            j -= 1
    return order


# --- small parts -----------------------------------------------------------------------------------------------------


@inner_ieee
def restart(state, shifts, radius):  # type: ignore[no-untyped-def]
    """Set the state to a sphere of this radius at the node, and the shifts to 0."""
    state[0], state[1], state[2], state[3] = 0.0, 0.0, 0.0, radius
    shifts[:] = 0.0


@inner_ieee
def least_of(values, count):  # type: ignore[no-untyped-def]
    """Return the row of the least of the first values."""
    best = 0
    for i in range(1, count):
        if values[i] < values[best]:
            best = i
    return best
