"""The attitude of a part: principal axes laid on the design's, and which of the possible ways is right.

Principal axes leave four proper rotations, eight where the section is nearly square. The source paper (000, section
2.2) resolves them by levelling the parts by hand; here every one is tried against the design's surface.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry import icp, mesh_distance, principal, rigid, surface_registration
from processor.geometry.mesh_distance import MeshSurface
from processor.geometry.neighbors import thinned, voxel_means
from processor.geometry.parallel import each
from processor.model import DesignPart, Floats

SAMPLE_SPACING_MM = 30.0  # of the design's surface: a mark of 0.1 m shows in ten samples
COARSE_GATES_MM = (400.0, 150.0)  # for every hypothesis
FINE_GATES_MM = (50.0, 25.0, 12.0)  # for those that can still win
COARSE_POINTS, FINE_POINTS = 600, 20_000
# Where no hypothesis of a whole part comes as near, the scan may be of a piece of it: noise and form of parts are less.
PIECE_MM = 5.0
PIECE_POINTS, PIECE_ITERATIONS, PIECES_KEPT = 200, 6, 24
SAME_SIZE = 0.05  # of the size along an axis, by which a piece may differ and yet be as large as the part along it
# After the coarse gates a hypothesis this many times worse than the best, and by so much, is dropped: the right one may
# have come to rest some millimetres off.
PROMISING, PROMISING_MM = 4.0, 10.0
SHORT_SHARE = 0.1  # of its length, by which a scan may be shorter than the part and still be of all of it
NO_FIT_MM = 25.0  # typical distance to the design, about a plate's thickness, beyond which no pose explains the scan
SAME_POSE_MM = 5.0  # poses that move no corner of the part by more are one and the same
TELLING_MM = 10.0  # design surface this far from the rival's design can tell two poses apart
CORNER_SAMPLES = 12  # nearest of the rival's design: some of them on each face that meets at a corner
LEAST_EVIDENCE = 10  # samples of telling surface that the scan shows
SLIDE_RAD = np.radians(45.0)  # a rival turned by less has slid along the part: along an arch it turns a little
RIVAL_RATIO = 1.5  # a pose whose misfit is within this factor of the best is a rival


@dataclass(frozen=True)
class Attitude:
    """The pose of a part by its principal axes and by its surface (``T_bridge_scan``, 4x4 each), and how sure it is."""

    T_principal: Floats
    T_surface: Floats
    status: str  # ok | ambiguous | failed
    message: str
    T_rival: Floats = field(default_factory=lambda: np.full((4, 4), np.nan))  # of an ambiguous part: the other pose


@dataclass(frozen=True)
class Surface:
    """Samples (n, 3) of a design part's surface in the bridge's frame with unit normals (n, 3)."""

    points: Floats
    normals: Floats
    tree: cKDTree
    mesh: MeshSurface
    centre: Floats  # (3,) of its area
    axes: Floats  # (3, 3) principal axes as columns
    size: float  # diagonal of the bounding box


@dataclass(frozen=True)
class _Candidate:
    """A pose ``T``, T_bridge_scan (4, 4), where its hypothesis began (4, 4), and its misfit in mm."""

    T: Floats
    start: Floats
    misfit: float = np.inf


def samples_of(part: DesignPart) -> tuple[Floats, Floats]:
    """Spread samples (n, 3), with unit normals, over the part's triangles, on a fixed low-discrepancy pattern."""
    samples = mesh_distance.spread(
        part.vertices, part.faces, lambda area_mm2: int(np.clip(area_mm2 / SAMPLE_SPACING_MM**2, 2_000, 400_000))
    )
    return samples.points, samples.normals


def sample_surface(part: DesignPart) -> Surface:
    """Prepare the part's surface: samples, their tree, and the mesh itself."""
    points, normals = samples_of(part)
    size = float(np.linalg.norm(np.ptp(part.vertices, axis=0)))
    mesh = mesh_distance.of_mesh(part.vertices, part.faces)
    own = principal.of_mesh(part.vertices, part.faces)
    return Surface(points, normals, cKDTree(points, balanced_tree=False), mesh, own.centre, own.axes, size)


def principal_hypotheses(points: Floats, part: DesignPart) -> list[Floats]:
    """T_bridge_scan that lay the scan's principal axes on the design's: eight proper rotations about the long axis.

    A scan that is shorter than the part is also laid to either end of it.
    """
    scan = principal.of_points(points)
    design = principal.of_mesh(part.vertices, part.faces)
    rotations = _rotations(scan.axes, design.axes)
    low, high = np.quantile((points - scan.centre) @ scan.axes[:, 0], [0.01, 0.99])
    whole = (part.vertices - design.centre) @ design.axes[:, 0]
    short = np.ptp(whole) - (high - low)
    shifts = [0.0] if short < SHORT_SHARE * np.ptp(whole) else [0.0, -1.0, 1.0]
    found = []
    for R in rotations:
        for shift in shifts:
            ahead = R @ scan.axes[:, 0] @ design.axes[:, 0]  # 1 or -1: which way the scan lies on the design
            own = (low, high) if ahead > 0.0 else (-high, -low)
            move = 0.0 if shift == 0.0 else whole.min() - own[0] if shift < 0.0 else whole.max() - own[1]
            found.append(rigid.transform(R, design.centre + move * design.axes[:, 0] - R @ scan.centre))
    return found


def _rotations(scan_axes: Floats, design_axes: Floats) -> list[Floats]:
    """Return the eight proper rotations (3, 3) that lay one long axis on the other and either cross axis on either."""
    turns = principal.turns(((0, 1, 2), (0, 2, 1)))
    return [design_axes @ turn @ scan_axes.T for turn in turns]


def piece_hypotheses(seeds: Floats, part: DesignPart) -> list[Floats]:
    """T_bridge_scan that lay a piece of the part, as evenly seen in seeds (n, 3), to either side and amid it.

    Of a half seen from above the middle is not the part's: along every axis along which it is smaller than the part it
    is tried at the low side, in the middle and at the high side.
    """
    design_axes = principal.of_mesh(part.vertices, part.faces).axes
    whole = part.vertices @ design_axes
    low, high = whole.min(axis=0), whole.max(axis=0)
    found = []
    for R in _rotations(principal.of_points(seeds).axes, design_axes):
        own = seeds @ R.T @ design_axes
        own_low, own_high = np.quantile(own, [0.002, 0.998], axis=0)  # the odd stray point does not count
        middle = 0.5 * (low + high - own_low - own_high)
        moves = [
            (m,) if abs((b - a) - (d - c)) < SAME_SIZE * (b - a) else (c_low, m, c_high)
            for a, b, c, d, m, c_low, c_high in zip(
                low, high, own_low, own_high, middle, low - own_low, high - own_high, strict=True
            )
        ]
        found += [rigid.transform(R, design_axes @ np.array(move)) for move in product(*moves)]
    return found


def find(points: Floats, part: DesignPart, surface: Surface | None = None) -> Attitude:
    """Attitude of the part scanned as points (n, 3), against its design, whose samples may be there already.

    Symmetric parts are told apart by what the designs in the two poses do not share (a pad, a taper); where there is
    nothing of the kind, or the scan does not show it, the answer is ``ambiguous``.
    """
    surface = sample_surface(part) if surface is None else surface
    seeds = voxel_means(points, surface.size / 150.0, least=2)
    if len(seeds) < 50:
        seeds = points
    few = thinned(seeds, COARSE_POINTS)
    begun = [_Candidate(T, T) for T in principal_hypotheses(points, part)]
    coarse = each(partial(_tried, few, surface, COARSE_GATES_MM), begun)
    box = _corners(points)
    if min(c.misfit for c in coarse) > PIECE_MM:
        coarse += _of_pieces(seeds, few, surface, part)
    coarse = _promising(coarse, box)
    # Single points now: means of voxels blend the end faces, which alone hold the part along its length.
    seeds = thinned(points, FINE_POINTS)
    tried = partial(_tried, seeds, surface, FINE_GATES_MM)
    candidates = _distinct(each(tried, coarse), box)
    # Few points hold a part of even curvature along itself, and it may have come to rest metres off; and what lies
    # beside the part turns its principal axes, from which the right attitude may not be reached. Every attitude is
    # tried from where the best one lies, too: turned as their beginnings are, and as the part may lie on itself.
    best = candidates[0]
    turns = [c.start @ rigid.invert(best.start) for c in coarse]
    turns += [_about(surface.centre, R) for R in _rotations(surface.axes, surface.axes)]
    turned = [_Candidate(S @ best.T, S @ best.start) for S in turns]
    screened = each(partial(_tried, few, surface, COARSE_GATES_MM[1:]), turned)
    turned = _promising([replace(c, misfit=s.misfit) for c, s in zip(turned, screened, strict=True)], box)
    candidates = _distinct(candidates + each(tried, turned), box)
    best = candidates[0]
    if best.misfit > NO_FIT_MM:
        said = f"no attitude fits the design (typical distance {best.misfit:.0f} mm)"
        return Attitude(best.start, best.T, "failed", said)
    rivals = [c for c in candidates if c.misfit <= RIVAL_RATIO * best.misfit + 0.5]
    return _settled(points, box, seeds, surface, rivals)


def _of_pieces(seeds: Floats, few: Floats, surface: Surface, part: DesignPart) -> list[_Candidate]:
    """Try the part's pieces: what stands best after a few quick steps goes through the coarse gates."""
    quick = thinned(few, PIECE_POINTS)

    def stepped(T: Floats) -> _Candidate:
        given = (quick, surface.points, surface.normals, T)
        gate = COARSE_GATES_MM[:1]
        fitted = icp.point_to_plane(
            *given, gates_mm=gate, tree=surface.tree, axes=surface.axes, max_iterations=PIECE_ITERATIONS
        ).T_target_source
        return _Candidate(fitted, fitted, _misfit(quick, surface, fitted))

    best = sorted(each(stepped, piece_hypotheses(seeds, part)), key=lambda c: c.misfit)[:PIECES_KEPT]
    return each(partial(_tried, few, surface, COARSE_GATES_MM), [_Candidate(c.T, c.T) for c in best])


def _about(centre: Floats, R: Floats) -> Floats:
    """Turn (4, 4) by R (3, 3) about a centre (3,)."""
    return rigid.transform(R, centre - R @ centre)


def _distinct(candidates: list[_Candidate], box: Floats) -> list[_Candidate]:
    """Sort candidates by their misfit; of those that take the corners of the scan's box (8, 3) alike, keep one."""
    kept: list[_Candidate] = []
    for one in sorted(candidates, key=lambda c: c.misfit):
        moved = rigid.apply(one.T, box)
        if all(np.linalg.norm(moved - rigid.apply(c.T, box), axis=1).max() >= SAME_POSE_MM for c in kept):
            kept.append(one)
    return kept


def _promising(candidates: list[_Candidate], box: Floats) -> list[_Candidate]:
    """Drop candidates that come so much less near than the best that they cannot win, and twins."""
    least = min(c.misfit for c in candidates)
    return _distinct([c for c in candidates if c.misfit <= PROMISING * least + PROMISING_MM], box)


def _settled(points: Floats, box: Floats, seeds: Floats, surface: Surface, candidates: list[_Candidate]) -> Attitude:
    """Choose, of candidates that fit, the one that no other beats by what the scan shows."""
    if len(candidates) > 1:
        # Evidence counts tens of millimetres: no pose may be off by such along the part.
        fine = [surface_registration.fine(seeds, surface.mesh, surface.axes, c.T).T_bridge_scan for c in candidates]
        candidates = _distinct([replace(c, T=T) for c, T in zip(candidates, fine, strict=True)], box)

    @cache
    def tells(i: int, j: int) -> int:
        """Whether the scan speaks for the one (1), for the other (-1), or for neither (0)."""
        ours, theirs = _evidence(points, surface, candidates[i].T, candidates[j].T)
        more, fewer = max(ours, theirs), min(ours, theirs)
        clear = more >= LEAST_EVIDENCE and more >= 2 * fewer
        return int(np.sign(ours - theirs)) if clear else 0

    best = 0
    for other in range(1, len(candidates)):
        best = other if tells(best, other) < 0 else best
    rivals = [other for other in range(len(candidates)) if other != best and tells(best, other) <= 0]
    T, start = candidates[best].T, candidates[best].start
    if not rivals:
        return Attitude(start, T, "ok", "")
    T_rival = candidates[rivals[0]].T
    return Attitude(start, T, "ambiguous", _said_of(T, T_rival, surface), T_rival)


def _said_of(best: Floats, rival: Floats, surface: Surface) -> str:
    """Say what a rival's pose is against the best, T_bridge_scan (4, 4) each, and what would tell them apart."""
    between = rival @ rigid.invert(best)
    middle = surface.points.mean(axis=0)
    turn = rigid.rotation_angle(between[:3, :3])
    if turn >= SLIDE_RAD:
        return f"the part fits its design as well when turned by {np.degrees(turn):.0f} deg; a mark on it would tell"
    shift = abs(float((rigid.apply(between, middle) - middle) @ surface.axes[:, 0]))
    return f"the part fits its design as well when shifted by {shift:.0f} mm along itself; an end seen would tell"


def _tried(points: Floats, surface: Surface, gates_mm: tuple[float, ...], candidate: _Candidate) -> _Candidate:
    """Align from where a candidate lies."""
    T = _aligned(points, surface, candidate.T, gates_mm)
    return _Candidate(T, candidate.start, _misfit(points, surface, T))


def _aligned(points: Floats, surface: Surface, T: Floats, gates_mm: tuple[float, ...]) -> Floats:
    found = icp.point_to_plane(
        points, surface.points, surface.normals, T, gates_mm=gates_mm, tree=surface.tree, axes=surface.axes
    )
    return found.T_target_source


def _misfit(points: Floats, surface: Surface, T: Floats) -> float:
    """Median distance in mm of the points to the nearest design sample's plane."""
    moved = rigid.apply(T, points)
    distance, index = surface.tree.query(moved)
    normal_part = np.abs(np.einsum("ni,ni->n", moved - surface.points[index], surface.normals[index]))
    # Beyond the surface's edge a point lies in the plane of its nearest sample and is far all the same.
    spacing = 3.0 * float(np.median(distance))
    return float(np.median(np.where(distance > 100.0 + spacing, distance, normal_part)))


def _corners(points: Floats) -> Floats:
    """Return the corners (8, 3) of the points' bounding box."""
    return np.array(list(product(*zip(points.min(axis=0), points.max(axis=0), strict=True))))


def _evidence(points: Floats, surface: Surface, best: Floats, rival: Floats) -> tuple[int, int]:
    """Count the shown samples of surface that only one of the poses has, for the best and for the rival."""
    return (
        shown(points, best, only_in(surface, best, surface, rival)[0]),
        shown(points, rival, only_in(surface, rival, surface, best)[0]),
    )


def only_in(surface: Surface, T: Floats, other: Surface, T_other: Floats) -> tuple[Floats, Floats]:
    """Give the samples (k, 3) of a design that, placed in the scan by T, are far from the other design as placed there.

    With their normals (k, 3). ``T`` and ``T_other`` are T_bridge_scan (4, 4); the designs may be one and the same.
    """
    there = rigid.apply(T_other, rigid.apply(rigid.invert(T), surface.points))
    _, distance, beyond = other.mesh.distances(there, 5.0 * TELLING_MM)
    near = (np.abs(distance) <= TELLING_MM) & (beyond <= TELLING_MM)  # not so where nothing is in reach: NaN
    far = np.flatnonzero(~near)
    # Near a corner the nearest sample may be on the other face, from which the walk does not come round.
    around = other.mesh.tree.query(there[far], k=CORNER_SAMPLES, workers=-1)
    beside = around[0][:, 0] <= 1.4 * TELLING_MM
    for k in range(CORNER_SAMPLES):
        face = other.mesh.sample_face[around[1][:, k]]
        _, distance, beyond = other.mesh.distances(there[far], np.inf, face)
        beside |= (np.abs(distance) <= TELLING_MM) & (beyond <= TELLING_MM)
    far = far[~beside]
    return surface.points[far], surface.normals[far]


def shown(points: Floats, T: Floats, samples: Floats) -> int:
    """Count the samples that have a point within TELLING_MM, the points taken by T."""
    if len(samples) == 0:
        return 0
    moved = rigid.apply(T, points)
    near = ((moved > samples.min(axis=0) - TELLING_MM) & (moved < samples.max(axis=0) + TELLING_MM)).all(axis=1)
    if not near.any():
        return 0
    distance = cKDTree(moved[near], balanced_tree=False).query(samples, distance_upper_bound=TELLING_MM, workers=-1)[0]
    return int(np.isfinite(distance).sum())
