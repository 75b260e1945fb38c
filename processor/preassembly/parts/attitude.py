"""The coarse pose of a part: its principal axes aligned with the design's, and the right one of the possible ways.

Principal axes leave four proper rotations, eight where the section is nearly square. The source paper (000, section
2.2) resolves them by levelling the parts by hand; here every one is aligned with the design's surface.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import product
from threading import Lock

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry import mesh_distance, rigid
from processor.geometry.mesh_distance import MeshSurface, Samples
from processor.geometry.nearest_neighbours import within_reach
from processor.geometry.thinning import thinned, voxel_means
from processor.geometry.thread_ranges import each
from processor.large_arrays import corners
from processor.model import ArchDesign, Bools, DesignPart, Floats, Ints, Reason, Status, reason
from processor.preassembly import topology
from processor.preassembly.ends import tube_end
from processor.preassembly.ends.joint_frame import end_place
from processor.preassembly.parts import turn_about_axis
from processor.registration import icp, principal, surface_registration
from processor.registration.principal import PrincipalAxes

SAMPLE_SPACING_MM = 30.0  # of the design's surface: ten samples on a mark of 0.1 m
COARSE_SPACING_MM = 120.0  # for the coarse gates
FEWEST_SAMPLES, MOST_SAMPLES = 2_000, 400_000
COARSE_GATES_MM = (400.0, 150.0)  # for every hypothesis
FINE_GATES_MM = (50.0, 25.0, 12.0)  # for the promising ones
COARSE_POINTS, FINE_POINTS = 600, 20_000
WIDE_POINTS = 4_000  # at all gates but the last
# Least misfit by noise and form of parts: where no hypothesis of a whole part is better, the scan may be of a piece.
PIECE_MM = 5.0
PIECE_POINTS, PIECE_ITERATIONS, PIECES_KEPT = 200, 6, 24
SAME_SIZE = 0.05  # relative difference of sizes along an axis that a piece of full size may have
# A hypothesis whose misfit after the coarse gates exceeds PROMISING times the best plus PROMISING_MM is dropped; the
# right one may have converged some millimetres off.
PROMISING, PROMISING_MM = 4.0, 10.0
ROUGH_KEPT = 4  # of the promising hypotheses, for a rough pose
EXTENT_POINTS = 100_000  # by which the ends of a scan along its longest axis are known
EXTENTS = (0.002, 0.998)  # quantiles of points, without single outliers
SHORT_SHARE = 0.1  # of its length, by which a scan of a whole part may be shorter
NO_FIT_MM = 25.0  # misfit, about a plate's thickness, beyond which no pose explains the scan
SAME_POSE_MM = 5.0  # poses are equal where no corner of the part differs by more
TELLING_MM = 10.0  # distance between two poses' surfaces beyond which the scan can distinguish the poses
SAME_CORNER_MM = 0.5 * TELLING_MM  # between corners of facets that two poses have in common
CORNER_SAMPLES = 12  # nearest of the rival's design: some of them on each face that meets at a corner
# An end plate's two sides are alike to few points: poses that differ by a plate's thickness, up to some 60 mm, along
# the part are each stable, and are tried from starts nearer to each other than half of the plates that are usual.
SLIDES_MM = (-60.0, -45.0, -30.0, -15.0, 15.0, 30.0, 45.0, 60.0)
SLID_KEPT = 2  # of the poses of a tube that differ by a slide along it
MARKS = 2_000  # samples of marks that the turn of a tube is searched by
LEAST_EVIDENCE = 10  # samples of distinguishing surface that the scan shows
SLIDE_RAD = np.radians(45.0)  # a rival turned by less has slid along the part: along an arch it turns a little
RIVAL_RATIO = 1.5  # a pose whose misfit is within this factor of the best is a rival


@dataclass(frozen=True)
class Attitude:
    """The pose of a part by its principal axes and by its surface (``T_bridge_scan``, 4x4 each), with its status."""

    T_principal: Floats
    T_surface: Floats
    status: Status  # ok | ambiguous | failed
    reasons: tuple[Reason, ...] = ()
    T_rival: Floats = field(default_factory=lambda: np.full((4, 4), np.nan))  # of an ambiguous part: the other pose
    turn_known: bool = True  # about the axis of a round tube


NOWHERE = Attitude(np.full((4, 4), np.nan), np.full((4, 4), np.nan), Status.FAILED)


@dataclass(frozen=True)
class Surface:
    """Samples (n, 3) of a design part's surface in the bridge's frame with unit normals (n, 3) and facets (n,)."""

    points: Floats
    normals: Floats
    facet: Ints  # of ``mesh``
    boxes: icp.SampleBoxes  # about the same samples, in another order
    coarse: icp.SampleBoxes  # about fewer samples, for the coarse gates
    mesh: MeshSurface
    centre: Floats  # (3,) of its area
    axes: Floats  # (3, 3) principal axes as columns
    size: float  # diagonal of the bounding box
    tube: PrincipalAxes | None = None  # of the wall of a round tube


class Shapes:
    """The sampled surfaces of a design's parts by their numbers, each made when it is first asked for.

    ``attitudes`` are those found of whole scans as they are, by the numbers of their parts, for other methods.
    """

    def __init__(self, design: ArchDesign, attitudes: dict[int, Attitude] | None = None) -> None:
        self.design = design
        self.attitudes = {} if attitudes is None else attitudes
        self._made: dict[int, Surface] = {}
        self._locks = [Lock() for _ in design.parts]  # parts may be fitted on several threads
        self._sizes: list[Floats] = []
        self._axes: dict[int, PrincipalAxes] = {}

    def __getitem__(self, index: int) -> Surface:
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
            self._sizes = [principal.sizes(samples_of(part).points) for part in self.design.parts]
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


@dataclass(frozen=True)
class _Candidate:
    """A pose ``T``, T_bridge_scan (4, 4), where its hypothesis began (4, 4), and its misfit in mm."""

    T: Floats
    start: Floats
    misfit: float = np.inf


def samples_of(part: DesignPart, spacing_mm: float = SAMPLE_SPACING_MM) -> Samples:
    """Sample the part's surface on a fixed low-discrepancy pattern."""
    return mesh_distance.spread(
        part.vertices,
        part.faces,
        lambda area_mm2: int(np.clip(area_mm2 / spacing_mm**2, FEWEST_SAMPLES, MOST_SAMPLES)),
    )


def sample_surface(part: DesignPart) -> Surface:
    """Prepare the part's surface: samples, boxes about them, and the mesh itself."""
    samples = samples_of(part)
    size = float(np.linalg.norm(np.ptp(part.vertices, axis=0)))
    mesh = mesh_distance.of_mesh(part.vertices, part.faces)
    axes = principal.of_mesh(part.vertices, part.faces)
    few = samples_of(part, COARSE_SPACING_MM)
    return Surface(
        points=samples.points,
        normals=samples.normals,
        facet=(np.cumsum(mesh_distance.has_area(part.vertices, part.faces)) - 1)[samples.facet],
        boxes=icp.boxes_of(samples.points, samples.normals),
        coarse=icp.boxes_of(few.points, few.normals),
        mesh=mesh,
        centre=axes.centre,
        axes=axes.axes,
        size=size,
    )


def principal_hypotheses(points: Floats, part: DesignPart) -> list[Floats]:
    """T_bridge_scan that align the scan's principal axes with the design's: eight proper rotations about the long axis.

    A scan that is shorter than the part is also placed at either end of it.
    """
    scan = principal.of_points(points)
    design = principal.of_mesh(part.vertices, part.faces)
    rotations = _rotations(scan.axes, design.axes)
    low, high = np.quantile((thinned(points, EXTENT_POINTS) - scan.centre) @ scan.axes[:, 0], [0.01, 0.99])
    whole = (part.vertices - design.centre) @ design.axes[:, 0]
    short = np.ptp(whole) - (high - low)
    shifts = [0.0] if short < SHORT_SHARE * np.ptp(whole) else [0.0, -1.0, 1.0]
    hypotheses = []
    for R in rotations:
        for shift in shifts:
            ahead = R @ scan.axes[:, 0] @ design.axes[:, 0]  # 1 or -1: direction of the scan along the design
            start, end = (low, high) if ahead > 0.0 else (-high, -low)
            move = 0.0 if shift == 0.0 else whole.min() - start if shift < 0.0 else whole.max() - end
            hypotheses.append(rigid.transform(R, design.centre + move * design.axes[:, 0] - R @ scan.centre))
    return hypotheses


def at_extents(points: Floats, part: DesignPart, T: Floats, axes: Floats | None = None) -> Floats:
    """Move a T_bridge_scan (4, 4) so that the middle of the scan's extents lies at that of the part's.

    Where a scan is denser at one end its centre is not the part's, and a part of even curvature slides along itself
    from there. A scan that is shorter than the part stays. ``axes`` (3, 3) are the part's principal axes, if at hand.
    """
    axes = principal.of_mesh(part.vertices, part.faces).axes if axes is None else axes
    whole, placed = part.vertices @ axes, rigid.apply(T, points) @ axes
    low, high = np.quantile(placed, EXTENTS, axis=0)
    if high[0] - low[0] < (1.0 - SHORT_SHARE) * np.ptp(whole[:, 0]):
        return T
    move = 0.5 * (whole.min(axis=0) + whole.max(axis=0) - low - high)
    return rigid.transform(np.eye(3), axes @ move) @ T


def _rotations(scan_axes: Floats, design_axes: Floats) -> list[Floats]:
    """Return the eight proper rotations (3, 3) that align the long axes, and the cross axes in either order."""
    turns = principal.turns(((0, 1, 2), (0, 2, 1)))
    return [design_axes @ turn @ scan_axes.T for turn in turns]


def piece_hypotheses(seeds: Floats, part: DesignPart) -> list[Floats]:
    """T_bridge_scan that place a piece of the part, evenly sampled by seeds (n, 3), at either side and in the middle.

    The middle of a half seen from above is not the part's. Along every axis along which the piece is smaller than the
    part, it is placed at the low side, in the middle and at the high side.
    """
    design_axes = principal.of_mesh(part.vertices, part.faces).axes
    whole = part.vertices @ design_axes
    low, high = whole.min(axis=0), whole.max(axis=0)
    hypotheses = []
    for R in _rotations(principal.of_points(seeds).axes, design_axes):
        turned = seeds @ R.T @ design_axes
        piece_low, piece_high = np.quantile(turned, EXTENTS, axis=0)
        moves = np.stack([low - piece_low, 0.5 * (low + high - piece_low - piece_high), high - piece_high], axis=1)
        same_size = np.abs((high - low) - (piece_high - piece_low)) < SAME_SIZE * (high - low)
        tried = [move[1:2] if same else move for move, same in zip(moves, same_size, strict=True)]
        hypotheses += [rigid.transform(R, design_axes @ np.array(move)) for move in product(*tried)]
    return hypotheses


def find(points: Floats, part: DesignPart, surface: Surface | None = None) -> Attitude:
    """Find the attitude of a part from points (n, 3) and its design; ``surface`` is its sampled surface, if at hand.

    The poses of a symmetric part are distinguished by surface that only one of them has (a pad, a taper). Where there
    is none, or the scan does not show it, the status is ``ambiguous``.
    """
    surface = sample_surface(part) if surface is None else surface
    box, even = _corners(points), _even(points, surface)
    coarse = _coarse(points, even, surface, part, pieces=True)
    # Single points: voxel means blur the end faces, which alone constrain the part along its length.
    seeds = thinned(points, FINE_POINTS)
    align = partial(_align, seeds, surface, FINE_GATES_MM)
    candidates = _distinct(each(align, coarse), box)
    # Few points constrain a part of even curvature along its length, so it may have converged metres off. Clutter
    # turns the principal axes, from which the right attitude may not be reached. So every attitude is also tried from
    # the best pose: turned by the rotations between the starts, and by those of the part onto itself.
    best = candidates[0]
    turns = [c.start @ rigid.invert(best.start) for c in coarse]
    turns += [_about(surface.centre, R) for R in _rotations(surface.axes, surface.axes)]
    turned = [_Candidate(S @ best.T, S @ best.start) for S in turns]
    screened = each(partial(_align, even[1], surface, COARSE_GATES_MM[1:]), turned)
    turned = _promising([replace(c, misfit=s.misfit) for c, s in zip(turned, screened, strict=True)], box)
    candidates = _distinct(candidates + each(align, turned), box)
    slid = _slid(thinned(seeds, WIDE_POINTS), surface, candidates[0], box)
    candidates = _distinct(candidates + each(align, slid), box)
    best = candidates[0]
    if best.misfit > NO_FIT_MM:
        why = reason("preassemble.no-attitude", distance=best.misfit)
        return Attitude(best.start, best.T, Status.FAILED, (why,))
    rivals = [c for c in candidates if c.misfit <= RIVAL_RATIO * best.misfit + 0.5]
    if surface.tube is None:
        return _decide(points, box, seeds, surface, rivals)
    return _of_tube(points, box, seeds, surface, rivals)


def _of_tube(points: Floats, box: Floats, seeds: Floats, surface: Surface, candidates: list[_Candidate]) -> Attitude:
    """Choose the pose of a round tube, and state whether the scan shows its turn about its axis."""
    assert surface.tube is not None
    centre, axes = surface.tube.centre, surface.tube.axes
    turns, identity = turn_about_axis.tested(centre, axes[:, 0]), np.eye(4)
    marks = turn_about_axis.marks(surface.points, [_lacks(surface, identity, surface, turn) for turn in turns])
    poses = [c.T for c in candidates]
    slid = [candidates[k] for k in turn_about_axis.shifted(poses, centre, axes[:, 0], SLIDE_RAD, SAME_POSE_MM)]
    chosen = [candidates[k] for k in turn_about_axis.in_either_sense(poses, axes[:, 0])]
    if len(marks) >= LEAST_EVIDENCE:
        marks = thinned(marks, MARKS)
        tree = cKDTree(seeds, balanced_tree=False)
        spacing = float(np.median(tree.query(thinned(seeds, COARSE_POINTS), k=2)[0][:, 1]))
        reach = max(2.0 * TELLING_MM, 4.0 * spacing)

        def count(T: Floats) -> int:
            near = tree.query(rigid.apply(rigid.invert(T), marks), distance_upper_bound=reach)[0]
            return int(np.isfinite(near).sum())

        turned = turn_about_axis.searched(centre, axes[:, 0], axes[:, 1], chosen[0].T, count)
        align = partial(_align, seeds, surface, FINE_GATES_MM)
        chosen = _distinct(chosen + each(align, [_Candidate(T, chosen[0].start) for T in turned]), box)
    found = _decide(points, box, seeds, surface, _distinct([*chosen, *slid[:SLID_KEPT]], box))
    for turn in turns:
        for_found, for_turned = _evidence(points, surface, found.T_surface, turn @ found.T_surface)
        if for_found < max(LEAST_EVIDENCE, 2 * for_turned):
            rival = found.T_rival if np.isfinite(found.T_rival).all() else turn @ found.T_surface
            why = (reason("preassemble.turn-unknown"), *found.reasons)
            return replace(found, status=Status.AMBIGUOUS, reasons=why, T_rival=rival, turn_known=False)
    return found


def rough(points: Floats, part: DesignPart, surface: Surface, *, pieces: bool, kept: int | None = ROUGH_KEPT) -> Floats:
    """T_bridge_scan (4, 4) of the hypothesis that a few hundred of points (n, 3) fit best; of a symmetric part any.

    With ``pieces`` the scan may also be of a piece of the part. ``kept`` promising hypotheses are tried, None: all.
    """
    even = _even(points, surface)
    coarse = _coarse(points, even, surface, part, pieces=pieces)[:kept]
    box = _corners(points)
    best, *others = _distinct(each(partial(_align, even[1], surface, FINE_GATES_MM), coarse), box)
    # A pose turned half round may have the least misfit of few points: the surface that only one pose has decides.
    rivals = [c for c in others if c.misfit <= RIVAL_RATIO * best.misfit + 0.5]
    for other in (*_slid(even[1], surface, best, box), *rivals):
        of_best, of_other = _evidence(points, surface, best.T, other.T)
        best = other if of_other >= max(LEAST_EVIDENCE, 2 * of_best) else best
    return best.T


def _slid(points: Floats, surface: Surface, best: _Candidate, box: Floats) -> list[_Candidate]:
    """Return other stable poses of points (n, 3) that differ from the best by a slide along the part."""
    slides = [rigid.transform(np.eye(3), slide * surface.axes[:, 0]) for slide in SLIDES_MM]
    starts = [_Candidate(slide @ best.T, best.start) for slide in slides]
    found = each(partial(_align, points, surface, FINE_GATES_MM), starts)
    return [c for c in _distinct([replace(best, misfit=-np.inf), *found], box) if c.misfit >= 0.0]


def _even(points: Floats, surface: Surface) -> tuple[Floats, Floats]:
    """Return points of even density, and a few hundred of them."""
    seeds = voxel_means(points, surface.size / 150.0, least=2)
    if len(seeds) < 50:
        seeds = points
    return seeds, thinned(seeds, COARSE_POINTS)


def _coarse(
    points: Floats, even: tuple[Floats, Floats], surface: Surface, part: DesignPart, *, pieces: bool
) -> list[_Candidate]:
    """Align all hypotheses by a few hundred points, and return the promising ones, the best first."""
    seeds, few = even
    by_axes = principal_hypotheses(points, part)
    starts = [_Candidate(T, T) for T in by_axes]
    starts += [_Candidate(at_extents(seeds, part, T, surface.axes), T) for T in by_axes]
    coarse = each(partial(_align, few, surface, COARSE_GATES_MM), starts)
    if pieces and min(c.misfit for c in coarse) > PIECE_MM:
        coarse += _of_pieces(seeds, few, surface, part)
    return _promising(coarse, _corners(points))


def _of_pieces(seeds: Floats, few: Floats, surface: Surface, part: DesignPart) -> list[_Candidate]:
    """Align pieces of the part: the best after a few quick iterations go through the coarse gates."""
    quick = thinned(few, PIECE_POINTS)

    def iterate(T: Floats) -> _Candidate:
        fitted = icp.point_to_plane(
            quick,
            surface.coarse,
            T,
            gates_mm=COARSE_GATES_MM[:1],
            axes=surface.axes,
            max_iterations=PIECE_ITERATIONS,
        ).T_target_source
        return _Candidate(fitted, fitted, _misfit(quick, surface, fitted))

    best = sorted(each(iterate, piece_hypotheses(seeds, part)), key=lambda c: c.misfit)[:PIECES_KEPT]
    return each(partial(_align, few, surface, COARSE_GATES_MM), [_Candidate(c.T, c.T) for c in best])


def _about(centre: Floats, R: Floats) -> Floats:
    """Rotation R (3, 3) about a centre (3,), as (4, 4)."""
    return rigid.transform(R, centre - R @ centre)


def _distinct(candidates: list[_Candidate], box: Floats) -> list[_Candidate]:
    """Sort candidates by their misfit, and drop equal poses by the corners (8, 3) of the scan's box."""
    distinct: list[_Candidate] = []
    for candidate in sorted(candidates, key=lambda c: c.misfit):
        corners = rigid.apply(candidate.T, box)
        if all(np.linalg.norm(corners - rigid.apply(c.T, box), axis=1).max() >= SAME_POSE_MM for c in distinct):
            distinct.append(candidate)
    return distinct


def _promising(candidates: list[_Candidate], box: Floats) -> list[_Candidate]:
    """Drop candidates with a misfit so much larger than the best that they cannot win, and equal ones."""
    least = min(c.misfit for c in candidates)
    return _distinct([c for c in candidates if c.misfit <= PROMISING * least + PROMISING_MM], box)


def _decide(points: Floats, box: Floats, seeds: Floats, surface: Surface, candidates: list[_Candidate]) -> Attitude:
    """Choose, of candidates that fit, the one that no other beats by the surface that the scan shows."""
    if len(candidates) > 1:
        # Evidence is counted at a scale of tens of millimetres: poses must be more accurate than that.
        fine = [surface_registration.fine(seeds, surface.mesh, surface.axes, c.T).T_design_scan for c in candidates]
        candidates = _distinct([replace(c, T=T) for c, T in zip(candidates, fine, strict=True)], box)

    @cache
    def compare(i: int, j: int) -> int:
        """Whether the scan supports the first candidate (1), the second (-1), or neither (0)."""
        for_i, for_j = _evidence(points, surface, candidates[i].T, candidates[j].T)
        more, fewer = max(for_i, for_j), min(for_i, for_j)
        clear = more >= LEAST_EVIDENCE and more >= 2 * fewer
        return int(np.sign(for_i - for_j)) if clear else 0

    best = 0
    for other in range(1, len(candidates)):
        best = other if compare(best, other) < 0 else best
    rivals = [other for other in range(len(candidates)) if other != best and compare(best, other) <= 0]
    T, start = candidates[best].T, candidates[best].start
    if not rivals:
        return Attitude(start, T, Status.OK)
    T_rival = candidates[rivals[0]].T
    return Attitude(start, T, Status.AMBIGUOUS, (_rival_reason(T, T_rival, surface),), T_rival)


def _rival_reason(best: Floats, rival: Floats, surface: Surface) -> Reason:
    """Describe a rival pose relative to the best, T_bridge_scan (4, 4) each, and what would distinguish them."""
    between = rival @ rigid.invert(best)
    middle = surface.points.mean(axis=0)
    turn = rigid.rotation_angle(between[:3, :3])
    if turn >= SLIDE_RAD:
        return reason("preassemble.rival-rotation", degrees=float(np.degrees(turn)))
    shift = abs(float((rigid.apply(between, middle) - middle) @ surface.axes[:, 0]))
    return reason("preassemble.rival-shift", shift=shift)


def _align(points: Floats, surface: Surface, gates_mm: tuple[float, ...], candidate: _Candidate) -> _Candidate:
    """Align from the pose of a candidate, by a share of the points until the last gate."""
    fine = gates_mm[-1] < COARSE_GATES_MM[-1]
    boxes = surface.boxes if fine else surface.coarse
    wide, known = thinned(points, WIDE_POINTS), icp.nothing_known(len(points))
    of_wide = known if len(wide) == len(points) else icp.nothing_known(len(wide))
    T = icp.point_to_plane(
        wide, boxes, candidate.T, gates_mm=gates_mm[:-1], axes=surface.axes, known=of_wide
    ).T_target_source
    T = icp.point_to_plane(points, boxes, T, gates_mm=gates_mm[-1:], axes=surface.axes, known=known).T_target_source
    return _Candidate(T, candidate.start, _misfit(points, surface, T, known if fine else None))


def _misfit(points: Floats, surface: Surface, T: Floats, known: icp.Known | None = None) -> float:
    """Median distance in mm of the points to the nearest design sample's plane; ``known`` is of ``surface.boxes``."""
    boxes = surface.boxes
    known = icp.nothing_known(len(points)) if known is None else known
    placed = rigid.apply(T, points)
    icp.find_partners(boxes, placed, np.inf, known, np.empty(len(points), bool))
    off = placed - boxes.samples[known.first]
    distance = np.sqrt(np.einsum("ni,ni->n", off, off))
    normal_part = np.abs(np.einsum("ni,ni->n", off, boxes.normals[known.first]))
    # A point beyond the surface's edge may lie in the plane of its nearest sample and still be far from it.
    spacing = 3.0 * float(np.median(distance))
    return float(np.median(np.where(distance > 100.0 + spacing, distance, normal_part)))


def _corners(points: Floats) -> Floats:
    """Return the corners (8, 3) of the points' bounding box."""
    return np.array(list(product(*zip(*corners(points), strict=True))))


def _evidence(points: Floats, surface: Surface, best: Floats, rival: Floats) -> tuple[int, int]:
    """Count the samples that the scan shows of surface that only one pose has, for the best and for the rival."""
    return (
        shown(points, best, only_in(surface, best, surface, rival)[0]),
        shown(points, rival, only_in(surface, rival, surface, best)[0]),
    )


def only_in(surface: Surface, T: Floats, other: Surface, T_other: Floats) -> tuple[Floats, Floats]:
    """Return samples and normals (k, 3) of a design that, placed in the scan, are far from the other design there.

    ``T`` and ``T_other`` are T_bridge_scan (4, 4) of the two designs, which may be the same.
    """
    lacking = _lacks(surface, T, other, T_other)
    return surface.points[lacking], surface.normals[lacking]


def _lacks(surface: Surface, T: Floats, other: Surface, T_other: Floats) -> Bools:
    """Mark the samples (n,) of a design that, placed in the scan, are far from the other design there."""
    near = _has_facets(surface.mesh, T, other.mesh, T_other)[surface.facet]
    rest = np.flatnonzero(~near)
    samples = rigid.apply(T_other, rigid.apply(rigid.invert(T), surface.points[rest]))
    near[rest] = _on_surface(samples, other.mesh)
    return ~near


def _has_facets(mesh: MeshSurface, T: Floats, other: MeshSurface, T_other: Floats) -> Bools:
    """Mark the facets (f,) of a mesh, placed in the scan, of which another mesh there has all corners in one facet.

    No point of such a facet is farther from the other mesh than its corners are.
    """
    moved = rigid.apply(T_other, rigid.apply(rigid.invert(T), mesh.vertices))
    corner = cKDTree(other.vertices).query(moved, distance_upper_bound=SAME_CORNER_MM, workers=-1)[1]
    count = len(other.vertices) + 1  # the last number: none is near

    def numbers(faces: Ints) -> Ints:
        low, middle, high = np.sort(faces, axis=1).T
        return np.asarray((low * count + middle) * count + high, np.int64)

    facets = corner[mesh.faces]
    found = (facets < count - 1).all(axis=1)
    found[found] = np.isin(numbers(facets[found]), numbers(other.faces))
    return np.asarray(found, bool)


def _on_surface(samples: Floats, mesh: MeshSurface) -> Bools:
    """Mark the samples (n, 3) of a design that are not far from another one's surface."""
    found, distance, beyond = mesh.distances(samples, 5.0 * TELLING_MM)
    near = (np.abs(distance) <= TELLING_MM) & (beyond <= TELLING_MM)  # False where nothing is in reach: NaN
    # Near a corner the nearest sample may be on the other face, from which the search over facets does not get round.
    # Where nothing is in reach, no face is: the most of two poses' samples, and the costly ones to search for.
    doubtful = np.flatnonzero(~near & (found >= 0))
    faces, away = mesh.nearest(samples[doubtful], np.inf, CORNER_SAMPLES)
    beside = away[:, 0] <= 1.4 * TELLING_MM
    for face in np.ascontiguousarray(faces.T):
        _, distance, beyond = mesh.distances(samples[doubtful], np.inf, face)
        beside |= (np.abs(distance) <= TELLING_MM) & (beyond <= TELLING_MM)
    near[doubtful[beside]] = True
    return np.asarray(near, bool)


def shown(points: Floats, T: Floats, samples: Floats) -> int:
    """Count the samples that have a point within TELLING_MM, the points placed by T (4, 4)."""
    if len(samples) == 0:
        return 0
    placed = rigid.apply(rigid.invert(T), samples)  # few, where the points are many
    return int(within_reach(points, placed, TELLING_MM)[1].sum())
