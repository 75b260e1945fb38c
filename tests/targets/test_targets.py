"""Targets: checkerboards by intensity, spheres by shape, their names, and their use as control points."""

import dataclasses

import numpy as np
import pytest
import scipy.stats
from scipy.fft import rfftn
from scipy.special import erfc

import designgen
from processor.geometry import rigid
from processor.language.messages import messages
from processor.model import Control, InputError, Scan, Scene, Stations, TargetSearch
from processor.report.stitching import targets as report
from processor.scan_folder import folder
from processor.stitching import step as stitching_step
from processor.targets import checkerboard, find, naming
from processor.targets.summary import summary
from tests.support.clouds.target_clouds import board

SIDE = 150.0


# --- checkerboards -------------------------------------------------------------------------------------------------


def boards_in(points, intensity):
    return checkerboard.search(points, intensity, SIDE)[0]


def found_in(seed, **settings):
    points, intensity, centre = board(np.random.default_rng(seed), side=SIDE, **settings)
    return boards_in(points, intensity), centre


@pytest.mark.parametrize(
    ("step", "count", "median_mm", "most_mm"),
    [(0.6e-3, 6, 0.3, 0.6), pytest.param(0.3e-3, 20, 0.1, 0.3, marks=pytest.mark.slow)],
)
def test_centres_at_ten_metres(step, count, median_mm, most_mm):
    """Footprints drawn ray by ray, apart from the model that is fitted; a tenth of the step at most, as is usual."""
    errors = []
    for seed in range(count):
        boards, centre = found_in(seed, distance=10_000.0, step=step)
        assert len(boards) == 1
        errors.append(float(np.linalg.norm(boards[0].centre - centre)))
    assert np.median(errors) < median_mm
    assert max(errors) < most_mm


@pytest.mark.slow
def test_standard_deviations_agree_with_the_errors_of_targets():
    """Of three coordinates of twenty boards at all turns: 60 errors; the bounds hold 99.9 % of such sets."""
    squares = []
    for seed in range(20):
        (one,), centre = found_in(100 + seed, distance=8_000.0, step=0.8e-3)
        off = one.centre - centre
        squares.append(float(off @ np.linalg.solve(one.covariance, off)))
    low, high = scipy.stats.chi2.ppf([5e-4, 1.0 - 5e-4], 60) / 60.0
    assert low < np.mean(squares) / 3.0 < high


@pytest.mark.parametrize("longer_mm", [pytest.param(2.0, marks=pytest.mark.slow), -3.0])
def test_a_difference_of_ranges_to_dark_and_bright_fields_is_in_the_interval(longer_mm):
    """Whichever colour has the right ranges: the centre lies midway, and both planes are within 1.96 sd."""
    points, intensity, centre = board(np.random.default_rng(7), side=SIDE)
    dark = intensity < 0.5 * (intensity.min() + intensity.max())
    (equal,) = boards_in(points, intensity)
    ranges = np.linalg.norm(points, axis=1)
    (one,) = boards_in(points * (1.0 + dark * longer_mm / ranges)[:, None], intensity)
    ray = centre / np.linalg.norm(centre)
    sd, before = (float(np.sqrt(ray @ found.covariance @ ray)) for found in (one, equal))
    for plane in (0.0, longer_mm):
        assert abs(float(ray @ (one.centre - centre)) - plane) < 1.96 * sd
    assert before < 0.3 < 0.45 * abs(longer_mm) < sd < 0.6 * abs(longer_mm)


def test_half_of_the_difference_between_dark_and_bright_fields_is_a_standard_deviation_across():
    """Seen square by a fine beam without noise: 3 mm longer to dark fields, on a plane midway."""
    points, intensity, centre = board(
        np.random.default_rng(3), step=0.3e-3, side=SIDE, tilt=0.0, noise=0.0, sigma=0.0, beam=1e-3
    )
    dark = intensity < 0.5 * (intensity.min() + intensity.max())
    (one,) = boards_in(points * (1.0 + dark * 3.0 / np.linalg.norm(points, axis=1))[:, None], intensity)
    ray = centre / np.linalg.norm(centre)
    assert np.sqrt(ray @ one.covariance @ ray) == pytest.approx(1.5, rel=2e-3)


def test_a_step_between_samples_is_misplaced_as_the_sum_of_its_samples():
    """The place of a step by all samples of one row, for steps anywhere between two of them: its scatter, in spacings.

    Of 400 points that lie anywhere 20 rows average it; where all rows lie alike, none does.
    """
    spacing, width, count = 3.0, 1.5, 400
    x, k = np.linspace(0.0, spacing, 1_000, endpoint=False), spacing * np.arange(-40, 40)
    misplaced = np.std(0.5 * spacing * erfc((k - x[:, None]) / width).sum(axis=1) - x)
    far = np.full(count, 50.0)
    anywhere = spacing * (8.0 * (0.618034 * np.arange(count) % 1.0) - 4.0)
    found = checkerboard._sampling_sd(anywhere, far, spacing, width)
    assert found == pytest.approx(misplaced / np.sqrt(20.0), rel=1e-3)  # the second harmonic: 5e-5 / 0.085
    aligned = checkerboard._sampling_sd(spacing * (np.arange(count) % 7 - 3.0), far, spacing, width)
    assert misplaced < aligned < 1.5 * misplaced  # seven samples of a row fit a period a little longer, too


def test_slopes_of_the_pattern_are_those_of_finite_differences():
    at = np.random.default_rng(4).uniform(-40.0, 40.0, (50, 2))
    x = np.array([3.0, -5.0, 0.4, 0.5, 0.3, 12.0])
    steps = 1e-5 * np.eye(6)
    ahead, behind = (np.stack([checkerboard._model(at, x + way * h) for h in steps], axis=1) for way in (1.0, -1.0))
    # Rounding of 1e-16 over 1e-5 and third differences.
    np.testing.assert_allclose(checkerboard._slopes(at, x), (ahead - behind) / 2e-5, atol=1e-8)


def test_the_correlation_is_one_where_the_image_is_the_pattern():
    upright = checkerboard._patterns(SIDE, 41)[0]
    assert upright.window == 17**2  # of cells of 1 / 18: those within 0.47 * 18 = 8.46 of the centre
    grid = np.arange(41) - 24
    square = np.where(np.abs(grid) <= 8, np.sign(grid), 0.0)
    image = 3.0 * np.outer(square, square)
    fields = {"there": np.ones((41, 41)), "image": image, "square": image**2}
    spectra = {name: rfftn(values, upright.extent) for name, values in fields.items()}
    found = checkerboard._correlation(spectra, upright, 41)
    assert np.unravel_index(found.argmax(), found.shape) == (24, 24)
    assert found.max() == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("field", [(1, 1), (-1, -1), (1, -1), (-1, 1)])
def test_a_field_has_points_in_half_of_its_cells_and_the_colour_of_the_one_across(field):
    """Within 10 spacings of the centre's lines, and beyond one, a field has 9 by 9 cells."""
    u, v = (10.0 * one.ravel() for one in np.meshgrid(*[np.arange(-9.5, 10.0)] * 2))
    of_field = np.flatnonzero((field[0] * u > 10.0) & (field[1] * v > 10.0))
    bright = np.where(u * v > 0.0, 0.1, 0.9)

    def accepted(points, colour):
        rows, colours = np.delete(np.arange(len(u)), of_field[points:]), bright.copy()
        colours[of_field] = colour
        return checkerboard._has_fields(u[rows], v[rows], colours[rows], 100.0, 10.0)

    colour = bright[of_field[0]]
    assert len(of_field) == 81
    assert accepted(41, colour)
    assert not accepted(40, colour)
    # A field that is d nearer to the other colour leaves a step of 0.8 - d / 2; d = 0.3 (0.8 - d / 2) at 0.2087.
    toward = 1.0 if colour == 0.1 else -1.0
    assert accepted(81, colour + 0.208 * toward)
    assert not accepted(81, colour + 0.209 * toward)


def test_the_order_of_the_points_does_not_matter():
    rng = np.random.default_rng(3)
    points, intensity, _ = board(rng, step=1e-3)
    order = rng.permutation(len(points))
    (one,), (other,) = (boards_in(points[rows], intensity[rows]) for rows in (slice(None), order))
    assert np.array_equal(one.centre, other.centre)


def test_no_checkerboard_is_found_without_intensities_contrast_or_points():
    points, intensity, _ = board(np.random.default_rng(1), step=1e-3)
    assert boards_in(points, np.ones(len(points))) == []
    assert boards_in(points, np.empty(0)) == []
    assert boards_in(points[:20], intensity[:20]) == []
    rng = np.random.default_rng(2)
    assert boards_in(points, rng.uniform(0.0, 1.0, len(points))) == []


def painted(colour, seed=0, step=6.0, half=170.0):
    """A wall with intensities by a function of u and v, mm, 5 m from the scanner."""
    rng = np.random.default_rng(seed)
    u, v = (one.ravel() for one in np.meshgrid(*[np.arange(-half, half, step)] * 2))
    bright = np.array([colour(a, b) for a, b in zip(u, v, strict=True)], float)
    points = np.column_stack([np.full(len(u), 5000.0) + rng.normal(0.0, 0.5, len(u)), u, v])
    return points, bright * (1.0 + 0.03 * rng.standard_normal(len(u)))


def on_board(inside):
    """A pattern on a white board of 230 mm on a grey wall."""
    return lambda u, v: 0.55 if max(abs(u), abs(v)) > 115.0 else (0.06 if inside(u, v) else 0.9)


DECOYS = {
    "chess": lambda u, v: 0.06 if (int(np.floor(u / 75.0)) + int(np.floor(v / 75.0))) % 2 else 0.9,
    "large tiles": lambda u, v: 0.06 if u * v > 0.0 else 0.9,
    "edge": on_board(lambda u, v: u > 0.0),
    "corner": on_board(lambda u, v: u > 0.0 and v > 0.0 and max(u, v) < 75.0),
    "square": on_board(lambda u, v: max(abs(u), abs(v)) < 60.0),
    "disc": on_board(lambda u, v: np.hypot(u, v) < 60.0),
    "cross": on_board(lambda u, v: min(abs(u), abs(v)) < 10.0),
    "stripes": on_board(lambda u, v: int(np.floor(u / 25.0)) % 2 == 0),
    "diagonal": on_board(lambda u, v: u * v > 0.0 and 25.0 < abs(u) < 75.0 and 25.0 < abs(v) < 75.0),
    "smaller": on_board(lambda u, v: u * v > 0.0 and max(abs(u), abs(v)) < 35.0),
}


SELDOM = ("edge", "cross", "square")  # every weekend: other shapes on the same board are tried every day


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in SELDOM else []) for name in DECOYS]
)
def test_similar_patterns_are_no_target(name):
    assert boards_in(*painted(DECOYS[name])) == []


def test_painted_target_on_a_wall_is_found_at_its_centre():
    target = on_board(lambda u, v: u * v > 0.0 and max(abs(u), abs(v)) < 75.0)
    (one,) = boards_in(*painted(target))
    # A step is 6 mm: 3 sd and a thirtieth of it.
    assert one.centre == pytest.approx([5000.0, 0.0, 0.0], abs=3.0 * one.sd + 0.2)


@pytest.mark.parametrize("diameter", [115.0, 150.0])
@pytest.mark.parametrize("around", [0.06, 0.55, 0.9])
def test_a_round_target_is_found_by_its_diameter(tmp_path, diameter, around):
    """Four sectors of a circle on a black, a grey and a white wall, with points every 3 mm."""

    def colour(u, v):
        return around if np.hypot(u, v) > 0.5 * diameter else 0.06 if u * v > 0.0 else 0.9

    points, bright = painted(colour, step=3.0, half=120.0)
    np.savetxt(tmp_path / "scan.xyz", points)
    (tmp_path / "project.toml").write_text(f'units = "mm"\n[targets]\nround_mm = {diameter}')
    side = folder.read_input(tmp_path).target_search.checkerboard_mm
    (one,) = checkerboard.search(points, bright, side)[0]
    assert one.centre == pytest.approx([5000.0, 0.0, 0.0], abs=3.0 * one.sd + 0.1)


# --- names ---------------------------------------------------------------------------------------------------------


def test_the_least_height_of_a_triangle_stands_on_its_longest_side():
    assert naming._height(np.array([[7.0, 0.0, 0.0], [7.0, 300.0, 0.0], [7.0, 0.0, 400.0]])) == pytest.approx(240.0)
    assert naming._height(np.ones((3, 3))) == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_a_pattern_names_targets_whatever_the_frame(seed):
    rng = np.random.default_rng(seed)
    known = rng.uniform(0.0, 12_000.0, (12, 3))
    T = rigid.transform(rigid.rotation_from_vector(rng.uniform(-2.0, 2.0, 3)), rng.uniform(-5e4, 5e4, 3))
    seen = rng.permutation(12)[:5]
    places = rigid.apply(T, known[seen]) + rng.normal(0.0, 0.3, (5, 3))
    stray = rigid.apply(T, rng.uniform(0.0, 12_000.0, (1, 3)))
    assert naming.by_pattern(np.vstack([places, stray]), known).tolist() == [*seen.tolist(), -1]


def test_symmetric_pattern_assigns_no_names():
    corners = 4000.0 * np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    assert (naming.by_pattern(corners + 1.0, corners) == -1).all()


def test_two_targets_get_names_by_a_pose_alone():
    known = np.random.default_rng(0).uniform(0.0, 9000.0, (6, 3))
    assert (naming.by_pattern(known[:2], known) == -1).all()
    assert naming.by_pose(known[[4, 2]] + 5.0, known).tolist() == [4, 2]
    assert naming.by_pose(known[[4]] + 500.0, known).tolist() == [-1]


# --- scenes --------------------------------------------------------------------------------------------------------


def scene_of_board(**changes):
    points, intensity, centre = board(np.random.default_rng(5))
    scan = Scan("S1", points, intensity=intensity, position=np.zeros(3), T_project_scan=np.eye(4))
    control = Control(("K1", "K2"), positions=[centre + 2.0, centre + 4000.0], sd=[0.5, 0.5])
    search = TargetSearch(checkerboard_mm=SIDE)
    return dataclasses.replace(
        Scene("hall", "structure", (scan,), control=control, target_search=search), **changes
    ), centre  # fmt: skip


def test_found_targets_become_sightings_of_control_points():
    scene, centre = scene_of_board()
    found = find.with_targets(scene)
    assert found.targets.name == ("K1",)
    assert found.control.seen[0] == pytest.approx(centre, abs=0.6)  # as of boards at ten metres
    assert (found.control.point.tolist(), found.control.scan.tolist()) == ([0], [0])
    assert found.control.seen_sd[0] >= np.sqrt(find.LEAST[0, 0])
    assert str(summary(found)) == "targets in 1 scan: 1 checkerboard; 1 of them are control points"
    assert "棋盘格" in messages("zh").text(summary(found))
    assert find.with_targets(found) is found
    rows = report.files(found)["targets.csv"].decode("utf-8").splitlines()
    assert rows[1].startswith("S1,,checkerboard,K1,")
    assert report.files(scene) == {}


def test_stated_sighting_is_not_replaced_by_a_found_one():
    scene, centre = scene_of_board()
    stated = dataclasses.replace(scene.control, point=[0], scan=[0], station=[-1], seen=[centre + 1.0], seen_sd=[0.7])
    found = find.with_targets(dataclasses.replace(scene, control=stated))
    assert found.control.seen_sd.tolist() == [0.7]


def test_a_merged_cloud_is_searched_station_by_station():
    scene, _ = scene_of_board()
    scan = dataclasses.replace(
        scene.scans[0], position=np.empty(0), T_project_scan=np.empty(0),
        point_station=np.ones(len(scene.scans[0].points), np.int32),
    )  # fmt: skip
    stations = Stations(("A", "B"), positions=np.zeros((2, 3)), T_project_station=np.tile(np.eye(4), (2, 1, 1)))
    found = find.with_targets(dataclasses.replace(scene, scans=(scan,), stations=stations))
    assert found.control.station.tolist() == [1]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[targets]", "'checkerboard_mm', 'round_mm' or 'sphere_radius_mm'"),
        ("[targets]\ncheckerboard_mm = 150\nround_mm = 115", "found both"),
        ("[targets]\ncheckerboard_mm = 0", "a number above 0"),
        ("[targets]\nchekerboard_mm = 150", "did you mean 'checkerboard_mm'"),
    ],
)
def test_a_search_that_makes_no_sense_is_refused(tmp_path, text, said):
    np.savetxt(tmp_path / "scan.xyz", np.random.default_rng(0).uniform(size=(50, 3)))
    (tmp_path / "project.toml").write_text(text)
    with pytest.raises(InputError, match=said):
        folder.read_input(tmp_path)


def test_control_points_without_sightings_are_accepted_with_a_target_search(tmp_path):
    np.savetxt(tmp_path / "scan.xyz", np.random.default_rng(0).uniform(size=(50, 3)))
    (tmp_path / "control.csv").write_text("name,scan,x,y,z,sd_mm\nT1,,1.0,2.0,3.0,0.5\n")
    (tmp_path / "project.toml").write_text("")
    with pytest.raises(InputError, match=r"or \[targets\]"):
        folder.read_input(tmp_path)
    (tmp_path / "project.toml").write_text("[targets]\nsphere_radius_mm = 72.5\n")
    scene = folder.read_input(tmp_path)
    assert scene.control.ids == ("T1",)
    assert len(scene.control.point) == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_room_with_targets_and_decoys(seed):
    """Every target with enough points is found and named, without false ones, and places are within 0.3 mm and 4 sd."""
    settings = {"scan.step_mrad": 4.0, "room.spheres": 0, "room.checkerboard_mm": 300.0, "room.decoys": 8}
    scene, truth = designgen.make("room-targets", seed=seed, settings=settings)
    found = find.with_targets(scene).targets
    for k in range(len(found)):
        place = rigid.apply(truth.stations.T_project_station[found.scan[k]], found.places[k])
        off = np.linalg.norm(truth.targets.positions - place, axis=1)
        # A station's own offset, scale and tilt move all that it sees.
        assert off.min() < 4.0 * found.sd[k] + 2.0, "a false target"
        assert found.name[k] in ("", truth.targets.ids[int(off.argmin())])
    expected = {
        (scan, name)
        for scan, label in enumerate(truth.labels)
        for i, name in enumerate(truth.targets.ids)
        if _points_on(label, i) > 400
    }
    seen = set(zip(found.scan.tolist(), found.name, strict=True))
    assert len(expected & seen) >= 0.95 * len(expected) > 4


def _points_on(label, number):
    rows = [i for i, name in enumerate(label.surface_names) if name.startswith(f"checkerboard {number + 1} ")]
    return int(np.isin(label.surface, rows).sum())


# --- what is not found, with a remark ---------------------------------------------------------------------------------


def test_points_without_intensity_do_not_prevent_a_target():
    points, intensity, centre = board(np.random.default_rng(7), side=SIDE)
    on_it = np.flatnonzero(np.linalg.norm(points - centre, axis=1) < 40.0)
    intensity[on_it[::25]] = np.nan
    (one,) = boards_in(points, intensity)
    assert np.linalg.norm(one.centre - centre) < 0.6  # as of boards at ten metres


def test_scan_without_intensities_is_reported_as_not_searched():
    scene, _ = scene_of_board()
    blank = dataclasses.replace(scene.scans[0], intensity=np.empty(0))
    found = find.with_targets(dataclasses.replace(scene, scans=(blank,)))
    assert [one.code for one in found.target_remarks] == ["targets.no-intensities"]
    assert "S1 has no intensities" in str(summary(found))
    assert "强度" in messages("zh").text(summary(found))
    assert find.with_targets(scene).target_remarks == ()


def test_places_and_spheres_beyond_the_search_limit_are_reported(monkeypatch):
    scene, _ = scene_of_board()
    monkeypatch.setattr(checkerboard, "MOST_SEEDS", 2)
    found = find.with_targets(scene)
    (remark,) = found.target_remarks
    assert (remark.code, remark.values["places"]) == ("targets.most-places", 2)
    monkeypatch.setattr(find, "MOST_SPHERES", 1)
    rng = np.random.default_rng(3)
    unit = rng.standard_normal((2, 900, 3))
    unit /= np.linalg.norm(unit, axis=2)[..., None]
    ball = (100.0 * unit + np.array([[[3000.0, 0.0, 0.0]], [[0.0, 3000.0, 0.0]]])).reshape(-1, 3)
    scan = Scan("S1", ball + rng.normal(0.0, 0.3, ball.shape))
    found = find.with_targets(Scene("x", "structure", (scan,), target_search=TargetSearch(sphere_radius_mm=100.0)))
    assert [one.code for one in found.target_remarks] == ["targets.most-spheres"]
    assert len(found.targets) == 1


def test_interval_of_a_target_includes_the_common_range_error_of_a_view():
    """The class of scanners: 0.5 mm, one standard deviation, for the ranges of one view."""
    scene, _ = scene_of_board()
    found = find.with_targets(scene)
    (one,) = boards_in(scene.scans[0].points, scene.scans[0].intensity)
    # Along the ray, where the covariance of the fit is not the largest
    length = np.linalg.norm(found.targets.places[0])
    assert np.hypot(0.5, 5e-6 * length) < found.targets.sd[0] < np.linalg.norm([0.5, 5e-6 * length, one.sd])
    assert found.control.seen_sd[0] == found.targets.sd[0]


def spread_targets(seed=4, count=6):
    return np.random.default_rng(seed).uniform(0.0, 12_000.0, (count, 3))


def test_two_targets_of_a_posed_scan_have_names_if_their_distance_agrees():
    known = spread_targets()
    seen = known[[1, 3]] + 20.0
    assert naming.by_pose(seen, known).tolist() == [1, 3]
    seen[1] += 30.0 * (known[3] - known[1]) / np.linalg.norm(known[3] - known[1])
    assert naming.by_pose(seen, known).tolist() == [-1, -1]
    line = np.array([[0.0, 0, 0], [4000.0, 0, 0], [9000.0, 0, 0]])
    assert naming.by_pose(line + 3.0, line).tolist() == [0, 1, 2]


def test_contradicting_targets_are_reported():
    known = spread_targets()
    seen = known + np.array([30.0, -20.0, 10.0])  # of an approximate pose
    seen[2, 2] += 40.0
    control = Control(tuple(f"K{i}" for i in range(6)), positions=known, sd=np.full(6, 0.5))
    found = [
        find.Found(
            kind="sphere",
            scan=0,
            station=-1,
            place=place,
            scanner=None,
            covariance=0.01 * np.eye(3),
            points=100,
            fit=np.nan,
        )
        for place in seen
    ]
    scan = Scan("S1", np.zeros((1, 3)), T_project_scan=np.eye(4))
    remarks: list = []
    names = find._names(Scene("x", "structure", (scan,), control=control), found, remarks)
    assert names.tolist() == [0, 1, -1, 3, 4, 5]
    assert [(one.code, one.values["targets"]) for one in remarks] == [("targets.contradict", 1)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 4))
def test_scans_of_a_room_are_placed_by_their_targets(seed):
    """The walls of a room look alike turned by half a turn: the targets decide, and places are within the intervals.

    Of three coordinates and three angles of two scans at most two are beyond 1.96 sd in 98 of 100 cases, by chance.
    """
    settings = {"scan.step_mrad": 4.0, "room.checkerboard_mm": 300.0}
    scene, truth = designgen.make("room-targets", seed=seed, settings=settings)
    found = stitching_step.run(find.with_targets(scene), stitching_step.Params())
    assert [str(one) for one in found.scans.status] == ["ok", "ok"]
    beyond = 0
    for T, C, true in zip(
        found.scans.T_project_scan, found.scans.covariance, truth.stations.T_project_station, strict=True
    ):
        at = true[:3, 3]
        J = np.vstack([np.eye(6)[:3], rigid.motion(at[None])[0]])
        off = np.concatenate([rigid.vector_from_rotation(T[:3, :3] @ true[:3, :3].T), T[:3, 3] - at])
        beyond += int((np.abs(off) > 1.96 * np.sqrt(np.diag(J @ C @ J.T))).sum())
    assert beyond <= 2
