"""Motions that lay one part on another of the same shape: by their bottom edges, or by their surfaces without any."""

from __future__ import annotations

import numpy as np

from processor.geometry import box_girder_mesh, mesh_distance, rigid
from processor.model import Floats
from processor.preassembly.parts.attitude import Shapes
from processor.registration import principal

SAMPLES = 1_000  # of the other part's surface
ALIKE_SHARE = 0.97  # of them near this part's surface: marks are smaller


def motions(shapes: Shapes, index: int, other: int) -> list[Floats]:
    """Rigid motions T_part_other (4, 4), no mirror images, that lay part ``other`` on part ``index``; but for marks."""
    part, other_part = shapes.design.parts[index], shapes.design.parts[other]
    edges = [len(one.bottom_edge_left) > 0 for one in (part, other_part)]
    if all(edges):
        return box_girder_mesh.motions(part, other_part)
    return [] if any(edges) else _by_surfaces(shapes, index, other)


def _by_surfaces(shapes: Shapes, index: int, other: int) -> list[Floats]:
    both = [shapes.design.parts[k] for k in (index, other)]
    axes, other_axes = (shapes.axes(k) for k in (index, other))
    sizes, other_sizes = (
        np.ptp(one.vertices @ of.axes, axis=0) for one, of in zip(both, (axes, other_axes), strict=True)
    )
    # A mark may add its height.
    if np.abs(np.sort(sizes) - np.sort(other_sizes)).max() > 3.0 * box_girder_mesh.ALIKE_MM:
        return []
    samples = mesh_distance.spread(both[1].vertices, both[1].faces, lambda _: SAMPLES).points
    surface = shapes[index].mesh
    found: list[Floats] = []
    for turn in principal.turns(((0, 1, 2), (0, 2, 1))):
        R = axes.axes @ turn @ other_axes.axes.T
        T = rigid.transform(R, axes.centre - R @ other_axes.centre)
        _, distance, beyond = surface.distances(rigid.apply(T, samples), 5.0 * box_girder_mesh.ALIKE_MM)
        near = (np.abs(distance) < box_girder_mesh.ALIKE_MM) & (beyond < box_girder_mesh.ALIKE_MM)
        if near.mean() >= ALIKE_SHARE:
            found.append(T)
    return found
