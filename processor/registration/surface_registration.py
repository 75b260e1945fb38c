"""Registration of a scan to the surface of its design: coarse by principal axes, then fine by least squares.

The fine registration needs a pose that is right to a few millimetres; see :mod:`processor.registration.principal` for
the search from any pose, and :mod:`processor.registration.pose_choice` for the choice between the attitudes of a nearly
symmetric structure. :func:`place` decides which of these a scan needs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from processor.adjustment import robust_least_squares
from processor.adjustment.body_motions import distance_derivative, transform_about, variances
from processor.geometry import mesh_distance, rigid
from processor.geometry.mesh_distance import MeshSurface, Samples, on_face
from processor.geometry.thinning import thinned, voxel_means
from processor.geometry.thread_ranges import each
from processor.model import NORMAL_95, Bools, Floats, Ints, Reason, Word
from processor.registration import icp, main_body, pose_choice, principal
from processor.registration.principal import CoarsePose, PrincipalAxes
from processor.robust_statistics import biweight, robust_sd

# --- Fine registration

POINTS, LAST_POINTS = 30_000, 250_000
MOST_ITERATIONS = 30
CONVERGED_MM = 3e-4  # a step that moves the part by less is the last
SMALL_MM = 0.3  # a step that moves the part by less leaves each point on its facet
NO_FORM = 2.0  # ratio of the cells' mean squares to those of chance, below which a part has no form error of its own
GATES_MM = (60.0, 30.0)
CUT = 4.5  # standard deviations
FLOOR_MM = 0.01  # least sigma, for scans without noise
LEAST_SHARE = 0.5  # of the points that must lie within the last gate
NO_FIT_MM = (10.0, 4.0)  # sigma above which the scan is not of the design; the second where much clutter is beside it
CLUTTER_SHARE = 0.15
CELL_MM = 500.0  # residuals on one face in one such length of the part are taken as dependent
WEAK_MM = 5.0  # a motion that may move the part's ends by more (95 %) is weakly determined


class Motion(Word):
    """A motion of a part about its middle and principal axes."""

    ROLL = "a turn about its length"
    YAW = "a turn sideways"
    PITCH = "a turn up and down"
    ALONG = "a shift along its length"
    SIDEWAYS = "a shift sideways"
    UP = "a shift up and down"


@dataclass(frozen=True)
class SurfaceFit:
    """T_design_scan (4, 4), its covariance (6, 6: turn about the design frame's axes, translation), sigma and shares.

    ``weak`` names the motions that the points seen do not determine. ``used_share`` is that of points on the surface.
    """

    T_design_scan: Floats
    covariance: Floats
    sigma_mm: float
    used_share: float
    weak: tuple[Motion, ...] = ()


NOWHERE = SurfaceFit(np.full((4, 4), np.nan), np.full((6, 6), np.nan), float("nan"), 0.0)


def fine(
    points: Floats, surface: MeshSurface, axes: Floats, start: Floats, iterations: int = MOST_ITERATIONS
) -> SurfaceFit:
    """Robust point-to-surface least squares of points (n, 3), scan frame, from ``start`` (4, 4).

    First, faces that look along each of the design's principal ``axes`` (3, 3, columns) have the same weight, so that
    the ends of a long part fix it along its length. If the part then shows no form error of its own, a second run gives
    every point the same weight, which is the best estimate. The covariance is a sandwich over cells of neighbouring
    residuals, so that what they have in common, form error included, counts once (Liang and Zeger 1986). It is NaN
    where the points seen do not determine the pose.
    """
    few, many = thinned(points, POINTS), thinned(points, LAST_POINTS)
    balanced, form = _iterate(few, surface, axes, start, GATES_MM[0], iterations, even=True)
    if not form < NO_FORM:
        return balanced
    return _iterate(many, surface, axes, balanced.T_design_scan, GATES_MM[1], iterations, even=False)[0]


def fits(fitted: SurfaceFit) -> bool:
    """Whether the scan is of the design's part: the points that are not clutter lie on its surface."""
    return fitted.sigma_mm < most_scatter(fitted.used_share)


def most_scatter(on_surface: float) -> float:
    """Return the scatter in mm above which a scan, with such a share on the surface, does not fit its design."""
    return NO_FIT_MM[on_surface < 1.0 - CLUTTER_SHARE]


def _iterate(
    points: Floats, surface: MeshSurface, axes: Floats, start: Floats, gate: float, iterations: int, *, even: bool
) -> tuple[SurfaceFit, float]:
    """Iterate to convergence; also return the ratio of the cells' mean squares to those of chance."""
    T, sigma, covariance, share, form = start.copy(), float("nan"), np.full((6, 6), np.nan), 0.0, float("inf")
    weak: tuple[Motion, ...] = ()
    face: Ints | None = None
    for iteration in range(iterations):
        placed = rigid.apply(T, points)
        face, residual, beyond = surface.distances(placed, gate + 60.0, face)
        used = on_face(face, beyond) & (np.abs(residual) < gate)
        if used.sum() < 100:
            break
        r, n = residual[used], surface.normals[face[used]]
        middle = placed[used].mean(axis=0)
        J = distance_derivative(placed[used] - middle, n)
        axis = icp.facing(n, axes)
        spread = np.array([robust_sd(r[axis == k], FLOOR_MM) for k in range(3)])
        sigma = robust_sd(r, FLOOR_MM)
        weight = biweight(r / (CUT * spread[axis]))
        weight = weight * icp.balance(axis) if even else weight
        N, g = robust_least_squares.normal_equations(J, weight, -r)
        if np.linalg.cond(N / np.sqrt(np.outer(np.diag(N), np.diag(N)) + 1e-300)) > 1e10:
            break  # the points seen do not determine the pose: the covariance stays NaN
        step = np.asarray(np.linalg.solve(N, g))
        T = transform_about(step, middle) @ T
        share = float(used.mean())
        if iteration >= 3:
            gate = max(GATES_MM[1], 6.0 * sigma)
        move = float(np.linalg.norm(step[3:]) + np.linalg.norm(step[:3]) * np.ptp(placed[:, 0]))
        if iteration == iterations - 1 or (move < CONVERGED_MM and (iteration > 4 or not even)):
            cell = cells(placed[used] @ axes, axis, n @ axes)
            form = _form(r, weight > 0.0, cell)
            inverse = np.asarray(np.linalg.inv(N))
            at_middle = robust_least_squares.sandwich(inverse, J * (weight * r)[:, None], cell)
            weak = _weak(at_middle, axes, float(np.abs((placed[used] - middle) @ axes[:, 0]).max()))
            covariance = rigid.about_origin(at_middle, middle)
            break
        face = face if move < SMALL_MM else None
    return SurfaceFit(T, covariance, sigma, share, weak), form


def cells(place: Floats, axis: Ints, normal: Floats) -> Ints:
    """Return the number (n,) of the cell of points at ``place`` (n, 3), all along the design's principal axes.

    A cell is a length of the part on one side of it: the ``axis`` (n,) that the ``normal`` (n, 3) looks along, and its
    direction.
    """
    cell = np.floor(place[:, 0] / CELL_MM).astype(np.int64)
    side = normal[np.arange(len(axis)), axis] > 0.0
    number: Ints = np.unique(6 * cell + 2 * axis + side, return_inverse=True)[1].reshape(-1)
    return number


def _form(residual: Floats, counted: Bools, cell: Ints) -> float:
    """Ratio of the mean square of the cells' means to that of chance: 1 for a part without form error of its own."""
    number = np.bincount(cell, counted)
    full = number > 20
    mean = np.bincount(cell, residual * counted) / np.maximum(number, 1)
    rest = (residual - mean[cell])[counted & full[cell]]
    chance = max(float(rest.var()) if len(rest) else 0.0, FLOOR_MM**2)
    return float(np.mean(number[full] * mean[full] ** 2)) / chance if full.any() else float("inf")


def _weak(covariance: Floats, axes: Floats, half_length: float) -> tuple[Motion, ...]:
    """Name the motions about the part's middle and its axes that may move its ends by more than WEAK_MM."""
    turned = np.kron(np.eye(2), axes.T)
    spread = NORMAL_95 * np.sqrt(np.diag(turned @ covariance @ turned.T))
    arms = np.array([0.1 * half_length, half_length, half_length, 1.0, 1.0, 1.0])
    order = (0, 2, 1, 3, 4, 5)  # a turn about the third axis is sideways where the second one is
    return tuple(name for name, k in zip(Motion, order, strict=True) if spread[k] * arms[k] > WEAK_MM)


# --- Coarse registration, and the choice between the two

COARSE_POINTS, COARSE_ITERATIONS = 3_000, 12
COARSE_SAMPLES = 40_000
GATE_SHARES = (0.05, 0.015, 0.005)  # of the design's size
EVEN_CELLS = 200.0  # voxels along the scan's extent, for points of even density
NEAR_MM = 100.0  # of the design's surface
NEAR_SHARE = 0.5  # share of points near the surface from which on a scan lies at its design
FINE_POINTS = 30_000
RIVAL_POINTS = 8_000  # enough to tell attitudes apart: the fit of the one that is chosen uses FINE_POINTS
RIVAL_ITERATIONS = 15
SIDE_ROUNDS = 3  # one for each axis
LEAST_SHIFT_MM = 2.0  # thinner plates are not told apart by the side of their surface
FACE_COS, MOST_AREA, FACE_ROUNDS = 0.9, 0.5, 5  # faces about along an axis, their least share of the area
PROMISING = 3.0  # ratio of two poses' errors after the coarse registration, below which the fine one decides
NAN = float("nan")


class Registration(Word):
    """How a scan was registered to its design."""

    AS_GIVEN = "as given"
    FINE = "fine"
    COARSE = "coarse"


@dataclass(frozen=True)
class Placed:
    """``T`` (4, 4) and ``T_best_fit`` (4, 4) map the scan's local frame to the design's; ``registration`` says how.

    ``covariance`` (6, 6) is that of the best fit. ``shift`` (3,) and ``turn`` are what the best fit does to the scan's
    middle relative to T. ``ambiguity`` is the ratio of the coarse errors of the next best attitude and this one; the
    pose is ``ambiguous`` if no surface distinguishes it from ``T_rival``.
    """

    T: Floats
    registration: Registration
    T_best_fit: Floats
    covariance: Floats
    ambiguity: float
    near_share: float
    shift: Floats
    turn: float
    weak: tuple[Motion, ...]
    sigma_mm: float
    ambiguous: bool
    T_rival: Floats  # (4, 4) of another attitude that fits as well; NaN without one


def place(points: Floats, surface: MeshSurface, given: Floats, how: str, scanner: Floats | None = None) -> Placed:
    """Place a scan's points (n, 3) at its design from ``given`` (4, 4); ``how``: auto, none, fine or coarse.

    A best fit absorbs whatever a structure moved as a whole. A scan that lies at its design already is therefore left
    where it is by ``auto``, and the best fit is only reported. ``scanner`` (n, 3) is the position that each point was
    measured from, if known: it helps to distinguish attitudes. Ground and what stands about the structure is left out.
    """
    of_body = body_of(points, surface) if how in ("auto", "coarse") else None
    return place_body(points, surface, given, how, scanner, of_body)


def place_body(
    points: Floats, surface: MeshSurface, given: Floats, how: str, scanner: Floats | None, of_body: Bools | None
) -> Placed:
    """Place a scan's points as :func:`place`, those of the structure being known, see :func:`body_of`."""
    axes = principal.of_mesh(surface.vertices, surface.faces)
    few = thinned(points, FINE_POINTS)
    share = near_share(few, surface, given)
    if of_body is not None:
        few_of_body = thinned(points[of_body], FINE_POINTS)
        of_body_share = near_share(few_of_body, surface, given)
        if share < NEAR_SHARE or of_body_share >= share:  # else it is something else beside the structure
            few, share = few_of_body, of_body_share
            points, scanner = points[of_body], None if scanner is None else scanner[of_body]
    registration, rivals, ambiguity = Registration.AS_GIVEN, [], NAN
    if how == "coarse" or (how == "auto" and share < NEAR_SHARE):
        registration = Registration.COARSE
        poses = _attitudes(even(points), surface, axes)
        starts = [T for error, T in poses if error <= PROMISING * poses[0][0]]
        fits = _fits(points, few, surface, axes.axes, starts)
        choice = pose_choice.choose(points, surface, [fit.T_design_scan for fit in fits], scanner)
        start, fitted = starts[choice.best], fits[choice.best]
        if choice.best:
            fitted = fine(few, surface, axes.axes, start)
        rivals = [fits[k].T_design_scan for k in choice.rivals]
        others = [error for k, (error, _) in enumerate(poses) if k != choice.best]
        ambiguity = min(others, default=NAN) / max(poses[choice.best][0], 1e-9)
    else:
        start, registration = given, Registration.FINE if how == "fine" else Registration.AS_GIVEN
        fitted = fine(few, surface, axes.axes, given)
        if how == "auto" and (turned := _surely_turned(points, surface, axes, fitted, scanner)):
            fitted, rivals = turned[0], [fit.T_design_scan for fit in turned[1:]]
            start, registration = fitted.T_design_scan, Registration.COARSE
    determined = np.isfinite(fitted.covariance).all()
    best = fitted.T_design_scan if determined else np.full((4, 4), NAN)
    T = start if registration is Registration.AS_GIVEN or not determined else best
    between = best @ rigid.invert(T) if determined else np.full((4, 4), NAN)
    middle = rigid.apply(T, few.mean(axis=0))
    return Placed(
        T=T,
        registration=registration,
        T_best_fit=best,
        covariance=fitted.covariance,
        ambiguity=ambiguity,
        near_share=share,
        shift=rigid.apply(between, middle) - middle,
        turn=rigid.rotation_angle(between[:3, :3]),
        weak=fitted.weak,
        sigma_mm=fitted.sigma_mm,
        ambiguous=bool(rivals),
        T_rival=rivals[0] if rivals else np.full((4, 4), NAN),
    )


def _fits(points: Floats, few: Floats, surface: MeshSurface, axes: Floats, starts: list[Floats]) -> list[SurfaceFit]:
    """Fit points (n, 3) from the starts (4, 4): ``few`` from the first, of the least error, RIVAL_POINTS from others.

    What the surface does not determine converges slowly, and distinguishes no attitude: RIVAL_ITERATIONS do for these.
    """
    fewer = thinned(points, RIVAL_POINTS)

    def fit(number: int) -> SurfaceFit:
        if number == 0:
            return fine(few, surface, axes, starts[0])
        return fine(fewer, surface, axes, starts[number], RIVAL_ITERATIONS)

    return each(fit, range(len(starts)))


def body_of(points: Floats, surface: MeshSurface) -> Bools | None:
    """Return which points (n, 3) are not of the ground or what stands about the structure; None where all are."""
    return main_body.of_sizes(points, [principal.sizes(surface.samples())])


def near_share(points: Floats, surface: MeshSurface, T: Floats) -> float:
    """Share of points (n, 3), placed by T (4, 4), near the design's surface."""
    nearest, _ = surface.nearest(rigid.apply(T, points), NEAR_MM)
    return float((nearest >= 0).mean())


def fits_design(placed: Placed, points: Floats, surface: MeshSurface) -> bool:
    """Whether points (n, 3), or half of them beside clutter, lie near the surface at the pose that was found."""
    return near_share(thinned(points, FINE_POINTS), surface, placed.T) >= NEAR_SHARE


def is_unproven(reasons: Iterable[Reason]) -> bool:
    """Whether step deviation states that single points scatter as they do at a wrong pose; see :func:`most_scatter`."""
    return any(one.code == "deviation.no-fit" for one in reasons)


def coarse(points: Floats, design: Samples, axes: PrincipalAxes) -> CoarsePose:
    """Register points (n, 3), even in density, from any pose to samples of a design with its principal axes."""
    size = float(np.linalg.norm(np.ptp(design.points, axis=0)))
    return principal.coarse(principal.of_points(points), axes, size, _refined(points, design, size))


def _refined(points: Floats, design: Samples, size: float) -> Callable[[Floats], tuple[float, Floats]]:
    """Return the function that improves a pose (4, 4) of points (n, 3), and returns the rms in mm left with it."""
    tree, boxes = cKDTree(design.points), icp.boxes_of(design.points, design.normals)
    few = thinned(points, COARSE_POINTS)
    gates = tuple(share * size for share in GATE_SHARES)

    def refined(start: Floats) -> tuple[float, Floats]:
        T = icp.point_to_plane(few, boxes, start, gates_mm=gates, max_iterations=COARSE_ITERATIONS).T_target_source
        return _rms(few, design, tree, T, gates[-1]), T

    return refined


def _surely_turned(
    points: Floats, surface: MeshSurface, axes: PrincipalAxes, given: SurfaceFit, scanner: Floats | None
) -> list[SurfaceFit]:
    """Return the fit in another attitude, then its rivals, if surface rules out the ``given`` attitude; else none.

    A scan in the design's frame may lie in it the wrong way round. Points of a plate slip along it, and each fit may
    have slipped differently: the given attitude is ruled out only if it is so with the slip of the other fits, too.
    """
    if not np.isfinite(given.T_design_scan).all():
        return []
    design = _samples(surface)
    refined = _refined(even(points), design, float(np.linalg.norm(np.ptp(design.points, axis=0))))
    turns = _turns(axes, surface)
    (error, _), *others = each(lambda turn: refined(turn @ given.T_design_scan), turns)
    few = thinned(points, RIVAL_POINTS)
    fits, turned_back = [], []
    for turn, (rms, T) in zip(turns[1:], others, strict=True):
        if rms <= PROMISING * error:
            fits.append(fine(few, surface, axes.axes, T))
            turned_back.append(rigid.invert(turn) @ fits[-1].T_design_scan)
    poses = [*(fit.T_design_scan for fit in fits), given.T_design_scan, *turned_back]
    choice = pose_choice.choose(points, surface, poses, scanner)
    if choice.best >= len(fits) or any(rival >= len(fits) for rival in choice.rivals):
        return []
    best = fine(thinned(points, FINE_POINTS), surface, axes.axes, fits[choice.best].T_design_scan)
    return [best, *(fits[rival] for rival in choice.rivals)]


def _samples(surface: MeshSurface) -> Samples:
    spacing = np.sqrt(mesh_distance.area(surface.vertices, surface.faces) / COARSE_SAMPLES)
    return mesh_distance.sampled(surface.vertices, surface.faces, spacing)


def _turns(axes: PrincipalAxes, surface: MeshSurface) -> list[Floats]:
    """Return the motions (4, 4) of a design about onto itself that its principal axes allow, the identity first."""
    square = _along_faces(axes.axes, surface)
    turns = [square @ turn @ square.T for turn in principal.possible_turns(axes.variances, axes.variances)]
    turns.sort(key=rigid.rotation_angle)
    return [rigid.transform(R, axes.centre - R @ axes.centre) for R in turns]


def _along_faces(axes: Floats, surface: MeshSurface) -> Floats:
    """Turn principal ``axes`` (3, 3) to the normals of the faces that look about along them, if most of the area does.

    A part on a plate turns the plate's principal axes by degrees: a half turn about these would tilt the plate.
    """
    weighted, size = mesh_distance.double_areas(surface.vertices, surface.faces)
    found = axes
    for _ in range(FACE_ROUNDS):
        along = weighted @ found
        axis = np.argmax(np.abs(along), axis=1)
        best = along[np.arange(len(axis)), axis]
        near = np.abs(best) > FACE_COS * size
        if size[near].sum() < MOST_AREA * size.sum():
            return axes
        towards = np.sign(best[near])[:, None] * weighted[near]
        found = rigid.nearest_rotation(np.stack([towards[axis[near] == k].sum(axis=0) for k in range(3)], axis=1))
    return found


def _attitudes(points: Floats, surface: MeshSurface, axes: PrincipalAxes) -> list[tuple[float, Floats]]:
    """Return the rms in mm and coarse pose (4, 4) of points (n, 3) in every attitude, the least rms first.

    Attitudes are that of the best pose by principal axes, its rival, and the best turned as the design's principal axes
    allow: the axes of a scan from one side are off, and may not lead to every attitude.
    """
    design = _samples(surface)
    size = float(np.linalg.norm(np.ptp(design.points, axis=0)))
    first = coarse(points, design, axes)
    refined = _refined(points, design, size)
    found = each(lambda turn: refined(turn @ first.T_target_source), _turns(axes, surface))
    found.append((first.rms_mm, first.T_target_source))
    if np.isfinite(first.T_rival).all():
        found.append((first.ambiguity * first.rms_mm, first.T_rival))
    square, centre = _along_faces(axes.axes, surface), points.mean(axis=0)
    distinct = untried = _distinct(found, centre, size)
    for _ in range(SIDE_ROUNDS):  # plates along several axes may lie on their other sides
        least = distinct[0][0]
        promising = [T for error, T in untried if error <= PROMISING * least]
        shifted = each(refined, [start for T in promising for start in _other_sides(points, design.points, square, T)])
        distinct = _distinct([*distinct, *shifted], centre, size)
        untried = [one for one in distinct if any(one is other for other in shifted)]
        if not distinct[0][0] < least:
            break
    return distinct


def _distinct(found: list[tuple[float, Floats]], centre: Floats, size: float) -> list[tuple[float, Floats]]:
    """Return the errors and poses of a body about ``centre`` that are not of one pose, the least error first."""
    distinct: list[tuple[float, Floats]] = []
    for k in sorted(range(len(found)), key=lambda k: (found[k][0], k)):
        T = found[k][1]
        if all(principal.differ(T, other, centre, size) for _, other in distinct):
            distinct.append(found[k])
    return distinct


def _other_sides(points: Floats, design: Floats, axes: Floats, T: Floats) -> list[Floats]:
    """Return poses (4, 4) shifted so that either side of the points (n, 3) lies at that side of the design (m, 3).

    The side of a plate that was scanned alone may have come to lie on the plate's other side.
    """
    placed, designed = rigid.apply(T, points) @ axes, design @ axes
    starts = []
    for k in range(3):
        for side in (np.min, np.max):
            shift = float(side(designed[:, k]) - side(placed[:, k]))
            if LEAST_SHIFT_MM < abs(shift) < NEAR_MM:
                starts.append(rigid.transform(np.eye(3), shift * axes[:, k]) @ T)
    return starts


def even(points: Floats) -> Floats:
    """Thin points (n, 3) to an even density: the dense part near a scanner must not attract the principal axes."""
    widest = float(np.ptp(points, axis=0).max())
    return voxel_means(points, max(widest / EVEN_CELLS, 1e-6))


def _rms(points: Floats, design: Samples, tree: cKDTree, T: Floats, most: float) -> float:
    """Rms distance along the design's normals of points (n, 3) placed by T, each at most ``most``, mm."""
    placed = rigid.apply(T, points)
    distance, index = tree.query(placed, distance_upper_bound=3.0 * most)
    near = np.isfinite(distance)
    r = np.full(len(points), most)
    off = np.einsum("ni,ni->n", placed[near] - design.points[index[near]], design.normals[index[near]])
    r[near] = np.minimum(np.abs(off), most)
    return float(np.sqrt(np.mean(r**2)))


def error_along(covariance: Floats, places: Floats, normals: Floats) -> float:
    """Rms over places (k, 3) of the standard deviation along normals (k, 3) that a pose's covariance causes, mm."""
    variance = variances(distance_derivative(places, normals), covariance)
    return float(np.sqrt(np.mean(variance))) if len(variance) else NAN
