"""Stitching of the room of ``stitch_clouds``: from a search of poses, or from known ones; and its errors."""

import dataclasses
import itertools
from unittest import mock

import numpy as np
from scipy.spatial.transform import Rotation

from processor.geometry import rigid
from processor.model import Scene
from processor.stitching import automatic
from processor.stitching import step as stitching_step
from processor.stitching.coarse import pairwise
from processor.stitching.params import Params
from tests.support.clouds import stitch_clouds

STEP_MRAD = 28.0  # between rays: the coarsest at which this room is stitched with each of ten seeds
ELSEWHERE = {
    "room": (np.array([-2000.0, -9000.0, 0.0]), np.array([2500.0, 8000.0, 5200.0])),
    "things": ((np.array([-2000.0, 3000.0, 0.0]), np.array([-500.0, 4000.0, 2600.0])),),
}


def stitched(scans, **params):
    return stitching_step.run(Scene("room", "structure", tuple(scans)), Params(**params))


def unsearched(T):
    """Stitch without the search, two thirds of the time: each pair's candidate is its true pose by T (k, 4, 4)."""

    def candidates(patches, *_):
        found = {}
        for a, b in itertools.combinations(range(len(T)), 2):
            refined = pairwise.refine(patches[a], patches[b], rigid.invert(T[a]) @ T[b])[0]
            found[a, b] = [pairwise.score_pose(patches[a], patches[b], refined)]
        return found

    return mock.patch.multiple(automatic, _find_candidates=candidates, DEEP_PAIRS=0)


def adjusted(T, scans):
    """Stitch scans from their true poses by T (k, 4, 4)."""
    with unsearched(T):
        return stitched(scans)


def elsewhere(name, **options):
    """Return a scan of another room."""
    return stitch_clouds.scan(name, stitch_clouds.pose([0.0, 0.0, 1500.0], 0.0), 9, **ELSEWHERE, **options)


def errors(T, true, reference=0):
    """Errors of positions (k, 3), mm, and of rotations (k,), mrad, of poses T relative to the reference's."""
    want = rigid.invert(true[reference]) @ true
    turn = Rotation.from_matrix(T[:, :3, :3] @ np.swapaxes(want[:, :3, :3], 1, 2)).magnitude()
    return T[:, :3, 3] - want[:, :3, 3], 1e3 * turn


def longer(scan, mm):
    """Return a scan whose ranges are longer by ``mm``, a number or one for each point."""
    R = np.linalg.norm(scan.points, axis=1)
    return dataclasses.replace(scan, points=scan.points * (1.0 + mm / R)[:, None])


def reordered(scan, order):
    """Return a scan of the points ``order``, rows or a mask, with their places in its grid."""
    names = [name for name in ("points", "grid_row", "grid_column") if len(getattr(scan, name))]
    return dataclasses.replace(scan, **{name: getattr(scan, name)[order] for name in names})
