"""Which parts are joined where: the ends of each part, the closed loops of parts, and the pieces of an assembly.

A part ends at the joints whose left part it is, and starts at those whose right part it is. A part of a row or a ring
has one start and one end at most. Any other is a branch: its ends have no other names than those of their joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from processor.distinct_rows import components
from processor.model import Bools, Ints


class PartEnd(NamedTuple):
    """An end of a part: the joint's number, None without a joint; +1 where the part ends there, -1 where it starts."""

    joint: int | None
    outward: float


class Side(NamedTuple):
    """A side of a joint: the number of a part, and of its end."""

    part: int
    end: int


class Loop(NamedTuple):
    """A closed loop of parts: the joint that closes it, and the other joints from its right part on to its left one."""

    closing: int
    joints: tuple[int, ...]


Sides = Sequence[tuple[Side, Side]]  # of each joint, left and right


def ends_of(joined: Ints, part: int) -> tuple[PartEnd, ...]:
    """Return the ends of a part by the left and right parts (j, 2) of joints: start and end, or those of a branch."""
    starts = [PartEnd(int(j), -1.0) for j in np.flatnonzero(joined[:, 1] == part)]
    ends = [PartEnd(int(j), 1.0) for j in np.flatnonzero(joined[:, 0] == part)]
    if len(starts) > 1 or len(ends) > 1:
        return tuple(sorted((*starts, *ends)))
    return (*(starts or [PartEnd(None, -1.0)]), *(ends or [PartEnd(None, 1.0)]))


def is_branch(ends: Sequence[PartEnd]) -> bool:
    """Whether these ends of a part are others than one start and one end."""
    return [end.outward for end in ends] != [-1.0, 1.0]


def sides_of(joined: Ints) -> Sides:
    """Return both sides of each joint by its left and right part (j, 2)."""
    sides = []
    for j, (left, right) in enumerate(joined.tolist()):
        at_left, at_right = (
            ends_of(joined, part).index(PartEnd(j, outward)) for part, outward in ((left, 1.0), (right, -1.0))
        )
        sides.append((Side(left, at_left), Side(right, at_right)))
    return sides


def row(parts: int) -> Ints:
    """Left and right parts (parts - 1, 2) of the joints of parts in a row."""
    return np.stack([np.arange(parts - 1), np.arange(1, parts)], axis=1).astype(np.int64)


def pieces(joined: Ints, measured: Bools, parts: int) -> Ints:
    """Return the number of the piece (parts,) that each part is of: parts that ``measured`` joints (j,) connect.

    Pieces are numbered from 0 in the order of their first parts.
    """
    return components(parts, *joined[measured].T)


def loops(joined: Ints, parts: int) -> list[Loop]:
    """Return one loop for each joint that a spanning tree of the parts leaves out (j, 2)."""
    way: dict[int, tuple[int, ...]] = {}  # of each part reached: the joints from the root of its tree
    in_tree: set[int] = set()
    for root in range(parts):
        if root in way:
            continue
        way[root] = ()
        reached = [root]
        for part in reached:
            for j in np.flatnonzero((joined == part).any(axis=1)).tolist():
                other = int(joined[j].sum()) - part
                if other not in way:
                    way[other] = (*way[part], j)
                    in_tree.add(j)
                    reached.append(other)
    found = []
    for j, (left, right) in enumerate(joined.tolist()):
        if j not in in_tree:
            common = sum(a == b for a, b in zip(way[left], way[right], strict=False))
            found.append(Loop(j, (*reversed(way[right][common:]), *way[left][common:])))
    return found
