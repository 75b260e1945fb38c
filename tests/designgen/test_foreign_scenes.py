"""Foreign generators: same bytes for the same seed, and truths that agree with the points in closed form."""

import ast
import runpy
import sys

import numpy as np
import pytest

from processor.evaluation import truth_json
from processor.scan_folder import folder
from tests.support.scenes.foreign_scenes import FOREIGN, foreign_scene

SCRIPTS = sorted(path for path in FOREIGN.glob("*.py") if path.name != "__init__.py")
SMALL = {
    "arch_bridge": ("spacing=90", "stations=3", "span=9000", "rise=2000"),
    "space_frame": ("rows=2", "columns=2", "stations=2", "step_mrad=8"),
    "steelwork": ("case=plate", "step_mrad=8", "spacing=20"),
}
COARSER = {"arch_bridge": ("spacing=400", "stations=2"), "space_frame": ("step_mrad=16",)}  # bytes alone are compared
QUIET = {
    "arch_bridge": ("noise=0", "noise_ppm=0", "range_offset=0", "shift=0", "rotation_urad=0", "drift=0",
                    "incidence_bias=0", "outliers=0", "beam=0", "clutter=0"),
    "space_frame": ("noise=0", "noise_ppm=0", "range_offset=0", "shift=0", "rotation_urad=0", "outliers=0",
                    "clutter=0", "mixed=0"),
    "steelwork": ("noise=0", "noise_ppm=0", "range_offset=0", "shift=0", "rotation_urad=0", "bias=0", "outliers=0",
                  "beam=0"),
}  # fmt: skip


def contents(path):
    return {str(file.relative_to(path)): file.read_bytes() for file in sorted(path.rglob("*")) if file.is_file()}


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_a_generator_shares_no_code(path):
    modules = {
        name.split(".")[0]
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        for name in (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [node.module]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    }
    assert modules <= {*sys.stdlib_module_names, "numpy"}


@pytest.mark.parametrize("name", [pytest.param("arch_bridge", marks=pytest.mark.slow), "space_frame", "steelwork"])
def test_the_same_seed_makes_the_same_bytes(name, tmp_path):
    one, again, other = (
        contents(foreign_scene(name, tmp_path / str(i), *SMALL[name], *COARSER.get(name, ()), seed=seed))
        for i, seed in enumerate((3, 3, 4))
    )
    assert one == again
    assert one.keys() == other.keys()
    assert one["truth.json"] != other["truth.json"]


def test_points_of_a_bridge_lie_on_the_true_parts(tmp_path):
    """The scan, by its true pose, lies within the box of the true key points' sections, and on its outer faces."""
    path = foreign_scene(
        "arch_bridge", tmp_path, *SMALL["arch_bridge"], *QUIET["arch_bridge"], "waviness=0", "fabrication=0"
    )
    truth, scene = truth_json.read(path).arch, folder.read_input(path)
    assert truth.names == ("SP-W", "SEG-1", "SEG-2", "SEG-3", "SP-E") == tuple(scan.component for scan in scene.scans)
    for i, scan in enumerate(scene.scans):
        T = truth.T_bridge_scan[i]
        at = scan.points @ T[:3, :3].T + scan.origin @ T[:3, :3].T + T[:3, 3]
        left, right = truth.edges_bridge[i]
        assert np.abs(left[:, 1] - 350.0).max() < 1e-9 > np.abs(right[:, 1] + 350.0).max()  # float64
        webs = np.abs(np.abs(at[:, 1]) - 350.0) < 0.05  # the files round to 0.05 mm
        assert webs.mean() > 0.25
        known = np.isfinite(truth.key_points_scan[i])
        placed = truth.key_points_scan[i] @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(placed[known], truth.key_points_bridge[i][known], atol=1e-6)  # digits of the JSON
        if 0 < i < 4:  # an end's four corners span its plane; rims lie in it
            for corners, out in zip(truth.key_points_bridge[i], (-1.0, 1.0), strict=True):
                normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
                normal *= np.sign(normal[0]) * out / np.linalg.norm(normal)
                near = np.linalg.norm(at - corners.mean(axis=0), axis=1) < 700.0
                assert ((at[near] - corners[0]) @ normal).max() < 0.1  # the files round to 0.05 mm


def test_rays_end_on_balls_and_members(tmp_path):
    path = foreign_scene("space_frame", tmp_path, *SMALL["space_frame"], *QUIET["space_frame"], "step_mrad=3")
    truth, (scan,) = truth_json.read(path).frame, folder.read_input(path).scans
    points = scan.points + scan.origin
    distance = np.linalg.norm(points[:, None] - truth.centres, axis=2) - truth.radii
    assert distance.min() > -1e-6  # none within a ball
    on = np.abs(distance) < 1e-6  # digits of the file
    assert (on.sum(axis=0) >= 5).all()
    np.testing.assert_allclose(truth.lowest, truth.centres - np.outer(truth.radii, [0, 0, 1]))


def test_a_plate_as_designed_is_scanned_as_designed(tmp_path):
    path = foreign_scene("steelwork", tmp_path, *SMALL["steelwork"], *QUIET["steelwork"])
    truth, scene = truth_json.read(path), folder.read_input(path)
    T = truth.pose.T_design_project
    (scan,) = scene.scans
    at = (scan.points + scan.origin) @ T[:3, :3].T + T[:3, 3]
    low, high = scene.structure.vertices.min(axis=0), scene.structure.vertices.max(axis=0)
    assert (at > low - 1e-6).all()
    assert (at < high + 1e-6).all()
    assert np.isin(np.round(at[:, 2], 6), (0.0, 12.0, 108.0)).mean() > 0.5
    assert not truth.structure.displacement.any()


def test_the_volume_of_a_dent_is_that_of_its_points(tmp_path):
    module = runpy.run_path(str(FOREIGN / "steelwork.py"))
    bump = module["Bump"](np.array([10.0, 300.0, -5.0]), 80.0, 6.0, np.array([0.0, 1.0, 0.0]))
    x, z = (v.ravel() for v in np.meshgrid(np.arange(-90.0, 110, 0.5), np.arange(-105.0, 95, 0.5)))
    moved = bump(np.column_stack([x, np.full(x.shape, 300.0), z]))
    assert moved[:, 1].min() == pytest.approx(-6.0)
    assert -moved.sum() * 0.25 == pytest.approx(bump.volume, rel=1e-4)  # sums of cells of 0.5 mm


def test_motion_by_station_errors_has_the_covariance_of_the_truth():
    """The covariance against fits to draws of the errors, as the generator draws them."""
    module = runpy.run_path(str(FOREIGN / "steelwork.py"))
    rng = np.random.default_rng(5)
    points = rng.uniform([0.0, 0.0, 0.0], [4000.0, 2000.0, 1500.0], (600, 3))
    normals = np.eye(3)[rng.integers(0, 3, 600)] * rng.choice([-1.0, 1.0], (600, 1))
    stations = np.array([[-3000.0, 500, 900], [7000, 900, 2500], [2000, -4000, 1000]])
    of, settings = rng.integers(0, 3, 600), module["SETTINGS"]
    J = np.hstack([np.cross(points, normals), normals])
    solve, draws = np.linalg.pinv(J), np.empty((1500, 6))
    for draw in draws:
        moved = points.copy()
        for k, station in enumerate(stations):
            ray = points[of == k] - station
            offset = settings["range_offset"] * rng.normal() * ray / np.linalg.norm(ray, axis=1)[:, None]
            moved[of == k] = module["turned"](points[of == k] + offset, station, settings, rng)
        draw[:] = solve @ np.einsum("ni,ni->n", moved - points, normals)
    stated = module["by_stations"](points, normals, of, stations, settings)
    root = np.linalg.inv(np.linalg.cholesky(stated))
    # 1500 draws: 0.037 each on the diagonal, 0.026 beside it.
    np.testing.assert_allclose(root @ np.cov(draws.T) @ root.T, np.eye(6), atol=0.12)


def test_a_piece_that_reaches_two_borders_is_a_missing_part(tmp_path):
    """As docs/steps/defects.md defines the classes: the corner of a rib, whose borders are at 430 and 700 mm."""
    path = foreign_scene("steelwork", tmp_path, "case=defects", "step_mrad=8", "spacing=40")
    truth = truth_json.read(path).defects
    off = np.array([430.0, 700.0]) - np.abs(truth.centres[:, 1:])
    sides = np.sqrt(truth.area_mm2)
    corner = np.flatnonzero((np.abs(off - sides[:, None] / 2) < 1e-6).all(axis=1))  # digits of the JSON
    assert [truth.classes[k] for k in corner] == ["missing-part"]
