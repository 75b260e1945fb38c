"""Waves: places in a row on one face that deviate to either side in turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from processor.model import Floats

FEWEST = 3  # half waves
GAP_SHARE = 0.5  # of the smaller width of two half waves, the largest gap between them
LEAST_SHARE = 0.25  # of the largest amplitude, for a half wave to count
STRAIGHT_SHARE = 0.5  # of the spacing, the largest rms distance of the middles from their line
EVEN = 2.0  # ratio of the largest and the least spacing


@dataclass(frozen=True)
class Lobe:
    """A place on a face: cells (n, 2) on it, its middle (2,), the signed depth in mm, and its smaller extent."""

    chart: int
    uv: Floats
    middle: Floats
    depth: float
    width: float


def waves(lobes: Sequence[Lobe]) -> list[list[int]]:
    """Return the rows of the lobes of each wave, in their order along it."""
    pairs = [
        (i, j)
        for i in range(len(lobes))
        for j in range(i)
        if lobes[i].chart == lobes[j].chart and lobes[i].depth * lobes[j].depth < 0.0 and _near(lobes[i], lobes[j])
    ]
    if not pairs:
        return []
    rows = np.array(pairs)
    links = coo_array((np.ones(len(rows), np.int8), (rows[:, 0], rows[:, 1])), (len(lobes),) * 2)
    group = connected_components(links, directed=False)[1]
    found = []
    for number in np.unique(group[rows[:, 0]]):
        members = np.flatnonzero(group == number).tolist()
        most = max(abs(lobes[k].depth) for k in members)
        members = [k for k in members if abs(lobes[k].depth) >= LEAST_SHARE * most]
        ordered = _in_line(members, lobes) if len(members) >= FEWEST else []
        if ordered:
            found.append(ordered)
    return found


def _near(one: Lobe, other: Lobe) -> bool:
    gap = float(cKDTree(one.uv).query(other.uv)[0].min())
    return gap <= GAP_SHARE * min(one.width, other.width)


def _in_line(members: list[int], lobes: Sequence[Lobe]) -> list[int]:
    """Return the members in order along their line; none if they are not in a line, in turn and evenly spaced."""
    middles = np.array([lobes[k].middle for k in members])
    arm = middles - middles.mean(axis=0)
    axes = np.linalg.eigh(arm.T @ arm)[1]
    direction = axes[:, 1] * np.sign(axes[np.argmax(np.abs(axes[:, 1])), 1])
    along = arm @ direction
    order = np.argsort(along, kind="stable")
    spacing = np.diff(along[order])
    signs = np.sign([lobes[members[k]].depth for k in order])
    straight = float(np.sqrt(np.mean((arm @ axes[:, 0]) ** 2))) <= STRAIGHT_SHARE * float(np.median(spacing))
    in_turn = bool((signs[1:] != signs[:-1]).all())
    even = float(spacing.max()) <= EVEN * max(float(spacing.min()), 1e-9)
    return [members[k] for k in order] if straight and in_turn and even else []
