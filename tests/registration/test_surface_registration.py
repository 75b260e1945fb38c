"""Statistics of the fine registration to a surface by hand."""

import numpy as np
import pytest
import trimesh

from processor.geometry import mesh_distance, rigid
from processor.registration import surface_registration


def test_form_is_the_ratio_of_squares_of_full_cells_without_clutter():
    """Cells of 30 residuals m +- 0.2: their means have n m^2 = 0.3 and 1.2 mm^2, chance has 0.04 mm^2."""
    alternating = 0.2 * (-1.0) ** np.arange(30)
    residual = np.concatenate([0.1 + alternating, -0.2 + alternating, np.full(20, 5.0), np.full(40, 20.0)])
    counted = residual < 20.0  # the last are clutter, in the cells of the first
    cell = np.concatenate([np.repeat([0, 1, 2], [30, 30, 20]), np.repeat([0, 1], 20)])  # 20 points do not fill a cell
    assert surface_registration._form(residual, counted, cell) == pytest.approx(0.5 * (0.3 + 1.2) / 0.04)
    assert surface_registration._form(residual[60:80], counted[60:80], np.zeros(20, int)) == np.inf


def test_cells_are_lengths_of_a_side():
    place = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [499.0, 9.0, 9.0], [499.0, 0.0, 0.0], [499.0, 0.0, 0.0]])
    normal = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.9, 0.1], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    cell = surface_registration.cells(place, np.array([1, 1, 1, 1, 2]), normal)
    assert cell.tolist() == [0, 2, 2, 1, 3]


def test_the_gate_does_not_grow_with_clutter():
    """Of points everywhere about a box the fine fit uses those within its first gate, 60 mm, of where it ends."""
    box = trimesh.creation.box((900.0, 600.0, 400.0))
    surface = mesh_distance.of_mesh(np.asarray(box.vertices), np.asarray(box.faces, np.int64))
    points = np.random.default_rng(0).uniform(-1000.0, 1000.0, (20_000, 3))
    fitted = surface_registration.fine(points, surface, np.eye(3), np.eye(4))
    low, high = (np.array(side) * [900.0, 600.0, 400.0] / 2.0 for side in (-1.0, 1.0))
    placed = rigid.apply(fitted.T_design_scan, points)
    outside = np.linalg.norm(np.maximum(0.0, np.maximum(low - placed, placed - high)), axis=1)
    inside = np.minimum(placed - low, high - placed).min(axis=1)
    near = (np.where(inside > 0.0, inside, outside) < 60.0).mean()
    assert 0.4 * near < fitted.used_share < 1.1 * near  # gates may shrink to 30 mm; the last step moves few across one
