"""In which frame a scan is held against its design: as given, by a best fit, or by principal axes and a best fit.

A best fit takes up whatever a structure moved as a whole. So a scan that lies at its design already is left where it
is, and what a best fit would have done is said beside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.deviation import attitude
from processor.deviation.cloud import ScanCloud
from processor.geometry import mesh_distance, principal, rigid, surface_registration
from processor.geometry.mesh_distance import MeshSurface
from processor.geometry.neighbors import thinned, voxel_means
from processor.model import Floats

NEAR_MM = 100.0  # of the design's surface
NEAR_SHARE = 0.5  # of the scan's points: it lies at its design
EVEN_CELLS = 200.0  # voxels along the scan's extent, for points of even density
COARSE_SAMPLES = 40_000
FINE_POINTS = 30_000
NAN = float("nan")


@dataclass(frozen=True)
class Placed:
    """``T`` (4, 4) and ``T_best_fit`` (4, 4) map the scan's local frame to the design's; ``registration`` says how.

    ``covariance`` (6, 6) is the best fit's, ``shift`` (3,) and ``turn`` what it does to the scan's middle against T.
    """

    T: Floats
    registration: str
    T_best_fit: Floats
    covariance: Floats
    ambiguity: float
    near_share: float
    shift: Floats
    turn: float
    weak: tuple[str, ...]
    sigma_mm: float


def place(scan: ScanCloud, surface: MeshSurface, given: Floats, how: str) -> Placed:
    """Place a scan at its design, from ``given`` (4, 4), local frames both; ``how``: auto, none, fine or coarse."""
    axes = principal.of_mesh(surface.vertices, surface.faces)
    few = thinned(scan.points, FINE_POINTS)
    near, _ = surface.tree.query(rigid.apply(given, few), distance_upper_bound=NEAR_MM, workers=-1)
    near_share = float(np.isfinite(near).mean())
    start, ambiguity, done = given, NAN, "as given"
    if how == "coarse" or (how == "auto" and near_share < NEAR_SHARE):
        spacing = np.sqrt(mesh_distance.area(surface.vertices, surface.faces) / COARSE_SAMPLES)
        samples = mesh_distance.sampled(surface.vertices, surface.faces, spacing)
        found = attitude.coarse(even(scan.points), samples, axes)
        start, ambiguity, done = found.T_design_scan, found.ambiguity, "coarse"
    elif how == "fine":
        done = "fine"
    fine = surface_registration.fine(few, surface, axes.axes, start)
    fitted = np.isfinite(fine.covariance).all()
    best = fine.T_bridge_scan if fitted else np.full((4, 4), NAN)
    T = start if done == "as given" or not fitted else best
    middle = few.mean(axis=0)
    between = best @ rigid.invert(T) if fitted else np.full((4, 4), NAN)
    at = rigid.apply(T, middle)
    shift = rigid.apply(between, at) - at
    turn = rigid.rotation_angle(between[:3, :3])
    return Placed(T, done, best, fine.covariance, ambiguity, near_share, shift, turn, fine.weak, fine.sigma_mm)


def even(points: Floats) -> Floats:
    """Thin points (n, 3) to an even density: a scanner's nearest part must not draw the axes to itself."""
    widest = float(np.ptp(points, axis=0).max())
    return voxel_means(points, max(widest / EVEN_CELLS, 1e-6))


def error_along(covariance: Floats, places: Floats, normals: Floats) -> float:
    """Rms (one standard deviation, mm) over places (k, 3) of what a pose's covariance (6, 6) does along normals."""
    J = np.hstack([np.cross(places, normals), normals])
    variance = np.einsum("ki,ij,kj->k", J, covariance, J)
    return float(np.sqrt(max(np.mean(variance), 0.0))) if len(J) else NAN
