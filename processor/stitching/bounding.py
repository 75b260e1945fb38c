"""Ends of one scan's faces held against the faces of others that bound them."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from processor.model import Floats
from processor.stitching import octree
from processor.stitching.clouds import Cloud
from processor.stitching.joint import Blocks

BEHIND_COS = -0.03  # a face looks away from the scanner
ACROSS_COS = 0.5  # of the way from ray to ray, to the face's normal
SQUARE_COS = 0.85  # the two faces meet at an angle
NEIGHBOURS = 12
REACH = 1.9  # of a piece: its half width by its standard deviation, with a little to spare
LEAST_MM = 1.0  # standard deviation of an end, however close the rays
INSIDE = 0.55  # of the width between two rays
MOST_NODES_MM = 4000.0


def bounded(clouds: list[Cloud], blocks: Blocks, T: Floats, gate_mm: float) -> Blocks:
    """Add the ends of faces to the pieces that bound them, as blocks of kind 1.

    A piece bounds an end where it looks away from the end's scanner, stands across, and passes within ``gate_mm`` of
    where the two rays leave room.
    """
    if not blocks.pieces:
        return blocks
    world = octree.moved(blocks.sums, T[blocks.scan])
    planes = octree.planes_of(octree.summed(world, blocks.piece, blocks.pieces))
    # A piece looks at the scanners that saw it; all of a piece see the same side.
    first = np.unique(blocks.piece, return_index=True)[1]
    towards = np.einsum("ni,ni->n", planes.normal, T[blocks.scan[first], :3, 3] - planes.mean)
    normal = planes.normal * np.where(towards < 0.0, -1.0, 1.0)[:, None]
    half = REACH * np.sqrt(planes.variance[:, 1:]) + 2.0 * clouds[0].cell_mm
    added: list[tuple[Floats, Floats, Floats, Floats]] = []
    for s, cloud in enumerate(clouds):
        if not len(cloud.ends.points) or not np.isfinite(T[s]).all():
            continue
        look = T[s, :3, 3] - planes.mean
        away = np.flatnonzero(np.einsum("ni,ni->n", look, normal) < BEHIND_COS * np.linalg.norm(look, axis=1))
        if not len(away):
            continue
        points = cloud.ends.points @ T[s, :3, :3].T + T[s, :3, 3]
        across = cloud.ends.across @ T[s, :3, :3].T
        faces = cloud.ends.normals @ T[s, :3, :3].T
        k = min(NEIGHBOURS, len(away))
        distance, index = cKDTree(planes.mean[away]).query(points, k=k, distance_upper_bound=MOST_NODES_MM)
        distance, index = distance.reshape(len(points), k), index.reshape(len(points), k)
        q = away[np.minimum(index, len(away) - 1)]
        y = points[:, None] - planes.mean[q]
        off = np.einsum("nki,nki->nk", y, normal[q])
        width = np.einsum("ni,nki->nk", across, normal[q])
        length = np.linalg.norm(across, axis=1)[:, None]
        fits = (
            np.isfinite(distance)
            & (np.abs(off) < INSIDE * width + gate_mm)
            & (width > ACROSS_COS * length)
            & (np.abs(np.einsum("ni,nki->nk", faces, normal[q])) < SQUARE_COS)
            & (np.abs(np.einsum("nki,nki->nk", y, planes.axes[q, :, 1])) < half[q, 0])
            & (np.abs(np.einsum("nki,nki->nk", y, planes.axes[q, :, 2])) < half[q, 1])
        )
        cost = np.where(fits, np.abs(off), np.inf)
        best = np.argmin(cost, axis=1)
        rows = np.flatnonzero(np.isfinite(cost[np.arange(len(cost)), best]))
        if not len(rows):
            continue
        piece, wide = q[rows, best[rows]], width[rows, best[rows]]
        weight = 1.0 / (wide**2 / 12.0 + LEAST_MM**2)
        own, inverse = np.unique(piece, return_inverse=True)
        inverse = inverse.ravel()
        sums = octree.summed(octree.sums_of(cloud.ends.points[rows]) * weight[:, None], inverse, len(own))
        added.append((own, np.full(len(own), s), sums, np.bincount(inverse).astype(float)))
    if not added:
        return blocks
    piece = np.concatenate([blocks.piece, *(one[0] for one in added)])
    order = np.argsort(piece, kind="stable")
    return Blocks(
        piece[order],
        np.concatenate([blocks.scan, *(one[1] for one in added)])[order],
        np.vstack([blocks.sums, *(one[2] for one in added)])[order],
        np.concatenate([blocks.count, *(one[3] for one in added)])[order],
        np.concatenate([blocks.kind, np.ones(len(piece) - len(blocks.piece), np.int64)])[order],
        blocks.pieces,
    )
