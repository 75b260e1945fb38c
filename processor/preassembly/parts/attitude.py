"""The attitude of a part: the pose of its scan by its whole surface, and the other pose where its symmetry leaves one.

The poses of a symmetric part are distinguished by surface that only one of them has (a pad, a taper).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from threading import Lock

import numpy as np

from processor.geometry import mesh_distance, rigid
from processor.geometry.mesh_distance import MeshSurface
from processor.geometry.nearest_neighbours import within_reach
from processor.geometry.thread_ranges import each
from processor.model import ArchDesign, DesignPart, Floats, Reason, Status, reason
from processor.preassembly import topology
from processor.preassembly.ends import tube_end
from processor.preassembly.ends.joint_frame import end_place
from processor.preassembly.parts import turn_about_axis
from processor.registration import pose_choice, pose_search, principal, surface_registration
from processor.registration.pose_search import DesignSurface
from processor.registration.principal import PrincipalAxes

ROUGH_KEPT, ROUGH_POINTS = 4, 30_000  # work: promising hypotheses for a rough pose, and points to decide among them
NO_FIT_MM = 25.0  # misfit, about a plate's thickness, beyond which no pose explains the scan
TELLING_MM = 10.0  # distance between two poses' surfaces beyond which the scan can distinguish the poses
LEAST_EVIDENCE = 10  # samples of distinguishing surface that the scan shows
TURN_POINTS = 50_000  # of a tube, which many turns are compared by


@dataclass(frozen=True)
class Attitude:
    """The pose of a part by its principal axes and by its surface (``T_bridge_scan``, 4x4 each), with its status."""

    T_principal: Floats
    T_surface: Floats
    status: Status  # ok | ambiguous | failed
    reasons: tuple[Reason, ...] = ()
    T_rival: Floats = field(default_factory=lambda: np.full((4, 4), np.nan))  # of an ambiguous part: the other pose
    turn_known: bool = True  # about the axis of a round tube


NOWHERE = Attitude(np.full((4, 4), np.nan), np.full((4, 4), np.nan), Status.FAILED)  # no pose


class Shapes:
    """The sampled surfaces of a design's parts by their numbers, each made when it is first asked for.

    ``attitudes`` are those found of whole scans as they are, by the numbers of their parts, for other methods.
    """

    def __init__(self, design: ArchDesign, attitudes: dict[int, Attitude] | None = None) -> None:
        self.design = design
        self.attitudes = {} if attitudes is None else attitudes
        self._made: dict[int, DesignSurface] = {}
        self._locks = [Lock() for _ in design.parts]  # parts may be fitted on several threads
        self._sizes: list[Floats] = []
        self._axes: dict[int, PrincipalAxes] = {}

    def __getitem__(self, index: int) -> DesignSurface:
        with self._locks[index]:
            if index not in self._made:
                made = sample_surface(self.design.parts[index])
                self._made[index] = replace(made, tube=self._tube(index, made.mesh))
            return self._made[index]

    def __len__(self) -> int:
        return len(self.design.parts)

    @property
    def sizes(self) -> list[Floats]:
        """Sizes (3,) of all parts along their principal axes."""
        if not self._sizes:
            self._sizes = [
                principal.sizes(pose_search.samples_of(part.vertices, part.faces).points) for part in self.design.parts
            ]
        return self._sizes

    def axes(self, index: int) -> PrincipalAxes:
        """Return the principal axes of a part's surface."""
        if index not in self._axes:
            part = self.design.parts[index]
            self._axes[index] = principal.of_mesh(part.vertices, part.faces)
        return self._axes[index]

    def _tube(self, index: int, mesh: MeshSurface) -> PrincipalAxes | None:
        """Return the axes of the wall of a part whose ends are all round; None of any other."""
        places = [
            end_place(self.design.joint_points[end.joint], end.outward, mesh)
            for end in topology.ends_of(self.design.joined, index)
            if end.joint is not None
        ]
        if not places or not all(place.section.radius for place in places):
            return None
        wall = tube_end.wall_of(mesh, places[0])
        return principal.of_mesh(mesh.vertices, mesh.faces[wall]) if wall.any() else None


def sample_surface(part: DesignPart) -> DesignSurface:
    """Prepare the part's surface for the search."""
    return pose_search.prepared(mesh_distance.of_mesh(part.vertices, part.faces))


def find(points: Floats, part: DesignPart, surface: DesignSurface | None = None) -> Attitude:
    """Find the attitude of a part from points (n, 3) and its design; ``surface`` is its sampled surface, if at hand.

    Where no surface distinguishes two poses, or the scan does not show it, the status is ``ambiguous``.
    """
    surface = sample_surface(part) if surface is None else surface
    candidates = pose_search.search(points, surface)
    best = candidates[0]
    if best.misfit > NO_FIT_MM:
        why = reason("preassemble.no-attitude", distance=best.misfit)
        return Attitude(best.start, best.T, Status.FAILED, (why,))
    rivals, tube = pose_search.rivals_of(candidates), surface.tube
    if tube is not None:
        rivals = turn_about_axis.to_decide(points, surface, tube, rivals, TELLING_MM)
    best, *rivals = surface_registration.decide(points, surface, rivals)
    found = Attitude(best.start, best.T, Status.OK)
    if rivals:
        why = _rival_reason(best.T, rivals[0].T, surface)
        found = Attitude(best.start, best.T, Status.AMBIGUOUS, (why,), rivals[0].T)
    return found if tube is None else _with_turn(points, surface, tube, found)


def _with_turn(points: Floats, surface: DesignSurface, tube: PrincipalAxes, found: Attitude) -> Attitude:
    """Return the attitude of a round tube, ambiguous where the scan does not show its turn about its axis."""
    poses = [found.T_surface, *(turn @ found.T_surface for turn in turn_about_axis.tested(tube))]
    best, *rivals = pose_choice.choose(points, [(surface.mesh, T) for T in poses], sample=TURN_POINTS)
    if best == 0 and not rivals:
        return found
    rival = found.T_rival if np.isfinite(found.T_rival).all() else poses[rivals[0] if best == 0 else best]
    why = (reason("preassemble.turn-unknown"), *found.reasons)
    return replace(found, status=Status.AMBIGUOUS, reasons=why, T_rival=rival, turn_known=False)


def rough(points: Floats, surface: DesignSurface, *, pieces: bool, kept: int | None = ROUGH_KEPT) -> Floats:
    """T_bridge_scan (4, 4) of the hypothesis that a few hundred of points (n, 3) fit best; of a symmetric part any.

    With ``pieces`` the scan may also be of a piece of the part. ``kept`` promising hypotheses are tried, None: all.
    """
    box, even = pose_search.box_of(points), pose_search.evenly(points, surface)
    starts = pose_search.promising_starts(points, even, surface, pieces=pieces)[:kept]
    found = pose_search.distinct(each(lambda start: pose_search.align(even[1], surface, start), starts), box)
    # A pose turned half round may have the least misfit of few points: the surface that only one pose has decides.
    found = pose_search.rivals_of(found) + pose_search.slid(even[1], surface, found[0], box)
    return found[pose_choice.choose(points, [(surface.mesh, c.T) for c in found], sample=ROUGH_POINTS)[0]].T


def _rival_reason(best: Floats, rival: Floats, surface: DesignSurface) -> Reason:
    """Describe a rival pose relative to the best, T_bridge_scan (4, 4) each, and what would distinguish them."""
    between = rival @ rigid.invert(best)
    middle = surface.points.mean(axis=0)
    turn = rigid.rotation_angle(between[:3, :3])
    if turn >= turn_about_axis.SLIDE_RAD:
        return reason("preassemble.rival-rotation", degrees=float(np.degrees(turn)))
    shift = abs(float((rigid.apply(between, middle) - middle) @ surface.axes[:, 0]))
    return reason("preassemble.rival-shift", shift=shift)


def only_in(surface: DesignSurface, T: Floats, other: MeshSurface, T_other: Floats) -> tuple[Floats, Floats]:
    """Return samples and normals (k, 3) of a design that, placed in the scan, are far from the other design there.

    ``T`` and ``T_other`` are T_bridge_scan (4, 4) of the two designs, which may be the same.
    """
    lacking = pose_choice.off_surface(rigid.apply(T_other @ rigid.invert(T), surface.points), other, TELLING_MM)
    return surface.points[lacking], surface.normals[lacking]


def shown(points: Floats, T: Floats, samples: Floats) -> int:
    """Count the samples that have a point within TELLING_MM, the points placed by T (4, 4)."""
    if len(samples) == 0:
        return 0
    placed = rigid.apply(rigid.invert(T), samples)  # few, where the points are many
    return int(within_reach(points, placed, TELLING_MM)[1].sum())
