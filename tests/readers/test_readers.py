"""Scan files made byte by byte, or by another library, and every real file there is."""

import struct

import numpy as np
import pytest

from processor import readers
from processor.model import InputError, Scan, reason
from processor.readers import ply
from processor.readers.e57 import cartesian_from_spherical
from processor.writers import e57
from processor.writers.cloud import of_scan
from tests.support.files.scan_bytes import DATA, POSE_ROWS, TURNED, las_bytes, needs_data, pcd_header, ply_header, put

POINTS = np.array([[1.5, -2.25, 3.0], [0.1, 0.2, 0.3], [-7.0, 8.0, 1e-3]])


ROUNDING = 1e-12  # a few products of numbers below 100 in float64


def one(path):
    scans = readers.read(path)
    assert len(scans) == 1
    return scans[0]


# --- PLY -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("form", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")], ids=["little", "big"]
)
@pytest.mark.parametrize(("kind", "code"), [("float", "f"), ("float64", "d")])
def test_ply_binary(tmp_path, form, order, kind, code):
    rows = b"".join(struct.pack(f"{order}3{code}H", *row, 7 * i) for i, row in enumerate(POINTS))
    scan = one(put(tmp_path / "a.ply", ply_header(form, kind, "property ushort intensity\n") + rows))
    assert np.array_equal(scan.points, POINTS.astype(code).astype(float))
    assert scan.intensity.tolist() == [0, 7, 14]
    assert (scan.name, scan.unit, scan.T_project_scan.size) == ("a", "", 0)


def test_ply_ascii_with_faces(tmp_path):
    more = "property float scalar_Intensity\nelement face 1\nproperty list uchar int vertex_indices\n"
    content = ply_header("ascii", "double", more) + b"1.5 -2.25 3 9\n0.1 0.2 0.3 8\n-7 8 1e-3 7\n3 0 1 2\n"
    scan = one(put(tmp_path / "a.ply", content))
    assert np.array_equal(scan.points, POINTS)
    assert scan.intensity.tolist() == [9, 8, 7]


@pytest.mark.parametrize(("form", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
@pytest.mark.parametrize("room", [1, 1 << 20])
def test_ply_with_elements_before_the_vertices(tmp_path, monkeypatch, form, order, room):
    """Lists of any length, of several types and with single values beside them; also longer than is read at once."""
    monkeypatch.setattr(ply, "SKIPPED_BYTES", room)
    head = (
        f"ply\nformat {form} 1.0\nelement face 40\nproperty uchar flag\nproperty list uchar int vertex_indices\n"
        "property list ushort double w\nelement other 2\nproperty float a\nelement vertex 3\n"
    ).encode()
    head += b"".join(f"property double {axis}\n".encode() for axis in "xyz") + b"end_header\n"
    faces = b"".join(
        struct.pack(f"{order}BB{k % 7}iH{k % 3}d", 9, k % 7, *range(k % 7), k % 3, *range(k % 3)) for k in range(40)
    )
    content = head + faces + bytes(8) + POINTS.astype(f"{order}f8").tobytes()
    assert np.array_equal(one(put(tmp_path / "a.ply", content)).points, POINTS)
    with pytest.raises(InputError, match="not a readable PLY file"):
        readers.read(put(tmp_path / "a.ply", content[: len(head) + len(faces) - 9]))


# --- PCD -----------------------------------------------------------------------------------------------------------


def test_pcd_ascii_with_any_blanks(tmp_path):
    scan = one(put(tmp_path / "a.pcd", pcd_header("ascii") + b"1.5  -2.25\t3 1\n0.5 0.25 nan 2\r\n-7 8 1 3"))
    assert scan.points.tolist() == [[1.5, -2.25, 3.0], [-7.0, 8.0, 1.0]]
    assert scan.intensity.tolist() == [1, 3]


def test_pcd_binary_organised(tmp_path):
    rows = np.array([[1.5, -2.25, 3, 1], [np.nan] * 4, [2, 2, 2, 4], [np.nan, 1, 1, 0]], "<f4")
    scan = one(put(tmp_path / "a.pcd", pcd_header("binary", 4, 2, 2) + rows.tobytes()))
    assert scan.points.tolist() == [[1.5, -2.25, 3.0], [2.0, 2.0, 2.0]]
    assert scan.intensity.tolist() == [1, 4]


@needs_data
@pytest.mark.parametrize("name", ["room_scan1.pcd", "region_growing_tutorial.pcd", "bun0.pcd"])
def test_pcd_against_another_library(name):
    o3d = pytest.importorskip("open3d")
    path = (DATA / "pcd" / name).resolve()
    scan = one(path)
    # The other library reads the decimal numbers of ASCII as float64, the declared type is float32.
    theirs = np.asarray(o3d.io.read_point_cloud(str(path)).points).astype(np.float32)
    assert np.array_equal((scan.origin + scan.points).astype(np.float32), theirs)


# --- PTX -----------------------------------------------------------------------------------------------------------


def test_ptx_poses_and_no_returns(tmp_path):
    grid = "2\n2\n" + TURNED + "1 2 3 0.5 9 9 9\n0 0 0 0.5 0 0 0\n4 5 6 0.25 9 9 9\n0 0 7 1 9 9 9\n"
    scans = readers.read(put(tmp_path / "a.ptx", grid + ptx_of() + "\n"))
    assert [scan.name for scan in scans] == ["a-1", "a-2"]
    assert scans[0].points.tolist() == [[1, 2, 3], [4, 5, 6], [0, 0, 7]]
    assert scans[0].intensity.tolist() == [0.5, 0.25, 1.0]
    assert scans[0].unit == "m"
    # By hand: (1, 2, 3) turned is (-2, 1, 3), moved (8, 21, 33).
    assert np.allclose(scans[0].T_project_scan @ [1, 2, 3, 1], [8, 21, 33, 1], atol=ROUNDING)
    assert np.allclose(scans[0].position, 0.0, atol=ROUNDING)
    assert scans[1].points.tolist() == [[7, 8, 9]]


IDENTITY = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"


def ptx_of(rows=IDENTITY, position="0 0 0", point="7 8 9"):
    """A grid of one cell."""
    return f"1\n1\n{position}\n1 0 0\n0 1 0\n0 0 1\n{rows}{point} 0.1\n"


@pytest.mark.parametrize(
    "rows",
    [
        "1 0 0 0\n0 1 0 0\n0 0 2 0\n0 0 0 1\n",
        "0.5 0 0 0\n0 0.5 0 0\n0 0 0.5 0\n0 0 0 1\n",  # R^T R is below the identity
        "1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n",
        "1 0.5 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n",
        "nan 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n",
        "1 0 0 0\n0 1 0 0\n0 0 1 0\n10 inf 30 1\n",
        "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 2\n",
        "1 0 0 9\n0 1 0 0\n0 0 1 0\n10 20 30 1\n",  # translations in the last row and in the last column
    ],
)
def test_a_ptx_matrix_that_is_no_pose_is_refused(tmp_path, rows):
    with pytest.raises(InputError, match="the matrix of scan 1 is not a rotation and a translation"):
        readers.read(put(tmp_path / "a.ptx", ptx_of(rows)))


def test_a_ptx_matrix_for_column_vectors_is_read_with_the_translation_of_its_last_column(tmp_path):
    scan = one(put(tmp_path / "a.ptx", ptx_of("0 -1 0 10\n1 0 0 20\n0 0 1 30\n0 0 0 1\n", "10 20 30")))
    # By hand: (1, 2, 3) turned by a quarter about z is (-2, 1, 3), moved (8, 21, 33).
    np.testing.assert_allclose(scan.T_project_scan @ [1, 2, 3, 1], [8, 21, 33, 1], atol=ROUNDING)
    np.testing.assert_allclose(scan.position, 0.0, atol=ROUNDING)
    assert [(x.code, x.values["scans"]) for x in scan.remarks] == [("read.matrix-for-columns", ("a",))]


@pytest.mark.parametrize(
    ("position", "rows", "expected"),
    [
        ("0 0 0", POSE_ROWS, [0, 0, 0]),  # says nothing: points are in the scanner's frame
        ("10 20 30", POSE_ROWS, [0, 0, 0]),
        ("10 20 35", POSE_ROWS, [0, 0, 5]),
        ("5 6 7", IDENTITY, [5, 6, 7]),  # a cloud in the project's frame
    ],
)
def test_the_scanner_of_a_ptx_grid(tmp_path, position, rows, expected):
    scan = one(put(tmp_path / "a.ptx", ptx_of(rows, position)))
    np.testing.assert_allclose(scan.position, expected, atol=ROUNDING)


def test_scans_without_points_are_named_and_the_others_read(tmp_path):
    grids = [ptx_of(point=point) for point in ("1 2 3", "0 0 0", "4 5 6")]
    scans = readers.read(put(tmp_path / "a.ptx", "".join(grids)))
    assert [(scan.name, scan.points.tolist()) for scan in scans] == [("a-1", [[1, 2, 3]]), ("a-3", [[4, 5, 6]])]
    assert scans[0].remarks[0].values == {"count": 1, "scans": ("a-2",)}
    with pytest.raises(InputError, match="found none in scan 'a'"):
        readers.read(put(tmp_path / "a.ptx", grids[1]))


def e57_of(path, counts, invalid=()):
    """Scans A, B, ... of some points each, those of the scans ``invalid`` all marked so."""
    from pye57 import libe57

    file = libe57.ImageFile(str(path), "w")
    root = file.root()
    root.set("formatName", libe57.StringNode(file, "ASTM E57 3D Imaging Data File"))
    root.set("guid", libe57.StringNode(file, "{0}"))
    for key in ("versionMajor", "versionMinor"):
        root.set(key, libe57.IntegerNode(file, key == "versionMajor"))
    scans = libe57.VectorNode(file, True)
    root.set("data3D", scans)
    for k, count in enumerate(counts):
        node, prototype = libe57.StructureNode(file), libe57.StructureNode(file)
        node.set("guid", libe57.StringNode(file, f"{{{k + 1}}}"))
        node.set("name", libe57.StringNode(file, "ABC"[k]))
        names = [f"cartesian{axis}" for axis in "XYZ"]
        for name in names:
            prototype.set(name, libe57.FloatNode(file, 0.0))
        prototype.set("cartesianInvalidState", libe57.IntegerNode(file, 0, 0, 2))
        points = libe57.CompressedVectorNode(file, prototype, libe57.VectorNode(file, True))
        node.set("points", points)
        scans.append(node)
        if count:
            columns = [*POINTS[:count].T.copy(), np.full(count, 2.0 * (k in invalid))]
            buffers = libe57.VectorSourceDestBuffer()
            for name, column in zip([*names, "cartesianInvalidState"], columns, strict=True):
                buffers.append(libe57.SourceDestBuffer(file, name, column, count, True, True))
            writer = points.writer(buffers)
            writer.write(count)
            writer.close()
    file.close()
    return path


@pytest.mark.parametrize(("counts", "invalid"), [((3, 0, 2), ()), ((3, 2, 2), (1,))])
def test_e57_scans_without_points_are_named_and_the_others_read(tmp_path, counts, invalid):
    scans = readers.read(e57_of(tmp_path / "a.e57", counts, invalid))
    assert [scan.name for scan in scans] == ["A", "C"]
    np.testing.assert_array_equal(scans[1].points, POINTS[:2])
    assert scans[0].remarks == (reason("read.scans-without-points", count=1, scans=["B"]),)
    with pytest.raises(InputError, match="expected points, found none in scan"):
        readers.read(e57_of(tmp_path / "b.e57", (0,)))


# --- text ----------------------------------------------------------------------------------------------------------

PLAIN = "1.5 -2.25 3\n0.1 0.2 0.3\n-7 8 1e-3\n"
TABLES = {
    "blanks": ("a.xyz", PLAIN),
    "tabs": ("a.txt", PLAIN.replace(" ", "\t")),
    "windows": ("a.txt", PLAIN.replace("\n", "\r\n")),
    "columns aligned": ("a.asc", "   1.5   -2.25  3 \n   0.1  0.2   0.3\n\n  -7  8  1e-3"),
    "commas": ("a.csv", PLAIN.replace(" ", ",")),
    "commas and blanks": ("a.csv", PLAIN.replace(" ", ", ")),
    "semicolons": ("a.csv", PLAIN.replace(" ", ";")),
    "semicolons at the end": ("a.csv", PLAIN.replace(" ", ";").replace("\n", ";\n")),
    "decimal commas, semicolons": ("a.csv", PLAIN.replace(" ", ";").replace(".", ",")),
    "decimal commas, blanks": ("a.txt", PLAIN.replace(".", ",")),
    "decimal commas, tabs, header": ("a.txt", "X\tY\tZ\n" + PLAIN.replace(" ", "\t").replace(".", ",")),
    "header": ("a.csv", "x,y,z\n" + PLAIN.replace(" ", ",")),
    "header in quotes": ("a.csv", '"X";"Y";"Z"\n' + PLAIN.replace(" ", ";")),
    "header as comment": ("a.txt", "//X Y Z\n" + PLAIN),
    "comments between": ("a.xyz", "# made by hand\n" + PLAIN.replace("\n", "\n# more\n")),
    "slashes between": ("a.xyz", PLAIN.replace("\n", "\n// more\n")),
    "count": ("a.pts", "3\n" + PLAIN),
    "count and blank line": ("a.pts", "3 \n\n" + PLAIN),
    "title": ("a.txt", "bridge east\n" + PLAIN),
    "byte order mark": ("a.csv", "\ufeffx,y,z\n" + PLAIN.replace(" ", ",")),
    "mark and no header": ("a.csv", "\ufeff" + PLAIN.replace(" ", ",")),
    "other order": ("a.csv", "id,z,y,x\n1,3,-2.25,1.5\n2,0.3,0.2,0.1\n3,1e-3,8,-7\n"),
}


@pytest.mark.parametrize("case", TABLES)
def test_text_tables_are_read_with_their_separators(tmp_path, case):
    name, text = TABLES[case]
    scan = one(put(tmp_path / name, text))
    assert np.array_equal(scan.points, POINTS)
    assert scan.intensity.size == 0
    assert scan.unit == ""


def test_text_in_other_encodings(tmp_path):
    for encoding in ("gb18030", "utf-16"):
        scan = one(put(tmp_path / "a.txt", ("# 桥梁\nX Y Z\n" + PLAIN).encode(encoding)))
        assert np.array_equal(scan.points, POINTS)


def test_text_intensity_and_unit(tmp_path):
    assert one(put(tmp_path / "a.pts", "2\n1 2 3 -1035 97 59 38\n4 5 6 -7 0 0 0\n")).intensity.tolist() == [-1035, -7]
    assert one(put(tmp_path / "a.xyz", "1 2 3 9\n4 5 6 8\n")).intensity.tolist() == [9, 8]
    assert one(put(tmp_path / "a.xyz", "1 2 3 255 0 0\n")).intensity.size == 0  # a colour
    scan = one(put(tmp_path / "a.csv", "x [mm],y [mm],z [mm],r,g,b,Intensity\n1,2,3,4,5,6,7\n"))
    assert (scan.unit, scan.intensity.tolist()) == ("mm", [7])


# --- LAS and E57 ---------------------------------------------------------------------------------------------------


def test_las_by_the_specification(tmp_path):
    raw = np.array([[123, 456, -789], [2_000_000, 3, 4]])
    scan = one(put(tmp_path / "a.las", las_bytes(raw, 0.001, [500_000.0, 4_400_000.0, 100.0])))
    expected = [[500_000.123, 4_400_000.456, 99.211], [502_000.0, 4_400_000.003, 100.004]]
    assert np.allclose(scan.origin + scan.points, expected, rtol=0, atol=1e-9)  # a step at 4e6 m as float64
    assert scan.intensity.tolist() == [100, 101]
    assert scan.unit == "m"


@pytest.mark.parametrize(
    ("own", "expected"),
    [
        (["S1"], ["a"]),  # a lone scan is named by its file
        (["S1", "二号站", "S 3"], ["S1", "二号站", "S 3"]),
        (["S1", "S1", "S2"], ["a-1", "a-2", "S2"]),
        (["", "../x", "S\n3", " S4", ".S5", "S" * 101], [f"a-{i}" for i in range(1, 7)]),
        (["a-2", "", "S3"], ["a-1", "a-2", "a-3"]),  # a number must not be another's name
    ],
)
def test_e57_scans_keep_their_names_where_these_are_plain(own, expected, tmp_path):
    scans = [Scan(name, POINTS + i) for i, name in enumerate(own)]
    e57.write(tmp_path / "a.e57", [*map(of_scan, scans)], spherical=False)
    assert [scan.name for scan in readers.read(tmp_path / "a.e57")] == expected


def test_e57_pose_and_invalid_points(tmp_path):
    pye57 = pytest.importorskip("pye57")
    path = tmp_path / "a.e57"
    columns = {f"cartesian{axis}": POINTS[:, i].copy() for i, axis in enumerate("XYZ")}
    columns["cartesianInvalidState"] = np.array([0, 2, 0], np.int8)
    half = np.sqrt(0.5)
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw(columns, rotation=np.array([half, 0, 0, half]), translation=np.array([10.0, 20.0, 30.0]))
        file.write_scan_raw({key: value for key, value in columns.items() if "Invalid" not in key})
    turned, plain = readers.read(path)
    assert (turned.name, plain.name, turned.unit) == ("Scan 0", "Scan 1", "m")  # that writer's own names
    assert np.allclose(turned.points, POINTS[[0, 2]], atol=1e-6)  # that writer keeps float32
    assert len(plain.points) == 3
    # By hand: (1, 2, 3) turned by a quarter about z is (-2, 1, 3), moved (8, 21, 33).
    assert np.allclose(turned.T_project_scan @ [1, 2, 3, 1], [8, 21, 33, 1])
    assert turned.position.tolist() == [0, 0, 0]


def test_spherical_points_by_hand():
    quarter = np.pi / 2
    points = cartesian_from_spherical(
        np.array([2.0, 2.0, 2.0, 2.0]), np.array([0, quarter, 0, quarter]), np.array([0, 0, quarter, np.pi / 6])
    )
    # The sine and cosine of pi as float64.
    assert np.allclose(points, [[2, 0, 0], [0, 2, 0], [0, 0, 2], [0, np.sqrt(3), 1]], atol=1e-15)


# --- real files ----------------------------------------------------------------------------------------------------

SCANS = [path for path in sorted(DATA.rglob("*")) if path.suffix in readers.SUFFIXES] if DATA.is_dir() else []
REFUSED = {
    "bunny_8.pts": "expected 8 points as declared, found more",
    "multiple-and-transform.ptx": "not a rotation and a translation",
}
# Points of each scan, less those without a return, and the unit: as headers, line counts and grids say.
EXPECTED = {
    "bunnyDouble.e57": ([30_571], "m"),
    "bunnyInt32.e57": ([30_571], "m"),
    "pumpAVisualReferenceImage.e57": ([155_201], "m"),
    "testWithNormals.e57": ([2], "m"),
    "translationWithoutRotation.e57": ([4], "m"),
    "autzen_trim.laz": ([110_000], "ft"),
    "indoor.laz": ([808_042], "m"),
    "simple.las": ([1_065], "m"),
    "simple.laz": ([1_065], "m"),
    "simple1_4.las": ([22_600], "m"),  # it also says degrees, which its coordinates are not
    "plane_horizontal_t1.xyz": ([441], ""),
    "plane_horizontal_t2.xyz": ([441], ""),
    "bun0.pcd": ([397], ""),
    "region_growing_tutorial.pcd": ([108_104], ""),
    "room_scan1.pcd": ([112_586], ""),
    "room_scan2.pcd": ([112_624], ""),
    "1.2-with-color.ptx": ([1_065], "m"),
    "complex-transform.ptx": ([4], "m"),  # of 12 cells
    "no-color.ptx": ([15], "m"),
    "autzen.pts": ([10], ""),
    "site_56_8.pts": ([8], ""),
    "test.pts": ([19], ""),
    "SPH101.xyz": ([6_474], ""),
    "SPH102.xyz": ([1_893], ""),
    "SPH103.xyz": ([6_716], ""),
    "column_mm.csv": ([232_559], ""),
}


@needs_data
@pytest.mark.parametrize("path", SCANS, ids=lambda path: path.name)
def test_every_real_file(path):
    if path.name in REFUSED:
        with pytest.raises(InputError, match=REFUSED[path.name]):
            readers.read(path)
        return
    scans = readers.read(path)
    assert ([len(scan.points) for scan in scans], scans[0].unit) == EXPECTED[path.name]
    for scan in scans:
        assert np.isfinite(scan.points).all()
        assert np.abs(scan.points).max() < 20_000.0  # the widest of them: near their origin all the same


@needs_data
def test_real_files_of_one_cloud_agree():
    las, laz = one(DATA / "las/simple.las"), one(DATA / "las/simple.laz")
    assert np.array_equal(las.points, laz.points)
    double, integer = one(DATA / "e57/bunnyDouble.e57"), one(DATA / "e57/bunnyInt32.e57")
    assert np.abs(double.points - integer.points).max() < 1e-6  # half a step of the scaled integers
    assert one(DATA / "las/autzen_trim.laz").unit == "ft"  # from its coordinate system
    ptx, pts = one(DATA / "ptx_pts/1.2-with-color.ptx"), one(DATA / "las/simple.las")
    assert np.abs((ptx.origin + ptx.points) - (pts.origin + pts.points)).max() < 1e-6  # digits of the text


@needs_data
def test_colours_are_those_that_other_programs_read():
    import laspy
    import pye57

    (scan,) = readers.read(DATA / "e57/pumpAVisualReferenceImage.e57")
    raw = pye57.E57(str(DATA / "e57/pumpAVisualReferenceImage.e57")).read_scan_raw(0)
    valid = raw["cartesianInvalidState"] == 0
    for i, name in enumerate(("Red", "Green", "Blue")):
        np.testing.assert_array_equal(scan.colour[:, i], raw[f"color{name}"][valid])
    (scan,) = readers.read(DATA / "las/simple1_4.las")  # 256 steps of 16 bits a step
    las = laspy.read(DATA / "las/simple1_4.las")
    np.testing.assert_array_equal(scan.colour, np.stack([las.red, las.green, las.blue], axis=1) // 256)
    (scan,) = readers.read(DATA / "las/indoor.laz")  # all black: no colours
    assert scan.colour.shape == (0, 3)
    (scan,) = readers.read(DATA / "ptx_pts/1.2-with-color.ptx")
    cells = np.loadtxt(DATA / "ptx_pts/1.2-with-color.ptx", skiprows=10)
    np.testing.assert_array_equal(scan.colour, cells[(cells[:, :3] != 0).any(axis=1), 4:])
    (scan,) = readers.read(DATA / "ptx_pts/test.pts")
    np.testing.assert_array_equal(scan.colour, np.loadtxt(DATA / "ptx_pts/test.pts", skiprows=1)[:, 4:])


def test_columns_that_are_no_colours_are_left(tmp_path):
    rows = np.column_stack([POINTS, np.full(len(POINTS), 0.5), [[0.1, 0.2, 0.3]] * len(POINTS)])
    np.savetxt(tmp_path / "normals.xyz", rows)
    (scan,) = readers.read(tmp_path / "normals.xyz")
    assert scan.colour.shape == (0, 3)
    np.savetxt(
        tmp_path / "named.csv", rows * [1, 1, 1, 1, 10, 10, 10], header="x,y,z,i,B,G,R", delimiter=",", comments=""
    )
    (scan,) = readers.read(tmp_path / "named.csv")
    assert scan.colour.tolist() == [[3, 2, 1]] * len(POINTS)
