"""Map coordinates, units, memory and closed formats: what all readers have in common."""

import json
import struct
import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from processor import readers
from processor.model import InputError, Scan, UsageError
from processor.readers import ascii_rows, coordinate_system, epsg_units
from processor.scan_folder import folder
from processor.writers import e57
from processor.writers.cloud import of_scan
from tests.support.files.scan_bytes import las_bytes, las_with_keys, ply_header, put
from tests.support.files.scan_folders import BOX, arch_design, surface, write_ply, write_xyz

BASE = np.array([512_000.0, 4_423_000.0, 1_000.0])  # whole numbers: differences from them are exact
NEAR = np.random.default_rng(3).uniform(0.0, 60.0, (50, 3)).round(6)
UTM = BASE + NEAR


def text(points, separator=" ", decimal="."):
    return "\n".join(separator.join(f"{x:.6f}" for x in row) for row in points).replace(".", decimal) + "\n"


def pcd(data, code, rows):
    size = code[1]
    return (
        f"VERSION 0.7\nFIELDS x y z\nSIZE {size} {size} {size}\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 50\nHEIGHT 1\n"
        f"POINTS 50\nDATA {data}\n"
    ).encode() + rows


def packed(path):
    import lzf

    columns = UTM.T.astype("<f8").tobytes()
    content = lzf.compress(columns, 2 * len(columns))
    put(path, pcd("binary_compressed", "f8", struct.pack("<II", len(content), len(columns)) + content))


def laz(path):
    import laspy

    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.header.scales, las.header.offsets = np.full(3, 1e-6), BASE
    las.x, las.y, las.z = UTM.T
    las.write(str(path))


def las(path):
    content = bytearray(las_bytes(np.rint(NEAR * 1e6).astype(int), 1e-6, list(BASE)))
    put(path, bytes(content))


def ptx(path):
    """Points in the scanner's frame, whose place on the map its matrix has."""
    pose = "\n".join(f"{a} {b} {c}" for a, b, c in [BASE, *np.eye(3)])
    rows = "1 0 0 0\n0 1 0 0\n0 0 1 0\n" + " ".join(map(str, BASE)) + " 1\n"
    put(path, f"50\n1\n{pose}\n{rows}" + "\n".join(f"{x:.6f} {y:.6f} {z:.6f} 0.5" for x, y, z in NEAR) + "\n")


def ptx_on_the_map(path):
    identity = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    put(path, "50\n1\n" + identity + "\n".join(f"{x:.6f} {y:.6f} {z:.6f} 0.5" for x, y, z in UTM) + "\n")


def posed_e57(path):
    pose = np.eye(4)
    pose[:3, 3] = BASE * 1_000.0
    e57.write(path, [of_scan(Scan("S1", NEAR * 1_000.0, T_project_scan=pose))], spherical=True)


DOUBLES = UTM.astype("<f8").tobytes()
FAR = {
    "e57": (
        "a.e57",
        lambda p: e57.write(p, [of_scan(Scan("S1", NEAR * 1e3, origin=BASE * 1e3))], spherical=False),
    ),
    "e57 with a pose": ("b.e57", posed_e57),
    "las": ("a.las", las),
    "laz": ("a.laz", laz),
    "ply": ("a.ply", lambda p: put(p, ply_header("binary_little_endian", "double", count=50) + DOUBLES)),
    "ply ASCII": ("a.ply", lambda p: put(p, ply_header("ascii", "float", count=50) + text(UTM).encode())),
    "pcd": ("a.pcd", lambda p: put(p, pcd("binary", "f8", DOUBLES))),
    "pcd ASCII": ("a.pcd", lambda p: put(p, pcd("ascii", "f4", text(UTM).encode()))),
    "pcd compressed": ("a.pcd", packed),
    "ptx": ("a.ptx", ptx),
    "ptx on the map": ("a.ptx", ptx_on_the_map),
    "pts": ("a.pts", lambda p: put(p, "50\n" + text(UTM))),
    "xyz": ("a.xyz", lambda p: put(p, text(UTM))),
    "csv, decimal commas": ("a.csv", lambda p: put(p, "x;y;z\n" + text(UTM, ";", ","))),
}


@pytest.mark.parametrize("case", FAR)
def test_map_coordinates_come_back_to_a_micron(tmp_path, case):
    name, write = FAR[case]
    write(tmp_path / name)
    (scan,) = folder.read_input(tmp_path / name).scans
    T = scan.T_project_scan if scan.T_project_scan.size else np.eye(4)
    base_mm = BASE * 1_000.0
    turned = scan.points @ T[:3, :3].T + (T[:3, 3] + T[:3, :3] @ scan.origin - base_mm)
    assert np.abs(turned - NEAR * 1_000.0).max() < 1e-3  # files have 1e-6 m; a micron is what is promised
    assert np.abs(scan.points).max() < 2e6  # near their origin, where steps calculate


@pytest.mark.parametrize("suffix", ["ply", "pcd", "e57"])
def test_map_coordinates_in_32_bits_are_refused(tmp_path, suffix):
    floats = UTM.astype("<f4").tobytes()
    path = tmp_path / f"a.{suffix}"
    if suffix == "ply":
        put(path, ply_header("binary_little_endian", "float", count=50) + floats)
    elif suffix == "pcd":
        put(path, pcd("binary", "f4", floats))
    else:
        pye57 = pytest.importorskip("pye57")
        with pye57.E57(str(path), mode="w") as file:
            file.write_scan_raw({f"cartesian{axis}": UTM[:, i].copy() for i, axis in enumerate("XYZ")})
    with pytest.raises(InputError, match=r"in 32 bits.* steps of 500 mm; export it in double precision"):
        folder.read_input(path)


# --- LAS: counts and coordinate systems -----------------------------------------------------------------------------


def las_in(tmp_path, points, keys, scale=0.001):
    return las_with_keys(tmp_path / "a.las", points, keys, scale)


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({1024: 1, 3076: 9002}, "ft"),
        ({1024: 1, 3076: 9001, 4099: 9001}, "m"),
        ({1024: 1, 3072: 2225}, "us-ft"),  # NAD83 / California zone 1 (ftUS)
        ({1024: 1, 3072: 2222, 4052: 9001}, "ft"),  # NAD83 / Arizona East (ft); the other unit is of its ellipsoid
        ({1024: 1, 3072: 25832}, "m"),
        ({1024: 1, 3072: 9999, 3076: 9003}, "us-ft"),
        ({1024: 1, 3072: 19999}, "it names EPSG:19999, whose unit is not known here"),
        ({1024: 1, 3072: 4326}, "EPSG:4326"),
        ({1024: 1, 3076: 9005}, "EPSG:9005"),  # Clarke's foot
        ({1024: 1, 3076: 9001, 4099: 9002}, "x and y are in m, z is in ft"),
        ({1024: 1, 3072: 25832, 4096: 6360}, "x and y are in m, z is in us-ft"),  # NAVD88 height (ftUS)
        ({1024: 2, 2048: 4326}, "longitude and latitude"),
    ],
)
def test_the_unit_of_a_las_file_is_that_of_its_coordinate_system(tmp_path, keys, expected):
    path = las_in(tmp_path, NEAR, scale=1e-7, keys=keys)
    (raw,) = readers.read(path)
    if raw.unit:
        assert (raw.unit, raw.unit_fault) == (expected, None)
        return
    with pytest.raises(InputError, match=f"{expected}.*--units") as refused:
        folder.read_input(path)
    assert refused.value.path == path
    # What the user states counts, with one remark that says over what.
    scene = folder.read_input(path, units="m/us-ft")
    # Half a step of the file, 5e-5 mm, and a micron.
    np.testing.assert_allclose(scene.scans[0].points, NEAR * [1e3, 1e3, 1_200_000 / 3937], atol=1e-3)
    (said,) = scene.units_reason
    assert (scene.units, said.code, said.values["file"]) == ("m/us-ft", "units.over-file", raw.unit_fault)


def test_degrees_that_the_coordinates_exceed_are_a_mistake_of_the_writer(tmp_path):
    assert readers.read(las_in(tmp_path, 1e4 * NEAR, scale=0.01, keys={1024: 2, 2048: 4326}))[0].unit == "m"


GEOGCS = 'GEOGCS["NAD83",UNIT["degree",0.0174532925199433]]'


@pytest.mark.parametrize(
    ("wkt", "expected"),
    [
        (f'PROJCS["p",{GEOGCS},UNIT["US survey foot",0.3048006096012192]]', "us-ft"),
        (f'PROJCS["p",{GEOGCS},UNIT["Foot_US",0.304801]]', "us-ft"),
        (f'PROJCS["p",{GEOGCS},UNIT["foot",0.3048]]', "ft"),
        ('LOCAL_CS["site",UNIT["foot",0.3048]]', "ft"),
        ('ENGCRS["site",EDATUM["d"],CS[Cartesian,3],AXIS["x",east],LENGTHUNIT["millimetre",0.001]]', "mm"),
        ('PROJCRS["p",BASEGEOGCRS["b",ELLIPSOID["e",6378137,298,LENGTHUNIT["metre",1]]],CONVERSION["c",PARAMETER["k",'
         '1,SCALEUNIT["unity",1]]],CS[Cartesian,2],AXIS["x",east],LENGTHUNIT["foot",0.3048]]', "ft"),
        (f'PROJCS["p",{GEOGCS},AUTHORITY["EPSG","2225"]]', "us-ft"),
        (f'PROJCS["p",{GEOGCS}]', "units.file-unit-missing"),
        (f'PROJCS["p",{GEOGCS},UNIT["Clarke\'s foot",0.3047972654]]', "units.file-size-unknown"),
        (f'COMPD_CS["c",PROJCS["p",{GEOGCS},UNIT["metre",1]],VERT_CS["v",UNIT["US survey foot",0.304800609601219]]]',
         "units.file-in-two"),
        (f'COMPD_CS["c",{GEOGCS},VERT_CS["v",UNIT["metre",1]]]', "units.file-in-degrees"),
    ],
)  # fmt: skip
def test_the_unit_of_a_system_as_text(wkt, expected):
    unit, fault = coordinate_system.unit([SimpleNamespace(string=wkt)], fits_degrees=True)
    assert (unit or fault.code) == expected


# By the names of the EPSG dataset: Arizona East in feet, California 1, New York and Hawaii in US survey feet,
# Switzerland and UTM; Tobago in links, degrees, codes of nobody.
@pytest.mark.parametrize(("code", "unit"), {2222: "ft", 2225: "us-ft", 2263: "us-ft", 3759: "us-ft", 2056: "m",
                         32633: "m", 2066: "", 4326: "", 12000: "", 32767: "", -1: ""}.items())  # fmt: skip
def test_units_of_codes(code, unit):
    assert epsg_units.unit("horizontal", code) == unit


@pytest.mark.parametrize("point_format", [3, 6])
def test_withheld_points_are_left_out_and_counted(tmp_path, point_format):
    import laspy

    las = laspy.LasData(laspy.LasHeader(point_format=point_format, version="1.4"))
    las.header.scales = np.full(3, 1e-6)
    las.x, las.y, las.z = NEAR.T
    las.intensity = np.arange(50)
    las.withheld = np.arange(50) % 5 == 0
    las.synthetic = np.arange(50) < 3
    las.write(str(tmp_path / "a.las"))
    (scan,) = readers.read(tmp_path / "a.las")
    kept = np.flatnonzero(np.arange(50) % 5)
    np.testing.assert_allclose(scan.points, NEAR[kept], atol=1e-9)  # whole steps of 1e-6
    assert scan.intensity.tolist() == kept.tolist()
    assert [(one.code, one.values["count"]) for one in scan.remarks] == [
        ("read.withheld-points", 10),
        ("read.synthetic-points", 3),
    ]
    las.withheld = np.ones(50, bool)
    las.write(str(tmp_path / "a.las"))
    with pytest.raises(InputError, match="all of its 50 points are flagged as withheld"):
        readers.read(tmp_path / "a.las")


def test_units_of_one_scan_in_a_project(tmp_path):
    for name in ("b", "a"):
        las_in(tmp_path, NEAR, scale=1e-6, keys={1024: 1, 3072: 2225}).rename(tmp_path / f"{name}.las")
    scans = '[[scan]]\nfile = "a.las"\nunits = "m/ft"\n[[scan]]\nfile = "b.las"\n'
    (tmp_path / "project.toml").write_text(scans)
    scene = folder.read_input(tmp_path)
    factors = [[1e3, 1e3, 304.8], [1_200_000 / 3937] * 3]
    for scan, factor in zip(scene.scans, factors, strict=True):
        np.testing.assert_allclose(scan.origin + scan.points, NEAR * factor, atol=1e-3)
    assert [one.code for one in scene.units_reason] == ["units.over-file", "units.by-format"]
    with pytest.raises(UsageError, match="expected one unit for a folder"):
        folder.read_input(tmp_path, units="m/ft")


def test_las_that_declares_fewer_points_than_it_holds(tmp_path):
    content = bytearray(las_bytes(np.arange(30).reshape(10, 3), 0.001, [0.0, 0.0, 0.0]))
    struct.pack_into("<I", content, 107, 7)
    with pytest.raises(InputError, match="declares 7 points, but there is room for 10"):
        readers.read(put(tmp_path / "a.las", bytes(content)))


# --- memory ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["ply", "pcd", "las", "xyz", "ptx"])
def test_reading_takes_little_more_than_the_points(tmp_path, monkeypatch, suffix):
    from tests.bench import readers as bench

    monkeypatch.setattr(ascii_rows, "PIECE_BYTES", 1 << 18)
    monkeypatch.setattr(ascii_rows, "PIECE_ROWS", 1 << 13)
    points, intensity = bench.cloud(60_000)
    path = tmp_path / f"a.{suffix}"
    {"pcd": bench.write_packed_pcd}.get(suffix, getattr(bench, f"write_{suffix}"))(path, points, intensity)
    readers.read(path)  # compiles
    tracemalloc.start()
    try:
        (scan,) = readers.read(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(scan.points) == 60_000
    assert np.abs(scan.points - points).max() < 1e-6  # the digits of the text
    assert peak < 2.5 * scan.points.nbytes + (3 << 20)  # and a few pieces


# --- names and closed formats --------------------------------------------------------------------------------------


def test_names_of_files_are_only_names(tmp_path):
    names = ["东桥 1.xyz", 'it\'s "quoted".xyz', "<script>alert(1)</script>.xyz".replace("/", "-"), "a;b&c $(x).xyz"]
    for name in names:
        put(tmp_path / name, text(NEAR))
    Path(tmp_path / "e57").mkdir()
    scene = folder.read_input(tmp_path)
    assert sorted(scan.name for scan in scene.scans) == sorted(name[:-4] for name in names)


@pytest.mark.parametrize("suffix", ["e57", "laz", "ply"])
def test_names_in_gb18030(tmp_path, suffix):
    source = tmp_path / f"a.{suffix}"
    FAR[suffix][1](source)
    name = "东桥".encode("gb18030").decode("utf-8", "surrogateescape")
    try:
        source.rename(tmp_path / f"{name}.{suffix}")
    except OSError:
        pytest.skip("this file system takes names in UTF-8 alone")
    assert [scan.name for scan in folder.read_input(tmp_path).scans] == ["东桥"]


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("a.fls", r"FARO.*export the scan to E57.*SCENE"),
        ("a.rcp", r"Autodesk.*ReCap"),
        ("a.dp", r"DotProduct.*Dot3D"),
    ],
)
def test_closed_formats_are_refused_with_export_instructions(tmp_path, name, why):
    (tmp_path / name).mkdir() if name == "a.fls" else (tmp_path / name).touch()
    with pytest.raises(InputError, match=why):
        folder.read_input(tmp_path)
    put(tmp_path / "a.xyz", text(NEAR))  # exported beside it
    assert len(folder.read_input(tmp_path).scans) == 1
    put(tmp_path / "b.rxp", "not exported")
    with pytest.raises(InputError, match=r"b\.rxp: is in a closed format, and no other file here has its name"):
        folder.read_input(tmp_path)


def test_a_packed_folder_is_named(tmp_path):
    put(tmp_path / "scans.zip", b"PK")
    with pytest.raises(InputError, match=r"found none; unpack scans\.zip first"):
        folder.read_input(tmp_path)


def test_feet_taken_for_metres_are_noticed(tmp_path):
    for i, name in enumerate(("foot1", "rib1")):
        write_xyz(tmp_path / f"scans/{name}.xyz", surface(i) / 0.3048)
        write_ply(tmp_path / f"design/{name}.ply", (BOX + np.array([4.0 * i, 0, 0])) * 1_000.0)
    (tmp_path / "design.json").write_text(json.dumps(arch_design()))
    with pytest.raises(InputError, match=r"close to 3\.281: .* read as m .*is it ft\?"):
        folder.read_input(tmp_path)
