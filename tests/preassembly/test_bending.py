"""Sections of meshes against closed forms; deflections of parts as beams against Hermite's finite elements."""

import numpy as np
import pytest
import trimesh

from processor.model import DesignPart, Steel
from processor.preassembly.parts import bending
from processor.preassembly.parts.mesh_sections import sections
from tests.support.scenes import bent_girders
from tests.support.scenes.bent_girders import Girder

DOWN = np.array([0.0, 0.0, -1.0])
CELL = 0.01  # of the largest deflection: cells of 125 mm, of which a support lies in the middle


def beam(girder, plates=True, turned=False):
    vertices, faces = bent_girders.mesh(girder, 0.0, plates)
    return bending.beam(DesignPart("g", vertices, faces[:, ::-1] if turned else faces), np.zeros(3), Steel())


@pytest.mark.parametrize("supports", [(0.0, 25e3), (3e3, 19e3), (1e3, 14e3, 23e3), (0.5e3, 1.5e3, 24e3)])
def test_deflections_are_those_of_finite_elements(supports):
    girder = Girder(25_000.0, 900.0, 1_000.0, 20.0, 16.0)
    nodes = np.union1d(np.linspace(0.0, girder.length, 121), supports)
    stiffness, load = bent_girders.E_MPA * girder.inertia(True), bent_girders.WEIGHT * girder.area
    across, slope, carrying = bent_girders.finite_elements(nodes, stiffness, load, 0.0, supports)
    made = beam(girder)
    made = made._replace(shear=0.0 * made.shear)  # these elements do not shear
    found, pushed = bending.sag(made, DOWN, supports)
    assert pushed == tuple(carrying)  # a support that would have to pull is left out
    low, high = (np.column_stack([nodes, 0.0 * nodes, np.full(len(nodes), z)]) for z in (0.0, girder.height))
    by_low, by_high = found.displacement(made, low), found.displacement(made, high)
    np.testing.assert_allclose(-by_low[:, 2], across, atol=CELL * np.abs(across).max())
    tilt = (by_low - by_high)[:, 0] / girder.height
    np.testing.assert_allclose(tilt, -slope, atol=CELL * np.abs(slope).max())


def test_webs_shear_over_a_short_span():
    girder = Girder(8_000.0, 1_000.0, 1_000.0, 16.0, 16.0)
    made, middle = beam(girder), np.array([[4_000.0, 0.0, 0.0]])
    both, bent = (
        -bending.sag(one, DOWN, (0.0, 8_000.0))[0].displacement(one, middle)[0, 2]
        for one in (made, made._replace(shear=0.0 * made.shear))
    )
    webs = 0.5 * girder.area  # of a square box of one thickness
    by_shear = bent_girders.WEIGHT * girder.area * 8_000.0**2 / (8.0 * 210_000.0 / 2.6 * webs)
    assert both - bent == pytest.approx(by_shear, rel=5e-3)  # corners belong to both


def test_a_mesh_without_plates_bends_as_thin_walls_of_one_thickness():
    girder = Girder(20_000.0, 1_000.0, 1_000.0, 16.0, 16.0)
    middle = np.array([[10_000.0, 0.0, 0.0]])
    supports = (0.0, 20_000.0)
    plates, outline, turned = (beam(girder), beam(girder, plates=False), beam(girder, turned=True))
    assert (plates.plates, outline.plates, turned.plates) == (True, False, True)
    sags = [bending.sag(one, DOWN, supports)[0].displacement(one, middle)[0, 2] for one in (plates, outline, turned)]
    assert sags[1] == pytest.approx(sags[0], rel=0.05)  # the outline is the plates' outer side
    assert sags[2] == pytest.approx(sags[0], rel=1e-9)


def test_a_difference_of_temperature_bends_to_a_parabola():
    girder = Girder(8_000.0)
    made = beam(girder)
    for axis, side in enumerate((made.depth[0, 0], made.depth[0, 1])):
        found = bending.by_gradient(made, axis, (0.0, 8_000.0)).scaled(10.0)
        most = 12e-6 * 10.0 / side * 8_000.0**2 / 8.0
        assert np.abs(found.across[:, axis]).max() == pytest.approx(most, rel=1e-3)
        assert np.abs(found.across[:, 1 - axis]).max() == 0.0


def test_what_no_two_supports_carry():
    made = beam(Girder(16_000.0))
    assert bending.sag(made, DOWN, (9_000.0, 15_000.0)) is None  # the centre of gravity is outside of them
    upright, _ = bending.sag(made, made.axes[0], (1_000.0, 15_000.0))  # gravity along the axis does not bend it
    assert np.abs(upright.across).max() < 1e-12
    assert bending.beam(DesignPart("p", *bent_girders.mesh(Girder(1_500.0), 0.0)), None, Steel()) is None


# --- sections ---

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


def test_open_inward_and_absent_sections():
    vertices, faces = extruded(rectangle(900.0, 1100.0))
    place, station = np.zeros(3), np.array([500.0])
    assert sections(vertices, faces[2:], place, AXES, station).open[0] == pytest.approx(900.0)  # without its bottom
    assert sections(vertices, faces[:, ::-1], place, AXES, station).area[0] == pytest.approx(-900.0 * 1100.0)
    nothing = sections(vertices, faces, place, AXES, np.array([2000.0]))
    assert (nothing.length[0], nothing.area[0]) == (0.0, 0.0)
