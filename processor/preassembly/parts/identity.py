"""Parts of one shape: whether a scan is of the part whose name it bears, told by what marks show.

The ribs, or the feet, of one arch are often each other's mirror images and, their sections being symmetric, the same
after half a turn: scans of either fit the other's design to the noise, and a chain of swapped parts closes. Only where
the designs differ, at the marks that tell a part's ends apart, do the scans.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry import box_girder, rigid
from processor.geometry.mesh_distance import on_face
from processor.geometry.neighbors import thinned
from processor.model import ArchDesign, DesignPart, Floats
from processor.preassembly.parts import attitude
from processor.preassembly.parts.attitude import LEAST_EVIDENCE, SAMPLE_SPACING_MM

AROUND = 30_000  # points by which the surface's own departure about a mark is known: one in 50 mm on a long part
NEIGHBOURS = 64  # of them about a place: a circle of some 0.2 m radius
LEAST_NEIGHBOURS = 8
REACH_MM = 60.0
SAME_FACE_COS = 0.9


@dataclass(frozen=True)
class Told:
    """Names of parts of the same shape: of which the scan is rather, with which it may be confused still.

    ``unseen``: their marks differ, but nothing of them was seen. ``same``: the designs differ in nothing at all.
    """

    rather: tuple[str, ...] = ()
    unseen: tuple[str, ...] = ()
    same: tuple[str, ...] = ()

    @property
    def wrong(self) -> str:
        """Why the scan is of another part, or nothing."""
        return f"by its mark it is rather {' or '.join(self.rather)}" if self.rather else ""

    @property
    def open(self) -> list[str]:
        """What the scan leaves open."""
        found = []
        if self.unseen:
            found.append(f"of the same shape as {' and '.join(self.unseen)}: no mark was seen that tells them apart")
        if self.same:
            found.append(f"of the same shape as {' and '.join(self.same)}: the scan may be of either")
        return found


def tell(points: Floats, T: Floats, surface: attitude.Surface, part: DesignPart, design: ArchDesign) -> Told:
    """Hold points (n, 3), placed on the part's surface by T_bridge_scan (4, 4), against the parts of the same shape."""
    rather, unseen, same = [], [], []
    for other in design.parts:
        ways = box_girder.motions(part, other) if other.name != part.name else []
        if not ways:
            continue
        theirs = attitude.sample_surface(other)
        # A part that is symmetric but for its mark lies on the other in two ways; where the marks agree in one of them
        # the two are the same, and a mark that agrees in the other is the part's own, laid the other way round.
        found = {_of_one(points, T, surface, theirs, way) for way in ways}
        if "same" in found:
            same.append(other.name)
        elif "other" in found:
            rather.append(other.name)
        elif "unseen" in found:
            unseen.append(other.name)
    return Told(tuple(rather), tuple(unseen), tuple(same))


def _of_one(points: Floats, T: Floats, surface: attitude.Surface, theirs: attitude.Surface, way: Floats) -> str:
    """Tell by one T_part_other: own | other | unseen | same."""
    T_other = rigid.invert(way) @ T
    own = attitude.only_in(surface, T, theirs, T_other)
    other = attitude.only_in(theirs, T_other, surface, T)
    if len(own[0]) + len(other[0]) < LEAST_EVIDENCE:
        return "same"
    other = rigid.apply(way, other[0]), other[1] @ way[:3, :3].T  # both in the frame of the part's design now
    telling = np.vstack([own[0], other[0]])
    around = _around(rigid.apply(T, thinned(points, AROUND)), surface, telling)
    ours, others = (attitude.shown(points, T, _where_the_part_is(*samples, *around)) for samples in (own, other))
    more, fewer = max(ours, others), min(ours, others)
    if more < LEAST_EVIDENCE or more < 2 * fewer:
        return "unseen"
    return "own" if ours > others else "other"


def _around(moved: Floats, surface: attitude.Surface, telling: Floats) -> tuple[Floats, Floats, Floats]:
    """Points (k, 3) on the design off its telling places, normals (k, 3) there, departures (k,) outward."""
    face, distance, beyond = surface.mesh.distances(moved, REACH_MM)
    used = on_face(face, beyond) & (cKDTree(telling).query(moved)[0] > 1.5 * SAMPLE_SPACING_MM)
    return moved[used], surface.mesh.normals[face[used]], distance[used]


def _where_the_part_is(
    samples: Floats, normals: Floats, around: Floats, around_normals: Floats, departure: Floats
) -> Floats:
    """Move samples (k, 3) along their normals by what the part's face departs from its design about them.

    A mark stands on its plate: where a plate is bowed or dented by as much as marks are high, so is the mark.
    """
    if len(samples) == 0 or len(around) < NEIGHBOURS:
        return samples
    near = cKDTree(around).query(samples, k=NEIGHBOURS)[1]
    same = np.einsum("kni,ki->kn", around_normals[near], normals) > SAME_FACE_COS
    known = same.sum(axis=1) >= LEAST_NEIGHBOURS
    shift = np.zeros(len(samples))
    shift[known] = np.nanmedian(np.where(same, departure[near], np.nan)[known], axis=1)
    return samples + shift[:, None] * normals
