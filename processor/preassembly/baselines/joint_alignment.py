"""Placing one part against the parts before it: by corners, by joint lines, or by joint and design lines together.

Source: paper 000. ``corner`` pairs four corners (its W1), ``line`` aligns the joint's edge points (W2), and
``design-aided`` aligns them together with the bottom edges, which are held against the design's (W3): point feature
histograms for a coarse pose, then iterative closest point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry import icp, pfh, rigid
from processor.geometry.neighbors import voxel_means
from processor.model import Floats


@dataclass(frozen=True)
class MatchParams:
    """Parameters of the registration (mm); PFH with 5 bins and ICP as in the paper."""

    pfh_bins: int = 5
    pfh_voxel_mm: float = 100.0  # features are thinned to this before the histograms
    pfh_radius_mm: float = 500.0
    pfh_tolerance_mm: float = 100.0
    pfh_iterations: int = 2000
    pfh_limit_deg: float = 15.0  # a coarse pose turned farther from the principal axes' attitude is not believed
    pfh_limit_mm: float = 500.0  # nor one that moves a feature point farther from where joint and attitude put it
    icp_max_distance_mm: float = 200.0
    icp_iterations: int = 200
    icp_tolerance: float = 1e-7


@dataclass(frozen=True)
class Placement:
    """The pose of a part in the bridge's frame, and what the coarse alignment had to say."""

    T_bridge_scan: Floats
    message: str


def by_lines(source: Floats, target: Floats, start: Floats, params: MatchParams, rng: np.random.Generator) -> Placement:
    """Align feature points source (n, 3), scan's frame, to target (m, 3), bridge's frame.

    ``start`` (4, 4) is the attitude from the principal axes. The coarse pose from histograms is used only where it
    keeps to that attitude: on straight lines it is often turned over with a perfect score.
    """
    coarse, message = _coarse(source, target, start, params, rng)
    fine = icp.point_to_point(
        source,
        target,
        coarse,
        max_distance_mm=params.icp_max_distance_mm,
        max_iterations=params.icp_iterations,
        tolerance=params.icp_tolerance,
    )
    return Placement(fine.T_target_source, message)


def _coarse(
    source: Floats, target: Floats, start: Floats, params: MatchParams, rng: np.random.Generator
) -> tuple[Floats, str]:
    thin_source = voxel_means(source, params.pfh_voxel_mm)
    thin_target = voxel_means(target, params.pfh_voxel_mm)
    if min(len(thin_source), len(thin_target)) < 4:
        return start, "too few feature points for histograms"
    described = [
        pfh.histograms(cloud, pfh.normals(cloud, params.pfh_radius_mm), params.pfh_radius_mm, params.pfh_bins)
        for cloud in (thin_source, thin_target)
    ]
    T = pfh.coarse_alignment(
        thin_source,
        thin_target,
        *described,
        tolerance_mm=params.pfh_tolerance_mm,
        iterations=params.pfh_iterations,
        rng=rng,
    )
    turn = np.degrees(rigid.rotation_angle(T[:3, :3] @ start[:3, :3].T))
    if turn > params.pfh_limit_deg:
        return start, f"coarse pose from histograms not believed: turned by {turn:.0f} deg from the principal axes"
    moved = float(np.linalg.norm(rigid.apply(T, thin_source) - rigid.apply(start, thin_source), axis=1).max())
    if moved > params.pfh_limit_mm:
        return start, f"coarse pose from histograms not believed: {moved:.0f} mm from where the joint puts the part"
    return T, ""
