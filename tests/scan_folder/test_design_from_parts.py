"""The design of an arch bridge from a mesh or CAD body a part: order, joints, bottom edges, and what is not sure."""

import json
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

from designgen.designs import girder_assemblies
from processor.cli import main
from processor.geometry.lines_and_polylines import Polyline
from processor.language.messages import messages
from processor.model import ArchDesign, DesignBodies
from processor.report.charts import design_picture
from processor.scan_folder import cad, guess
from processor.scan_folder import folder as scan_folder
from processor.scan_folder.shapes import arch_bridge, guess_design
from processor.scan_folder.shapes.body import stacked, welded
from processor.scan_folder.units import MM_PER_UNIT
from tests.support.files.scan_folders import write_ply
from tests.support.made import made
from tests.support.results.reasons import codes, values
from tests.support.solids import bridge_parts, frame_solids, step_bridges

CORNER_MM = 0.05  # edges between rows are chords of curves: their planes are off by less
ROUNDING_MM = 1e-6  # planes through exact points, solved for corners at 1e4 mm: 1e5 roundings
I_HEIGHT, I_WIDTH, I_FLANGE, I_WEB = 900.0, 400.0, 30.0, 16.0


WRITERS = {"obj": bridge_parts.write_obj, "stl": bridge_parts.write_stl, "ply": write_ply}


def found(meshes, names=None):
    names = names or bridge_parts.names(len(meshes))
    return arch_bridge.find([welded(name, *mesh) for name, mesh in zip(names, meshes, strict=True)])


def order(design):
    return [part.name for part in design.parts]


def joined(*meshes):
    """Several meshes as one."""
    return frame_solids.joined([("", *mesh) for mesh in meshes])


@pytest.mark.parametrize(("parts", "gap", "seed"), [(2, 0.0, 0), (5, 0.0, 1), (7, 8.0, 0), (11, 55.0, 1)])
def test_joints_and_edges_are_those_of_the_closed_form(parts, gap, seed):
    meshes, joints = bridge_parts.bridge(parts, seed, gap)
    shuffled = np.random.default_rng(seed).permutation(parts)
    one = found([meshes[k] for k in shuffled], [bridge_parts.names(parts)[k] for k in shuffled])
    assert one.doubts == ()
    assert order(one.design) == bridge_parts.names(parts)
    assert one.root_gap_mm == pytest.approx(gap, abs=0.01)  # as it is printed
    assert np.abs(one.design.joint_points - joints).max() < CORNER_MM
    for k, part in enumerate(one.design.parts):
        for side, edge in enumerate((part.bottom_edge_left, part.bottom_edge_right)):
            assert (np.diff(edge[:, 0]) > 0.0).all()
            curve = Polyline.through(bridge_parts.edge(side, edge[:, 0]))
            assert np.abs(curve.vertices - edge).max() < 0.1  # the sag of chords of 1 m between rows is 0.07 mm
            for end, joint in ((0, k - 1), (-1, k)):
                if 0 <= joint < parts - 1:  # where the edges of both parts end, half a gap from the joint
                    off = np.linalg.norm(edge[end] - one.design.joint_points[joint, side])
                    assert off == pytest.approx(0.5 * gap, abs=CORNER_MM + 0.01 * gap)  # edges lean against the cut


def turned(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.roll(np.roll([[1, 0, 0], [0, c, -s], [0, s, c]], axis, axis=0), axis, axis=1)


@pytest.mark.parametrize(
    ("R", "code"),
    [
        (turned(2, np.pi / 2), "init.along-y"),
        (turned(2, 0.5), "init.off-x"),
        (turned(0, np.pi / 2), "init.rises-along-y"),
        (turned(0, np.pi), "init.hangs-down"),
        (turned(1, np.pi / 2), "init.along-z"),
    ],
)
def test_a_design_in_another_frame_is_refused(R, code):
    one = found([(vertices @ R.T, faces) for vertices, faces in bridge_parts.bridge()[0]])
    assert one.design is None
    assert codes(one.doubts) == ["init.other-frame", code]
    if code == "init.off-x":
        assert values(one.doubts, code)["degrees"] == pytest.approx(np.degrees(0.5), abs=0.5)  # whole degrees


def test_names_numbered_against_the_order_of_parts_are_reported():
    one = found(bridge_parts.bridge()[0], bridge_parts.names(5)[::-1])
    assert order(one.design) == bridge_parts.names(5)[::-1]
    assert codes(one.doubts) == ["init.numbered-backwards"]


# Triangles between two loops of four corners.
SIDES = [q for k in range(4) for q in ((k, (k + 1) % 4, (k + 1) % 4 + 4), (k, (k + 1) % 4 + 4, k + 4))]


def slab(plane, scale, thickness):
    """An end plate on a plane, larger than the section by a factor."""
    four = bridge_parts.section(*plane)[:4]
    four = four.mean(axis=0) + scale * (four - four.mean(axis=0))
    ends = [(0, 1, 2), (0, 2, 3), (4, 6, 5), (4, 7, 6)]
    return np.vstack([four, four + thickness * plane[1]]), np.array([*ends, *SIDES])


def bevelled(vertices, faces):
    """The outer corners of the start's face drawn in by 15 mm over 12 mm of length."""
    vertices, outer = vertices.copy(), vertices[:4].copy()
    along, inside = vertices[4:8] - outer, outer.mean(axis=0) - outer
    vertices[4:8] = outer + 12.0 * along / np.linalg.norm(along, axis=1, keepdims=True)
    vertices[:4] = outer + 15.0 * inside / np.linalg.norm(inside, axis=1, keepdims=True)
    return vertices, faces


def chamfered(vertices, faces, steps=1):
    """The part's outer faces with the lower left corner cut off by 40 mm, or rounded in several steps."""
    rows, count = bridge_parts.ROWS, steps + 4
    four = vertices[: 4 * rows].reshape(rows, 4, 3)
    up, right = four[:, 3] - four[:, 0], four[:, 1] - four[:, 0]
    one = four[:, 0] + 40.0 * up / np.linalg.norm(up, axis=1, keepdims=True)
    two = four[:, 0] + 40.0 * right / np.linalg.norm(right, axis=1, keepdims=True)
    round_ = [(1 - t) ** 2 * one + 2 * t * (1 - t) * four[:, 0] + t**2 * two for t in np.linspace(0, 1, steps + 1)]
    round_ = [one, two] if steps == 1 else round_
    loops = np.stack([*round_, four[:, 1], four[:, 2], four[:, 3]], axis=1)
    k = np.arange(count)
    triangles = []
    for i in range(rows - 1):
        a, b = count * i + k, count * i + np.roll(k, -1)
        triangles += [*np.stack([a, b, b + count], axis=1), *np.stack([a, b + count, a + count], axis=1)]
    ends = [(e, e + m, e + m + 1) for e in (0, count * (rows - 1)) for m in range(1, count - 1)]
    return loops.reshape(-1, 3), np.array([*triangles, *ends])


@pytest.mark.parametrize(
    ("flaw", "code", "expected"),
    [
        (lambda m, p: m.__setitem__(1, joined(m[1], slab(p[1], 1.2, 20.0))), "init.off-outer-faces", {}),
        (lambda m, p: m.__setitem__(1, bevelled(*m[1])), "init.off-outer-faces", {}),
        (lambda m, p: m.__setitem__(1, chamfered(*m[1])), "init.not-four-corners", {"corners": 5}),
        (lambda m, p: m.__setitem__(1, (m[1][0] + [0.0, 5.0, 0.0], m[1][1])), "init.corners-differ", {"mm": 5.0}),
        (lambda m, p: m.__setitem__(1, (m[1][0] - 5.0 * p[1][1], m[1][1])), "init.ends-overlap", {"mm": 5.0}),
        (lambda m, p: m.__setitem__(1, (m[1][0].round(0), m[1][1])), "init.rounded-parts", {"parts": ("rib1",)}),
    ],
    ids=["end plate", "bevel", "chamfer", "offset", "overlap", "rounded"],
)
def test_unclear_corners_are_reported_as_doubts(flaw, code, expected):
    meshes, _ = bridge_parts.bridge(5, 0)
    flaw(meshes, bridge_parts.cutting_planes(5, 0))
    one = found(meshes)
    assert order(one.design) == bridge_parts.names(5)
    for name, value in expected.items():
        assert values(one.doubts, code)[name] == pytest.approx(value, abs=CORNER_MM)
    assert code in codes(one.doubts)


def test_edges_that_are_not_sharp_are_left_out():
    meshes, _ = bridge_parts.bridge(5, 0)
    meshes[2] = chamfered(*meshes[2], steps=8)
    one = found(meshes)
    assert values(one.doubts, "init.bottom-edges-left-out")["part"] == "rib2"
    assert [len(part.bottom_edge_left) > 0 for part in one.design.parts] == [True, True, False, True, True]


def test_behind_a_bevel_or_an_end_plate_the_outer_faces_are_followed():
    meshes, joints = bridge_parts.bridge(5, 0)
    meshes[1] = bevelled(*meshes[1])
    meshes[2] = joined(meshes[2], slab(bridge_parts.cutting_planes(5, 0)[2], 1.2, 20.0))
    one = found(meshes)
    assert np.abs(one.design.joint_points - joints).max() < 1.0  # faces are continued over 12 and 20 mm
    assert codes(one.doubts).count("init.off-outer-faces") == 2


def ring_parts(count):
    """Hollow boxes with mitred ends around Y, and the corners (count, 4, 3) of their ends."""
    angles = np.arange(count + 1) * 2.0 * np.pi / count

    def corners(angle, width, low, high):
        radial = np.array([np.cos(angle), 0.0, np.sin(angle)])
        return np.array(
            [r * radial + [0.0, y, 0.0] for y, r in ((width, low), (-width, low), (-width, high), (width, high))]
        )

    def segment(a, b):
        outer, inner = (
            np.vstack([corners(p, w, 5e3 + t, 6e3 - t) for p in (a, b)]) for w, t in ((400.0, 0.0), (380.0, 20.0))
        )
        rings = [(e + k, e + (k + 1) % 4, e + 8 + k) for e in (0, 4) for k in range(4)]
        rings += [(e + (k + 1) % 4, e + 8 + (k + 1) % 4, e + 8 + k) for e in (0, 4) for k in range(4)]
        return np.vstack([outer, inner]), np.array([*SIDES, *((i + 8, j + 8, k + 8) for i, j, k in SIDES), *rings])

    return [segment(*pair) for pair in pairwise(angles)], np.array([corners(a, 400.0, 5e3, 6e3) for a in angles[1:]])


def same_corners(found_points, corners):
    """Greatest distance of P1 to P4 from the corners (4, 3), whichever of them each is."""
    return np.linalg.norm(found_points[:4, None] - corners, axis=2).min(axis=1).max()


@pytest.mark.parametrize("count", [4, 6])
def test_a_ring_has_a_joint_between_each_two_of_its_parts(count):
    meshes, corners = ring_parts(count)
    names = [f"part {k + 1}" for k in range(count)]
    one = found(meshes, names)
    assert one.doubts == ()
    assert not one.row
    left, right = one.design.joint_left, one.design.joint_right
    assert list(zip(left, right, strict=True)) == [(names[k], names[(k + 1) % count]) for k in range(count)]
    for points, four in zip(one.design.joint_points, corners, strict=True):
        assert same_corners(points, four) < ROUNDING_MM


@pytest.mark.parametrize("kind", ["node", "ribs"])
def test_parts_of_nodes_and_braced_ribs_are_joined_as_designed(kind):
    design = girder_assemblies.build(
        girder_assemblies.Params(type=kind, length_mm=4000.3, width_mm=500.2, height_mm=700.3, stub_mm=1401.3)
    )
    shuffled = np.random.default_rng(1).permutation(len(design.parts))
    parts = [design.parts[k] for k in shuffled]
    one = found([part.mesh() for part in parts], [part.name for part in parts])
    assert one.doubts == ()
    expected = {frozenset((joint.left, joint.right)): joint for joint in design.joints}
    pairs = list(zip(one.design.joint_left, one.design.joint_right, strict=True))
    assert {frozenset(pair) for pair in pairs} == set(expected)
    assert len(pairs) == len(expected)
    for pair, points in zip(pairs, one.design.joint_points, strict=True):
        joint = expected[frozenset(pair)]
        corners = np.column_stack([np.zeros(4), joint.section.key_points[:4]]) @ joint.T[:3, :3].T + joint.T[:3, 3]
        assert same_corners(points, corners) < ROUNDING_MM


def test_a_part_that_ends_on_a_side_of_another_has_no_section_there():
    meshes, _ = ring_parts(4)
    ring = [f"part {k + 1}" for k in range(4)]
    post = np.array([[x, y, z] for x in (-150.0, 150.0) for y in (400.0, 3000.0) for z in (5100.0, 5900.0)])
    box = trimesh.convex.convex_hull(post)
    one = found([*meshes, (np.array(box.vertices), np.array(box.faces))], [*ring, "post"])
    assert [part.name for part in one.design.parts] == ring
    assert [(doubt.code, doubt.values["parts"]) for doubt in one.doubts] == [("init.meets-no-part", ("post",))]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda m: m.append(m[2]), "init.crowded"),
        (lambda m: m.pop(2), "init.several-chains"),
        (lambda m: m.__setitem__(1, (m[1][0], m[1][1][:-8])), "init.several-chains"),
        (lambda m: m.__setitem__(slice(None), [(v / 1000.0, f) for v, f in m]), "init.none-meet"),
        (lambda m: m.extend([(v + np.array([0.0, 6000.0, 0.0]), f) for v, f in m]), "init.several-chains"),
    ],
    ids=["twice", "missing", "open", "metres", "two bridges"],
)
def test_parts_without_a_clear_order_make_no_design(change, expected):
    meshes, _ = bridge_parts.bridge()
    closed = len(meshes[1][1])
    change(meshes)
    one = found(meshes, [f"part{k}" for k in range(len(meshes))])
    assert one.design is None
    assert one.doubts[0].code == expected
    if len(meshes[1][1]) < closed:
        assert values(one.doubts, "init.unclosed")["parts"] == ("part1",)


def test_part_without_neighbours_is_left_out_with_a_remark():
    meshes, joints = bridge_parts.bridge()
    one = found([*meshes, (meshes[2][0] + [0.0, 9000.0, 0.0], meshes[2][1])], [*bridge_parts.names(5), "spare"])
    assert order(one.design) == bridge_parts.names(5)
    assert np.abs(one.design.joint_points - joints).max() < CORNER_MM
    assert values(one.doubts, "init.parts-left-out")["parts"] == ("spare",)


def i_beam(start, end):
    """A prism of I-section from x to x, that leans with the line z = 0.1 x up to the middle and falls behind it."""
    h, w, f, t = I_HEIGHT, I_WIDTH / 2, I_FLANGE, I_WEB / 2
    half = np.array([[-w, 0], [w, 0], [w, f], [t, f], [t, h - f], [w, h - f]])
    outline = np.vstack([half, [0, h] - half])
    flanges, web = [(0, 1, 2), (0, 2, 3), (0, 3, 10), (0, 10, 11)], [(3, 4, 9), (3, 9, 10)]
    cap = [*flanges, *(tuple((k + 6) % 12 for k in face) for face in flanges), *web]
    ends = [
        np.column_stack([np.full(12, x), outline[:, 0], outline[:, 1] + 1000.0 - 0.1 * abs(x)]) for x in (start, end)
    ]
    k = np.arange(12)
    sides = [(i, (i + 1) % 12, (i + 1) % 12 + 12) for i in k] + [(i, (i + 1) % 12 + 12, i + 12) for i in k]
    return np.vstack(ends), np.array([*sides, *cap, *((a + 12, c + 12, b + 12) for a, b, c in cap)])


def test_sections_of_i_beams():
    one = found([i_beam(*ends) for ends in pairwise((-9000.0, -3000.0, 0.0, 3000.0, 9000.0))], list("abcd"))
    assert one.doubts == ()
    w, h = I_WIDTH / 2, I_HEIGHT
    four = [[w, 0.0], [-w, 0.0], [-w, h], [w, h], [0.0, 0.0], [-w, h / 2], [0.0, h], [w, h / 2]]
    for points, x in zip(one.design.joint_points, (-3000.0, 0.0, 3000.0), strict=True):
        assert points == pytest.approx(np.column_stack([np.full(8, x), four + np.array([0.0, 1000.0 - 0.1 * abs(x)])]))


# --- folders ----------------------------------------------------------------------------------------------------------


def write_parts(place, meshes, suffix, folder="design", size_mm=1.0):
    """A mesh a part, in units of a size."""
    for name, (vertices, faces) in zip(bridge_parts.names(5), meshes, strict=True):
        WRITERS[suffix](place / f"{folder}/{name}.{suffix}", vertices / size_mm, faces)


def write_scans(place, meshes, scale=1.0, header=""):
    """Points on the parts as scans, in the bridge's frame."""
    (place / "scans").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for name, (vertices, faces) in zip(bridge_parts.names(5), meshes, strict=True):
        share = rng.dirichlet([1.0, 1.0, 1.0], 1500)
        corners = vertices[faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        points = np.einsum("nk,nki->ni", share, corners[rng.choice(len(faces), 1500, p=area / area.sum())]) * scale
        np.savetxt(place / f"scans/{name}.csv", points, fmt="%.4f", delimiter=",", header=header, comments="")


def write_lone_scans(place, *names):
    """Scans that say nothing but their names."""
    (place / "scans").mkdir()
    for name in names:
        np.savetxt(place / f"scans/{name}.xyz", np.random.default_rng(0).uniform(0.0, 1.0, (500, 3)))


def init(place, *options):
    done = CliRunner().invoke(main.commands, ["init", str(place), *options], catch_exceptions=False)
    assert done.exit_code == 0
    return done.output


@pytest.fixture
def no_picture(monkeypatch):
    """Leave the picture of a design out: for tests of all else, as drawing takes most of the time."""
    monkeypatch.setattr(design_picture, "draw", lambda *_: b"")


def test_the_picture_marks_what_is_not_sure_and_a_design_that_is_there_is_not_changed(tmp_path, monkeypatch):
    meshes, _ = bridge_parts.bridge(5, 0)
    meshes[1] = bevelled(*meshes[1])
    meshes[3] = chamfered(*meshes[3], steps=8)
    names = bridge_parts.names(5)
    write_parts(tmp_path, meshes, "obj")
    write_scans(tmp_path, meshes)
    drawn = []
    real = design_picture._name
    monkeypatch.setattr(
        design_picture, "_name", lambda axes, place, name, *rest: drawn.append(name) or real(axes, place, name, *rest)
    )
    assert "design.png" in init(tmp_path).splitlines()[0]
    assert (tmp_path / "design.png").read_bytes().startswith(b"\x89PNG")
    sure = {name for name in drawn if not name.startswith("?")}
    assert {"? J1", "J2"} <= set(drawn)
    assert f"? {names[3]}" in drawn
    assert not {f"? {name}" for name in sure} & set(drawn)
    assert set(names) | {"J1", "J2", "J3", "J4"} == {name.removeprefix("? ") for name in drawn}
    with (tmp_path / "design.json").open("a", encoding="utf-8") as file:
        file.write("\n")
    before = (tmp_path / "design.json").read_bytes()
    init(tmp_path, "--force")
    assert (tmp_path / "design.json").read_bytes() == before


@pytest.mark.usefixtures("no_picture")
@pytest.mark.parametrize(
    ("suffix", "unit", "size_mm"),
    [
        ("stl", "inch", 25.4),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in (("obj", "mm", 1.0), ("ply", "m", 1000.0))),
    ],
)
def test_the_unit_comes_from_scans_that_state_theirs(tmp_path, suffix, unit, size_mm):
    meshes, joints = bridge_parts.bridge(5, 2)
    write_parts(tmp_path, meshes, suffix, "Modelle 3D", size_mm)
    write_scans(tmp_path, meshes, 0.001, "x_m,y_m,z_m")
    output = init(tmp_path)
    assert "5 parts (foot1, rib1, rib2, rib3, foot2), 4 joint(s)" in output
    assert "?" not in output
    written = json.loads((tmp_path / "design.json").read_text("utf-8"))
    assert written["units"] == unit
    assert "unsure" not in written
    scene = scan_folder.read_input(tmp_path)
    assert np.abs(scene.arch.joint_points - joints).max() < CORNER_MM
    assert [scan.component for scan in scene.scans] == sorted(bridge_parts.names(5))
    # The same without the files that init wrote.
    (tmp_path / "project.toml").unlink()
    (tmp_path / "design.json").unlink()
    again = scan_folder.read_input(tmp_path)
    assert again.arch.joint_points == pytest.approx(scene.arch.joint_points, abs=1e-5)  # digits of design.json
    assert again.units_reason[-1].code == "units.design-guessed"


@pytest.mark.usefixtures("no_picture")
def test_guessed_unit_of_a_design_is_marked_unsure(tmp_path):
    meshes, _ = bridge_parts.bridge()
    write_parts(tmp_path, meshes, "ply", size_mm=1000.0)
    write_scans(tmp_path, meshes, 0.001)
    (doubt,) = guess.guess(tmp_path).made.unit_doubts
    assert (doubt.code, doubt.values["unit"]) == ("init.design-unit-taken", "m")
    written = f"? {messages('en').text(doubt)}"
    assert written in init(tmp_path).splitlines()
    assert json.loads((tmp_path / "design.json").read_text("utf-8"))["unsure"] == [written]


@pytest.mark.parametrize("one_file", [True, False])
def test_bodies_of_cad_files_without_a_unit_have_the_guessed_one(tmp_path, monkeypatch, one_file):
    """The bridge in numbers of metres; facets are those of a file in the unit that is asked for."""
    meshes, joints = bridge_parts.bridge()
    parts_of = dict(zip(bridge_parts.names(5), meshes, strict=True))
    asked = []

    def read_design(path, unit):
        asked.append(unit)
        parts = parts_of if path.stem == "bridge" else {path.stem: parts_of[path.stem]}
        bodies = [
            welded(name, vertices / 1000.0 * MM_PER_UNIT[unit], faces) for name, (vertices, faces) in parts.items()
        ]
        body = stacked("all", bodies)
        of_facet = np.repeat(np.arange(len(bodies)), [len(one.faces) for one in bodies])
        names = DesignBodies(names=tuple(parts), of_facet=of_facet)
        return body.vertices, body.faces, names, ""

    monkeypatch.setattr(cad, "read", read_design)
    (tmp_path / "design").mkdir()
    paths = [tmp_path / f"design/{name}.step" for name in (["bridge"] if one_file else parts_of)]
    for path in paths:
        path.write_text("ISO-10303-21;")
    guessed = guess_design.guess(tmp_path, paths, [])
    assert asked[-1] == "m"
    assert values(guessed.unit_doubts, "init.design-unit-taken")["unit"] == "m"
    assert guessed.units == ("mm" if one_file else "m")  # of one file each part's mesh is written, in mm
    assert np.abs(guessed.design.joint_points - joints).max() < CORNER_MM


@pytest.mark.usefixtures("no_picture")
def test_design_in_inches_is_made_only_with_stated_units(tmp_path):
    meshes, joints = bridge_parts.bridge()
    write_parts(tmp_path, meshes, "ply", size_mm=25.4)
    write_scans(tmp_path, meshes, 1.0 / 25.4)
    assert "init.design-unit-unclear" in codes(guess.guess(tmp_path).doubts)
    init(tmp_path)
    assert not (tmp_path / "design.json").exists()
    init(tmp_path, "--force", "--design-units", "inch")
    assert np.abs(scan_folder.read_input(tmp_path).arch.joint_points - joints).max() < CORNER_MM


@pytest.mark.usefixtures("no_picture")
def test_two_files_of_one_name_and_a_root_gap(tmp_path):
    meshes, _ = bridge_parts.bridge(5, 0, 6.0)
    write_parts(tmp_path, meshes, "obj")
    bridge_parts.write_stl(tmp_path / "design/rib1.stl", *meshes[1])
    write_scans(tmp_path, meshes, 0.001, "x_m,y_m,z_m")
    doubts = guess.guess(tmp_path).doubts
    assert [(doubt.code, doubt.values["file"]) for doubt in doubts] == [("init.files-of-one-name", "rib1.stl")]
    init(tmp_path)
    assert scan_folder.read_input(tmp_path).tolerance.root_gap_mm == pytest.approx(6.0, abs=0.01)
    (tmp_path / "project.toml").unlink()
    (tmp_path / "design.json").unlink()
    assert scan_folder.read_input(tmp_path).tolerance.root_gap_mm == pytest.approx(6.0, abs=0.01)  # as it is printed


@pytest.mark.usefixtures("cad_here")
def test_a_step_file_with_all_parts_of_our_own_bridge(tmp_path):
    """Four ribs as solids of one file, whose names are those of the bodies."""
    (tmp_path / "CAD").mkdir()
    (tmp_path / "CAD/bridge v3.step").write_bytes(made(step_bridges.ribs_in_one_file))
    write_lone_scans(tmp_path, "a")
    guessed = guess.guess(tmp_path)
    assert isinstance(guessed.made.design, ArchDesign)
    assert guessed.made.doubts == ()
    assert order(guessed.made.design) == step_bridges.RIBS
    for points, four in zip(guessed.made.design.joint_points, step_bridges.corners_of_ribs(), strict=True):
        assert np.abs(points - np.vstack([four, 0.5 * (four + np.roll(four, -1, axis=0))])).max() < CORNER_MM
    guess.write_design(tmp_path, guessed)
    written = scan_folder.read_design(tmp_path, tmp_path / "design.json", "m")
    assert np.abs(written.joint_points - guessed.made.design.joint_points).max() < 1e-5  # digits of design.json
    assert (tmp_path / "design-parts/拱肋3.ply").is_file()
    # What init has made is no second design.
    (tmp_path / "design.json").unlink()
    assert guess.guess(tmp_path).made.doubts == ()


@pytest.mark.usefixtures("cad_here")
def test_a_step_file_a_part_of_an_independent_bridge(tmp_path):
    (tmp_path / "Teile").mkdir()
    files, corners = made(step_bridges.lofted_parts, 3)
    for name, content in files.items():
        (tmp_path / f"Teile/{name}.step").write_bytes(content)
    write_lone_scans(tmp_path, "a")
    one = guess.guess(tmp_path).made
    assert one.doubts == ()
    assert order(one.design) == list(files)
    assert np.abs(one.design.joint_points[:, :4] - corners).max() < CORNER_MM


@pytest.mark.usefixtures("cad_here")
def test_spliced_girders_of_a_step_file_are_joined_where_they_end(tmp_path):
    """Splice plates and bolts are no parts: they are named as left out, and the joints are those of the girders."""
    content, joints = made(step_bridges.spliced_girders, 6.0)
    (tmp_path / "all.step").write_bytes(content)
    write_lone_scans(tmp_path, "G1", "G2", "G3")
    guessed = guess.guess(tmp_path)
    design = guessed.made.design
    assert order(design) == ["G1", "G2", "G3"]
    b, h = 0.5 * step_bridges.WIDTH, 0.5 * step_bridges.HEIGHT
    for points, x in zip(design.joint_points, joints, strict=True):
        assert np.abs(points[:4] - [[x, b, -h], [x, -b, -h], [x, -b, h], [x, b, h]]).max() < CORNER_MM
    assert guessed.made.root_gap_mm == pytest.approx(6.0)
    assert [doubt.code for doubt in guessed.made.other_doubts] == ["init.splice-plates", "init.fasteners"]
    assert codes(guessed.made.kind_doubts) == ["init.straight"]
    guess.write_design(tmp_path, guessed)
    assert len(list((tmp_path / "design-parts").iterdir())) == 3
    # Girders end to end in one file may as well be a structure that is built, where no scan has the name of one.
    (tmp_path / "other").mkdir()
    (tmp_path / "other/all.step").write_bytes(content)
    write_lone_scans(tmp_path / "other", "S1", "S2")
    guessed = guess.guess(tmp_path / "other")
    assert (guessed.made, guessed.kind) == (None, "structure")
