"""Exported scan folders: read back completely, and read by independent programs."""

import dataclasses
import hashlib
import json

import numpy as np
import open3d
import pytest

from designgen import recipe_files
from designgen.export import FORMATS, formats
from designgen.export import folder as export_folder
from designgen.scenes.make import make as make_scene
from processor.model import InputError, PointLabels, Scan, Stations, Truth, UsageError
from processor.scan_folder import folder
from processor.store import store
from processor.writers import e57
from processor.writers.cloud import of_scan
from tests.support.processes import commands
from tests.support.scenes.exported_scenes import exported, merged, on_grid, stations_apart

# Half a step of LAS; a last digit of text, of two numbers where the point is moved; the rest are float64.
LIMITS_MM = {"las": 0.0501, "laz": 0.0501, "ptx": 1.1e-4, "xyz": 1.1e-4}
DOUBLE_MM = 1e-6  # of 3e4 mm: 1e5 steps
MAP_MM = 2e-6  # of 4.3e9 mm: two roundings of half a step of 1e-6 mm


ORIGINS = {"local": np.zeros(3), "georeferenced": np.array([5.0e8, 4.3e9, 1.0e5])}


def sorted_rows(points):
    return points[np.lexsort(np.round(points, 1).T)]


# Far places are the harder ones; near ones have the same code and tighter limits, which one format of numbers shows.
@pytest.mark.parametrize(
    ("format_", "where"),
    [*((one, "georeferenced") for one in (*FORMATS, "e57-spherical")), ("e57", "local"), ("ptx", "local")],
)
def test_scans_of_stations_come_back(format_, where, tmp_path):
    name, _, spherical = format_.partition("-")
    options = {"spherical": True} if spherical else {}
    scene, out = exported(stations_apart(ORIGINS[where]), tmp_path, name, **options)
    back = folder.read_input(out)
    assert (back.name, back.kind, back.temperature_C) == ("屋盖 <1>", "space-frame", 28.5)
    assert len(back.scans) == 3
    limit = LIMITS_MM.get(name, DOUBLE_MM)
    for ours, theirs in zip(scene.scans, back.scans, strict=True):
        given, found = (s.points + s.origin for s in (ours, theirs))
        if name == "ptx":  # a grid is written column by column
            given, found = sorted_rows(given), sorted_rows(found)
        np.testing.assert_allclose(found, given, atol=limit)
        # Digits of PTX.
        np.testing.assert_allclose(theirs.T_project_scan[:3, :3], ours.T_project_scan[:3, :3], atol=2e-9)
        np.testing.assert_allclose(theirs.T_project_scan[:3, 3], ours.T_project_scan[:3, 3], atol=MAP_MM)
        # The place in the project turned back: 1e-9 of it, for the digits of rotations.
        np.testing.assert_allclose(theirs.position, 0.0, atol=1e-3 if where == "georeferenced" else 1e-5)
        assert theirs.sigma_mm == 1.5
        assert len(theirs.intensity) == len(ours.points)
    np.testing.assert_allclose(back.frame.centres, scene.frame.centres, atol=DOUBLE_MM)
    np.testing.assert_allclose(sorted_rows(back.stations.positions), sorted_rows(scene.stations.positions), atol=1e-3)


@pytest.mark.parametrize(
    ("format_", "where"),
    [*((one, "georeferenced") for one in ("ply", "las", "laz", "pcd", "xyz")), ("ply", "local")],
)
def test_a_merged_cloud_comes_back_with_its_stations(format_, where, tmp_path):
    scene, out = exported(merged(ORIGINS[where]), tmp_path, format_)
    back = folder.read_input(out)
    (ours,), (theirs,) = scene.scans, back.scans
    limit = LIMITS_MM.get(format_, 1e-6 if where == "local" else 1e-3)
    np.testing.assert_allclose((theirs.points - ours.points) + (theirs.origin - ours.origin), 0.0, atol=limit)
    np.testing.assert_array_equal(theirs.point_station, ours.point_station)
    assert back.stations.ids == ("S1", "S2")
    np.testing.assert_allclose(back.stations.positions, scene.stations.positions, atol=1e-5)  # digits of the JSON
    np.testing.assert_allclose(back.structure.vertices, scene.structure.vertices, atol=1e-5)
    np.testing.assert_array_equal(back.structure.faces, scene.structure.faces)


def ptx_grids(path):
    """Read PTX with nothing but the definition: columns, rows, pose, matrix, cells."""
    lines = path.read_text("ascii").splitlines()
    at = 0
    while at < len(lines):
        columns, rows = int(lines[at]), int(lines[at + 1])
        T = np.array([line.split() for line in lines[at + 6 : at + 10]], np.float64).T
        cells = np.array([line.split() for line in lines[at + 10 : at + 10 + columns * rows]], np.float64)
        yield cells.reshape(columns, rows, 4), T
        at += 10 + columns * rows


@pytest.mark.parametrize("make", [stations_apart, merged])
def test_ptx_keeps_the_grid_and_the_pose(make, tmp_path):
    scene, out = exported(make(np.zeros(3)), tmp_path, "ptx")
    grids = [grid for path in sorted((out / "scans").iterdir()) for grid in ptx_grids(path)]
    assert len(grids) == (3 if make is stations_apart else 2)
    in_project = []
    for cells, T in grids:
        column, row = np.nonzero((cells[:, :, :3] != 0.0).any(axis=2))
        points = cells[column, row, :3]
        in_project.append(points @ T[:3, :3].T + T[:3, 3])
        assert (cells[(cells[:, :, :3] == 0.0).all(axis=2)][:, 3] == 0.5).all()
        # In the scanner's frame a column is one azimuth and a row one elevation, as the points were made.
        turned = np.exp(1j * (np.arctan2(points[:, 1], points[:, 0]) - 0.06 * column))
        np.testing.assert_allclose(turned, turned[0], atol=1e-6)  # rad: 1e-4 mm of 2 m are 5e-8, twice
        elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
        np.testing.assert_allclose(elevation - 0.02 * row, (elevation - 0.02 * row)[0], atol=1e-6)
    given = []
    for scan in scene.scans:
        T = scan.T_project_scan if scan.T_project_scan.size else np.eye(4)
        given.append((scan.points + scan.origin) @ T[:3, :3].T + T[:3, 3])
    np.testing.assert_allclose(sorted_rows(np.vstack(in_project) * 1000.0), sorted_rows(np.vstack(given)), atol=1e-3)


def test_another_program_reads_pcd(tmp_path):
    """What is written of the other formats is read by other programs in tests/clouds, and PTX above."""
    (scan,) = merged(np.zeros(3)).scans
    formats.write_pcd(tmp_path / "a.pcd", scan)
    cloud = open3d.t.io.read_point_cloud(str(tmp_path / "a.pcd"))
    np.testing.assert_allclose(cloud.point.positions.numpy(), scan.points / 1000.0, atol=1e-15)  # one division


@pytest.mark.parametrize("format_", ["e57", "laz"])  # whose formats have a time and identifiers
def test_the_same_scene_makes_the_same_files(format_, tmp_path):
    scene = stations_apart(np.zeros(3))
    digests = []
    for turn in ("a", "b"):
        (tmp_path / turn).mkdir()
        _, out = exported(scene, tmp_path / turn, format_)
        digests.append([hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(out.rglob("*")) if p.is_file()])
    assert digests[0] == digests[1]


def test_scene_unfit_for_the_format_is_refused_before_writing(tmp_path):
    scene = stations_apart(np.zeros(3))
    bare = dataclasses.replace(
        scene, scans=tuple(dataclasses.replace(s, grid_row=[], grid_column=[]) for s in scene.scans)
    )
    with pytest.raises(UsageError, match="not made on a scanner's grid"):
        exported(bare, tmp_path, "ptx")
    assert not (tmp_path / "out").exists()
    loose = merged(np.zeros(3))
    loose = dataclasses.replace(loose, stations=Stations(loose.stations.ids, loose.stations.positions))
    with pytest.raises(UsageError, match="no poses of its stations"):
        exported(loose, tmp_path, "ptx")
    with pytest.raises(UsageError, match="does not name the recipe"):
        exported(scene, tmp_path, "ply", step=True)


def labelled(scene):
    """A truth whose labels rank a scan's points by their intensity, which tells them apart in every format."""

    def ranks(scan):
        return np.argsort(np.argsort(scan.intensity))

    return Truth(tuple(PointLabels(s.name, ("p",), ranks(s), np.zeros(len(s.points))) for s in scene.scans))


@pytest.mark.parametrize("make", [stations_apart, merged])
@pytest.mark.parametrize("format_", ["e57", "laz", "ply", "ptx"])
def test_the_truth_is_found_by_the_names_that_scans_are_read_by(make, format_, tmp_path):
    scene = make(np.zeros(3))
    store.write_scene(tmp_path / "s.h5", scene, labelled(scene), {})
    export_folder.export(tmp_path / "s.h5", tmp_path / "out", format_, with_truth=True)
    back = folder.read_input(tmp_path / "out")
    truth = store.read_truth(tmp_path / "out/truth.h5")
    labels = {label.scan: label for label in truth.labels}
    assert sorted(labels) == sorted(scan.name for scan in back.scans)
    if make is stations_apart:
        assert {"S1"} <= set(labels)
    if format_ == "e57":
        assert set(labels) == {scan.name for scan in scene.scans}
    rank = 0
    for scan in back.scans:
        ranks = labels[scan.name].part
        assert len(ranks) == len(scan.points)
        in_order = scan.intensity[np.argsort(ranks)]
        assert (np.diff(in_order) >= -1e-6 * in_order.max()).all()
        rank += len(np.unique(ranks))
    assert rank == sum(len(scan.points) for scan in scene.scans)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["f-2", "a/b", "ok"], ["f-1", "f-2", "f-3"]),
        (["ok", "a/b", " a", ".a", "x" * 101, "a\\b", "a\tb", "S 1"], ["ok", *(f"f-{i}" for i in range(2, 8)), "S 1"]),
    ],
)
def test_invalid_names_in_e57_are_numbered_in_the_truth_as_in_the_reader(tmp_path, names, expected):
    """The generator's notion of an odd name is the reader's."""
    points = on_grid(50)[0]
    e57.write(tmp_path / "f.e57", [of_scan(Scan(name, points + i)) for i, name in enumerate(names)], spherical=False)
    read = [scan.name for scan in folder.read_input(tmp_path / "f.e57").scans]
    assert read == e57.names_read("f", names) == expected


@pytest.mark.parametrize("format_", ["e57", "ply"])  # all scans in one file, and a file a scan
def test_station_without_points_is_left_out_with_a_message(format_, tmp_path):
    scene = stations_apart(np.zeros(3))
    blind = Scan("S2", np.empty((0, 3)), station="S2", position=np.zeros(3), T_project_scan=np.eye(4))
    scene = dataclasses.replace(scene, scans=(scene.scans[0], blind, scene.scans[2]))
    truth = Truth(tuple(PointLabels(s.name, (), np.zeros(len(s.points)), np.zeros(len(s.points))) for s in scene.scans))
    store.write_scene(tmp_path / "s.h5", scene, truth, {})
    done = commands.here("designgen", "export", tmp_path / "s.h5", "-o", tmp_path / "out", "--format", format_)
    assert done.returncode == 0, done.stderr
    assert "scan 'S2' is left out: it has almost no points" in done.stderr
    assert "2 scan(s)" in done.stdout
    back = folder.read_input(tmp_path / "out")
    assert [len(scan.points) for scan in back.scans] == [400, 402]
    assert len(store.read_truth(tmp_path / "out/truth.h5").labels) == 2
    store.write_scene(tmp_path / "none.h5", dataclasses.replace(scene, scans=(blind,)), None, {})
    with pytest.raises(UsageError, match="no scan has 4 points or more, so there is nothing to export"):
        export_folder.export(tmp_path / "none.h5", tmp_path / "none", format_, with_truth=True)
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
@pytest.mark.parametrize("spherical", [False, True])
def test_an_arch_bridge_comes_back_from_e57_with_its_components(spherical, tmp_path):
    settings = ["scan.step_mrad=15", "scan.stations=2", "scan.clutter=0"]
    scene, truth = make_scene("bridge", recipe_files.overridden(recipe_files.load("arch-s1-rays")[1], settings))
    scans = [dataclasses.replace(scan, sigma_mm=1.0 + i) for i, scan in enumerate(scene.scans)]
    scans[0] = dataclasses.replace(scans[0], station="foot1/S1")
    store.write_scene(tmp_path / "s.h5", dataclasses.replace(scene, scans=tuple(scans)), truth, {})
    export_folder.export(tmp_path / "s.h5", tmp_path / "out", "e57", with_truth=True, spherical=spherical)
    files = sorted(path.name for path in (tmp_path / "out/scans").iterdir())
    assert files == ["foot1.e57", "foot2.e57", "rib1.e57", "rib2.e57", "rib3.e57"]
    back, kept = folder.read_input(tmp_path / "out"), store.read_scene(tmp_path / "s.h5")
    for ours, theirs in zip(kept.scans, back.scans, strict=True):
        assert (theirs.name, theirs.component, theirs.sigma_mm) == (ours.name, ours.component, ours.sigma_mm)
        assert theirs.station == ours.station
        np.testing.assert_allclose(theirs.points + theirs.origin, ours.points + ours.origin, atol=DOUBLE_MM)
    # Each point's station has no place in E57; where the stations stood is said all the same.
    assert len(json.loads((tmp_path / "out/stations.json").read_text())) == 10
    labels = {label.scan: label for label in store.read_truth(tmp_path / "out/truth.h5").labels}
    assert all(len(labels[scan.name].part) == len(scan.points) for scan in back.scans)


def test_two_e57_files_may_hold_scans_of_one_name(tmp_path):
    scans = stations_apart(np.zeros(3)).scans
    for stem in ("day1", "day2"):
        e57.write(tmp_path / f"{stem}.e57", [*map(of_scan, scans[:2])], spherical=False)
    back = folder.read_input(tmp_path)
    assert [scan.name for scan in back.scans] == ["S1", "二号站", "day2-1", "day2-2"]


def test_stations_that_points_name_must_be_there(tmp_path):
    _, out = exported(merged(np.zeros(3)), tmp_path, "ply")
    places = json.loads((out / "stations.json").read_text())
    (out / "stations.json").write_text(json.dumps({"S1": places["S1"]}))
    with pytest.raises(InputError, match=r"name stations 1 to 2, but stations\.json has 1"):
        folder.read_input(out)
    (out / "stations.json").write_text(json.dumps({"S1": {"place": [0, 0, 0]}}))
    with pytest.raises(InputError, match="place"):
        folder.read_input(out)
