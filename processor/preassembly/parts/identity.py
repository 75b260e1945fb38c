"""Parts of one shape: whether a scan is of the part it is named after.

The ribs, or the feet, of one arch are often mirror images of each other and, their sections being symmetric, equal
after half a turn. A scan of one then fits the design of the other to the noise, and a chain of swapped parts closes.
Scans differ only where the designs do: at the marks that distinguish a part's ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry import rigid
from processor.geometry.mesh_distance import on_face
from processor.geometry.thinning import thinned
from processor.model import Floats, Reason, reason
from processor.preassembly.parts import attitude, same_shape
from processor.preassembly.parts.attitude import LEAST_EVIDENCE
from processor.registration.pose_search import SAMPLE_SPACING_MM, DesignSurface

AROUND = 30_000  # points that show the surface's departure near a mark: one in 50 mm on a long part
NEIGHBOURS = 64  # of them near a sample: a circle of some 0.2 m radius
LEAST_NEIGHBOURS = 8  # of them on the sample's own face: a median of fewer is a point's noise
REACH_MM = 60.0  # of points off the design that show its departure: parts are within
SAME_FACE_COS = 0.9  # 25 degrees: less than between the faces of a section, more than noise of normals


@dataclass(frozen=True)
class Identity:
    """Other parts of the same shape, by what the scan shows.

    ``rather``: the scan shows their mark. ``unseen``: their marks differ, but the scan shows none. ``same``: the
    designs do not differ.
    """

    rather: tuple[str, ...] = ()
    unseen: tuple[str, ...] = ()
    same: tuple[str, ...] = ()

    def parts(self, part: str) -> tuple[str, ...]:
        """Name the parts that the scan may be of, placed on a part of this name."""
        return self.rather or (part, *self.unseen, *self.same)

    @property
    def contradiction(self) -> tuple[Reason, ...]:
        """Why the scan is of another part; empty where it is not."""
        return (reason("preassemble.mark-of-other", parts=self.rather),) if self.rather else ()

    @property
    def open_questions(self) -> tuple[Reason, ...]:
        """Parts that the scan may be of as well."""
        unseen = (reason("preassemble.mark-not-seen", parts=self.unseen),) if self.unseen else ()
        return (*unseen, reason("preassemble.same-shape", parts=self.same)) if self.same else unseen


class _Outcome(Enum):
    """Which part's mark a scan shows; UNSEEN: neither's, SAME: the designs do not differ."""

    PART = 1
    OTHER = 2
    UNSEEN = 3
    SAME = 4


class _Surroundings(NamedTuple):
    """Points (k, 3) on the design, its normals (k, 3) there, and departures (k,) outward."""

    points: Floats
    normals: Floats
    departure: Floats


def identify(points: Floats, T: Floats, index: int, shapes: attitude.Shapes) -> Identity:
    """Compare points (n, 3), placed on part ``index`` by T_bridge_scan (4, 4), with the parts of the same shape."""
    rather, unseen, same = [], [], []
    surface = shapes[index]
    on_design: _Surroundings | None = None
    for k, other in enumerate(shapes.design.parts):
        motions = same_shape.motions(shapes, index, k) if k != index else []
        if not motions:
            continue
        # A part that is symmetric but for its mark lies on the other in two ways. Where the marks agree in one of them
        # the two parts are the same; a mark that agrees in the other way is the part's own, turned round.
        if on_design is None:
            placed = rigid.apply(T, thinned(points, AROUND))
            face, distance, beyond = surface.mesh.distances(placed, REACH_MM)
            used = on_face(face, beyond)
            on_design = _Surroundings(placed[used], surface.mesh.normals[face[used]], distance[used])
        outcomes = {_compare(points, T, surface, shapes[k], motion, on_design) for motion in motions}
        if _Outcome.SAME in outcomes:
            same.append(other.name)
        elif _Outcome.OTHER in outcomes:
            rather.append(other.name)
        elif _Outcome.UNSEEN in outcomes:
            unseen.append(other.name)
    return Identity(tuple(rather), tuple(unseen), tuple(same))


def _compare(
    points: Floats,
    T: Floats,
    surface: DesignSurface,
    other_surface: DesignSurface,
    T_part_other: Floats,
    on_design: _Surroundings,
) -> _Outcome:
    """Compare with another part laid on this one in one way; ``on_design`` are some of the points."""
    T_other = rigid.invert(T_part_other) @ T
    of_part = attitude.only_in(surface, T, other_surface.mesh, T_other)
    of_other = attitude.only_in(other_surface, T_other, surface.mesh, T)
    if len(of_part[0]) + len(of_other[0]) < LEAST_EVIDENCE:
        return _Outcome.SAME
    of_other = rigid.apply(T_part_other, of_other[0]), of_other[1] @ T_part_other[:3, :3].T
    marks = np.vstack([of_part[0], of_other[0]])  # both in the frame of the part's design
    around = _around(on_design, marks)
    part_count, other_count = (
        attitude.shown(points, T, _as_built(samples, normals, around)) for samples, normals in (of_part, of_other)
    )
    more, fewer = max(part_count, other_count), min(part_count, other_count)
    if more < LEAST_EVIDENCE or more < 2 * fewer:
        return _Outcome.UNSEEN
    return _Outcome.PART if part_count > other_count else _Outcome.OTHER


def _around(on_design: _Surroundings, marks: Floats) -> _Surroundings:
    """Points on the design that are away from samples (m, 3) of the marks."""
    away = 1.5 * SAMPLE_SPACING_MM
    near = cKDTree(marks).query(on_design.points, distance_upper_bound=np.nextafter(away, np.inf))[0] <= away
    return _Surroundings(*(of_points[~near] for of_points in on_design))


def _as_built(samples: Floats, normals: Floats, around: _Surroundings) -> Floats:
    """Move samples (k, 3) along their normals by the departure of the part's face from its design around them.

    A mark stands on its plate. Where the plate is bowed or dented by as much as marks are high, the mark moves with it.
    """
    if len(samples) == 0 or len(around.points) < NEIGHBOURS:
        return samples
    near = cKDTree(around.points).query(samples, k=NEIGHBOURS)[1]
    same_face = np.einsum("kni,ki->kn", around.normals[near], normals) > SAME_FACE_COS
    known = same_face.sum(axis=1) >= LEAST_NEIGHBOURS
    shift = np.zeros(len(samples))
    shift[known] = np.nanmedian(np.where(same_face, around.departure[near], np.nan)[known], axis=1)
    return samples + shift[:, None] * normals
