"""Motions that lay one part on another of the same shape: by their bottom edges, or by their surfaces without any."""

from __future__ import annotations

import numpy as np

from processor.geometry import box_girder_mesh, mesh_distance, rigid
from processor.model import DesignPart, Floats
from processor.registration import principal

SAMPLES = 1_000  # of the other part's surface
ALIKE_SHARE = 0.97  # of them near this part's surface: marks are smaller


def motions(part: DesignPart, other: DesignPart) -> list[Floats]:
    """Rigid motions T_part_other (4, 4), no mirror images, that lay the other part on this one but for small marks."""
    edges = [len(one.bottom_edge_left) > 0 for one in (part, other)]
    if all(edges):
        return box_girder_mesh.motions(part, other)
    return [] if any(edges) else _by_surfaces(part, other)


def _by_surfaces(part: DesignPart, other: DesignPart) -> list[Floats]:
    axes, other_axes = (principal.of_mesh(one.vertices, one.faces) for one in (part, other))
    sizes, other_sizes = (np.ptp(one.vertices @ of.axes, axis=0) for one, of in ((part, axes), (other, other_axes)))
    if (
        np.abs(np.sort(sizes) - np.sort(other_sizes)).max() > 3.0 * box_girder_mesh.ALIKE_MM
    ):  # a mark may add its height
        return []
    samples = mesh_distance.spread(other.vertices, other.faces, lambda _: SAMPLES).points
    surface = mesh_distance.of_mesh(part.vertices, part.faces)
    found: list[Floats] = []
    for turn in principal.turns(((0, 1, 2), (0, 2, 1))):
        R = axes.axes @ turn @ other_axes.axes.T
        T = rigid.transform(R, axes.centre - R @ other_axes.centre)
        _, distance, beyond = surface.distances(rigid.apply(T, samples), 5.0 * box_girder_mesh.ALIKE_MM)
        near = (np.abs(distance) < box_girder_mesh.ALIKE_MM) & (beyond < box_girder_mesh.ALIKE_MM)
        if near.mean() >= ALIKE_SHARE:
            found.append(T)
    return found
