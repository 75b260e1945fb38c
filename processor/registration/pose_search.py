"""Candidate poses of a scan at its design: principal axes laid on each other in every way, each refined.

Principal axes leave four proper rotations, eight where the section is nearly square, 24 where all axes are alike. The
source paper (000, section 2.2) resolves them by levelling the parts by hand; here every one is aligned with the
design's surface, by few points with wide gates first. Which of the poses that fit is the right one is decided by
:mod:`processor.registration.pose_choice`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np

from processor.geometry import mesh_distance, rigid
from processor.geometry.mesh_distance import MeshSurface, Samples
from processor.geometry.thinning import thinned, voxel_means
from processor.geometry.thread_ranges import each
from processor.large_arrays import corners
from processor.model import Floats, Ints
from processor.registration import icp, principal
from processor.registration.principal import PrincipalAxes

SAMPLE_SPACING_MM = 30.0  # of the design's surface: ten samples on a mark of 0.1 m
COARSE_SPACING_MM = 120.0  # for the coarse gates
SAMPLES = (2_000, 400_000)  # work, the fewest and the most: enough for a mark; 10 MB
STRUCTURE_SAMPLES = (40_000, 40_000)  # of a small structure as well: its plates are thin
# Gates for every hypothesis, and for the promising ones: of a part of 8 m and more, and shares of a smaller one's size.
COARSE_GATES_MM, COARSE_GATE_SHARES = (400.0, 150.0), (0.05, 0.02)
FINE_GATES_MM, FINE_GATE_SHARES = (50.0, 25.0, 12.0), (0.015, 0.01, 0.005)  # the last beyond form and noise
COARSE_POINTS, FINE_POINTS = 600, 20_000  # work: the first for every hypothesis, the second for the promising ones
WIDE_POINTS = 4_000  # at all gates but the last
# Least misfit by noise and form of parts: where no hypothesis of a whole part is better, the scan may be of a piece.
PIECE_MM = 5.0
PIECE_POINTS, PIECE_ITERATIONS, PIECES_KEPT = 200, 6, 24  # work: few points for many placements
SAME_SIZE = 0.05  # relative difference of sizes along an axis that a piece of full size may have
# A hypothesis whose misfit after the coarse gates exceeds PROMISING times the best plus PROMISING_MM is dropped; the
# right one may have converged some millimetres off.
PROMISING, PROMISING_MM = 4.0, 10.0
RIVAL_RATIO, RIVAL_MM = 1.5, 0.5  # a pose whose misfit is within this factor of the best, and more, is a rival
EXTENT_POINTS = 100_000  # by which the ends of a scan along its longest axis are known
EXTENTS = (0.002, 0.998)  # quantiles of points, without single outliers
SHORT_SHARE = 0.1  # of its length, by which a scan of a whole part may be shorter
SAME_POSE_MM = 5.0  # poses are equal where no corner of the part differs by more
# An end plate's two sides are alike to few points: poses that differ by a plate's thickness, up to some 60 mm, along
# the part are each stable, and are tried from starts nearer to each other than half of the plates that are usual.
SLIDES_MM = (-60.0, -45.0, -30.0, -15.0, 15.0, 30.0, 45.0, 60.0)
SIDE_ROUNDS = 3  # one for each axis
SIDE_MM = (2.0, 100.0)  # thinner plates are not told apart by their side; the gates tell thicker ones apart


@dataclass(frozen=True)
class DesignSurface:
    """Samples (n, 3) of a design's surface with unit normals (n, 3)."""

    points: Floats
    normals: Floats
    boxes: icp.SampleBoxes  # about the same samples, in another order
    coarse: icp.SampleBoxes  # about fewer samples, for the coarse gates
    mesh: MeshSurface
    centre: Floats  # (3,) of its area
    axes: Floats  # (3, 3) principal axes as columns
    variances: Floats  # (3,) along them
    size: float  # diagonal of the bounding box
    tube: PrincipalAxes | None = None  # of the wall of a round tube
    is_structure: bool = False  # of any size, of which a scan shows some part: hypotheses lie farther off

    def gates(self, most_mm: tuple[float, ...], shares: tuple[float, ...]) -> tuple[float, ...]:
        """Return gates in mm: shares of the design's size, of a single part no wider than ``most_mm``."""
        by_size = tuple(share * self.size for share in shares)
        return by_size if self.is_structure else tuple(map(min, most_mm, by_size))


@dataclass(frozen=True)
class Candidate:
    """A pose ``T``, T_design_scan (4, 4), where its hypothesis began (4, 4), and its misfit in mm."""

    T: Floats
    start: Floats
    misfit: float = np.inf


def samples_of(
    vertices: Floats, faces: Ints, spacing_mm: float = SAMPLE_SPACING_MM, bounds: tuple[int, int] = SAMPLES
) -> Samples:
    """Sample a mesh on a fixed low-discrepancy pattern, by a number of points within bounds."""
    return mesh_distance.spread(vertices, faces, lambda area_mm2: int(np.clip(area_mm2 / spacing_mm**2, *bounds)))


def prepared(mesh: MeshSurface, is_structure: bool = False) -> DesignSurface:
    """Prepare a mesh for the search: a number of samples within bounds, boxes about them, principal axes."""
    bounds = STRUCTURE_SAMPLES if is_structure else SAMPLES
    samples = samples_of(mesh.vertices, mesh.faces, bounds=bounds)
    few = samples_of(mesh.vertices, mesh.faces, COARSE_SPACING_MM, (SAMPLES[0], bounds[1]))
    axes = principal.of_mesh(mesh.vertices, mesh.faces)
    return DesignSurface(
        points=samples.points,
        normals=samples.normals,
        boxes=icp.boxes_of(samples.points, samples.normals),
        coarse=icp.boxes_of(few.points, few.normals),
        mesh=mesh,
        centre=axes.centre,
        axes=axes.axes,
        variances=axes.variances,
        size=float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))),
        is_structure=is_structure,
    )


# --- The search


def search(points: Floats, design: DesignSurface) -> list[Candidate]:
    """Return the different poses at which points (n, 3) in any frame come to lie on a design, the best first."""
    box, even = box_of(points), evenly(points, design)
    started = promising_starts(points, even, design, pieces=True)
    # Single points: voxel means blur the end faces, which alone constrain the part along its length.
    seeds = thinned(points, FINE_POINTS)
    aligned = partial(align, seeds, design)
    candidates = distinct(each(aligned, started), box)
    # Few points constrain a part of even curvature along its length, so it may have converged metres off. Clutter
    # turns the principal axes, from which the right attitude may not be reached. So every attitude is also tried from
    # the best pose: turned by the rotations between the starts, and by those of the part onto itself.
    best = candidates[0]
    turns = [c.start @ rigid.invert(best.start) for c in started]
    turns += symmetries(design)
    turned = [Candidate(S @ best.T, S @ best.start) for S in turns]
    coarse_gates = design.gates(COARSE_GATES_MM, COARSE_GATE_SHARES)
    screened = each(partial(align, even[1], design, gates_mm=coarse_gates[1:]), turned)
    turned = _promising([replace(c, misfit=s.misfit) for c, s in zip(turned, screened, strict=True)], box)
    candidates = distinct(candidates + each(aligned, turned), box)
    candidates = distinct(
        candidates + each(aligned, slid(thinned(seeds, WIDE_POINTS), design, candidates[0], box)), box
    )
    untried = candidates
    for _ in range(SIDE_ROUNDS):  # plates along several axes may lie on their other sides
        known = candidates
        shifted = on_other_sides(even, design, _promising(untried, box), box)
        candidates = distinct(known + each(aligned, shifted), box)
        untried = [c for c in candidates if not any(c is other for other in known)]
        if not untried or not candidates[0].misfit < known[0].misfit:
            break
    return candidates


def rivals_of(candidates: list[Candidate]) -> list[Candidate]:
    """Return the candidates, the best first, that fit about as well as the best."""
    return [c for c in candidates if c.misfit <= RIVAL_RATIO * candidates[0].misfit + RIVAL_MM]


def evenly(points: Floats, design: DesignSurface) -> tuple[Floats, Floats]:
    """Return points of even density, and a few hundred of them: what is dense near a scanner must not attract axes."""
    seeds = voxel_means(points, max(design.size / 150.0, 1e-6), least=2)
    if len(seeds) < 50:
        seeds = points
    return seeds, thinned(seeds, COARSE_POINTS)


def promising_starts(
    points: Floats, even: tuple[Floats, Floats], design: DesignSurface, *, pieces: bool
) -> list[Candidate]:
    """Align all hypotheses by a few hundred points, and return the promising ones, the best first."""
    seeds, few = even
    by_axes = by_principal_axes(points, design)
    starts = [Candidate(T, T) for T in by_axes]
    starts += [Candidate(at_extents(seeds, design, T), T) for T in by_axes]
    gates = design.gates(COARSE_GATES_MM, COARSE_GATE_SHARES)
    coarse = each(partial(align, few, design, gates_mm=gates), starts)
    if pieces and min(c.misfit for c in coarse) > PIECE_MM:
        quick = thinned(few, PIECE_POINTS)

        def iterate(T: Floats) -> Candidate:
            fitted = icp.point_to_plane(
                quick, design.coarse, T, gates_mm=gates[:1], axes=design.axes, max_iterations=PIECE_ITERATIONS
            ).T_target_source
            return Candidate(fitted, fitted, _misfit(quick, design, fitted))

        best = sorted(each(iterate, of_pieces(seeds, design)), key=lambda c: c.misfit)[:PIECES_KEPT]
        coarse += each(partial(align, few, design, gates_mm=gates), [Candidate(c.T, c.T) for c in best])
    return _promising(coarse, box_of(points))


# --- Hypotheses


def by_principal_axes(points: Floats, design: DesignSurface) -> list[Floats]:
    """T_design_scan that lay the scan's principal axes on the design's: eight or more proper rotations.

    A scan that is shorter than the part is also placed at either end of it.
    """
    scan = principal.of_points(points)
    low, high = np.quantile((thinned(points, EXTENT_POINTS) - scan.centre) @ scan.axes[:, 0], [0.01, 0.99])
    whole = (design.mesh.vertices - design.centre) @ design.axes[:, 0]
    short = np.ptp(whole) - (high - low)
    shifts = [0.0] if short < SHORT_SHARE * np.ptp(whole) else [0.0, -1.0, 1.0]
    hypotheses = []
    for R in _rotations(scan, design):
        for shift in shifts:
            ahead = R @ scan.axes[:, 0] @ design.axes[:, 0]  # 1 or -1: direction of the scan along the design
            start, end = (low, high) if ahead > 0.0 else (-high, -low)
            move = 0.0 if shift == 0.0 else whole.min() - start if shift < 0.0 else whole.max() - end
            hypotheses.append(rigid.transform(R, design.centre + move * design.axes[:, 0] - R @ scan.centre))
    return hypotheses


def at_extents(points: Floats, design: DesignSurface, T: Floats) -> Floats:
    """Move a T_design_scan (4, 4) so that the middle of the scan's extents lies at that of the part's.

    Where a scan is denser at one end its centre is not the part's, and a part of even curvature slides along itself
    from there. A scan that is shorter than the part stays.
    """
    whole, placed = design.mesh.vertices @ design.axes, rigid.apply(T, points) @ design.axes
    low, high = np.quantile(placed, EXTENTS, axis=0)
    if high[0] - low[0] < (1.0 - SHORT_SHARE) * np.ptp(whole[:, 0]):
        return T
    move = 0.5 * (whole.min(axis=0) + whole.max(axis=0) - low - high)
    return rigid.transform(np.eye(3), design.axes @ move) @ T


def of_pieces(seeds: Floats, design: DesignSurface) -> list[Floats]:
    """T_design_scan that place a piece of the part, evenly sampled by seeds (n, 3), at either side and in the middle.

    The middle of a half seen from above is not the part's. Along every axis along which the piece is smaller than the
    part, it is placed at the low side, in the middle and at the high side.
    """
    whole = design.mesh.vertices @ design.axes
    low, high = whole.min(axis=0), whole.max(axis=0)
    hypotheses = []
    for R in _rotations(principal.of_points(seeds), design):
        turned = seeds @ R.T @ design.axes
        piece_low, piece_high = np.quantile(turned, EXTENTS, axis=0)
        moves = np.stack([low - piece_low, 0.5 * (low + high - piece_low - piece_high), high - piece_high], axis=1)
        same_size = np.abs((high - low) - (piece_high - piece_low)) < SAME_SIZE * (high - low)
        tried = [move[1:2] if same else move for move, same in zip(moves, same_size, strict=True)]
        hypotheses += [rigid.transform(R, design.axes @ np.array(move)) for move in product(*tried)]
    return hypotheses


def _rotations(scan: PrincipalAxes, design: DesignSurface) -> list[Floats]:
    """Return the proper rotations (3, 3) that align axes, the cross axes in either order."""
    turns = principal.possible_turns(design.variances, scan.variances, either_cross=True)
    return [design.axes @ turn @ scan.axes.T for turn in turns]


def symmetries(design: DesignSurface) -> list[Floats]:
    """Return the motions (4, 4) of a design about onto itself that its principal axes allow, the identity first."""
    square = principal.along_faces(design.axes, design.mesh)
    turns = [square @ turn @ square.T for turn in principal.possible_turns(design.variances, design.variances)]
    turns.sort(key=rigid.rotation_angle)
    return [rigid.transform(R, design.centre - R @ design.centre) for R in turns]


def slid(points: Floats, design: DesignSurface, best: Candidate, box: Floats) -> list[Candidate]:
    """Return other stable poses of points (n, 3) that differ from the best by a slide along the part."""
    slides = [rigid.transform(np.eye(3), slide * design.axes[:, 0]) for slide in SLIDES_MM]
    found = each(partial(align, points, design), [Candidate(slide @ best.T, best.start) for slide in slides])
    return [c for c in distinct([replace(best, misfit=-np.inf), *found], box) if c.misfit >= 0.0]


def on_other_sides(
    even: tuple[Floats, Floats], design: DesignSurface, candidates: list[Candidate], box: Floats
) -> list[Candidate]:
    """Return stable poses that differ from the candidates by a shift of either side to that side of the design.

    The side of a plate that was scanned alone may have come to lie on the plate's other side.
    """
    square = principal.along_faces(design.axes, design.mesh)
    designed, starts = design.points @ square, []
    for c in candidates:
        placed = rigid.apply(c.T, even[0]) @ square
        for side, k in product((np.min, np.max), range(3)):
            shift = float(side(designed[:, k]) - side(placed[:, k]))
            if SIDE_MM[0] < abs(shift) < SIDE_MM[1]:
                starts.append(replace(c, T=rigid.transform(np.eye(3), shift * square[:, k]) @ c.T))
    found = each(partial(align, even[1], design), starts)
    return [c for c in distinct([*(replace(c, misfit=-np.inf) for c in candidates), *found], box) if c.misfit >= 0.0]


# --- Refinement


def align(
    points: Floats, design: DesignSurface, candidate: Candidate, gates_mm: tuple[float, ...] | None = None
) -> Candidate:
    """Align from the pose of a candidate, by a share of the points until the last gate; the fine gates without any."""
    fine = gates_mm is None
    gates = design.gates(FINE_GATES_MM, FINE_GATE_SHARES) if gates_mm is None else gates_mm
    boxes = design.boxes if fine else design.coarse
    wide, known = thinned(points, WIDE_POINTS), icp.nothing_known(len(points))
    of_wide = known if len(wide) == len(points) else icp.nothing_known(len(wide))
    T = icp.point_to_plane(
        wide, boxes, candidate.T, gates_mm=gates[:-1], axes=design.axes, known=of_wide
    ).T_target_source
    T = icp.point_to_plane(points, boxes, T, gates_mm=gates[-1:], axes=design.axes, known=known).T_target_source
    return Candidate(T, candidate.start, _misfit(points, design, T, known if fine else None))


def _misfit(points: Floats, design: DesignSurface, T: Floats, known: icp.Known | None = None) -> float:
    """Median distance in mm of the points to the nearest design sample's plane; ``known`` is of ``design.boxes``."""
    boxes = design.boxes
    known = icp.nothing_known(len(points)) if known is None else known
    placed = rigid.apply(T, points)
    icp.find_partners(boxes, placed, np.inf, known, np.empty(len(points), bool))
    off = placed - boxes.samples[known.first]
    distance = np.sqrt(np.einsum("ni,ni->n", off, off))
    normal_part = np.abs(np.einsum("ni,ni->n", off, boxes.normals[known.first]))
    # A point beyond the surface's edge may lie in the plane of its nearest sample and still be far from it.
    spacing = 3.0 * float(np.median(distance))
    return float(np.median(np.where(distance > 100.0 + spacing, distance, normal_part)))


def box_of(points: Floats) -> Floats:
    """Return the corners (8, 3) of the points' bounding box."""
    return np.array(list(product(*zip(*corners(points), strict=True))))


def distinct(candidates: list[Candidate], box: Floats) -> list[Candidate]:
    """Sort candidates by their misfit, and drop equal poses by the corners (8, 3) of the scan's box."""
    kept: list[Candidate] = []
    placed = np.empty((len(candidates), *box.shape))  # of those kept
    for candidate in sorted(candidates, key=lambda c: c.misfit):
        at = rigid.apply(candidate.T, box)
        if (np.linalg.norm(placed[: len(kept)] - at, axis=2).max(axis=1) >= SAME_POSE_MM).all():
            placed[len(kept)] = at
            kept.append(candidate)
    return kept


def _promising(candidates: list[Candidate], box: Floats) -> list[Candidate]:
    """Drop candidates with a misfit so much larger than the best that they cannot win, and equal ones."""
    least = min(c.misfit for c in candidates)
    return distinct([c for c in candidates if c.misfit <= PROMISING * least + PROMISING_MM], box)
