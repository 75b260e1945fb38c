"""Whole structures: which way their faces look, what is inside of what."""

import numpy as np
import pytest
import trimesh

from designgen import recipe_files
from designgen.asbuilt import defects
from designgen.designs import boxes_and_tubes, defect_specimens, prismatic_parts, stadium_roof, truss_bridge
from designgen.scenes.make import make

EXACT_MM = 1e-6  # float64 at 100 m: 1e-11, and squares of it


def corners_of(patches):
    """Triangles (f, 3, 3) of the nets of patches."""
    found = []
    for patch in patches:
        knots, triangles = patch.net()
        found.append(patch.at(knots[:, 0], knots[:, 1])[triangles])
    return np.concatenate(found)


def signed_volume(patches, about):
    """Volume of a closed net by the divergence theorem: positive where its triangles look outward."""
    a, b, c = (corners_of(patches)[:, i] - about for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def test_boxes_look_outward_in_frames_of_either_hand():
    R, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    for axes in (R, R * [[-1.0], [1.0], [1.0]]):
        box = boxes_and_tubes.Box(np.array([100.0, -50.0, 7.0]), axes, np.array([3.0, 5.0, 7.0]))
        assert signed_volume(box.patches(), np.zeros(3)) == pytest.approx(105.0)
        within = box.centre + np.array([[1.0, 0.5, -3.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) @ axes
        np.testing.assert_allclose(box.depth(within), [0.5, -0.5, 1.5], atol=1e-12)  # below the nearest side; float64
        knots = tuple(np.array([0.0, 0.3, 1.0]) for _ in range(3))
        assert signed_volume(box.patches(knots), np.zeros(3)) == pytest.approx(105.0)


@pytest.mark.parametrize(
    "components",
    [
        truss_bridge.build(truss_bridge.Params()),
        defect_specimens.build(defect_specimens.Params(form="girder", components=("step",))),
    ],
    ids=["truss", "girder"],
)
def test_every_box_of_a_structure_has_its_volume(components):
    whole = trimesh.Trimesh(*boxes_and_tubes.mesh_of(components), process=False)
    assert whole.volume == pytest.approx(sum(np.prod(body.size) for one in components for body in one.bodies))
    for one in components:
        for body in one.bodies:
            assert signed_volume(body.patches(), body.centre) == pytest.approx(float(np.prod(body.size)))
        volume = sum(float(np.prod(body.size)) for body in one.bodies)
        assert signed_volume(one.patches, one.bodies[0].centre) == pytest.approx(volume)


def test_a_truss_bridge_is_symmetric_about_its_middle_plane_and_its_beams_join_the_chords_axes():
    trusses = truss_bridge.build(truss_bridge.Params(width_mm=6000.0, height_mm=4500.0, depth_mm=5000.0))[:4]
    left, right, floor, top = ([_ends(box) for box in one.bodies] for one in trusses)
    # Ends are sums of numbers of 1e4 mm in float64.
    np.testing.assert_allclose(np.multiply(left, [1.0, -1.0, 1.0]), right, atol=1e-9)
    for beams, z in ((floor, 4500.0), (top, 9500.0)):
        for start, end in beams:
            np.testing.assert_allclose([start[1:], end[1:]], [[-3000.0, z], [3000.0, z]], atol=1e-9)
    heights = np.array([end for bar in left for end in bar])
    assert set(np.round(heights[:, 1], 9)) == {3000.0}
    assert set(np.round(heights[:, 2], 9)) == {4500.0, 9500.0}


def test_the_net_about_a_pad_fits_its_sides():
    """Edges of a single triangle lie at the rim of the wall: about the pad every edge has two."""
    edge = np.array([[-300.0, 0.0], [300.0, 0.0]])  # 2000 x 600 mm, whose net has a line at x = 1000
    whole = prismatic_parts.Part("wall", tuple(prismatic_parts.marked(np.eye(4), 0.0, 2000.0, edge, 1040.0)), (), None)
    vertices, faces = whole.mesh()
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    open_, count = np.unique(sides, axis=0, return_counts=True)
    middle = vertices[open_[count == 1]].mean(axis=1)
    at_rim = np.isclose(middle[:, 0], [[0.0], [2000.0]]).any(axis=0) | np.isclose(np.abs(middle[:, 1]), 300.0)
    assert at_rim.all()
    assert (count <= 2).all()


def test_a_hole_takes_its_volume_from_the_plate():
    """The cut faces close the net, and look into the hole."""
    row = defect_specimens.Params(components=("crack",))
    (place,) = defect_specimens.places(row)
    for kind in ("crack", "edge-loss", "missing-part"):
        defect = defects.draw(kind, defects.Params(), row, np.random.default_rng(2))
        patches = defects.damaged(place, defect_specimens.bodies(row, place), defect)
        assert signed_volume(patches, place.origin) == pytest.approx(1000.0 * 1000.0 * 12.0 - defect.volume_mm3)


def test_tubes_and_their_truth_look_away_from_the_axis():
    components = stadium_roof.build(stadium_roof.Params(trusses=4))
    tubes = [body for one in components for body in one.bodies]
    for tube in tubes:
        a, b, c = (corners_of(tube.patches())[:, i] for i in range(3))
        unit = (tube.end - tube.start) / np.linalg.norm(tube.end - tube.start)
        radial = (a + b + c) / 3.0 - tube.start
        radial -= np.outer(radial @ unit, unit)
        assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), radial) > 0.0).all()
    settings = ["structure.trusses=4", "scan.spacing_mm=500"]
    _, truth = make("x", recipe_files.overridden(recipe_files.load("stadium-roof")[1], settings))
    at = 0
    for tube in tubes:
        unit = (tube.end - tube.start) / np.linalg.norm(tube.end - tube.start)
        arm = truth.structure.points[at:] - tube.start
        along = arm @ unit
        radial = arm - np.outer(along, unit)
        own = np.abs(np.linalg.norm(radial, axis=1) - tube.radius) < EXACT_MM
        own &= (along > 0.0) & (along < np.linalg.norm(tube.end - tube.start))
        count = int(np.argmin(own)) if not own.all() else len(own)
        assert count >= 16 * 0.8
        expected = radial[:count] / tube.radius
        np.testing.assert_allclose(truth.structure.normals[at : at + count], expected, atol=EXACT_MM)
        at += count
    assert at == len(truth.structure.points)


def test_no_point_of_the_truth_lies_inside_a_tube():
    """Nor is one left out elsewhere: of a chord between joints all points are there, 8 around each 250 mm at most."""
    _, truth = make(
        "x",
        recipe_files.overridden(recipe_files.load("stadium-roof")[1], ["structure.trusses=4", "scan.spacing_mm=1000"]),
    )
    points, moved = truth.structure.points, truth.structure.displacement
    components = stadium_roof.build(stadium_roof.Params(trusses=4))
    tubes = [body for one in components for body in one.bodies]
    deepest = np.max([inside_by(tube, points) for tube in tubes], axis=0)
    np.testing.assert_allclose(deepest, 0.0, atol=EXACT_MM)  # float64 at 100 m
    np.testing.assert_allclose(moved, defects.movement(defects.MovementParams(), components)(points), atol=EXACT_MM)
    asked = sum(8 * max(2, int(np.linalg.norm(tube.end - tube.start) / 250.0)) for tube in tubes)
    assert 0.9 * asked < len(points) < asked
    chord = tubes[0]
    axis = chord.end - chord.start
    share = (points - chord.start) @ axis / (axis @ axis)
    own = (np.abs(inside_by(chord, points)) < EXACT_MM) & (share > 0.25) & (share < 0.75)
    steps = (np.arange(int(np.linalg.norm(axis) / 250.0)) + 0.5) / int(np.linalg.norm(axis) / 250.0)
    assert own.sum() == 8 * ((steps > 0.25) & (steps < 0.75)).sum()


def inside_by(body, points):
    """How far inside a body points lie, by its corners or its axis alone."""
    if isinstance(body, boxes_and_tubes.Tube):
        n = body.end - body.start
        t = (points - body.start) @ n / (n @ n)
        radius = np.linalg.norm(np.cross(points - body.start, n), axis=1) / np.linalg.norm(n)
        length = np.linalg.norm(n)
        return np.minimum.reduce([body.radius - radius, t * length, (1.0 - t) * length])
    walls = []
    for axis, size in zip(body.axes, body.size, strict=True):
        for sign in (-1.0, 1.0):
            walls.append((body.centre + 0.5 * sign * size * axis - points) @ (sign * axis))
    return np.minimum.reduce(walls)


@pytest.mark.parametrize("name", ["stadium-roof", pytest.param("truss-bridge", marks=pytest.mark.slow)])
def test_no_point_of_a_sample_lies_inside_a_body(name):
    table = {key: value for key, value in recipe_files.load(name)[1].items() if key not in ("scan", "asbuilt")}
    settings = ["scan.mode=surface", "scan.spacing_mm=120", "scan.sigma_mm=0"]
    settings += ["structure.trusses=4"] if name == "stadium-roof" else []
    made, truth = make("x", recipe_files.overridden(table, settings))
    points, part = made.scans[0].points, truth.labels[0].part
    module = stadium_roof if name == "stadium-roof" else truss_bridge
    components = module.build(module.Params(**({"trusses": 4} if name == "stadium-roof" else {})))
    bodies = [body for one in components for body in one.bodies]
    deepest = np.full(len(points), -np.inf)
    for body in bodies:
        deepest = np.maximum(deepest, inside_by(body, points))
    assert deepest.max() < EXACT_MM
    np.testing.assert_allclose(deepest, 0.0, atol=EXACT_MM)  # each is on a body's surface
    # Far from joints nothing is left out: points a square of 120 mm along the middle of the first bodies.
    for number, one in enumerate(components[:2]):
        body = one.bodies[0]
        start, end = (body.start, body.end) if name == "stadium-roof" else _ends(body)
        own = points[(part == number) & (np.abs(inside_by(body, points)) < EXACT_MM)]
        t = (own - start) @ (end - start) / ((end - start) @ (end - start))
        low, high = (0.2, 0.8) if name == "stadium-roof" else (0.03, 0.06)
        length = (high - low) * np.linalg.norm(end - start)
        girth = 2.0 * np.pi * body.radius if name == "stadium-roof" else 2.0 * (body.size[1] + body.size[2])
        count = ((t > low) & (t < high)).sum()
        assert count == pytest.approx(girth * length / 14_400.0, abs=5.0 * np.sqrt(girth * length / 14_400.0))


def _ends(box):
    return box.centre - 0.5 * box.size[0] * box.axes[0], box.centre + 0.5 * box.size[0] * box.axes[0]
