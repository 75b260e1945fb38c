"""Residuals of a part for maps: a plate with a dent and noise, against closed forms."""

import numpy as np

from processor.geometry import mesh_distance
from processor.preassembly.parts import part_residuals

SIDE, T, SIGMA, DENT, SPREAD = 1000.0, 20.0, 1.0, 4.0, 150.0


def plate():
    """A closed plate, both sides of which are scanned."""
    corners = np.array([[x, y, z] for x in (0.0, SIDE) for y in (0.0, SIDE) for z in (0.0, T)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return mesh_distance.of_design(
        corners, np.array([f for q in quads for f in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))])
    )


def scan(count=40_000, dent=DENT):
    rng = np.random.default_rng(3)
    xy = rng.uniform(0.0, SIDE, (2 * count, 2))
    top = np.arange(2 * count) < count
    z = np.where(top, T, 0.0) - np.where(top, depth(xy, dent), 0.0) + rng.normal(0.0, SIGMA, 2 * count)
    return np.column_stack([xy, z])[rng.permutation(2 * count)]


def depth(xy, dent=DENT):
    return dent * np.exp(-0.5 * ((xy - 0.5 * SIDE) ** 2).sum(axis=1) / SPREAD**2)


def test_a_residual_is_the_median_of_the_points_about_it_on_its_side_of_a_plate():
    """The noise of a median of 25 is 0.25 of that of a point (sqrt(pi / 2) / 5); the dent stays, as does its sign."""
    found = part_residuals.part_residuals(scan(), plate())
    top = found.places[:, 2] > 0.5 * T
    true = np.where(top, -depth(found.places[:, :2]), 0.0)
    inside = ((found.places[:, :2] > 40.0) & (found.places[:, :2] < SIDE - 40.0)).all(axis=1)
    assert len(found.places) >= part_residuals.PLACES
    off = (found.distance - true)[inside]
    assert abs(off.mean()) < 0.02  # of 0.25 by a thousand places: 0.008
    # Of a thousand places: four sds of 2.2 %.
    assert 0.9 * np.sqrt(np.pi / 2) / 5 < off.std() / SIGMA < 1.1 * np.sqrt(np.pi / 2) / 5


def test_a_part_without_points_at_its_design_has_no_residuals():
    found = part_residuals.part_residuals(scan(100) + 500.0, plate())
    assert found.places.shape == (0, 3)
    assert found.distance.shape == (0,)
