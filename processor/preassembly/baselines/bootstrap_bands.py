"""Bands of the source paper's methods by the parametric bootstrap: their results for parts exactly as designed.

The methods state no uncertainty, and noise is the smallest of their errors: principal axes tilt, boxes miss edges, and
every joint passes its error on. So each scan is repeated with its part as designed: the points are projected onto the
design's surface and get new noise of the same size; density, occlusion and clutter stay. All gaps and departures of
such a bridge are zero, so the method's result is its own error (Efron and Tibshirani, An Introduction to the Bootstrap,
1993, section 6.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from processor.geometry import rigid
from processor.geometry.mesh_distance import MeshSurface
from processor.geometry.thinning import by_cell
from processor.geometry.thread_ranges import each
from processor.model import ArchDesign, Bools, DesignPart, Floats, Ints, Status, reason
from processor.preassembly import assembly_errors
from processor.preassembly.baselines import methods
from processor.preassembly.baselines.methods import PartFeatures
from processor.preassembly.params import Params
from processor.preassembly.parts import attitude
from processor.preassembly.result import Deviations, Result
from processor.registration import surface_registration

CELL_MM = 40.0  # a part's form does not change within a cell
NEAR_MM = 30.0  # largest distance of a part as built from its design
LEAST = 3  # repetitions with an answer, for a band
QUARTILE = 0.6745  # of the normal distribution


@dataclass(frozen=True)
class _AsDesigned:
    """A part's scan: points (n, 3), in its frame, projected on the design where they are ``near`` (n,), their noise."""

    part: PartFeatures
    points: Floats
    near: Bools
    sigma_mm: float
    T_bridge_scan: Floats


def repeat_scans(parts: list[PartFeatures], design: ArchDesign, params: Params) -> list[list[PartFeatures]]:
    """Repeat the scans ``params.repetitions`` times with the parts as designed; return the features of each repetition.

    They are the same for every method.
    """
    if params.repetitions < LEAST:
        return []
    as_designed = [_as_designed(part, design_part) for part, design_part in zip(parts, design.parts, strict=True)]

    def repeat(turn: int) -> list[PartFeatures]:
        return [_repeated(part, i, turn, design, params) for i, part in enumerate(as_designed)]

    return each(repeat, range(params.repetitions))


def with_bands(result: Result, repeated: list[list[PartFeatures]], design: ArchDesign, params: Params) -> Result:
    """Add bands to the result of a method: its errors in the ``repeated`` scans of parts as designed.

    NaN where too few of the repetitions have an answer; unchanged without repetitions.
    """
    if not repeated:
        return result
    assemblies = [methods.place(parts, design, params) for parts in repeated]
    linear = [assembly.linear for assembly in assemblies]
    best_fit = [assembly.best_fit for assembly in assemblies]
    splicing = np.array([assembly_errors.splicing_error(assembly.gaps) for assembly in assemblies])
    return replace(
        result,
        reasons=(reason("preassemble.bands-as-designed"), reason("preassemble.inner-edges")),
        splicing=replace(result.splicing, ci95=bound(splicing[:, :, None])),
        linear=replace(
            result.linear,
            assembled=_with_band(result.linear.assembled, linear),
            best_fit=_with_band(result.linear.best_fit, best_fit),
        ),
    )


def _with_band(deviations: Deviations, repeated: list[assembly_errors.LinearError]) -> Deviations:
    figures = np.array([(error.mean, error.max) for error in repeated])
    band = bound(np.array([error.vector for error in repeated]))
    return replace(
        deviations,
        error=replace(deviations.error, ci95=bound(figures[:, :, None])),
        ci95=np.where(np.isfinite(deviations.deviation), band, np.nan),
    )


def bound(vectors: Floats) -> Floats:
    """Bound (n,) on the length of one further vector, with 95 %, by k draws of n vectors: (k, n, m).

    It is the length of the mean of the draws plus the prediction interval by Student's distribution. NaN with too few
    draws.
    """
    known: Bools = np.logical_and.reduce(np.isfinite(vectors), axis=2)
    given = np.where(known[:, :, None], vectors, 0.0)
    count = np.maximum(known.sum(axis=0), 2)
    mean = given.sum(axis=0) / count[:, None]
    square = (given**2).sum(axis=(0, 2)) - count * (mean**2).sum(axis=1)
    sd = np.sqrt(np.maximum(square, 0.0) / (count - 1) * (1.0 + 1.0 / count))
    length: Floats = np.linalg.norm(mean, axis=1) + stdtrit(count - 1, 0.975) * sd
    length[known.sum(axis=0) < LEAST] = np.nan
    return length


def _as_designed(part: PartFeatures, design: DesignPart) -> _AsDesigned:
    """Project the points near the design onto it; unchanged where the part's pose is not known."""
    points = by_cell(part.scan.points, CELL_MM).points
    unchanged = _AsDesigned(part, points, np.zeros(len(points), bool), 0.0, part.attitude.T_surface)
    if part.attitude.status == Status.FAILED:
        return unchanged
    shape = attitude.sample_surface(design)
    fitted = surface_registration.fine(points, shape.mesh, shape.axes, part.attitude.T_surface)
    if not surface_registration.fits(fitted):
        return unchanged
    on_design = rigid.apply(fitted.T_design_scan, points)
    face, residual, _ = shape.mesh.distances(on_design, NEAR_MM + surface_registration.GATES_MM[0])
    rows = np.flatnonzero((face >= 0) & (np.abs(residual) < NEAR_MM))
    foot = _nearest(shape.mesh, on_design[rows], face[rows])
    projected: Bools = np.linalg.norm(foot - on_design[rows], axis=1) < NEAR_MM
    on_design[rows[projected]] = foot[projected]
    near = np.zeros(len(points), bool)
    near[rows[projected]] = True
    # Neighbours share the part's form; their differences are noise.
    sigma = float(np.median(np.abs(np.diff(residual[near])))) / (QUARTILE * np.sqrt(2.0)) if near.sum() > 1 else 0.0
    in_scan = rigid.apply(rigid.invert(fitted.T_design_scan), on_design)
    return _AsDesigned(part, in_scan, near, sigma, fitted.T_design_scan)


def _nearest(mesh: MeshSurface, points: Floats, face: Ints) -> Floats:
    """Nearest point (n, 3) of each point's facet: a part longer than designed ends where the design does."""
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


def _repeated(scanned: _AsDesigned, index: int, turn: int, design: ArchDesign, params: Params) -> PartFeatures:
    """Extract the features of one repetition, with a new attitude by principal axes."""
    points = scanned.points.copy()
    rng = methods.generator(params, f"repetition {turn} of {scanned.part.name}")
    points[scanned.near] += scanned.sigma_mm * rng.normal(size=(int(scanned.near.sum()), 3))
    before = rigid.apply(scanned.part.attitude.T_principal, points[::100])
    hypotheses = attitude.principal_hypotheses(points, design.parts[index])
    T = min(hypotheses, key=lambda T: float(np.linalg.norm(rigid.apply(T, points[::100]) - before)))
    pose = replace(scanned.part.attitude, T_principal=T, T_surface=scanned.T_bridge_scan)
    features = methods.features_of(replace(scanned.part.scan, points=points), index, pose, design, params)
    return replace(features, scan=scanned.part.scan)  # without the new points, which are not needed any more
