"""What whole scans have in common and their data cannot show: the interval of the mean deviation.

A range that is too long moves a surface away from its scanner: of a structure seen from all around, every face moves
inward, which no pose takes up and no difference between stations shows. The class of scanners states how large such
errors are.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from processor.adjustment import scanner_class_errors
from processor.adjustment.body_motions import distance_derivative
from processor.deviation.cloud import ScanCloud
from processor.deviation.local_translation import Movement
from processor.geometry import rigid
from processor.geometry.mesh_distance import Samples
from processor.model import Floats

SAMPLE = 100_000  # points of a scan by which the shares of its stations are found


def mean_sd(scan: ScanCloud, T: Floats, core: Samples, moved: Movement, covariance: Floats, overlap: float) -> float:
    """Return the standard deviation of the mean movement along normals at the core points, mm; NaN without any.

    The scan is placed by T (4, 4), with ``covariance`` (6, 6) about the core points' frame. Each scanned point counts
    at ``overlap`` core points. The sum has the noise of the points, the pose, the error that each station has alone,
    and the offset of ranges that all of them share.
    """
    known = np.flatnonzero(np.isfinite(moved.along))
    if not len(known):
        return float("nan")
    points, normals = core.points[known], core.normals[known]
    noise = overlap * float((moved.sd[known] ** 2 / moved.count[known]).sum()) / len(known) ** 2
    J = distance_derivative(points, normals).mean(axis=0)
    shares = _shares(scan, T, points, normals)
    own = scanner_class_errors.known().view_mm ** 2 * float((shares**2).sum())
    common = scanner_class_errors.known().offset_mm ** 2 * float(shares.sum()) ** 2
    return float(np.sqrt(noise + J @ covariance @ J + own + common))


def _shares(scan: ScanCloud, T: Floats, points: Floats, normals: Floats) -> Floats:
    """Return by how much the mean movement at core points (k, 3) changes with the range of each station, without unit.

    It is the station's share of the points at a core point times the cosine of incidence, on average; where scanners
    are not known, all ranges are taken to be along the normals of one station's faces, which is the most.
    """
    rows = slice(0, len(scan.points), max(1, len(scan.points) // SAMPLE))
    scanner, view = scan.scanner(rows), scan.view[rows]
    if scanner is None:
        return np.ones(1)
    at, seen_from = rigid.apply(T, scan.points[rows]), rigid.apply(T, scanner)
    nearest = cKDTree(points).query(at, workers=-1)[1]
    arm = seen_from - at
    cosine = np.abs(np.einsum("ni,ni->n", arm, normals[nearest])) / np.maximum(np.linalg.norm(arm, axis=1), 1e-9)
    count = np.bincount(nearest, minlength=len(points))
    weight = cosine / count[nearest]
    shares: Floats = np.bincount(view, weight, len(scan.views)) / (count > 0).sum()
    return shares
