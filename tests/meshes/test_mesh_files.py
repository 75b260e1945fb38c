"""Meshes of PLY, STL and OBJ files, and polygons cut into triangles."""

from collections import Counter

import numpy as np
import pytest
import trimesh

from processor.meshes import mesh_files
from processor.meshes.polygons import CrossingError, triangulated
from processor.model import InputError

L = np.array([(0, 0), (1000, 0), (1000, 200), (200, 200), (200, 1000), (0, 1000)], float)
FLAT = np.array([(0, 0), (1, 0), (2, 0), (3, 0), (3, 1), (0, 1)], float)  # corners in line with their neighbours
CUT_OPEN = np.array(  # a square with a square hole, cut open from a corner of one to a corner of the other
    [(0, 0), (10, 0), (10, 10), (0, 10), (0, 0), (3, 3), (3, 6), (6, 6), (6, 3), (3, 3)], float
)


def comb(teeth):
    top = [(i + 0.5 * k, 6 - 5 * k) for i in range(teeth, 0, -1) for k in (1, 0)]
    return np.array([(0, 0), (teeth + 2, 0), (teeth + 2, 1), *top, (0, 1)], float)


def star(seed, corners=25):
    rng = np.random.default_rng(seed)
    angle, radius = 2.0 * np.pi * np.arange(corners) / corners, rng.uniform(100.0, 1000.0, corners)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def in_space(polygon):
    """The polygon in a plane of any direction, far from the origin."""
    Q, _ = np.linalg.qr(np.random.default_rng(len(polygon)).normal(size=(3, 3)))
    return np.column_stack([polygon, np.zeros(len(polygon))]) @ Q.T + [1e5, -2e5, 3e4]


@pytest.mark.parametrize("polygon", [L, L[::-1], FLAT, CUT_OPEN, comb(9), *(star(k) for k in range(5))])
def test_triangles_make_up_the_polygon_whatever_its_first_corner(polygon):
    x, y = polygon.T
    area = 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y))  # the surveyor's formula
    points = in_space(polygon)
    for first in range(len(points)):
        ring = np.roll(np.arange(len(points)), -first)
        triangles = triangulated(points, ring, np.array([len(ring)]))
        a, b, c = (points[triangles[:, k]] for k in range(3))
        areas = 0.5 * np.cross(b - a, c - a)
        assert np.linalg.norm(areas, axis=1).sum() == pytest.approx(area)  # none overlaps another
        assert np.linalg.norm(areas.sum(axis=0)) == pytest.approx(area)  # all face one way
        # The sides of one triangle alone are those of the polygon: no corner is passed over.
        sides = Counter((int(t[k]), int(t[(k + 1) % 3])) for t in triangles for k in range(3))
        rim = {pair for pair in sides if pair[::-1] not in sides}
        assert rim == {(int(i), int(j)) for i, j in zip(ring, np.roll(ring, -1), strict=True)}


def test_convex_polygons_are_fans_from_their_first_corner():
    hexagon = in_space(np.array([(np.cos(k), np.sin(k)) for k in range(6)]))
    triangles = triangulated(hexagon, np.array([0, 1, 2, 3, 4, 5, 2, 1, 0]), np.array([6, 3]))
    assert triangles.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5], [2, 1, 0]]


def test_sides_that_cross_are_no_polygon():
    bow = np.array([(0, 0, 0), (1, 1, 0), (1, 0, 0), (0, 2, 0)], float)
    with pytest.raises(CrossingError) as error:
        triangulated(bow, np.array([0, 1, 2, 0, 1, 2, 3]), np.array([3, 4]))
    assert error.value.row == 1


def test_a_sliver_of_the_last_digits_is_cut_anyhow():
    sliver = np.array([(0, 0, 0), (1000, 1e-5, 0), (2000, -1e-5, 0), (1500, 1e-5, 0)], float)
    assert triangulated(sliver, np.arange(4), np.array([4])).shape == (2, 3)


# --- Files

BOX = trimesh.creation.box((400.0, 300.0, 200.0))
PRISM = np.array([(*p, z) for z in (0.0, 20.0) for p in L])
ASCII = "\n".join(
    ["solid", *("facet normal 0 0 0\nouter loop\n{}\n{}\n{}\nendloop\nendfacet" for _ in BOX.faces), "endsolid"]
).format(*(f"vertex {x} {y} {z}" for x, y, z in BOX.triangles.reshape(-1, 3)))
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
CORNERS = np.array([(x, y, z) for x in (-200, 200) for y in (-150, 150) for z in (-100, 100)], float)

HALVES = [row for a, b, c, d in QUADS for row in ((a, b, c), (a, c, d))]


def obj(corner="{}", shift=1, end="\n"):
    lines = ["v {} {} {}".format(*p) for p in CORNERS]
    return end.join([*lines, *("f " + " ".join(corner.format(k + shift) for k in quad) for quad in QUADS), ""])


def ply(lists, header="uchar int vertex_indices"):
    head = ["ply", "format ascii 1.0", f"element vertex {len(CORNERS)}", *(f"property double {k}" for k in "xyz")]
    head += [f"element face {len(lists)}", f"property list {header}", "end_header"]
    rows = [" ".join(map(str, p)) for p in CORNERS] + [" ".join(map(str, (len(row), *row))) for row in lists]
    return "\n".join([*head, *rows, ""])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.stl", ASCII),
        ("capitals.stl", ASCII.upper()),
        ("tabs.stl", ASCII.replace("vertex ", "\tvertex\t").replace("\n", "\r\n")),
        ("a.obj", obj()),
        ("numbers.obj", obj("{}/1/1")),
        ("normals.obj", obj("{}//3")),
        ("from-the-end.obj", obj("{}", -8)),
        ("continued.obj", obj().replace(" 4 3\n", " \\\n4 3\n")),
        ("colours.obj", obj().replace("100\n", "100 0.5 0.5 0.5\n")),
        ("windows.obj", "# Träger\r\nmtllib ../x.mtl\r\n" + obj(end="\r\n")),
        ("quads.ply", ply(QUADS)),
        ("triangles.ply", ply(HALVES, "uint8 uint32 vertex_index")),
        ("mixed.ply", ply([*QUADS[1:], (0, 1, 3), (0, 3, 2)])),
    ],
)  # fmt: skip
def test_a_box_is_read_however_it_is_written(name, text, tmp_path):
    (tmp_path / name).write_bytes(text.encode("latin-1"))
    whole = trimesh.Trimesh(*mesh_files.read_whole(tmp_path / name))
    assert whole.is_watertight
    assert whole.volume == pytest.approx(400.0 * 300.0 * 200.0)


@pytest.mark.parametrize("kind", ["stl", "ply", "stl_ascii"])
def test_files_of_another_library_are_read(kind, tmp_path):
    torus = trimesh.creation.torus(500.0, 100.0)
    path = tmp_path / f"a.{kind[:3]}"
    torus.export(path, file_type=kind)
    vertices, triangles = mesh_files.read_whole(path)
    np.testing.assert_allclose(vertices[triangles], torus.triangles, rtol=1e-6, atol=1e-4)  # float32 of STL


@pytest.mark.parametrize("first", range(6))
def test_a_face_with_a_corner_inward_has_its_own_area(first, tmp_path):
    top = " ".join(str(7 + (first + k) % 6) for k in range(6))
    sides = "\n".join(f"f {k + 1} {(k + 1) % 6 + 1} {(k + 1) % 6 + 7} {k + 7}" for k in range(6))
    lines = "\n".join("v {} {} {}".format(*p) for p in PRISM)
    (tmp_path / "a.obj").write_text(f"{lines}\nf 6 5 4 3 2 1\nf {top}\n{sides}\n")
    whole = trimesh.Trimesh(*mesh_files.read_whole(tmp_path / "a.obj"))
    up = whole.face_normals[:, 2] > 0.5
    assert whole.area_faces[up].sum() == pytest.approx(1000.0 * 1000.0 - 800.0 * 800.0)
    assert (whole.is_watertight, whole.volume) == (True, pytest.approx(20.0 * 360_000.0))


def sizes(path):
    return [(name, len(faces)) for name, _, faces in mesh_files.read(path)]


def test_objects_of_a_file_are_pieces_with_their_names(tmp_path):
    box = obj().splitlines()
    lines = [*box[:8], "o Träger", *box[8:11], "o b", *box[11:13], "o Träger", box[13]]
    for coding in ("utf-8", "latin-1"):
        (tmp_path / "a.obj").write_bytes("\n".join(lines).encode(coding))
        assert sizes(tmp_path / "a.obj") == [
            ("Träger", 8),
            ("b", 4),
        ]
    (tmp_path / "a.stl").write_text(ASCII.replace("solid", "solid web", 1) + "\nsolid flange\n" + ASCII[6:])
    assert sizes(tmp_path / "a.stl") == [
        ("web", 12),
        ("flange", 12),
    ]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.stl", ASCII[: len(ASCII) // 2], "endsolid, is missing"),
        ("a.stl", ASCII.replace("vertex", "vertx", 1), "three vertices in each facet"),
        ("a.stl", ASCII.replace("vertex -200.0", "vertex -200,0", 1), "numbers alone"),
        ("a.stl", "\0" * 134, "expected an STL file|no faces|none"),
        ("a.obj", obj().replace("f 1 2", "f 1 x"), "numbers alone"),
        ("a.obj", obj().replace("f 1 2", "f 0 2"), "no 0"),
        ("a.obj", obj().replace("f 1 2", "f 9 2"), "do not exist"),
        ("a.obj", obj("{}", -20), "do not exist"),
        ("a.obj", obj().replace("-200.0 -150.0 -100.0", "nan 0 0"), "no nan"),
        ("a.obj", obj().replace("v -200.0 -150.0 -100.0", "v inf 0 0"), "finite"),
        ("a.obj", obj().replace("-150.0 -100.0", "", 1), "x, y, z"),
        ("a.obj", obj().replace("f 1 2 4 3", "f 1 4 2 3"), "face 1 of the file is a polygon whose sides cross"),
        ("a.obj", "v 0 0 0\n", "found none"),
        ("a.ply", ply([(0, 1, 9)]), "do not exist"),
        ("a.ply", ply([]), "found none"),
        ("a.ply", ply(QUADS).replace("vertex_indices", "others"), "vertex_indices"),
    ],
)  # fmt: skip
def test_a_damaged_mesh_is_one_line(name, content, message, tmp_path):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=message) as error:
        mesh_files.read(tmp_path / name)
    assert str(tmp_path / name) in str(error.value)
    assert "\n" not in str(error.value)
