"""Errors that many points of a part share, by hand and by least squares of each error alone."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from processor.geometry import mesh_distance
from processor.geometry.lines_and_polylines import Polyline
from processor.preassembly.ends import bottom_edges
from processor.preassembly.params import SystematicParams
from processor.preassembly.parts import measure, systematic_errors
from processor.registration import principal
from tests.support.results import measured_parts

SIZE = np.array([1000.0, 300.0, 200.0])
CORNERS = SIZE * (np.indices((2, 2, 2)).reshape(3, 8).T + np.array([2.0, 1.0, 3.0]))
QUADS = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
FACES = QUADS[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def test_errors_of_views_move_a_part_as_each_view_alone_does():
    """A box with points on its six sides; a view is a side of one half, and its error moves its points outward."""
    rng = np.random.default_rng(4)
    face = rng.integers(0, 6, 600)
    axis, points = face // 2, CORNERS[0] + SIZE * rng.uniform(0.1, 0.9, (600, 3))  # clear of other sides
    points[np.arange(600), axis] = np.where(face % 2, CORNERS[7, axis], CORNERS[0, axis])
    normals = np.where(face % 2, 1.0, -1.0)[:, None] * np.eye(3)[axis]
    mesh = mesh_distance.of_mesh(CORNERS, FACES)
    shape = SimpleNamespace(mesh=mesh, axes=principal.of_mesh(CORNERS, FACES).axes)
    found = measure._views(measured_parts.registered(points, mesh, mesh), shape)
    names, view = np.unique(2 * face + (points[:, 0] > points[:, 0].mean()), return_inverse=True)
    errors = np.eye(len(names))[view.ravel()]
    arm = 1e3  # metres, so that turns and shifts have like sizes
    J = np.hstack([np.cross(points / arm, normals), normals])
    motion = np.linalg.lstsq(J, errors, rcond=None)[0]
    scale = np.repeat([1.0 / arm, 1.0], 3)[:, None]
    expected = (scale * motion) @ (scale * motion).T
    np.testing.assert_allclose(found.pose, expected, rtol=1e-6, atol=1e-9 * expected.max())  # condition about 1e4
    left = np.array([(errors - J @ motion)[view.ravel() == k].mean(axis=0) for k in range(len(names))])
    assert found.left == pytest.approx((left**2).sum() / len(names), rel=1e-6)


def test_an_offset_of_the_scanner_moves_all_faces_of_edges_inward_and_stations_each_view():
    """2 mm inward are -2 mm of the left edge, 2 mm of the right one and 2 mm up; 0.3 mm are of each view alone."""
    edges = measured_parts.edges(np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2, 3)), np.zeros((2, 2)), sd=0.5)
    edges = dataclasses.replace(edges, by_view=np.stack([np.eye(2)] * 2))
    params = SystematicParams(registration_mm=0.3, offset_mm=2.0)
    found = systematic_errors.added_to_edges(edges, params).covariance
    alone = (0.5**2 + 0.3**2) * np.eye(2)
    common = np.array([[[4.0, -4.0], [-4.0, 4.0]], [[4.0, 4.0], [4.0, 4.0]]])
    np.testing.assert_allclose(found, alone + common, rtol=1e-12)  # float64


@pytest.mark.parametrize("number", [0, 6])
def test_a_cloud_of_one_station_has_views_that_are_not_named_whatever_its_number(number):
    """Both edges of a box, four views: two halves of a web each, and two of the bottom, that may tilt as well."""
    mesh = mesh_distance.of_mesh(CORNERS, FACES)
    part = measured_parts.registered(CORNERS[:1], mesh, mesh)
    part = dataclasses.replace(part, station=part.station + number)
    low, high = (np.array([[x, y, CORNERS[0, 2]] for x in CORNERS[[0, 7], 0]]) for y in CORNERS[[0, 7], 1])
    edges = bottom_edges.measure(part, Polyline.through(high), Polyline.through(low), 0.3)
    assert edges.by_view.shape == edges.by_tilt.shape == (2, len(edges.side), 4)
