"""Placement of a scan at its design, and the scans of it that do not lie there: those in another frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.deviation.cloud import ScanCloud
from processor.geometry import mesh_distance, rigid
from processor.geometry.mesh_distance import MeshSurface
from processor.geometry.thinning import thinned
from processor.model import Floats, Ints
from processor.registration import surface_registration
from processor.registration.surface_registration import NEAR_MM, NEAR_SHARE, Placed

# Points in another frame lie as often from NEAR_MM to twice as far from the design's surface as nearer to it; points of
# the structure lie nearer. The limit is half way between these shares.
AT_DESIGN = 0.75
FEWEST_SHARE, FEWEST_POINTS = 0.01, 20  # of a scan's points within twice NEAR_MM: fewer are there by chance
SAMPLE = 20_000  # points of a view: a share of them is known to 0.4 %
MOST_TRIALS = 6  # scans that are placed one by one, if all together do not lie at the design


@dataclass(frozen=True)
class Placement:
    """A scan without what was left out of it, its pose, and whether anything of it lies at the design there.

    ``left_out`` are the names of the scans and stations that do not lie at the design, and their numbers of points.
    """

    scan: ScanCloud
    placed: Placed
    left_out: tuple[tuple[str, int], ...]
    lies: bool


def place(scan: ScanCloud, surface: MeshSurface, given: Floats, how: str) -> Placement:
    """Place a scan at its design from ``given`` (4, 4), by the views of it that lie there; the others are left out.

    If none lies there, the scan is placed as a whole, and nothing is left out.
    """
    everything = np.flatnonzero(np.bincount(scan.view, minlength=len(scan.views)) > 0)
    used = everything
    if how == "auto" and len(everything) > 1:
        lying = [view for view in everything.tolist() if _near(scan, view, surface, given)[0] >= NEAR_SHARE]
        used = np.array(lying or everything)
    placed = _placed(scan, used, surface, given, how)
    count = np.bincount(scan.view, minlength=len(scan.views))
    at_design = _at_design(scan, everything, surface, placed.T)
    if len(everything) > 1 and how != "none" and not np.isin(used, at_design).all():
        # A scan in another frame moves the pose of the others: it is found again without it, or by one scan.
        largest = everything[np.argsort(-count[everything], kind="stable")][:MOST_TRIALS]
        for start in [at_design] if len(at_design) else largest[:, None]:
            other = _placed(scan, start, surface, given, how)
            others = _at_design(scan, everything, surface, other.T)
            if not len(at_design) or count[others].sum() > count[at_design].sum() or np.array_equal(others, at_design):
                placed, at_design = other, others
    lies = bool(len(at_design)) or surface_registration.fits_design(placed, scan.points, surface)
    if not len(at_design) or len(at_design) == len(everything):
        return Placement(scan, placed, (), lies)
    left_out = tuple((scan.views[k], int(count[k])) for k in everything if k not in at_design)
    return Placement(scan.of(at_design), placed, left_out, lies)


def _placed(scan: ScanCloud, numbers: Ints, surface: MeshSurface, given: Floats, how: str) -> Placed:
    few = scan.of(numbers)
    return surface_registration.place(few.points, surface, given, how, few.scanner(slice(None)))


def _at_design(scan: ScanCloud, numbers: Ints, surface: MeshSurface, T: Floats) -> Ints:
    """Return the views that lie at the design if the scan is placed by T (4, 4)."""
    lying = []
    for view in numbers.tolist():
        near, about, count = _near(scan, view, surface, T)
        enough = about >= FEWEST_SHARE and about * count >= FEWEST_POINTS
        if enough and near >= AT_DESIGN * about:
            lying.append(view)
    return np.array(lying, np.int64)


def _near(scan: ScanCloud, view: int, surface: MeshSurface, T: Floats) -> tuple[float, float, int]:
    """Return the shares of a view's points within NEAR_MM and twice NEAR_MM of the design, and the sample's size."""
    points = thinned(scan.points[scan.view[: len(scan.points)] == view], SAMPLE)
    if not len(points):
        return 0.0, 0.0, 0
    face, distance, beyond = surface.distances(rigid.apply(T, points), 2.0 * NEAR_MM)
    off = np.abs(distance[mesh_distance.on_face(face, beyond)])
    return float((off <= NEAR_MM).sum()) / len(points), float((off <= 2.0 * NEAR_MM).sum()) / len(points), len(points)
