"""Integrals over sections of meshes against closed forms: a box, a tube of plates, an I, a mesh with an open side."""

import numpy as np
import pytest
import trimesh

from processor.preassembly.parts.mesh_sections import sections

AXES = np.eye(3)
ROUNDING = 1e-9  # float64 of products of metres in mm


def extruded(*outlines, length=1000.0):
    """Vertices and facets of outlines (n, 2), counterclockwise, or clockwise around holes, without end faces."""
    vertices, faces = [], []
    for outline in outlines:
        n, start = len(outline), sum(map(len, vertices))
        vertices.append(np.vstack([np.column_stack([np.full(n, x), outline]) for x in (0.0, length)]))
        for i in range(n):
            a, b = start + i, start + (i + 1) % n
            faces += [(a, b, b + n), (a, b + n, a + n)]
    return np.vstack(vertices), np.array(faces)


def rectangle(b, h, centre=(0.0, 0.0)):
    return np.array([[-b, -h], [b, -h], [b, h], [-b, h]]) / 2.0 + centre


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_a_box_of_plates(turn):
    vertices, faces = extruded(rectangle(900.0, 1100.0), rectangle(860.0, 1052.0)[::-1])
    R = trimesh.transformations.rotation_matrix(turn, [1.0, 2.0, 3.0])[:3, :3]
    found = sections(vertices @ R.T + 5000.0, faces, R @ np.zeros(3) + 5000.0, R.T, np.array([1.0, 400.0, 999.0]))
    A = 900.0 * 1100.0 - 860.0 * 1052.0
    across, up = (900.0**3 * 1100.0 - 860.0**3 * 1052.0) / 12.0, (900.0 * 1100.0**3 - 860.0 * 1052.0**3) / 12.0
    np.testing.assert_allclose(found.area, A, rtol=ROUNDING)
    np.testing.assert_allclose(found.centroid, 0.0, atol=1e-6)
    np.testing.assert_allclose(found.second_moment, np.diag([across, up])[None].repeat(3, 0), atol=1e-6 * up)
    np.testing.assert_allclose(found.length, 2.0 * (900.0 + 1100.0 + 860.0 + 1052.0), rtol=ROUNDING)
    lines = sum(2.0 * b * (h / 2.0) ** 2 + h**3 / 6.0 for b, h in ((900.0, 1100.0), (860.0, 1052.0)))
    np.testing.assert_allclose(found.line_moment[:, 1, 1], lines, rtol=ROUNDING)
    np.testing.assert_allclose(found.direction[:, 1, 1], 2.0 * (1100.0 + 1052.0), rtol=ROUNDING)
    np.testing.assert_allclose(found.extent, [[900.0, 1100.0]] * 3, rtol=ROUNDING)
    np.testing.assert_allclose(found.open, 0.0, atol=1e-9)


def test_an_unsymmetric_i_off_the_axis():
    top, bottom, web, h, tf = 300.0, 500.0, 12.0, 1000.0, 20.0
    right = np.array(
        [[bottom / 2, 0], [bottom / 2, tf], [web / 2, tf], [web / 2, h - tf], [top / 2, h - tf], [top / 2, h]]
    )
    outline = np.vstack([right, (right * [-1.0, 1.0])[::-1]])
    outline = outline + np.array([70.0, -30.0])
    found = sections(*extruded(outline), np.zeros(3), AXES, np.array([500.0]))
    plates = [(bottom, tf, tf / 2), (web, h - 2 * tf, h / 2), (top, tf, h - tf / 2)]
    A = sum(b * t for b, t, _ in plates)
    z = sum(b * t * c for b, t, c in plates) / A
    up = sum(b * t**3 / 12.0 + b * t * (c - z) ** 2 for b, t, c in plates)
    assert found.area[0] == pytest.approx(A)
    np.testing.assert_allclose(found.centroid[0], [70.0, z - 30.0], atol=1e-9)
    assert found.second_moment[0, 1, 1] == pytest.approx(up)
    assert found.second_moment[0, 0, 1] == pytest.approx(0.0, abs=1e-6 * up)


def test_a_round_tube_as_a_polygon():
    angle = np.arange(720) * np.pi / 360.0
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    found = sections(*extruded(250.0 * circle, 230.0 * circle[::-1]), np.zeros(3), AXES, np.array([500.0]))
    # A polygon of n sides has 1 - (2 pi / n)^2 / 6 of its circle's area.
    assert found.area[0] == pytest.approx(np.pi * (250.0**2 - 230.0**2), rel=2e-5)
    assert found.second_moment[0, 0, 0] == pytest.approx(np.pi / 4.0 * (250.0**4 - 230.0**4), rel=4e-5)


def test_open_inward_and_absent_sections():
    vertices, faces = extruded(rectangle(900.0, 1100.0))
    place, station = np.zeros(3), np.array([500.0])
    assert sections(vertices, faces[2:], place, AXES, station).open[0] == pytest.approx(900.0)  # without its bottom
    assert sections(vertices, faces[:, ::-1], place, AXES, station).area[0] == pytest.approx(-900.0 * 1100.0)
    nothing = sections(vertices, faces, place, AXES, np.array([2000.0]))
    assert (nothing.length[0], nothing.area[0]) == (0.0, 0.0)
