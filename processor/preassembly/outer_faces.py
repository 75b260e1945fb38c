"""The outer faces of a part, those that its corners and bottom edges lie on, apart from the walls' inner sides.

A face that was built a plate's thickness further in lies where the design has the plate's inner side. So it is held
against the design's outer face, whatever is nearest to its points.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processor.geometry import rigid
from processor.geometry.mesh_surface import MeshSurface
from processor.model import Floats
from processor.preassembly import features

FACES = (("bottom", 2, -1.0), ("right", 1, -1.0), ("top", 2, 1.0), ("left", 1, 1.0))  # axis and sense of the normal
ALONG = 0.9  # cosine: a facet that looks this much along an axis is of a face across it
NEAR_MM = 500.0  # of a joint, beyond the facet nearest to it


def of_part(surface: MeshSurface, joints: Sequence[Floats]) -> MeshSurface:
    """Return the outer faces of a part that ends at ``joints``, P1..P8 (8, 3) each, in the bridge's frame.

    At a joint these are, of the smooth faces that look up, down, left and right, those that lie nearest to the corners.
    The whole surface where there is none of one of them.
    """
    chosen = np.zeros(len(surface.faces), bool)
    centre = surface.vertices[surface.faces].mean(axis=1)
    for corners in joints:
        frame = features.joint_frame(corners)
        half = 0.5 * np.ptp(rigid.apply(rigid.invert(frame), corners[:4]), axis=0)
        local, normal = rigid.apply(rigid.invert(frame), centre), surface.normals @ frame[:3, :3]
        for _, axis, sense in FACES:
            own = (np.abs(normal[:, axis]) > ALONG) & (sense * local[:, axis] > 0.0)
            if not own.any():
                return surface
            own &= np.abs(local[:, 0]) < NEAR_MM + np.abs(local[own, 0]).min()
            groups, which = np.unique(surface.part_of[own], return_inverse=True)
            off = np.bincount(which, np.abs(sense * local[own, axis] - half[axis])) / np.bincount(which)
            chosen |= surface.part_of == groups[np.argmin(off)]
    return surface.only(chosen) if chosen.any() else surface
