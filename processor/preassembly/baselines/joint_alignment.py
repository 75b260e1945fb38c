"""Alignment of one part's feature points: point feature histograms for a coarse pose, then iterative closest point.

Source: paper 000. ``line`` aligns the points of the joint's edges (its W2), ``design-aided`` (W3) aligns them together
with the bottom edges, with the design's as their target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processor import diagnostics
from processor.geometry import rigid
from processor.geometry.lines_and_polylines import Polyline
from processor.geometry.thinning import voxel_means
from processor.model import Floats, Reason, reason
from processor.preassembly.params import MatchParams
from processor.registration import icp, pfh


@dataclass(frozen=True)
class Alignment:
    """The pose of a part in the bridge's frame, and remarks on the alignment."""

    T_bridge_scan: Floats
    reasons: tuple[Reason, ...] = ()


def by_lines(
    source: Floats,
    target: Floats,
    lines: Sequence[Polyline],
    start: Floats,
    params: MatchParams,
    rng: np.random.Generator,
) -> Alignment:
    """Align feature points source (n, 3), scan's frame, to target (m, 3) and the ``lines`` it is of, bridge's frame.

    ``start`` (4, 4) is the attitude from the principal axes. The coarse pose from histograms is sought near it: the
    ring of a joint's edges lies on itself when turned over, with a perfect score.
    """
    coarse, reasons = _coarse(source, target, start, params, rng)
    fine = icp.point_to_lines(
        source,
        lines,
        coarse,
        max_distance_mm=params.icp_max_distance_mm,
        max_iterations=params.icp_iterations,
        tolerance=params.icp_tolerance,
    )
    share = fine.paired_share
    diagnostics.note("iterative closest point", rounds=fine.iterations, rms_mm=fine.rms, paired_share=share)
    with diagnostics.placed(np.eye(4), "bridge"):
        diagnostics.keep("fused target", target)
        diagnostics.keep("fused source", lambda: rigid.apply(fine.T_target_source, source))
    return Alignment(fine.T_target_source, reasons)


def _coarse(
    source: Floats, target: Floats, start: Floats, params: MatchParams, rng: np.random.Generator
) -> tuple[Floats, tuple[Reason, ...]]:
    """Return the coarse pose, and why it is not the one from histograms."""
    thin_source = voxel_means(source, params.pfh_voxel_mm)
    thin_target = voxel_means(target, params.pfh_voxel_mm)
    diagnostics.note("fused features", source_points=len(source), target_points=len(target))
    if min(len(thin_source), len(thin_target)) < 4:
        return start, (reason("preassemble.few-feature-points"),)
    histograms = [
        pfh.histograms(cloud, pfh.normals(cloud, params.pfh_radius_mm), params.pfh_radius_mm, params.pfh_bins)
        for cloud in (thin_source, thin_target)
    ]
    T = pfh.coarse_alignment(
        thin_source,
        thin_target,
        *histograms,
        tolerance_mm=params.pfh_tolerance_mm,
        iterations=params.pfh_iterations,
        rng=rng,
        prior=pfh.Prior(start, params.pfh_limit_deg, params.pfh_limit_mm),
    )
    if T is None:
        return start, (reason("preassemble.no-coarse-pose", degrees=params.pfh_limit_deg, shift=params.pfh_limit_mm),)
    return T, ()
