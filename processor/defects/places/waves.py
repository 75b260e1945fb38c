"""Waves: places in a row on one plate that move it to either side in turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from processor.defects.places.other_side import OPPOSITE_COS, PLATE_MM
from processor.model import Floats

FEWEST = 3  # half waves
GAP_SHARE = 1.0  # of the smaller width of two half waves, the largest gap between them: no other one fits into it
LEAST_SHARE = 0.25  # ratio of the amplitudes of neighbours, at least
TURN_COS = 0.8  # of the angle between steps from one half wave to the next
EVEN = 2.0  # ratio of the lengths of two such steps, at most


@dataclass(frozen=True)
class Lobe:
    """A place on a flat face of a component: its cells (n, 3) and their middle (3,), mm.

    ``outward`` (3,) is the unit normal of the face, ``height`` the signed amplitude along it, and ``width`` the smaller
    extent, mm.
    """

    component: int
    cells: Floats
    middle: Floats
    outward: Floats
    height: float
    width: float

    def step(self, other: Lobe) -> Floats:
        """Return the way (3,) to another lobe along the face."""
        way = other.middle - self.middle
        return way - (way @ self.outward) * self.outward


def waves(lobes: Sequence[Lobe]) -> list[list[int]]:
    """Return the rows of the lobes of each wave, in their order along it, the longest wave first.

    A lobe is in one wave at most; lobes beside a wave that do not continue it are left out.
    """
    neighbours: dict[int, list[int]] = {i: [] for i in range(len(lobes))}
    for i in range(len(lobes)):
        for j in range(i):
            if _alternate(lobes[i], lobes[j]):
                neighbours[i].append(j)
                neighbours[j].append(i)
    rows = [_row(lobes, neighbours, i, j) for i, near in neighbours.items() for j in near]
    rows.sort(key=lambda row: (-len(row), row))
    found: list[list[int]] = []
    taken: set[int] = set()
    for row in rows:
        if len(row) >= FEWEST and not taken.intersection(row):
            taken.update(row)
            # Rows are in the order in which the larger component of the way along them increases
            along = lobes[row[-1]].middle - lobes[row[0]].middle
            found.append(row if float(along[np.argmax(np.abs(along))]) > 0.0 else row[::-1])
    return found


def _alternate(one: Lobe, other: Lobe) -> bool:
    """Return whether two lobes may be neighbouring half waves, on the same or on opposite sides of a plate."""
    parallel = float(one.outward @ other.outward)
    apart = abs(float((other.middle - one.middle) @ one.outward))
    if one.component != other.component or abs(parallel) < -OPPOSITE_COS or apart > PLATE_MM:
        return False
    if one.height * other.height * parallel >= 0.0:
        return False
    least, most = sorted((abs(one.height), abs(other.height)))
    gap = float(cKDTree(one.cells).query(other.cells)[0].min())
    return least >= LEAST_SHARE * most and gap <= GAP_SHARE * min(one.width, other.width)


def _row(lobes: Sequence[Lobe], neighbours: Mapping[int, Sequence[int]], first: int, second: int) -> list[int]:
    """Continue a row from its first two lobes, each time to the neighbour that is most straight ahead."""
    row = [first, second]
    while True:
        step = lobes[row[-2]].step(lobes[row[-1]])
        ahead = []
        for k in neighbours[row[-1]]:
            onwards = lobes[row[-1]].step(lobes[k])
            lengths = sorted((float(np.linalg.norm(step)), float(np.linalg.norm(onwards))))
            cosine = float(step @ onwards) / max(lengths[0] * lengths[1], 1e-9)
            if k not in row and cosine >= TURN_COS and lengths[1] <= EVEN * lengths[0]:
                ahead.append((-cosine, k))
        if not ahead:
            return row
        row.append(min(ahead)[1])
