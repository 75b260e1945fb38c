"""Meshes of a body."""

import trimesh


def bracket():
    """A body without symmetry."""
    boxes = [((4000, 300, 200), (0, 0, 0)), ((300, 1500, 200), (1500, 600, 0)), ((200, 200, 900), (-1700, 0, 500))]
    return trimesh.util.concatenate(
        [trimesh.creation.box(extents, trimesh.transformations.translation_matrix(at)) for extents, at in boxes]
    )
