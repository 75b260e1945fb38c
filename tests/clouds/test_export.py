"""Clouds exported from runs, read back by programs that share no code with this one."""

import contextlib
import dataclasses
import json
import resource
import signal
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import open3d
import plyfile
import pye57
import pytest
import trimesh
from click.testing import CliRunner
from scipy.spatial import cKDTree

import processor
from processor import __main__
from processor.cli.main import commands
from processor.clouds import cleaning, poisson_disk, slabs
from processor.clouds import export as clouds_export
from processor.clouds.points import InMemory, Spool
from processor.model import InputError, Scene, Stations, UsageError
from processor.preassembly.result import ScanPoses
from processor.scan_folder import folder
from processor.store import store
from processor.writers.cloud import Block, Cloud
from tests.support.clouds import stitch_clouds
from tests.support.files.e57_fields import e57_field
from tests.support.results import exported_runs
from tests.support.results.exported_runs import MAP, pose, swept
from tests.support.solids.meshes import bracket

pytestmark = pytest.mark.usefixtures("blank_pictures")

RNG = np.random.default_rng(8)
DOUBLE_MM = 2e-6  # coordinates of a national grid, 3.5e9 mm, have steps of 5e-7 mm as float64; each is rounded twice
LAS_MM = 0.05 + 1e-4  # half a step of LAS, and the rounding of its offset
TEXT_MM = 0.5e-4 + DOUBLE_MM  # half of the last digit
ROTATION = 1e-12  # products of rotations keep 1e-15; quaternions of E57 and rows of text lose some digits of it


def in_project(scan, T):
    """Points (n, 3) of a scan by its pose, relative to the offset of the map: in extended precision."""
    long = np.longdouble
    points = scan.points.astype(long) + scan.origin.astype(long)
    return points @ T[:3, :3].astype(long).T + T[:3, 3].astype(long)


def in_order(points):
    return points[np.lexsort(np.round(points, 1).T)]


def cloud_of(path):
    """Points (n, 3) in mm of a file, by another program."""
    if path.suffix == ".ply":
        vertex = plyfile.PlyData.read(str(path))["vertex"]
        return np.stack([vertex[axis] for axis in "xyz"], axis=1)
    if path.suffix in (".las", ".laz"):
        return 1000.0 * laspy.read(path).xyz
    if path.suffix == ".e57":
        data = pye57.E57(str(path)).read_scan_raw(0, ignore_unsupported_fields=True)
        return 1000.0 * np.stack([data[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    return 1000.0 * np.loadtxt(path, skiprows=1)[:, :3]


@pytest.fixture
def hall():
    """Two scans far from the origin of the project, and their poses."""
    scans = [swept("S1", 1), swept("S 2", 2)]
    poses = np.array([pose(1, MAP), pose(2, MAP)])
    return scans, poses, exported_runs.stitched(scans, poses)


@pytest.mark.parametrize("format_", clouds_export.FORMATS)
def test_merged_scans_lie_where_their_poses_put_them(hall, format_, tmp_path):
    scans, poses, results = hall
    done = processor.export(results, tmp_path / "m", what="merged", format=format_)
    expected = np.concatenate([in_project(scan, T) for scan, T in zip(scans, poses, strict=True)])
    assert done.files == {f"merged.{format_}": len(expected)}
    found = cloud_of(tmp_path / f"m/merged.{format_}")
    limit = {"las": LAS_MM, "laz": LAS_MM, "xyz": TEXT_MM}.get(format_, DOUBLE_MM)
    assert np.abs(found - expected).max() < limit


def test_columns_of_a_merged_cloud(hall, tmp_path):
    scans, _, results = hall
    intensity = np.concatenate([scan.intensity for scan in scans])
    colour = np.concatenate([scan.colour for scan in scans])
    station = np.repeat([1, 2], [len(scan.points) for scan in scans])
    for format_ in ("ply", "laz", "e57"):
        processor.export(results, tmp_path / format_, what="merged", format=format_)
    vertex = plyfile.PlyData.read(str(tmp_path / "ply/merged.ply"))["vertex"]
    laz = laspy.read(tmp_path / "laz/merged.laz")
    e57 = pye57.E57(str(tmp_path / "e57/merged.e57"))
    raw = e57.read_scan_raw(0)
    np.testing.assert_array_equal(vertex["intensity"], intensity)
    np.testing.assert_array_equal(laz.intensity, intensity)  # whole numbers of 16 bits stay
    np.testing.assert_array_equal(raw["intensity"], intensity)
    np.testing.assert_array_equal(np.stack([vertex[name] for name in ("red", "green", "blue")], axis=1), colour)
    np.testing.assert_array_equal(np.stack([laz.red, laz.green, laz.blue], axis=1) >> 8, colour)
    np.testing.assert_array_equal(np.stack([raw[f"color{n}"] for n in ("Red", "Green", "Blue")], axis=1), colour)
    np.testing.assert_array_equal(vertex["station"], station)
    np.testing.assert_array_equal(laz.point_source_id, station)
    assert (laz.header.version.minor, laz.header.point_format.id) == (4, 7)
    np.testing.assert_array_equal(trimesh.load(tmp_path / "ply/merged.ply").vertices.shape, (len(station), 3))
    assert len(open3d.io.read_point_cloud(str(tmp_path / "ply/merged.ply")).points) == len(station)
    limits = e57.get_header(0).node["intensityLimits"]
    assert limits["intensityMaximum"].value() == intensity.max()


def test_registered_scans_keep_pose_grid_intensity_and_colour(hall, tmp_path):
    scans, poses, results = hall
    done = processor.export(results, tmp_path / "r")
    assert list(done.files) == ["scans/S1.e57", "scans/S_2.e57"]  # a blank is no part of a file's name
    for file, scan, T in zip(done.files, scans, poses, strict=True):
        e57 = pye57.E57(str(tmp_path / "r" / file))
        header, raw = e57.get_header(0), e57.read_scan_raw(0)
        np.testing.assert_allclose(header.rotation_matrix, T[:3, :3], atol=ROTATION)
        np.testing.assert_allclose(1000.0 * header.translation, T[:3, 3], rtol=1e-14)  # one product
        np.testing.assert_allclose(cloud_of(tmp_path / "r" / file), scan.points, atol=1e-9)  # of 3e4 mm: 1e2 roundings
        np.testing.assert_array_equal(raw["rowIndex"], scan.grid_row)
        np.testing.assert_array_equal(raw["columnIndex"], scan.grid_column)
        np.testing.assert_array_equal(raw["intensity"], scan.intensity)
        np.testing.assert_array_equal(raw["colorGreen"], scan.colour[:, 1])
        assert header["name"].value() == scan.name


@pytest.mark.parametrize("format_", clouds_export.FORMATS)
def test_a_registered_folder_is_read_with_the_same_poses(hall, format_, tmp_path):
    scans, poses, results = hall
    processor.export(results, tmp_path / "r", format=format_)
    scene = processor.read(tmp_path / "r")
    assert (scene.name, scene.kind, len(scene.scans)) == ("hall", "structure", 2)
    for back, scan, T in zip(scene.scans, scans, poses, strict=True):
        np.testing.assert_allclose(back.T_project_scan[:3, :3], T[:3, :3], atol=ROTATION)
        np.testing.assert_allclose(back.T_project_scan[:3, 3], T[:3, 3], atol=DOUBLE_MM)
        np.testing.assert_allclose(back.points + back.origin, scan.points, atol=LAS_MM)
        assert back.sigma_mm == scan.sigma_mm
        np.testing.assert_array_equal(back.colour, scan.colour)


def test_scans_without_a_sure_pose_are_left_out_and_named(hall, tmp_path):
    scans, poses, _ = hall
    results = exported_runs.stitched(
        [*scans, swept("S3", 3)], [*poses, np.full((4, 4), np.nan)], ["ok", "weak", "failed"]
    )
    done = processor.export(results, tmp_path / "r")
    assert len(done.files) == 2
    assert [(r.code, r.values["scan"]) for r in done.remarks] == [
        ("export.scan-doubtful", "S 2"),
        ("export.scan-not-placed", "S3"),
    ]
    none = exported_runs.stitched(scans, poses, ["ambiguous", "failed"])
    with pytest.raises(InputError, match="placed no scan"):
        processor.export(none, tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_free_scale_is_applied_to_exported_points(hall, tmp_path):
    scans, poses, _ = hall
    scaled = poses.copy()
    scaled[1, :3, :3] *= 1.004
    results = exported_runs.stitched(scans, scaled, scale="free")
    processor.export(results, tmp_path / "r")
    processor.export(results, tmp_path / "m", what="merged", format="ply")
    back = processor.read(tmp_path / "r").scans[1]
    assert abs(np.linalg.det(back.T_project_scan[:3, :3]) - 1.0) < 1e-9  # what a pose is checked for is 1e-3
    expected = in_project(scans[1], scaled[1])
    np.testing.assert_allclose(
        in_project(back, back.T_project_scan).astype(float), expected.astype(float), atol=DOUBLE_MM
    )
    np.testing.assert_allclose(
        cloud_of(tmp_path / "m/merged.ply")[len(scans[0].points) :], expected.astype(float), atol=DOUBLE_MM
    )


def test_parts_are_assembled_at_the_reference_temperature(tmp_path):
    scans = [swept(name, i, component=name, origin=1e6 * np.eye(3)[i]) for i, name in enumerate(("foot1", "foot2"))]
    poses = [pose(5), pose(6)]
    for degrees, alpha in ((float("nan"), 0.0), (45.0, 12e-6)):
        results = exported_runs.assembled(scans, poses, degrees)
        for format_ in ("ply", "e57"):
            target = tmp_path / f"{degrees}-{format_}"
            done = processor.export(results, target, what="assembled", format=format_)
            for file, scan, T in zip(done.files, scans, poses, strict=True):
                reduced = (scan.points + scan.origin) / (1.0 + alpha * (45.0 - 20.0))
                np.testing.assert_allclose(cloud_of(target / file), reduced @ T[:3, :3].T + T[:3, 3], atol=DOUBLE_MM)
    assert [scan.component for scan in processor.read(target).scans] == ["foot1", "foot2"]
    assert np.isnan(processor.read(target).temperature_C)


def test_stations_of_a_merged_cloud(tmp_path):
    scan = dataclasses.replace(swept("all", 1), grid_row=(), grid_column=())
    station = np.arange(len(scan.points)) % 4 - 1  # -1: unknown
    scan = dataclasses.replace(scan, point_station=station)
    stations = Stations(("A", "B", "C"), RNG.uniform(-1e4, 1e4, (3, 3)))
    results = exported_runs.not_run(Scene("hall", "structure", (scan,), stations=stations))
    for what, name in (("registered", "scans/all"), ("merged", "merged")):
        processor.export(results, tmp_path / what, what=what, format="laz")
        np.testing.assert_array_equal(laspy.read(tmp_path / what / f"{name}.laz").point_source_id, station + 1)
        back = processor.read(tmp_path / what)
        np.testing.assert_array_equal(back.scans[0].point_station, station)
        np.testing.assert_allclose(back.stations.positions, stations.positions, atol=DOUBLE_MM)
    done = processor.export(results, tmp_path / "e57")
    assert [remark.code for remark in done.remarks] == ["export.stations-lost"]


def test_stations_that_no_point_names_make_no_column(tmp_path):
    """One scan of unknown position beside a file of three stations: nothing tells views of it apart."""
    scan = dataclasses.replace(swept("all", 1), grid_row=(), grid_column=(), position=np.empty(0))
    stations = Stations(("A", "B", "C"), RNG.uniform(-1e4, 1e4, (3, 3)))
    results = exported_runs.not_run(Scene("hall", "structure", (scan,), stations=stations))
    processor.export(results, tmp_path, what="merged", format="ply")
    assert "station" not in plyfile.PlyData.read(str(tmp_path / "merged.ply"))["vertex"].data.dtype.names


def test_of_several_scans_of_a_part_those_that_were_used_are_assembled(tmp_path):
    names = ("foot1", "foot1, again", "foot1, moved")
    scans = [swept(name, i, component="foot1") for i, name in enumerate(names)]
    used = ScanPoses(("foot1, again", "foot1"), np.array([pose(5), pose(6)]))
    results = exported_runs.assembled(scans, [pose(5)], used=("foot1, again, foot1",), scan_poses=(used,))
    done = processor.export(results, tmp_path / "a", what="assembled", format="ply")
    for file, k, T in (("foot1.ply", 0, pose(6)), ("foot1-2.ply", 1, pose(5))):
        np.testing.assert_allclose(
            cloud_of(tmp_path / "a/scans" / file), scans[k].points @ T[:3, :3].T + T[:3, 3], atol=DOUBLE_MM
        )
    assert [(r.code, r.values["scans"]) for r in done.remarks] == [("export.further-scans", ("foot1, moved",))]


# --- a run of the program, and its folder of results


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A scan folder of four stations without poses, and results as if they had been stitched."""
    place = tmp_path_factory.mktemp("room")
    write_room(place / "room", 40.0)
    return place, stitched_in(place, "room")


def write_room(folder_, step_mrad):
    (folder_ / "scans").mkdir(parents=True)
    for scan in stitch_clouds.four(seed=2, step_mrad=step_mrad)[1]:
        lines = np.column_stack([scan.points / 1000.0, np.arange(len(scan.points)) % 200])
        np.savetxt(folder_ / f"scans/{scan.name}.xyz", lines, fmt="%.6f", header="x y z intensity", comments="")
    (folder_ / "project.toml").write_text('kind = "structure"\n')


def stitched_in(place, name):
    """Results of an input in a folder, written there as ``out``."""
    scene = processor.read(place / name)
    results = exported_runs.stitched(scene.scans, [pose(i) for i in range(4)], scene=scene)
    (place / "out").mkdir()
    made_from = {**results.execution.provenance, "input": name}
    store.write_results(place / "out/results.h5", results.execution.runs, made_from)
    return results


def test_memory_scene_file_and_folder_give_the_same_cloud(room, tmp_path):
    place, results = room
    processor.export(results, tmp_path / "a", what="merged", format="ply", spacing_mm=150.0)
    processor.export(place / "out", tmp_path / "b", what="merged", format="ply", spacing_mm=150.0)
    assert (tmp_path / "a/merged.ply").read_bytes() == (tmp_path / "b/merged.ply").read_bytes()
    store.write_scene(tmp_path / "s.h5", results.scene, None, {})
    results = stitched_in(tmp_path, "s.h5")
    processor.export(tmp_path / "out", tmp_path / "c", what="merged", format="ply")
    poses = results.steps["stitch"].scans.T_project_scan
    expected = [in_project(scan, T).astype(float) for scan, T in zip(results.scene.scans, poses, strict=True)]
    np.testing.assert_allclose(cloud_of(tmp_path / "c/merged.ply"), np.concatenate(expected), atol=DOUBLE_MM)


@pytest.mark.slow
def test_an_exported_folder_is_stitched_to_the_same_poses(tmp_path):
    """Half of the search is enough for scans that are level."""
    write_room(tmp_path / "room", 16.0)
    found = processor.run(tmp_path / "room", tmp_path / "out", params={"stitch": {"levelled_mrad": 20.0}})
    first = found.steps["stitch"].scans
    processor.export(tmp_path / "out", tmp_path / "again", what="registered", format="e57")
    second = processor.run(tmp_path / "again").steps["stitch"].scans
    assert first.name == second.name == ("S1", "S2", "S3", "S4")
    half = 1.96 * np.sqrt(np.array([np.diag(one)[3:] for one in first.covariance]))
    off = np.abs(first.T_project_scan[:, :3, 3] - second.T_project_scan[:, :3, 3])
    assert (off <= half + 1e-3).all()  # the reference has no interval; a micron is the rounding of both searches


def test_export_command_lists_the_files_that_it_writes(room, tmp_path, monkeypatch):
    place, results = room
    monkeypatch.chdir(place)
    target = tmp_path / "laz"
    done = CliRunner().invoke(
        commands, ["export", "out", "-o", str(target), "--what", "registered", "--format", "laz"], standalone_mode=False
    )
    assert done.exception is None, done.output
    count = sum(len(scan.points) for scan in results.scene.scans)
    assert done.output.splitlines()[0] == f"{target / 'scans/S1.laz'}: {len(results.scene.scans[0].points):,} points"
    assert sum(len(laspy.read(path).points) for path in (target / "scans").iterdir()) == count
    done = CliRunner().invoke(
        commands,
        ["export", "out", "room", "-o", str(tmp_path / "j"), "--what", "merged", "--format", "e57", "--json"],
        standalone_mode=False,
    )
    assert json.loads(done.output)["files"] == {"merged.e57": count}
    help_ = CliRunner().invoke(commands, ["export", "--help"]).output
    assert {line.split()[0] for line in help_.splitlines() if line.strip()} >= set(clouds_export.CONTENTS)


# --- what cannot be exported


def test_an_input_that_changed_is_refused(room, tmp_path):
    place, _ = room
    changed = tmp_path / "room"
    (changed / "scans").mkdir(parents=True)
    for path in (place / "room").rglob("*.*"):
        (changed / path.relative_to(place / "room")).write_bytes(path.read_bytes())
    with (changed / "scans/S3.xyz").open("a") as file:
        file.write("1.0 2.0 3.0 7\n")
    with pytest.raises(InputError, match="as it was then, not from"):
        clouds_export.export(place / "out", tmp_path / "x", "merged", "ply", input_=changed)
    assert not (tmp_path / "x").exists()
    assert not list(tmp_path.glob(".x*"))


@pytest.mark.parametrize(
    ("what", "step"), [("assembled", "stitch,preassemble"), ("deviation", "stitch,deviation")]
)  # fmt: skip
def test_a_step_that_is_missing_is_named(room, what, step, tmp_path):
    place, _ = room
    with pytest.raises(UsageError, match=f"{what} needs the step {step[7:]}, .* on room.*--steps {step},"):
        processor.export(place / "out", tmp_path / "x", what=what, format="ply")
    assert not list(tmp_path.iterdir())


def test_scans_without_poses_need_stitching(tmp_path):
    scans = tuple(swept(f"S{i}", i) for i in range(2))
    results = exported_runs.not_run(Scene("hall", "structure", scans))
    with pytest.raises(UsageError, match="registered needs the step stitch"):
        processor.export(results, tmp_path / "x")
    parts = exported_runs.assembled([swept("a", 1, component="a"), swept("b", 2, component="b")], [pose(1), pose(2)])
    with pytest.raises(UsageError, match="use --what assembled or clean"):
        processor.export(parts, tmp_path / "x", what="merged")


def test_wrong_names_and_folders(hall, tmp_path):
    *_, results = hall
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine.txt").write_text("kept")
    with pytest.raises(UsageError, match="exists and is not empty"):
        processor.export(results, tmp_path / "full")
    assert [path.name for path in tmp_path.rglob("*")] == ["full", "mine.txt"]
    for wrong in ({"what": "all"}, {"format": "dwg"}, {"spacing_mm": -1.0}):
        with pytest.raises(UsageError, match="expected"):
            processor.export(results, tmp_path / "x", **wrong)
    with pytest.raises(UsageError, match="expected a folder of results"):
        processor.export(tmp_path / "full", tmp_path / "x")


@contextlib.contextmanager
def files_of_at_most(size):
    """Let this process write no file larger than ``size`` bytes: stands for a full disk."""
    limits, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)


def assert_nothing_written(code, err, tmp_path):
    assert code == 3, err
    (line,) = err.splitlines()
    assert line.startswith(f"error: {tmp_path / 'x'}: cannot be written"), line
    assert not list(tmp_path.iterdir())


def exporting(room, format_, tmp_path):
    return ["export", str(room[0] / "out"), "-o", str(tmp_path / "x"), "--what", "merged", "--format", format_]


@pytest.mark.parametrize("format_", [one for one in clouds_export.FORMATS if one != "laz"])
def test_a_full_disk_leaves_nothing_behind(room, format_, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["processor", *exporting(room, format_, tmp_path)])
    with files_of_at_most(200_000), pytest.raises(SystemExit) as end:
        __main__.main()
    assert_nothing_written(end.value.code, capsys.readouterr().err, tmp_path)


LIMITED = """
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
from processor.__main__ import main
main()
"""


@pytest.mark.slow
def test_a_full_disk_leaves_nothing_behind_of_laz(room, tmp_path):
    """The library that packs holds a file open that it could not finish: this takes a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, *exporting(room, "laz", tmp_path)],
        capture_output=True, text=True, cwd=Path(processor.__file__).parents[1],
    )  # fmt: skip
    assert_nothing_written(done.returncode, done.stderr, tmp_path)


# --- thinning, outliers, clutter


def cloud(points, count=None, **fields):
    columns = {name: np.asarray(column) for name, column in fields.items()}

    def blocks():
        for start in range(0, len(points), 1000):
            rows = slice(start, start + 1000)
            yield Block(points[rows], {name: column[rows] for name, column in columns.items()})

    return Cloud("c", {name: column.dtype for name, column in columns.items()}, blocks, count=len(points))


def collected(some):
    parts = list(some.blocks())
    fields = {name: np.concatenate([part.fields[name] for part in parts]) for name in some.fields}
    return np.concatenate([part.points for part in parts]), fields


@pytest.mark.parametrize("most", [10**9, 1500, 300])
@pytest.mark.parametrize("spacing", [25.0, 400.0])
def test_thinned_points_keep_their_distance_and_leave_no_hole(most, spacing, tmp_path, monkeypatch):
    points = RNG.uniform([0.0, -500.0, 1e6], [9000.0, 500.0, 1e6 + 60.0], (7000, 3))
    monkeypatch.setattr(slabs.cut, "__defaults__", (most,))
    kept, fields = collected(poisson_disk.sampled(cloud(points, row=np.arange(7000)), spacing, tmp_path))
    np.testing.assert_array_equal(points[fields["row"]], kept)
    assert len(np.unique(fields["row"])) == len(kept)
    tree = cKDTree(kept)
    assert not tree.query_pairs(spacing * (1.0 - 1e-12))
    assert tree.query(points)[0].max() < spacing
    assert len(kept) < (6500 if spacing == 25.0 else 150)


def test_thinning_keeps_the_first_points_of_a_slab(tmp_path):
    points = RNG.uniform(0.0, 1000.0, (1500, 3))
    kept, _ = collected(poisson_disk.sampled(cloud(points), 90.0, tmp_path))
    expected = []
    for point in points:
        if not expected or np.linalg.norm(np.array(expected) - point, axis=1).min() >= 90.0:
            expected.append(point)
    np.testing.assert_array_equal(kept, expected)


@pytest.mark.parametrize("most", [10**9, 6000])
def test_outliers_are_those_of_open3d(most, tmp_path, monkeypatch):
    monkeypatch.setattr(slabs.cut, "__defaults__", (most,))
    plane = np.column_stack(
        [RNG.uniform(0.0, 8000.0, 20_000), RNG.uniform(0.0, 2000.0, 20_000), RNG.normal(0, 1.0, 20_000)]
    )
    points = RNG.permutation(np.concatenate([plane, RNG.uniform([0, 0, 100.0], [8000.0, 2000.0, 2000.0], (60, 3))]))
    some, removed = cleaning.cleaned(cloud(points, row=np.arange(len(points))), None, None, tmp_path)
    kept, fields = collected(some)
    # Open3D counts a point among its own neighbours.
    theirs = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    _, rows = theirs.remove_statistical_outlier(cleaning.NEIGHBOURS + 1, cleaning.RATIO)
    difference = np.setxor1d(fields["row"], rows)
    # It divides the sum by 21, and the standard deviation by n - 1: the limit of the ratio is the same.
    assert len(difference) <= (0 if most > 6000 else 3)
    assert removed.outliers == len(points) - len(kept)
    assert 40 <= removed.outliers < 200
    assert removed.clutter == 0


def test_a_scan_that_is_sparse_far_away_is_kept(tmp_path):
    """Spacing grows with the range; distances are compared relative to it."""
    e, a = np.meshgrid(np.linspace(-0.9, -0.03, 120), np.linspace(0.0, 1.5, 200))
    r = 1500.0 / np.sin(-e.ravel())  # a floor
    ray = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(-1, 3)
    points = ray * r[:, None] + RNG.normal(0.0, 1.0, (len(r), 3))
    stray = RNG.uniform([500.0, 500.0, 200.0], [3000.0, 3000.0, 900.0], (20, 3))
    every = np.concatenate([points, stray])
    some, _ = cleaning.cleaned(cloud(every, row=np.arange(len(every))), None, np.zeros(3), tmp_path)
    _, fields = collected(some)
    lost = np.setdiff1d(np.arange(len(points)), fields["row"])
    assert len(lost) < 0.02 * len(points)
    assert not (fields["row"] >= len(points)).any()


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Two bodies apart, one scanned 4 mm off, with clutter; step deviation was run."""
    place = tmp_path_factory.mktemp("bodies")
    mesh = bracket()
    other = trimesh.creation.box((800.0, 800.0, 100.0), trimesh.transformations.translation_matrix([0.0, 4000.0, 0.0]))
    design = trimesh.util.concatenate([mesh, other])
    (place / "bodies/scans").mkdir(parents=True)
    design.export(place / "bodies/design.ply")
    points, facet = trimesh.sample.sample_surface(design, 20_000, seed=4)
    moved = np.where((facet >= len(mesh.faces))[:, None], 4.0 * design.face_normals[facet], 0.0)
    points = points + moved + np.random.default_rng(5).normal(0.0, 0.5, points.shape)
    clutter = np.random.default_rng(6).uniform([-3000.0, 1000.0, 900.0], [3000.0, 3500.0, 1000.0], (1200, 3))
    np.savetxt(place / "bodies/scans/S1.xyz", np.concatenate([points, clutter]), fmt="%.4f")
    (place / "bodies/project.toml").write_text('units = "mm"\ndesign = "design.ply"\n')
    results = processor.run(
        place / "bodies", place / "out", steps="deviation", params={"deviation": {"register": "none"}}
    )
    return place, results, len(points)


def test_core_points_carry_deviation_lod_and_component(measured, tmp_path):
    place, *_ = measured
    table = np.genfromtxt(place / "out/deviation.csv", delimiter=",", names=True)
    for format_ in ("ply", "laz", "e57", "xyz"):
        done = processor.export(place / "out", tmp_path / format_, what="deviation", format=format_)
        assert done.files == {f"deviation.{format_}": len(table)}
        assert [path.name for path in (tmp_path / format_).iterdir()] == [f"deviation.{format_}"]
        found = cloud_of(tmp_path / f"{format_}/deviation.{format_}")
        expected = np.stack([table[axis] for axis in "xyz"], axis=1)
        np.testing.assert_allclose(found, expected, atol=LAS_MM)
    vertex = plyfile.PlyData.read(str(tmp_path / "ply/deviation.ply"))["vertex"]
    laz = laspy.read(tmp_path / "laz/deviation.laz")
    for name, column in (("deviation_mm", "distance"), ("lod95_mm", "lod95")):
        np.testing.assert_array_equal(vertex[name], table[column])
        np.testing.assert_array_equal(laz[name], table[column])
        np.testing.assert_array_equal(e57_field(tmp_path / "e57/deviation.e57", f"ssc:{name}"), table[column])
    component, is_other = np.array(vertex["component"]), table["y"] > 3000.0
    assert component.min() == 1
    assert (component[is_other] == component.max()).all()  # the last body of the mesh
    assert (component[~is_other] < component.max()).all()
    other = vertex["deviation_mm"][is_other]
    assert np.nanmedian(other) == pytest.approx(4.0, abs=0.3)  # each has an interval of some tenths at this density


def test_a_clean_scan_has_no_clutter(measured, tmp_path):
    place, results, count = measured
    done = processor.export(place / "out", tmp_path / "c", what="clean", format="ply")
    (remark,) = done.remarks
    assert remark.code == "export.removed"
    (scan,) = results.scene.scans
    kept = cKDTree(cloud_of(tmp_path / "c/scans/S1.ply"))
    gone = kept.query(scan.points + scan.origin)[0] > 1e-6
    assert gone[count:].all()  # the clutter is 100 mm and more from any surface
    assert gone[:count].mean() < 0.02  # spacings beyond the mean and three standard deviations: 0.5 %
    assert remark.values["clutter"] == 1200
    assert remark.values["outliers"] == gone[:count].sum()
    assert processor.read(tmp_path / "c").structure is not None


# --- parts


def test_points_spooled_to_disk_equal_those_in_memory(tmp_path):
    scans = (swept("S1", 1), dataclasses.replace(swept("S2", 2), intensity=(), colour=()))
    scene = Scene("hall", "structure", scans)
    spool = Spool(tmp_path)
    without = dataclasses.replace(scene, scans=tuple(spool.keep(scan) for scan in scans))
    for scan in without.scans:
        assert not len(scan.points)
        assert scan.points.base is None or not scan.points.base.size, "a view keeps the points in memory"
    assert store.scene_hash(without, spool.pieces) == store.scene_hash(scene)
    for number in range(2):
        for name in ("points", "intensity", "colour", "grid_row", "point_station"):
            column, expected = spool.column(number, name), InMemory(scene).column(number, name)
            assert len(column) == len(expected)
            np.testing.assert_array_equal(column[5:90], expected[5:90])


def test_colours_are_part_of_the_hash_of_a_scene():
    scans = swept("S1", 1), dataclasses.replace(swept("S1", 1), colour=())
    coloured, plain = (store.scene_hash(Scene("hall", "structure", (scan,))) for scan in scans)
    assert coloured != plain
    assert folder.as_read(scans[1]) is scans[1]
