"""What the source paper's methods make of parts that are exactly as designed: the band of their own error.

The methods state no uncertainty, and noise is the least of their errors: principal axes tilt, boxes miss edges, and
every joint hands its error on. So each scan is repeated with its part as designed: the points are laid on the design's
surface and given new noise as large as theirs; density, shadows, and what lies beside the part stay. Of a bridge of
such scans all gaps and departures are nothing, and what a method finds is its own doing (the parametric bootstrap:
Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section 6.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.stats import t as student

from processor.geometry import rigid, surface_registration
from processor.geometry.mesh_distance import MeshSurface
from processor.geometry.neighbors import by_cell
from processor.geometry.parallel import each
from processor.model import ArchDesign, DesignPart, Floats, Ints
from processor.preassembly import errors
from processor.preassembly.baselines import methods
from processor.preassembly.params import Params
from processor.preassembly.parts import attitude
from processor.preassembly.result import Result

Bools = npt.NDArray[np.bool_]

CELL_MM = 40.0  # within which a part's form does not show
NEAR_MM = 30.0  # of the design: so far a part as built may lie off it
LEAST = 3  # repetitions that must have an answer, for a band
QUARTILE = 0.6745  # of the normal distribution


@dataclass(frozen=True)
class _AsDesigned:
    """A part's scan: points (n, 3), in its frame, laid on the design where they are ``near`` (n,), and their noise."""

    part: methods.Part
    points: Floats
    near: Bools
    sigma_mm: float
    T_bridge_scan: Floats


def scanned_again(parts: list[methods.Part], design: ArchDesign, params: Params) -> list[list[methods.Part]]:
    """Scan parts as designed, ``params.repetitions`` times, as the given ones were scanned; their features each time.

    They are the same for every method.
    """
    if params.repetitions < LEAST:
        return []
    exact = [_as_designed(part, own) for part, own in zip(parts, design.parts, strict=True)]

    def again(turn: int) -> list[methods.Part]:
        return [_repeated(one, i, turn, design, params) for i, one in enumerate(exact)]

    return each(again, range(params.repetitions))


def with_bands(result: Result, repeated: list[list[methods.Part]], design: ArchDesign, params: Params) -> Result:
    """Add to what a method says how far it errs by itself: what it says of parts as designed, ``repeated``.

    NaN where too few of the repetitions have an answer; unchanged without any.
    """
    if not repeated:
        return result
    found = [methods.place(parts, design, params) for parts in repeated]
    figures = [
        (*errors.splicing_error(one.gaps), one.linear.mean, one.linear.max, one.best_fit.mean, one.best_fit.max)
        for one in found
    ]
    return replace(
        result,
        message=f"bands are what this method makes of parts as designed; {methods.INNER_EDGES}",
        linear_ci95=bound(np.array([one.linear.vector for one in found])),
        best_fit_linear_ci95=bound(np.array([one.best_fit.vector for one in found])),
        errors_ci95=bound(np.array(figures)[:, :, None]),
    )


def bound(vectors: Floats) -> Floats:
    """Return what one more of vectors (k, n, m), each of n by itself, exceeds in length in 5 % of cases at most: (n,).

    It is the length of their mean, and how far from it one may lie by Student's distribution.
    """
    known: Bools = np.logical_and.reduce(np.isfinite(vectors), axis=2)
    given = np.where(known[:, :, None], vectors, 0.0)
    count = np.maximum(known.sum(axis=0), 2)
    mean = given.sum(axis=0) / count[:, None]
    square = (given**2).sum(axis=(0, 2)) - count * (mean**2).sum(axis=1)
    sd = np.sqrt(np.maximum(square, 0.0) / (count - 1) * (1.0 + 1.0 / count))
    found: Floats = np.linalg.norm(mean, axis=1) + student.ppf(0.975, count - 1) * sd
    found[known.sum(axis=0) < LEAST] = np.nan
    return found


def _as_designed(part: methods.Part, design: DesignPart) -> _AsDesigned:
    """Lay what is near the design on it; where the part was not found, all stays as it is."""
    points = part.scan.points[by_cell(part.scan.points, CELL_MM)]
    as_is = _AsDesigned(part, points, np.zeros(len(points), bool), 0.0, part.attitude.T_surface)
    if part.attitude.status == "failed":
        return as_is
    shape = attitude.sample_surface(design)
    fitted = surface_registration.fine(points, shape.mesh, shape.axes, part.attitude.T_surface)
    if not surface_registration.fits(fitted):
        return as_is
    moved = rigid.apply(fitted.T_bridge_scan, points)
    face, residual, _ = shape.mesh.distances(moved, NEAR_MM + surface_registration.GATES_MM[0])
    some = np.flatnonzero((face >= 0) & (np.abs(residual) < NEAR_MM))
    foot = _nearest(shape.mesh, moved[some], face[some])
    on_it: Bools = np.linalg.norm(foot - moved[some], axis=1) < NEAR_MM
    laid = moved.copy()
    laid[some[on_it]] = foot[on_it]
    near = np.zeros(len(points), bool)
    near[some[on_it]] = True
    # Neighbours share the part's form; what is left between them is noise.
    sigma = float(np.median(np.abs(np.diff(residual[near])))) / (QUARTILE * np.sqrt(2.0)) if near.sum() > 1 else 0.0
    return _AsDesigned(part, rigid.apply(rigid.invert(fitted.T_bridge_scan), laid), near, sigma, fitted.T_bridge_scan)


def _nearest(mesh: MeshSurface, points: Floats, face: Ints) -> Floats:
    """Return the nearest (n, 3) of each point's facet: a part longer than designed ends where the design does."""
    corners = mesh.vertices[mesh.faces[face]]
    share = mesh.barycentric(points, face)
    foot: Floats = np.einsum("nk,nki->ni", share, corners)
    outside = np.flatnonzero((share < 0.0).any(axis=1))
    nearest = np.full(len(outside), np.inf)
    for k in range(3):
        a, b = corners[outside, k], corners[outside, k - 1]
        t = np.einsum("ni,ni->n", points[outside] - a, b - a) / np.einsum("ni,ni->n", b - a, b - a)
        on_side = a + np.clip(t, 0.0, 1.0)[:, None] * (b - a)
        distance = np.linalg.norm(on_side - points[outside], axis=1)
        nearer = distance < nearest
        nearest[nearer] = distance[nearer]
        foot[outside[nearer]] = on_side[nearer]
    return foot


def _repeated(one: _AsDesigned, index: int, turn: int, design: ArchDesign, params: Params) -> methods.Part:
    """Scan the part once more, its attitude by principal axes found anew, and take its features."""
    points = one.points.copy()
    rng = methods.generator(params, f"repetition {turn} of {one.part.name}")
    points[one.near] += one.sigma_mm * rng.normal(size=(int(one.near.sum()), 3))
    T_before = one.part.attitude.T_principal
    hypotheses = attitude.principal_hypotheses(points, design.parts[index])
    T = min(
        hypotheses,
        key=lambda T: float(np.linalg.norm(rigid.apply(T, points[::100]) - rigid.apply(T_before, points[::100]))),
    )
    found = replace(one.part.attitude, T_principal=T, T_surface=one.T_bridge_scan)
    features = methods.features_of(replace(one.part.scan, points=points), index, found, design, params)
    return replace(features, scan=one.part.scan)  # the points are not needed any more
