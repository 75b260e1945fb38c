"""Joints of round tubes and of hollow sections with rounded corners: their key points against closed forms."""

import json

import cadquery as cq
import numpy as np
import pytest
from click.testing import CliRunner

from processor.cli import main
from processor.scan_folder import folder as scan_folder
from processor.scan_folder.shapes import arch_bridge
from processor.scan_folder.shapes.body import welded
from tests.support.results.reasons import codes
from tests.support.solids import round_tubes
from tests.support.solids.round_tubes import Sizes

CORNER_MM = 0.05  # tessellated to 0.02 and 0.05 mm of the surface
RADIUS, WALL, LENGTH, GAP = 250.0, 16.0, 3000.0, 3.0


@pytest.mark.parametrize(
    "sizes",
    [Sizes(), Sizes(parts=4, bend=20_000.0), Sizes(radius=90.0, wall=8.0), Sizes(gusset=True)],
    ids=["straight", "arch", "narrow", "gusset"],
)
def test_key_points_of_tubes_are_at_45_degrees_on_their_outer_edge(sizes):
    one = arch_bridge.find([welded(f"tube{k + 1}", *round_tubes.mesh(sizes, k)) for k in range(sizes.parts)])
    expected = round_tubes.design(sizes)
    assert one.doubts == ()
    assert one.root_gap_mm == pytest.approx(GAP, abs=0.01)  # as it is printed
    assert [part.name for part in one.design.parts] == [part.name for part in expected.parts]
    np.testing.assert_allclose(one.design.joint_points, expected.joint_points, atol=CORNER_MM)
    assert all(len(part.bottom_edge_left) == 0 for part in one.design.parts)


def mitred(angle):
    """Two straight tubes that meet at a mitre, each turned by an angle downwards from it, with a root gap."""
    solids = []
    for sense in (-1.0, 1.0):
        way = cq.Vector(sense * np.cos(angle), 0.0, -np.sin(angle))
        start = cq.Vector(0.0, 0.0, 4000.0) - way * 1000.0
        tube = cq.Workplane(cq.Plane(start, cq.Vector(0.0, 1.0, 0.0), way)).circle(RADIUS).circle(RADIUS - WALL)
        box = cq.Workplane(origin=(sense * (5000.0 + 0.5 * GAP), 0.0, 3000.0)).box(10_000.0, 2000.0, 6000.0)
        solids.append(tube.extrude(4000.0).intersect(box).val())
    return solids


@pytest.mark.parametrize("degrees", [2.0, 6.0])
def test_a_mitre_is_an_ellipse(degrees):
    angle = np.radians(degrees)
    bodies = []
    for k, solid in enumerate(mitred(angle)):
        vertices, faces = solid.tessellate(0.02, 0.05)
        bodies.append(welded(f"tube{k + 1}", np.array([v.toTuple() for v in vertices]), np.array(faces)))
    points = arch_bridge.find(bodies).design.joint_points[0]
    # Half the gap farther along, each axis is lower by its slope.
    middle = np.array([0.0, 0.0, 4000.0 - 0.5 * GAP * np.tan(angle)])
    off = points - middle
    assert np.abs(off[:, 0]).max() < CORNER_MM
    high = RADIUS / np.cos(angle)
    np.testing.assert_allclose((off[:, 1] / RADIUS) ** 2 + (off[:, 2] / high) ** 2, 1.0, atol=2.0 * CORNER_MM / RADIUS)
    np.testing.assert_allclose(np.abs(off[:4, 1]), np.abs(off[:4, 2]), atol=CORNER_MM)
    np.testing.assert_allclose(off[4:, 1:], [[0, -high], [-RADIUS, 0], [0, high], [RADIUS, 0]], atol=CORNER_MM)


def tubes_of_step(path):
    """A STEP file of three straight tubes in a row."""
    assembly = cq.Assembly(name="bridge")
    for k in range(3):
        plane = cq.Workplane("YZ", origin=(k * (LENGTH + GAP), 0.0, 1000.0))
        assembly.add(plane.circle(RADIUS).circle(RADIUS - WALL).extrude(LENGTH).val(), name=f"seg{k + 1}")
    assembly.export(str(path))


@pytest.mark.usefixtures("cad_here")
def test_a_step_file_of_tubes_is_a_bridge_where_scans_have_their_names(tmp_path):
    tubes_of_step(tmp_path / "bridge.step")
    (tmp_path / "scans").mkdir()
    for k in range(3):
        (tmp_path / f"scans/seg{k + 1}.xyz").write_text("0 0 0\n3 0 0\n0 0.5 0\n0 0 0.5\n")
    done = CliRunner().invoke(main.commands, ["init", str(tmp_path)])
    assert done.exit_code == 0, done.output
    design = scan_folder.read_input(tmp_path).arch
    assert design.joint_left == ("seg1", "seg2")
    for j, points in enumerate(design.joint_points):
        off = points - [(j + 1) * (LENGTH + GAP) - 0.5 * GAP, 0.0, 1000.0]
        half = RADIUS * np.sqrt(0.5)
        np.testing.assert_allclose(
            off[:4, 1:], [[half, -half], [-half, -half], [-half, half], [half, half]], atol=CORNER_MM
        )
        np.testing.assert_allclose(np.abs(off[:, 0]), 0.0, atol=CORNER_MM)
    unsure = json.loads((tmp_path / "design.json").read_text())["unsure"]
    assert len(unsure) == 1  # that they are in a straight line


def hollow(radii):
    """Meshes of two hollow sections of 300 x 500 x 12 mm with rounded corners, ``GAP`` apart."""
    bodies = []
    for k in range(2):
        plane = cq.Workplane("YZ", origin=(k * (LENGTH + GAP), 0.0, 1000.0))
        outer = plane.rect(300.0, 500.0).extrude(LENGTH).edges("|X").fillet(radii[0])
        inner = plane.rect(276.0, 476.0).extrude(LENGTH).edges("|X").fillet(radii[1])
        vertices, faces = outer.cut(inner).val().tessellate(0.05, 0.1)
        bodies.append(welded(f"rhs{k + 1}", np.array([v.toTuple() for v in vertices]), np.array(faces)))
    return bodies


@pytest.mark.parametrize("radii", [(30.0, 18.0), (20.0, 8.0)])
def test_corners_of_hollow_sections_are_where_their_sides_would_meet(radii):
    one = arch_bridge.find(hollow(radii))
    off = one.design.joint_points[0] - [LENGTH + 0.5 * GAP, 0.0, 1000.0]
    expected = [[150, -250], [-150, -250], [-150, 250], [150, 250], [0, -250], [-150, 0], [0, 250], [150, 0]]
    np.testing.assert_allclose(off[:, 1:], expected, atol=CORNER_MM)
    assert "init.at-joint" not in codes(one.doubts)
    assert len(one.design.parts[0].bottom_edge_left) == 0
