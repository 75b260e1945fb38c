"""Whether a scan is of the part it is assigned to, before the costly registration; and the assignment of all scans.

A scan whose size is that of its part goes on without delay. Otherwise rough poses on the part and on the others are
compared by surface that only one of two designs has there: the scan shows that of the right one. A part of an arch may
lie on a longer one to some millimetres, so that points near a design do not show that the scan is a piece of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from processor.geometry import box_girder_mesh, rigid
from processor.geometry.mesh_distance import MeshSurface
from processor.geometry.thinning import thinned
from processor.model import Floats, Reason, reason
from processor.preassembly.parts import attitude, same_shape
from processor.preassembly.parts.attitude import TELLING_MM, Shapes
from processor.registration import located_part, pose_choice, principal, surface_registration
from processor.registration.pose_search import DesignSurface

POINTS, NEAR_POINTS = 100_000, 3_000  # of a scan, by which rough poses are compared, and their share near a design
NEAR_MM = surface_registration.GATES_MM[1]


@dataclass(frozen=True)
class ScanParts:
    """The part that a scan is assigned to, and the parts that it may be of by its points; () = none of the design."""

    scan: str
    assigned: str
    parts: tuple[str, ...]

    @property
    def wrong(self) -> tuple[Reason, ...]:
        """Why the scan is not of the part that it is assigned to; empty where it may be."""
        if self.assigned in self.parts:
            return ()
        if not self.parts:
            return (reason("preassemble.scan-of-none", scan=self.scan),)
        if len(self.parts) == 1 and self.scan == self.assigned:
            return (reason("preassemble.named-scan-of-other", scan=self.scan, part=self.parts[0]),)
        if len(self.parts) == 1:
            return (reason("preassemble.scan-of-other", scan=self.scan, part=self.parts[0], assigned=self.assigned),)
        return (reason("preassemble.scan-of-others", scan=self.scan, parts=self.parts, assigned=self.assigned),)


def of_size(points: Floats, shapes: Shapes) -> list[int]:
    """Return the numbers of the parts that have the size of a scan's points (n, 3)."""
    size = principal.sizes(points)
    limit = principal.SIZE_SHARE * float(size.max())
    return [k for k in range(len(shapes)) if np.abs(shapes.sizes[k] - size).max() < limit]


def rather(points: Floats, index: int, shapes: Shapes) -> int | None:
    """Return the number of a part that points (n, 3) show rather than part ``index``; -1 for no part, None for none.

    Of parts with equal edges, which their marks alone distinguish, it is any: see :mod:`.identity`.
    """
    alike = of_size(points, shapes)
    others = other_shapes(index, alike or range(len(shapes)), shapes)
    if index in alike and not others:
        return None
    few = thinned(points, POINTS)
    pieces = not alike

    def rough(k: int, kept: int | None = attitude.ROUGH_KEPT) -> Floats:
        return attitude.rough(few, shapes[k], pieces=pieces, kept=kept)

    best, T_best = index, rough(index)
    share = _near_share(few, T_best, shapes[index])
    for other in others:
        T = rough(other)
        share = max(share, _near_share(few, T, shapes[other]))
        if _shows_other(few, (shapes[best].mesh, T_best), (shapes[other].mesh, T)):
            best, T_best = other, T
    # Surfaces made from design curves are not whole: points of the right part lie off them, too.
    whole = all(part.source != box_girder_mesh.SOURCE for part in shapes.design.parts)
    if whole and share <= surface_registration.LEAST_SHARE:
        return -1
    if best == index:
        return None
    # The first rough pose may have missed the part itself: a scan is called wrong only after all that are promising,
    # and not by what millimetres of a rough pose, or a plate that lies on its other side, show.
    fewer = thinned(few, located_part.RIVAL_POINTS)
    own, rival = (
        (shapes[k].mesh, located_part.attitude(fewer, shapes[k], T))
        for k, T in ((index, rough(index, None)), (best, T_best))
    )
    return best if _shows_other(few, own, rival) else None


def other_shapes(index: int, numbers: Iterable[int], shapes: Shapes) -> list[int]:
    """Return one part, of those in ``numbers``, of each shape that is not that of part ``index``."""
    different = [index]
    for number in numbers:
        if not any(number == one or same_shape.motions(shapes, one, number) for one in different):
            different.append(number)
    return different[1:]


def locate(points: Floats, index: int, shapes: Shapes) -> tuple[Floats, int, float] | None:
    """Locate part ``index`` among points (n, 3) of a scan with surroundings; None where no part is shown.

    Returns the pose T_bridge_scan (4, 4) of the part that the body there shows, which may be another than ``index``,
    with its number, and the points on another body of the same shape, as a share of those on this one.
    """
    numbers = [index, *other_shapes(index, range(len(shapes)), shapes)]
    designs = [shapes[k] for k in numbers]
    (own,) = located_part.locate(points, designs[:1])
    if located_part.most_shown([own]) < located_part.LEAST_SHOWN:
        bodies = located_part.which(points, designs, [[], *located_part.locate(points, designs[1:])])
        return (bodies[0].places[0].T, numbers[bodies[0].numbers[0]], 0.0) if bodies else None
    found, other = list[located_part.Located](), None
    for place in own:
        region = points[located_part.about_design(points, place.T, designs[0])]
        body = thinned(region[located_part.at_design(region, place.T, designs[0])], POINTS)
        # Points are counted in samples of one density: the region's are denser than those of the scan.
        count = int(located_part.at_design(thinned(region, located_part.SHOWN_POINTS), place.T, designs[0]).sum())
        there = [[replace(place, count=count)], *located_part.locate(region, designs[1:], body)]
        bodies = located_part.which(region, designs, there, 0)
        if bodies and 0 in bodies[0].numbers:
            found.append(place)
        elif bodies and other is None:
            other = bodies[0].places[0].T, numbers[bodies[0].numbers[0]], 0.0
    return (found[0].T, index, found[1].count / found[0].count if found[1:] else 0.0) if found else other


def _near_share(points: Floats, T: Floats, surface: DesignSurface) -> float:
    """Share of points (n, 3), placed by T (4, 4), near a part's surface."""
    placed = rigid.apply(T, thinned(points, NEAR_POINTS))
    _, distance, beyond = surface.mesh.distances(placed, 2.0 * NEAR_MM)
    return float(((np.abs(distance) < NEAR_MM) & (beyond < TELLING_MM)).mean())


def _shows_other(points: Floats, part: tuple[MeshSurface, Floats], other: tuple[MeshSurface, Floats]) -> bool:
    """Whether points (n, 3) show surface that the other part alone has, each part with its T_bridge_scan (4, 4)."""
    return pose_choice.choose(points, [part, other]) == [1]


def solve(scans: Sequence[ScanParts]) -> list[ScanParts]:
    """Assign all scans to the parts that scans are assigned to, each as often as now, with the fewest contradictions.

    Of the parts that a scan may be of, those remain that are in one of these assignments (Kuhn 1955). A scan that is
    of one part by its points keeps it, also where other parts are then left without a scan; one of which nothing is
    known may be of all parts, and stays so.
    """
    slots = [scan.assigned for scan in scans]
    cost = np.array([[part not in scan.parts for part in slots] for scan in scans], float).reshape(len(scans), -1)
    solved = []
    for i, scan in enumerate(scans):
        if set(slots) <= set(scan.parts):
            solved.append(scan)
            continue
        fewest = {part: _contradictions(cost, i, [slot == part for slot in slots]) for part in scan.parts}
        left = tuple(part for part in scan.parts if fewest[part] == min(fewest.values()))
        solved.append(replace(scan, parts=left))
    return solved


def _contradictions(cost: Floats, row: int, columns: list[bool]) -> float:
    """Fewest contradictions of all assignments with a scan in some of the columns."""
    forced = cost.copy()
    forced[row, ~np.array(columns)] = len(cost) + 1.0
    rows, assigned = linear_sum_assignment(forced)
    return float(forced[rows, assigned].sum())
