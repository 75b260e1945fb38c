"""Errors of registered stations in the axes and radii of tubes, which the fit of a tube by itself does not contain.

Of the points that a station sees of a tube, the share is taken to fall with the square of its distance, and around the
tube with the cosine of incidence.
"""

from __future__ import annotations

import numpy as np

from processor import large_arrays
from processor.model import Floats
from processor.space_frame.members.records import Members
from processor.space_frame.stations.records import Stations, moved_by_offset

SECTORS = 36  # around a tube
MEMBERS = 1024  # at once: all sectors of tens of thousands, for all stations, would take a gigabyte


def of_axes(members: Members, stations: Stations, along: Floats) -> Floats:
    """Covariances (m, 2, 2), along side and other, of the axes at ``along`` (m,) from the middles of tubes; mm^2.

    They include the motion and the offset of ranges that all stations have in common.
    """
    places = members.points + along[:, None] * members.directions
    nearness = 1.0 / np.maximum(np.sum((places[:, None] - stations.places) ** 2, axis=2), 1e-300)
    share = nearness / nearness.sum(axis=1, keepdims=True)
    offset = stations.shared_offset_sd * moved_by_offset(places, stations.places)
    covariance = stations.effect(places, share) + offset[:, :, None] * offset[:, None]
    basis = np.stack([members.side, members.other], axis=2)
    return np.asarray(np.swapaxes(basis, 1, 2) @ covariance @ basis, np.float64)


def of_radii(members: Members, stations: Stations) -> Floats:
    """Variances (m,) of the radii by the offset that all ranges have in common, mm^2.

    An offset d moves a point by d times the cosine of incidence. The offset estimated from the tubes is not subtracted
    from the ranges, because a wide beam has the same effect: its size counts as a standard deviation.
    """
    turn = 2.0 * np.pi * np.arange(SECTORS) / SECTORS
    across = np.column_stack([np.cos(turn), np.sin(turn)])
    by_unit, basis = np.empty(len(members.points)), np.stack([members.side, members.other], axis=1)
    for rows in large_arrays.blocks(len(by_unit), MEMBERS):
        by_unit[rows] = _by_unit(members.points[rows], basis[rows], across, stations.places)
    return (stations.shared_offset_sd**2 + stations.shared_offset**2) * by_unit**2


def _by_unit(points: Floats, basis: Floats, across: Floats, places: Floats) -> Floats:
    """Return by how much radii (m,) change where all ranges are 1 mm too long.

    ``basis`` (m, 2, 3) is across the tubes, which scanners at ``places`` (s, 3) see in directions ``across`` (n, 2).
    """
    normals = across[:, :1] * basis[:, None, 0] + across[:, 1:] * basis[:, None, 1]  # (m, n, 3)
    ray = places - points[:, None]
    squared = np.maximum(np.sum(ray**2, axis=2), 1e-300)
    cosine = np.maximum(np.einsum("mni,msi->mns", normals, ray / np.sqrt(squared)[:, :, None]), 0.0)
    weight = cosine / squared[:, None]  # (m, n, s)
    seen = weight.sum(axis=2)
    moved = np.sum(weight * cosine, axis=2) / np.where(seen > 0.0, seen, 1.0)
    J = np.column_stack([across, np.ones(SECTORS)])
    normal = np.einsum("mn,ni,nj->mij", seen, J, J)
    right = np.einsum("mn,ni,mn->mi", seen, J, moved)
    change: Floats = np.einsum("mij,mj->mi", np.linalg.pinv(normal, rcond=1e-6, hermitian=True), right)[:, 2]
    return change
