"""The design of a space frame from the surfaces of its balls and tubes: nodes, members, and what is not sure."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from processor.cli import main
from processor.model import FrameDesign
from processor.report.charts import design_picture
from processor.scan_folder import folder as scan_folder
from processor.scan_folder import guess
from processor.scan_folder.shapes import space_frame as frame_shapes
from processor.scan_folder.shapes.body import stacked, welded
from tests.support.made import made
from tests.support.results.reasons import codes, values
from tests.support.solids import bridge_parts, frame_solids, step_bridges

NODE_MM = 0.01  # vertices are exact but for the digits of their file, 1e-3 mm; the mean of hundreds has less


def whole(bodies):
    """All bodies as one mesh."""
    return welded("all", *frame_solids.joined(bodies))


def compare(design, truth):
    """Greatest errors of centres, radii and diameters in mm; the members have to be the same."""
    centres, radii, members, diameters = truth
    nearest = np.linalg.norm(centres[:, None] - design.centres, axis=2).argmin(axis=1)
    assert sorted(nearest) == list(range(len(design.ids)))
    row = {int(i): k for k, i in enumerate(design.ids)}
    pairs = zip(design.member_a, design.member_b, strict=True)
    thick = {frozenset((row[a], row[b])): d for (a, b), d in zip(pairs, design.tube_diameters, strict=True)}
    expected = {frozenset(nearest[[a, b]].tolist()): d for (a, b), d in zip(members, diameters, strict=True)}
    assert thick.keys() == expected.keys()
    return (
        np.abs(design.centres[nearest] - centres).max(),
        np.abs(design.radii[nearest] - radii).max(),
        max(abs(thick[pair] - expected[pair]) for pair in expected),
    )


@pytest.mark.parametrize(
    ("hollow", "fused", "seed"),
    [
        (False, False, 0),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in ((True, False, 1), (False, True, 2))),
        (True, True, 3),
    ],
)
def test_all_nodes_and_members_are_found(hollow, fused, seed):
    bodies, truth = frame_solids.solids(seed, hollow=hollow)
    one = frame_shapes.find(whole(bodies) if fused else stacked("all", [welded(*body) for body in bodies]))
    assert one[1] == ()
    assert max(compare(one[0], truth)) < NODE_MM


@pytest.mark.parametrize(("step_mm", "limit_mm"), [(0.01, 0.01), (0.1, 0.05)])
def test_rounded_coordinates(step_mm, limit_mm):
    """Rounding has an sd of 0.29 steps a coordinate, and a ball has hundreds of them."""
    bodies, truth = frame_solids.solids(1)
    vertices, faces = frame_solids.joined(bodies)
    one = frame_shapes.find(welded("all", np.round(vertices / step_mm) * step_mm, faces))
    assert max(compare(one[0], truth)) < limit_mm


def test_hollow_balls_and_coarse_ones():
    bodies, truth = frame_solids.solids(2)
    shells = [frame_solids.ball(c, r - 8.0) for c, r in zip(truth[0], truth[1], strict=True)]
    one = frame_shapes.find(whole([*bodies, *(("shell", *mesh) for mesh in shells)]))
    assert max(compare(one[0], truth)) < NODE_MM
    coarse = [(f"ball {k}", *frame_solids.ball(c, r, 1)) for k, (c, r) in enumerate(zip(*truth[:2], strict=True))]
    one = frame_shapes.find(whole([*coarse, *bodies[len(coarse) :]]))
    assert max(compare(one[0], truth)) < NODE_MM


def test_uncertain_balls_and_tubes_are_reported_as_doubts():
    bodies, (centres, radii, _, _) = frame_solids.solids(0)
    lone = ("lone", *frame_solids.ball(centres[0] + [0.0, 0.0, 3000.0], 60.0))
    up, profile = np.array([0.0, 0.0, 1.0]), [(0.0, 30.0), (3000.0, 30.0)]
    pole = ("pole", *frame_solids.lathe(profile, centres[0] - [900.0, 0.0, 3000.0], up))
    cut = bodies[4][1][bodies[4][2]].mean(axis=1)[:, 2] > centres[4, 2] + 0.85 * radii[4]
    cap = ("cap", bodies[4][1], bodies[4][2][cut])
    one = frame_shapes.find(whole([*bodies[:4], cap, *bodies[5:], lone, pole]))
    assert len(one[0].ids) == len(centres) + 1
    assert values(one[1], "init.doubtful-balls")["nodes"] == (4,)
    assert "init.nodes-alone" in codes(one[1])
    assert values(one[1], "init.tubes-left-out")["tubes"] == 1
    place = {unsure.name: unsure.place for unsure in one[2]}
    assert len(place) == 2
    assert np.linalg.norm(place["4"] - centres[4]) < 1.0  # a cap of 15 % of the radius: its centre is weak
    assert any(np.linalg.norm(at - centres[0] - [0.0, 0.0, 3000.0]) < NODE_MM for at in place.values())
    start, end = next(v for name, v, _ in bodies if name == "tube 3").reshape(2, 24, 3)
    bent = np.vstack([start, 0.5 * (start + end) + np.array([0.0, 0.0, 200.0]), end])
    _, faces = frame_solids.lathe([(0.0, 1.0), (1.0, 1.0), (2.0, 1.0)], np.zeros(3), up)
    others = [body for body in bodies if body[0] != "tube 3"]
    one = frame_shapes.find(whole([*others, ("bent", bent, faces)]))
    assert "init.surface-aside" in codes(one[1])
    off = np.array([0.0, 0.0, 9.0])
    aside = [(name, vertices + off * (name == "tube 0"), faces) for name, vertices, faces in bodies]
    one = frame_shapes.find(whole(aside))
    assert "init.eccentric-members" in codes(one[1])
    assert len(one[2]) == 1
    assert design_picture.draw(one[0], one[2]).startswith(b"\x89PNG")


def test_bodies_without_balls_are_no_frame():
    meshes, _ = bridge_parts.bridge()
    assert frame_shapes.find(stacked("all", [welded("part", *mesh) for mesh in meshes])) is None
    bodies, _ = frame_solids.solids()
    assert frame_shapes.find(whole([b for b in bodies if "ball" not in b[0]])) is None


def write_scan(place, centres, header="x_m,y_m,z_m"):
    (place / "scans").mkdir(parents=True)
    np.savetxt(
        place / "scans/roof.csv", np.repeat(centres, 3, axis=0) / 1000.0, delimiter=",", header=header, comments=""
    )


def test_a_mesh_in_metres_and_the_scan_that_shows_it(tmp_path):
    bodies, truth = frame_solids.solids(1)
    vertices, faces = frame_solids.joined(bodies)
    bridge_parts.write_stl(tmp_path / "roof.stl", vertices / 1000.0, faces)
    write_scan(tmp_path, truth[0])
    done = CliRunner().invoke(main.commands, ["init", str(tmp_path)], catch_exceptions=False)
    assert f"{len(truth[0])} node(s), {len(truth[2])} member(s)" in done.output
    assert "?" not in done.output
    assert json.loads((tmp_path / "design.json").read_text("utf-8"))["units"] == "m"
    scene = scan_folder.read_input(tmp_path)
    assert scene.kind == "space-frame"
    assert max(compare(scene.frame, truth)) < NODE_MM


def test_a_file_for_each_ball_and_tube(tmp_path):
    bodies, truth = frame_solids.solids(2, cells=1)
    for k, (name, vertices, faces) in enumerate(bodies):
        bridge_parts.write_obj(tmp_path / f"Bauteile/{name} {k}.obj", vertices, faces)
    write_scan(tmp_path, truth[0])
    assert max(compare(scan_folder.read_input(tmp_path).frame, truth)) < NODE_MM


@pytest.mark.usefixtures("cad_here")
def test_our_own_frame_as_step(tmp_path):
    """Balls with flats, bores and process holes, hexagonal sleeves, cones and tubes."""
    content, design = made(step_bridges.our_frame)
    (tmp_path / "frame.step").write_bytes(content)
    write_scan(tmp_path, design.centres)
    one = guess.guess(tmp_path).made
    assert isinstance(one.design, FrameDesign)
    assert one.doubts == ()
    truth = design.centres, design.radii, design.members, np.full(len(design.members), 60.0)
    assert max(compare(one.design, truth)) < NODE_MM
