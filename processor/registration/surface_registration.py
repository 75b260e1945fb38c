"""Registration of a scan to the surface of its design: coarse by principal axes, then fine by least squares.

The fine registration needs a pose that is right to a few millimetres; see :mod:`processor.registration.pose_search` for
the search from any pose, and :mod:`processor.registration.pose_choice` for the choice between the attitudes of a nearly
symmetric structure. :func:`place` decides which of these a scan needs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from processor.adjustment import robust_least_squares
from processor.adjustment.body_motions import distance_derivative, transform_about
from processor.geometry import rigid
from processor.geometry.mesh_distance import MeshSurface, on_face
from processor.geometry.thinning import thinned
from processor.geometry.thread_ranges import each
from processor.model import NORMAL_95, Bools, Floats, Ints, Reason, Word
from processor.registration import icp, main_body, pose_choice, pose_search, principal
from processor.registration.pose_search import Candidate, DesignSurface
from processor.robust_statistics import biweight, robust_sd

# --- Fine registration

POINTS, LAST_POINTS = 30_000, 250_000  # work: first run; final pose: 1 um by so many at 0.5 mm noise
MOST_ITERATIONS = 30  # work: at most
CONVERGED_MM = 3e-4  # a step that moves the part by less is the last
SMALL_MM = 0.3  # a step that moves the part by less leaves each point on its facet
NO_FORM = 2.0  # ratio of the cells' mean squares to those of chance, below which a part has no form error of its own
GATES_MM = (60.0, 30.0)  # off the surface: as far as a coarse pose may be off; then, where clutter begins
CUT = 4.5  # standard deviations
FLOOR_MM = 0.01  # least sigma, for scans without noise
LEAST_SHARE = 0.5  # of the points that must lie within the last gate
NO_FIT_MM = (10.0, 4.0)  # sigma above which the scan is not of the design; the second where much clutter is beside it
CLUTTER_SHARE = 0.15  # of points off the surface, from which on much stands beside the part
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


NOWHERE = SurfaceFit(np.full((4, 4), np.nan), np.full((6, 6), np.nan), float("nan"), 0.0)  # no pose


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
            gate = min(max(GATES_MM[1], 6.0 * sigma), GATES_MM[0])
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


# --- Placement: coarse registration where a scan does not lie at its design, and the choice between attitudes

NEAR_MM = 100.0  # of the design's surface
NEAR_SHARE = 0.5  # share of points near the surface from which on a scan lies at its design
FINE_POINTS = 30_000  # work: as many as the first run of a fine fit takes
RIVAL_POINTS = 8_000  # enough to tell attitudes apart: the fit of the one that is chosen uses FINE_POINTS
SYMMETRY_POINTS = 3_000  # of even density, aligned in each attitude that the design's symmetry allows
MOST_REFINED = 24  # work: the attitudes of a box with three like sides; of a scan of something else all are as bad
# What the surface does not determine converges slowly, and distinguishes no attitude.
RIVAL_ITERATIONS = 15
PROMISING = 3.0  # ratio of two poses' misfits after the coarse registration, below which the fine one decides
NAN = float("nan")


class Registration(Word):
    """How a scan was registered to its design."""

    AS_GIVEN = "as given"
    FINE = "fine"
    COARSE = "coarse"


@dataclass(frozen=True)
class Placed:
    """``T`` (4, 4) and ``T_best_fit`` (4, 4) map the scan's local frame to the design's; ``registration`` says how.

    ``covariance`` (6, 6) is that of the best fit. ``ambiguity`` is the ratio of the coarse misfits of the next best
    attitude and this one; the pose is ``ambiguous`` if no surface distinguishes it from ``T_rival``. ``of_body`` (n,)
    marks the points that are not of the ground or what stands about the structure; None where all are used.
    """

    T: Floats
    registration: Registration
    T_best_fit: Floats
    covariance: Floats
    ambiguity: float
    near_share: float
    weak: tuple[Motion, ...]
    T_rival: Floats  # (4, 4) of another attitude that fits as well; NaN without one
    of_body: Bools | None

    @property
    def ambiguous(self) -> bool:
        """Whether another attitude fits as well."""
        return bool(np.isfinite(self.T_rival).all())


def place(points: Floats, surface: MeshSurface, given: Floats, how: str, scanner: Floats | None = None) -> Placed:
    """Place a scan's points (n, 3) at its design from ``given`` (4, 4); ``how``: auto, none, fine or coarse.

    A best fit absorbs whatever a structure moved as a whole. A scan that lies at its design already is therefore left
    where it is by ``auto``, and the best fit is only reported. ``scanner`` (n, 3) is the position that each point was
    measured from, if known: it helps to distinguish attitudes. Ground and what stands about the structure is left out.
    """
    few = thinned(points, FINE_POINTS)
    share = near_share(few, surface, given)
    of_body = main_body.of_sizes(points, [principal.sizes(surface.samples())]) if how in ("auto", "coarse") else None
    if of_body is not None:
        few_of_body = thinned(points[of_body], FINE_POINTS)
        of_body_share = near_share(few_of_body, surface, given)
        if share < NEAR_SHARE or of_body_share >= share:
            few, share = few_of_body, of_body_share
            points, scanner = points[of_body], None if scanner is None else scanner[of_body]
        else:  # it is something else beside the structure
            of_body = None
    axes, rivals, ambiguity = principal.of_mesh(surface.vertices, surface.faces).axes, [], NAN
    start, registration = given, Registration.FINE if how == "fine" else Registration.AS_GIVEN
    if how == "coarse" or (how == "auto" and share < NEAR_SHARE):
        registration, design = Registration.COARSE, pose_search.prepared(surface, is_structure=True)
        candidates = pose_search.search(points, design)
        promising = [c for c in candidates[:MOST_REFINED] if c.misfit <= PROMISING * candidates[0].misfit]
        best, *rivals = decide(points, design, promising, scanner)
        start = best.T
        middle = few.mean(axis=0)
        others = [c.misfit for c in candidates if principal.differ(c.T, best.T, middle, design.size)]
        ambiguity = min(others, default=NAN) / max(best.misfit, 1e-9)
    fitted = fine(few, surface, axes, start)
    if how == "auto" and registration is Registration.AS_GIVEN and np.isfinite(fitted.T_design_scan).all():
        turned = _surely_turned(points, surface, fitted.T_design_scan, scanner)
        if turned:
            start, rivals, registration = turned[0].T, turned[1:], Registration.COARSE
            fitted = fine(few, surface, axes, start)
    determined = np.isfinite(fitted.covariance).all()
    best_fit = fitted.T_design_scan if determined else np.full((4, 4), NAN)
    T = start if registration is Registration.AS_GIVEN or not determined else best_fit
    return Placed(
        T=T,
        registration=registration,
        T_best_fit=best_fit,
        covariance=fitted.covariance,
        ambiguity=ambiguity,
        near_share=share,
        weak=fitted.weak,
        T_rival=rivals[0].T if rivals else np.full((4, 4), NAN),
        of_body=of_body,
    )


def decide(
    points: Floats, design: DesignSurface, candidates: list[Candidate], scanner: Floats | None = None
) -> list[Candidate]:
    """Return the candidate whose own surface points (n, 3) show, then those that they do not rule out.

    Several candidates are refined first: surface that one pose alone has is compared to some millimetres.
    """
    if len(candidates) > 1:
        fewer = thinned(points, RIVAL_POINTS)

        def refined(c: Candidate) -> Candidate:
            return replace(c, T=fine(fewer, design.mesh, design.axes, c.T, RIVAL_ITERATIONS).T_design_scan)

        candidates = pose_search.distinct(each(refined, candidates), pose_search.box_of(points))
    return [candidates[k] for k in pose_choice.choose(points, [(design.mesh, c.T) for c in candidates], scanner)]


def _surely_turned(points: Floats, surface: MeshSurface, given: Floats, scanner: Floats | None) -> list[Candidate]:
    """Return another attitude, then its rivals, if surface rules out the ``given`` (4, 4) attitude; else none.

    A scan in the design's frame may lie in it the wrong way round. Points of a plate slip along it, and each fit may
    have slipped differently: the given attitude is ruled out only if it is so with the slip of the other fits, too.
    """
    design = pose_search.prepared(surface, is_structure=True)
    few, fewer = pose_search.evenly(points, design)[0], thinned(points, RIVAL_POINTS)
    turns = pose_search.symmetries(design)
    kept = thinned(few, SYMMETRY_POINTS)
    first, *others = each(lambda turn: pose_search.align(kept, design, Candidate(turn @ given, given)), turns)
    fits, turned_back = [], []
    for turn, other in zip(turns[1:], others, strict=True):
        if other.misfit <= PROMISING * first.misfit:
            T = fine(fewer, surface, design.axes, other.T).T_design_scan
            fits.append(replace(other, T=T))
            turned_back.append(rigid.invert(turn) @ T)
    poses = [*(fit.T for fit in fits), given, *turned_back]
    best, *rivals = pose_choice.choose(points, [(surface, T) for T in poses], scanner)
    return [] if max(best, *rivals, 0) >= len(fits) else [fits[k] for k in (best, *rivals)]


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
