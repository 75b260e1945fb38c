"""Defects found on clouds made here: plates seen from stations, their damage and their truth in closed form."""

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy.stats import norm

from processor.adjustment import scanner_class_errors
from processor.defects import (
    alignment,
    baseline,
    defect_grids,
    detect,
    deviation_field,
    regions,
    scan_statistic,
    shape_models,
    surface_charts,
)
from processor.defects import step as defects_step
from processor.defects.measures import thickness_at
from processor.geometry import mesh_bodies, mesh_distance, rigid
from processor.model import InputError, Scan, Scene, StructureDesign, UsageError
from processor.report.defects import figures, section
from tests.support.clouds.plate_rows import GAP, SIDE, THICK, box, bump, design_of, flat, scene_of
from tests.support.scenes.at_design import AT_DESIGN


def run(scene, **params):
    """The defects of a scene that lies at its design, see :mod:`tests.support.scenes.at_design`."""
    return defects_step.run(scene, defects_step.Params(**params), AT_DESIGN)


DEEP = 0.1  # of a depth: a fit by noisy cells of a tenth of the radius, over which the middle is 1 % less deep


def found(result):
    return list(zip(result.defects.defect_class, result.defects.component, strict=True))


# --- the whole step ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_an_undamaged_structure_has_no_defect(seed):
    result = defects_step.run(scene_of(3, flat, seed=seed), defects_step.Params())
    assert result.status == "ok"
    assert found(result) == []
    inner = SIDE - 16.0  # less a border of 8 mm, and what a row of cells may take
    assert 3 * (inner - 2.0 * result.cell) ** 2 <= result.examined_mm2 <= 3 * inner**2
    assert result.noise == pytest.approx(0.4, rel=0.05)  # by 30,000 points, less those that are cut as outliers


def test_chance_detections_are_flagged_doubtful():
    """Asked for 5000 false alarms on 100 m2 there are some on 1 m2, at most as many, and none passes for sure."""
    result = run(scene_of(3, flat), false_alarms=5000.0)
    allowed = 5000.0 * result.examined_mm2 / 1e8
    assert 0 < len(result.defects) < allowed
    assert result.defects.doubtful.all()
    assert (result.defects.chance <= 5000.0 * (1.0 + 1e-9)).all()
    fewer = (result.defects.chance < 500.0).sum()
    assert fewer < 0.1 * allowed + 3.0 * np.sqrt(0.1 * allowed)  # a tenth as often ten times as strong
    assert "no defects found and" in str(section.REPORT.summary(result)[0])


def test_a_dent_a_bulge_and_a_pit_are_measured():
    bumps = {"dent": (3.0, 90.0, (250.0, 300.0)), "bulge": (-2.0, 80.0, (1250.0, 350.0)),
             "pit": (4.0, 16.0, (2100.0, 200.0))}  # fmt: skip
    scene = scene_of(3, lambda x, z: sum(bump(*one)(x, z) for one in bumps.values()), spacing=4.0)
    result = run(scene)
    assert sorted(found(result)) == [("bulge", "component-2"), ("dent", "component-1"), ("pit", "component-3")]
    assert not result.defects.doubtful.any()
    for kind, (depth, radius, at) in bumps.items():
        k = result.defects.defect_class.index(kind)
        off = abs(result.defects.depth_max[k] - depth)
        assert off < max(DEEP * abs(depth), 2.0 * result.defects.lod95[k])
        assert off < 2.5 * result.defects.depth_ci95[k]
        # A tenth of its radius: less than a cell of the dent.
        np.testing.assert_allclose(result.defects.centre[k], [at[0], 0.0, at[1]], atol=0.1 * radius + 1.0)
        assert result.defects.confidence[k] > 0.9
        deep = np.linalg.norm(result.surface.points - [at[0], 0.0, at[1]], axis=1) < 0.1 * radius + result.cell
        assert set(result.surface.defect[deep].tolist()) in ({k}, {-1, k})
        if kind != "pit":  # outward positive, and nearly as deep as its middle
            # (1 - 0.2**2)**2 at the rim of what is averaged, and noise.
            assert np.median(result.surface.deviation[deep]) == pytest.approx(-depth, rel=0.15)
            # A third of the cylinder about a bump (1 - r^2 / R^2)^2; its foot is lost in the noise.
            assert result.defects.volume_mm3[k] == pytest.approx(np.pi * radius**2 * depth / 3.0, rel=0.05)
            # Of the middle alone; over a cell of a sixth of the radius a twentieth is lost, and noise counts twice.
            curvature = 4.0 * abs(depth) / radius**2 * 1000.0
            assert result.defects.curvature_per_m[k] == pytest.approx(curvature, rel=0.35)


def test_missing_corners_edges_and_holes_are_named():
    def missing(x, z):
        corner = (x > SIDE - 90.0) & (x <= SIDE) & (z > SIDE - 90.0)
        edge = (np.abs(x - 1150.0) < 40.0) & (z > SIDE - 50.0)
        hole = np.hypot(x - 2100.0, z - 300.0) < 50.0
        return corner | edge | hole

    result = run(scene_of(3, flat, missing, spacing=4.0))
    assert sorted(found(result)) == [
        ("edge-loss", "component-2"), ("missing-part", "component-1"), ("missing-part", "component-3"),
    ]  # fmt: skip
    np.testing.assert_allclose(result.defects.depth_max, THICK)
    area = dict(zip(result.defects.component, result.defects.area_mm2, strict=True))
    # Half a cell of 6 mm at either border of a size.
    assert area["component-1"] == pytest.approx(90.0**2, rel=0.15)  # half a cell of 10 mm at one of two sides
    assert area["component-2"] == pytest.approx(80.0 * 50.0, rel=0.2)  # half a cell at two of three sides
    assert area["component-3"] == pytest.approx(np.pi * 50.0**2, rel=0.15)  # half a cell of its radius


def test_hole_seen_from_both_sides_is_one_missing_part_without_a_face():
    """Its cells face both ways, so that no face is the one to draw."""

    def missing(x, z):
        return np.hypot(x - 300.0, z - 300.0) < 60.0

    scene = scene_of(3, flat, missing)
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    half_turn[:3, 3] = [3 * (SIDE + GAP) - GAP, THICK, 0.0]
    behind = scene_of(3, flat, lambda x, z: missing(3 * (SIDE + GAP) - GAP - x, z), seed=2)
    backs = (dataclasses.replace(s, name=f"{s.name} behind", T_project_scan=half_turn) for s in behind.scans)
    result = run(dataclasses.replace(scene, scans=(*scene.scans, *backs)))
    assert found(result) == [("missing-part", "component-1")]
    assert result.pictures[0].deviation.size == 0
    drawn = figures.draw(result)
    assert set(drawn) == {"defects-maps.png"}
    assert figures.files(result)["defects.pdf"].startswith(b"%PDF")


def test_surface_in_the_shadow_of_clutter_is_not_missing():
    """A ball in the way of both stations: no point of the surface in its shadow."""
    clutter = (1200.0, -250.0, 300.0, 90.0)
    scene = scene_of(3, flat, clutter=clutter)
    result = run(scene)
    assert found(result) == []
    assert result.expected_mm2 < 3 * SIDE**2 - 8_000.0
    # The same points gone without anything in the way are.
    kept = [dataclasses.replace(s, points=s.points[s.points[:, 1] > -100.0]) for s in scene.scans]
    gone = run(dataclasses.replace(scene, scans=tuple(kept)))
    assert set(found(gone)) == {("missing-part", "component-2")}


@pytest.mark.parametrize(
    ("kind", "inward", "depth"),
    [
        ("bend", lambda x, z: 3.0 * np.cos(np.pi * (x - 1200.0) / SIDE), 3.0),
        ("misalignment", lambda x, z: 2.0 + 0.003 * (z - 300.0), 2.9),
    ],
)
def test_shapes_of_whole_components(kind, inward, depth):
    """On the second of four plates; the others determine the pose of the whole, to 0.05 mm."""
    clutter = (1200.0, -250.0, 300.0, 90.0) if kind == "bend" else None  # cells behind it have no deflection
    result = run(scene_of(4, lambda x, z: np.where((x > 850.0) & (x < 1550.0), inward(x, z), 0.0), clutter=clutter))
    assert found(result) == [(kind, "component-2")]
    assert abs(result.defects.depth_max[0]) == pytest.approx(depth, abs=0.05 + 0.02 * depth)
    if kind == "misalignment":  # by 2 mm on average
        # A plate that is off by the depth's interval everywhere is off by that of the volume.
        (area,), (volume,), (ci95,) = result.defects.area_mm2, result.defects.volume_mm3, result.defects.volume_ci95
        assert area == pytest.approx(SIDE**2, rel=1e-9)  # float64
        assert abs(volume - 2.0 * SIDE**2) < ci95
        assert 0.5 < ci95 / SIDE**2 / result.defects.depth_ci95[0] <= 1.0
    curve = result.defects.deflection[0]
    assert (len(curve.displacement) > 25) == (kind == "bend")
    if kind == "bend":
        at = curve.along
        np.testing.assert_allclose(curve.displacement, -3.0 * np.cos(np.pi * at / SIDE), atol=0.06)  # 2 % of 3 mm


def test_unsettled_alignment_gives_the_same_pose_as_a_settled_one(monkeypatch):
    """The whole is 1.5 mm off; an alignment that never settles gives the same pose as one that does."""
    scene = scene_of(4, lambda x, z: np.full(len(x), 1.5))
    settled = run(scene)
    monkeypatch.setattr(detect, "AGAIN_MM", 0.0)
    again = run(scene)
    # Plates fix y: noise of 0.4 mm, 40,000 points, and a prior of 1 mm for the pose, which draws it by 1 %.
    assert settled.T_design_project[1, 3] == pytest.approx(-1.5, abs=0.03)
    np.testing.assert_allclose(again.T_design_project[1], settled.T_design_project[1], atol=0.01)
    assert again.covariance.shape == (6, 6)
    assert 0.0 < np.sqrt(again.covariance[4, 4]) < 1.0


def test_no_defect_is_sure_where_another_attitude_fits_as_well():
    """A dent in a box that looks the same from four sides, scanned in a frame of its own."""
    vertices, faces = box((0.0, 0.0, 0.0), (2000.0, 600.0, 400.0))
    solid = trimesh.Trimesh(vertices, faces, process=False)
    points, facet = trimesh.sample.sample_surface(solid, 40_000, seed=1)
    depth = bump(9.0, 150.0, (700.0, 300.0))(points[:, 0], points[:, 1]) * (solid.face_normals[facet][:, 2] > 0.5)
    points = points - [0.0, 0.0, 1.0] * depth[:, None] + np.random.default_rng(1).normal(0.0, 0.3, points.shape)
    T = rigid.transform(rigid.rotation_from_vector(np.array([0.1, -0.2, 2.0])), np.array([5e4, -3e4, 2e3]))
    scans = (Scan("S1", rigid.apply(T, points), T_project_scan=np.eye(4)),)
    scene = Scene("box", "structure", scans, structure=StructureDesign("box", vertices, faces))
    result = defects_step.run(scene, defects_step.Params())
    assert result.status == "ambiguous"
    assert len(result.defects) > 0
    assert result.defects.doubtful.all()
    assert (result.defects.confidence <= 0.5).all()
    assert all(row[-1].code == "defects.pose-ambiguous" for row in result.defects.reasons)
    assert "no defects found and" in str(section.REPORT.summary(result)[0])


def test_the_order_of_points_and_the_place_in_the_world_do_not_matter():
    scene = scene_of(2, bump(3.0, 90.0, (250.0, 300.0)))
    first = run(scene)
    mixed = [dataclasses.replace(s, points=np.random.default_rng(5).permutation(s.points)) for s in scene.scans]
    again = run(dataclasses.replace(scene, scans=tuple(mixed)))
    far, T = np.array([4.5e8, 3.2e9, 1e5]), np.eye(4)
    T[:3, 3] = far
    moved = Scene(
        "far", "structure", tuple(dataclasses.replace(s, T_project_scan=T) for s in scene.scans),
        structure=StructureDesign("far", scene.structure.vertices + far, scene.structure.faces),
    )  # fmt: skip
    for other, origin in ((again, 0.0), (run(moved), far)):
        assert found(other) == found(first)
        # Sums in another order; coordinates of 3e9 mm are known to 5e-7 mm.
        np.testing.assert_allclose(other.defects.depth_max, first.defects.depth_max, atol=1e-6)
        np.testing.assert_allclose(other.defects.centre - origin, first.defects.centre, atol=1e-6)


def test_the_papers_chain_finds_a_dent_and_is_seeded():
    scene = scene_of(2, bump(5.0, 120.0, (250.0, 300.0)), spacing=8.0)
    params = defects_step.Params(method="paper", paper=baseline.Paper(trials=30, feature_points=80))
    result = defects_step.run(scene, params)
    assert set(result.defects.defect_class) == {"unknown"}
    np.testing.assert_allclose(result.defects.centre[0], [250.0, 2.0, 300.0], atol=12.0)  # a tenth of its radius
    assert result.defects.depth_max[0] == pytest.approx(5.0, abs=1.2)  # three sds of the noise, of single points
    assert len(result.defects.deflection[0].along) > 5
    again = defects_step.run(scene, params)
    np.testing.assert_array_equal(again.defects.depth_max, result.defects.depth_max)


def test_scene_without_design_or_points_and_bad_parameters_are_refused():
    scene = scene_of(2, flat, spacing=20.0)
    for changed, name in (({"structure": None}, "design"), ({"scans": ()}, "points")):
        with pytest.raises(InputError, match=name):
            defects_step.run(dataclasses.replace(scene, **changed), defects_step.Params())
    for params in ({"reach_mm": 0.0}, {"method": "magic"}):
        with pytest.raises(UsageError, match=next(iter(params))):
            defects_step.run(scene, defects_step.Params(**params))


# --- parts of it ---------------------------------------------------------------------------------------------------


def test_false_alarms_are_no_more_than_asked_for():
    """A hundred square metres of independent noise, over and over: one alarm each is allowed, and chance on top."""
    plate = surface_charts.of_mesh(*box((0.0, 0.0, 0.0), (10_000.0, 12.0, 10_000.0)), 50.0)
    chart = int(np.argmin(plate.charts.axes[:, 2, 1]))
    rows = plate.charts.cells(chart)
    seen = np.zeros(len(plate.share))
    seen[rows] = 1.0
    alarms = 0
    runs = 8
    for seed in range(runs):
        noise = np.random.default_rng(seed).normal(0.0, 0.1, len(seen))
        ones = np.ones(len(seen), np.int64)
        columns = noise, np.full(len(seen), 0.01), 9 * ones, 0 * ones, 0.3 * seen, seen, seen, 0 * ones, 0 * ones
        field = deviation_field.Field(plate, alignment.none(plate, 1, 0.0), *columns)
        levels = scan_statistic.levels_of(field, 1e-8, 0.0)
        sign = scan_statistic.search(field, levels).sign
        alarms += int((np.abs(plate.charts.image(sign.astype(float), chart)) > 0).any())
    assert alarms < runs  # in each of which 1 is allowed: at 0.63 a run, eight of eight is one in forty
    assert np.all(levels.inflation < 1.1)


# --- alignment of stations -----------------------------------------------------------------------------------------


def two_sides(seed, off_mm):
    """Blocks of two pairs of stations, each pair on its side: of the other's they see what hardly shows shifts in x."""
    rng = np.random.default_rng(seed)
    moved = off_mm * rng.normal(size=(4, 7)) * [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0]
    rows = [(0, 1), (2, 3)] * 600 + [(0, 1, 2, 3)] * 400
    block = np.repeat(np.arange(len(rows)), [len(row) for row in rows])
    station = np.concatenate(rows)
    normal = rng.normal(size=(len(rows), 3))
    normal[1200:, 0] = 0.02
    normal = (normal / np.linalg.norm(normal, axis=1)[:, None])[block]
    arm = (rng.uniform(-1.0, 1.0, (len(rows), 3)) * [5000.0, 800.0, 800.0])[block]
    J = np.hstack([np.cross(arm, normal), normal, np.zeros((len(block), 1))])
    free = 5.0 * rng.normal(size=len(rows))[block]
    mean = free + np.einsum("nk,nk->n", J, moved[station]) + 0.2 * rng.normal(size=len(block))
    blocks = alignment.StationBlocks(block, station, mean, np.full(len(block), 0.04), np.zeros(len(block), np.int64))
    return blocks, J, moved


def test_shifts_of_agreeing_stations_stay_near_zero_where_undetermined():
    shifts = []
    for seed in range(3):
        blocks, J, _ = two_sides(seed, 0.0)
        x, covariance = alignment.station_movements(blocks, J, 4)
        shifts.append(np.abs(x[:, 3:6]).max())
        # Less than the class of scanners has, as four stations agree; shifts along the plates hardly show.
        of_class = alignment.CLASS_SHARE[3] * scanner_class_errors.known().view_mm
        assert np.sqrt(np.diag(covariance).reshape(4, 7)[:, 3:6].max()) < of_class
    assert max(shifts) < 0.1  # with a prior of 3 mm for every station, up to 0.7 mm


def test_covariance_of_station_shifts_includes_undetermined_directions():
    z = []
    for seed in range(20):
        blocks, J, moved = two_sides(seed, 0.5)
        x, covariance = alignment.station_movements(blocks, J, 4)
        between = np.zeros((4, 7))
        between[:, 3] = [0.5, 0.5, -0.5, -0.5]  # of the sides, along x
        error = float(((x - moved) * between).sum())
        z.append(error / np.sqrt(between.ravel() @ covariance @ between.ravel()))
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_the_covariance_of_the_whole_is_that_of_components_that_scatter():
    """Components lie off by a or -a in each of six ways: a mean of n with 6 unknowns has the variance a^2 / (n - 6)."""
    a, n = 2.0, 10
    J = np.tile(np.diag([1e4] * 3 + [1.0] * 3), (n, 1))  # turns show at 10 m
    component = np.repeat(np.arange(n), 6)
    deviation = np.where(component % 2 == 0, a, -a)
    x, covariance, gain = alignment._whole(deviation, J, component)
    scale = a / norm.ppf(0.75)  # by the median, of normal errors
    cauchy = (1.0 + (np.array([norm.ppf(0.75), 1.0]) / alignment.CAUCHY) ** 2) ** -2  # of a block, of its component
    of_fit = scale**2 / (n * np.prod(cauchy))
    # The prior, 50 mm there as well, pulls by a thousandth: the square of a fit's sd of 1.2 mm to it.
    np.testing.assert_allclose(np.diag(J[:6] @ covariance @ J[:6]), a**2 / (n - 6) + of_fit, rtol=0.02)
    assert x == pytest.approx(np.zeros(6), abs=1e-12)
    np.testing.assert_allclose(J[:6] @ gain[:, :6], np.eye(6) / n, atol=2e-3)


def test_cells_cover_the_area_of_a_design():
    plate = surface_charts.of_mesh(*box((0.0, 0.0, 0.0), (300.0, 12.0, 200.0)), 5.0)
    area = 2.0 * (300.0 * 200.0 + 300.0 * 12.0 + 200.0 * 12.0)
    # Cells at borders have the share of their samples that is on the body: 1 / 20 of a cell at a border is not known.
    assert plate.area_mm2 == pytest.approx(area, rel=0.02)
    assert len(plate.names) == 1
    assert thickness_at(plate, np.array([100.0, 0.0, 90.0]), np.array([0.0, -1.0, 0.0]), 0) == pytest.approx(12.0)
    tube = trimesh.creation.cylinder(100.0, 1000.0, sections=96)
    round_ = surface_charts.of_mesh(np.asarray(tube.vertices), np.asarray(tube.faces, np.int64), 10.0)
    cylinder = np.flatnonzero(round_.charts.kind == surface_charts.CYLINDER)
    assert len(cylinder) == 1
    mantle = round_.share[round_.charts.cells(int(cylinder[0]))].sum() * 100.0
    assert mantle == pytest.approx(2.0 * np.pi * 100.0 * 1000.0, rel=0.02)  # whole cells of 10 mm at both ends
    np.testing.assert_allclose(
        np.linalg.norm(round_.centres[round_.charts.cells(int(cylinder[0]))][:, :2], axis=1), 100.0, rtol=0.01
    )


def test_vertices_at_one_place_are_one_wherever_the_place_is():
    """Two triangles of a plate with corners that differ by rounding, on either side of half a hundredth millimetre."""
    step = mesh_bodies.WELD_MM
    at = np.array([0.5 * step - 1e-9, 300.5 * step - 1e-9, 0.0])
    square = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [100.0, 50.0, 0.0], [0.0, 50.0, 0.0]]) + at
    vertices = np.vstack([square[[0, 1, 2]], square[[0, 2, 3]] + 2e-9])
    plate = surface_charts.of_mesh(vertices, np.array([[0, 1, 2], [3, 4, 5]]), 10.0)
    assert len(plate.vertices) == 4


def test_density_clusters_are_those_of_the_definition():
    rng = np.random.default_rng(4)
    points = np.vstack([rng.normal(0, 3, (60, 3)), rng.normal(40, 3, (50, 3)), rng.uniform(-80, 120, (40, 3))])
    label = baseline.density_clusters(points, 4.0, 4)
    near = np.linalg.norm(points[:, None] - points[None], axis=2) <= 4.0
    core = near.sum(axis=1) >= 4
    reach = np.where(core[:, None] & core[None], near, False)
    for _ in range(8):  # who is reached by way of others
        reach = (reach.astype(int) @ reach.astype(int)) > 0
    same = label[:, None] == label[None]
    np.testing.assert_array_equal(same[np.ix_(core, core)], reach[np.ix_(core, core)])
    np.testing.assert_array_equal(label < 0, ~core & ~(near & core[None]).any(axis=1))


def test_numbers_by_hand():
    # Huber, limit 2: 1 -> 0.5; 3 -> 0.5 * 2 * (6 - 2) = 4.
    assert baseline.huber(np.array([1.0, 3.0]), 2.0) == pytest.approx(4.5)
    # A parabola of 1 mm at 100 mm: slopes of its chords add up to what it is at the end.
    x = np.linspace(0.0, 100.0, 2001)
    curve = defect_grids.by_slopes(x, (x / 100.0) ** 2, 10)
    # Chords of a parabola over a tenth: 1e-2 / 24.
    np.testing.assert_allclose(curve.displacement, (curve.along / 100.0) ** 2, atol=5e-4)


@pytest.mark.parametrize(
    ("kind", "height"),
    [
        ("bend", lambda p: -2.0 * np.cos(np.pi * p[:, 0] / 1000.0)),
        ("twist", lambda p: 3e-6 * p[:, 0] * p[:, 1]),
        ("waviness", lambda p: 0.8 * np.sin(2.0 * np.pi * p[:, 0] / 230.0)),
        ("step", lambda p: np.where(p[:, 0] > 130.0, 0.6, 0.0)),
        ("misalignment", lambda p: 0.5 + 1e-3 * p[:, 1]),
        ("", lambda p: bump(3.0, 150.0, (100.0, -50.0))(p[:, 0], p[:, 1])),
        ("", lambda p: np.zeros(len(p))),
    ],
)
def test_shape_of_a_deformed_plate_is_identified_and_a_flat_plate_has_none(kind, height):
    a, b = (x.ravel() for x in np.meshgrid(np.linspace(-485.0, 485.0, 34), np.linspace(-285.0, 285.0, 20)))
    points = np.stack([a, b, np.zeros(len(a))], axis=1)
    frame = shape_models.Frame(np.zeros(3), np.eye(3), np.array([500.0, 300.0, 6.0]), 300.0)
    mean = height(points) + np.random.default_rng(2).normal(0.0, 0.03, len(a))
    outward = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    fitted = shape_models.fit(shape_models.Blocks(points, outward, mean, np.full(len(a), 0.03**-2), 30.0), frame)
    assert [one.kind for one in fitted.shapes] == ([kind] if kind else [])
    if kind:
        value = fitted.shapes[0].values(frame, points, outward)
        # Two sds of the noise; a step's own line lies within half a cell of where it is.
        np.testing.assert_allclose(value, height(points), atol=0.06 if kind != "step" else 0.7)


def test_pieces_in_line_with_a_crack_are_joined_and_others_are_not():
    """Cells by their places on the front of a plate: a slim piece, others in its line, one that lies 4 cells off."""
    design = design_of(1)
    whole = surface_charts.gridded(surface_charts.of_mesh(design.vertices, design.faces, 60.0), 10.0)
    (chart,) = {
        int(k) for k in range(len(whole.charts.kind)) if whole.outward[whole.charts.first[k]] @ [0.0, -1.0, 0.0] > 0.9
    }
    rows = np.arange(*whole.charts.cells(chart).indices(len(whole.centres))[:2])

    def piece(low, high, x=305.0, sign=-1):
        at = whole.centres[rows]
        own = rows[(np.abs(at[:, 0] - x) < 5.0) & (at[:, 2] > low) & (at[:, 2] < high)]
        return regions.Region(chart, own, sign, 9.0, 1e-12)

    slim, inside, beyond, far = piece(300, 380), piece(410, 425), piece(100, 200), piece(520, 590)
    beside, raised = piece(410, 425, x=345.0), piece(440, 470, sign=1)
    first, *others = regions.united([raised, far, beside, beyond, inside, slim], whole, 25.0)
    # The slim one reaches 80 mm to either side: the piece below is farther, but not than all that lies above it.
    assert [one.sign for one in first] == [-1]
    joined = np.concatenate([piece.cells for piece in (slim, inside, beyond, far)])
    np.testing.assert_array_equal(first[0].cells, np.unique(joined))
    assert sorted(len(group) for group in others) == [1, 1]
    assert {id(group[0]) for group in others} == {id(beside), id(raised)}


# --- what should have been seen ------------------------------------------------------------------------------------


@pytest.mark.parametrize("gap", [-0.1, 0.0, 0.1])
def test_faces_that_touch_another_body_are_not_missing(gap):
    """A wall with two plates on it, the points from one station in front of it."""
    plates = [box((x, -10.0 - gap, 300.0), (x + 400.0, -gap, 700.0)) for x in (300.0, 1300.0)]
    design = design_of_solids(box((0.0, 0.0, 0.0), (2000.0, 20.0, 1000.0)), *plates)
    rng = np.random.default_rng(1)
    x, z = rng.uniform(0.0, 2000.0, 25_000), rng.uniform(0.0, 1000.0, 25_000)
    y = np.zeros(len(x))
    for corners, _ in plates:
        low, high = corners.min(axis=0), corners.max(axis=0)
        y = np.where((x > low[0]) & (x < high[0]) & (z > low[2]) & (z < high[2]), low[1], y)
    points = np.stack([x, y + rng.normal(0.0, 0.3, len(x)), z], axis=1)
    scan = Scan("S1", points, position=np.array([1000.0, -4000.0, 500.0]), T_project_scan=np.eye(4))
    scene = Scene("wall", "structure", (scan,), structure=design)
    assert found(run(scene, align=False, registration_error_mm=0.01)) == []


def design_of_solids(*solids):
    vertices = np.vstack([corners for corners, _ in solids])
    return StructureDesign("solids", vertices, np.vstack([own + 8 * i for i, (_, own) in enumerate(solids)]))


def scene_seen(design, built, stations):
    """Scans of the solids ``built`` from stations at the design of the solids ``design``."""
    mesh = trimesh.util.concatenate([trimesh.Trimesh(corners, own, process=False) for corners, own in built])
    surface = surface_charts.of_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces).astype(np.int64), 100.0)
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, 50.0)
    scans = []
    for seed, station in enumerate(stations):
        position = np.array(station)
        points, facet = trimesh.sample.sample_surface(mesh, 150_000, seed=seed)
        points, normal = np.asarray(points), np.asarray(mesh.face_normals)[facet]
        away = np.linalg.norm(position - points, axis=1)
        angle = np.einsum("ni,ni->n", position - points, normal) / away**3  # solid angle of an area: as of rays
        front = angle > np.random.default_rng([seed, 1]).uniform(0.0, np.quantile(angle, 0.99), len(angle))
        points, normal = points[front], normal[front]
        hidden = mesh_distance.crossings(grid, points + normal, np.repeat(position[None], len(points), axis=0), True)[0]
        points = np.delete(points, hidden, axis=0)
        ray = (points - position) / np.linalg.norm(points - position, axis=1)[:, None]
        points = points + np.random.default_rng(seed).normal(0.0, 0.3, len(points))[:, None] * ray
        scans.append(Scan(f"S{seed}", points, position=position, T_project_scan=np.eye(4)))
    return Scene("solids", "structure", tuple(scans), structure=design_of_solids(*design))


WEB = box((0.0, 0.0, 0.0), (3000.0, 14.0, 1400.0))
BRACKETS = [box((x, -140.0, 700.0), (x + 400.0, 0.0, 714.0)) for x in (300.0, 1300.0, 2300.0)]
COVERS = [box((x, -10.0, 300.0), (x + 400.0, 0.0, 600.0)) for x in (300.0, 1300.0)]


@pytest.mark.parametrize(
    ("parts", "centre"),
    [
        pytest.param(BRACKETS, [2500.0, -70.0, 707.0], id="bracket", marks=pytest.mark.slow),
        pytest.param(COVERS, [1500.0, -5.0, 450.0], id="cover"),
    ],
)
def test_a_part_that_is_gone_is_missing_where_scanners_see_through_it(parts, centre):
    """Behind a bracket they see the floor or the web far away, behind a cover of 10 mm the web that it lies on."""
    stations = [1500.0, -3500.0, 2500.0], [1500.0, -3500.0, -1200.0]
    settings = {"align": False, "registration_error_mm": 0.01}
    assert found(run(scene_seen([WEB, *parts], [WEB, *parts], stations), **settings)) == []
    result = run(scene_seen([WEB, *parts], [WEB, *parts[:-1]], stations), **settings)
    assert result.defects.defect_class == ("missing-part",)
    np.testing.assert_allclose(result.defects.centre[0], centre, atol=60.0)  # two to three cells


def test_the_shadow_of_a_stack_close_to_a_wall_is_not_missing():
    """Its top hides a strip of the wall 100 mm behind it from a station above: rays that end on the stack show it."""
    wall, stack = box((0.0, 0.0, 0.0), (2000.0, 14.0, 2000.0)), box((200.0, -700.0, 0.0), (1800.0, -100.0, 1600.0))
    high = [[1000.0, -2500.0, 5000.0]]
    settings = {"align": False, "registration_error_mm": 0.01}
    assert found(run(scene_seen([wall], [wall, stack], high), **settings)) == []
    hole = [box((0.0, 0.0, z), (2000.0, 14.0, z + height)) for z, height in ((0.0, 1200.0), (1600.0, 400.0))]
    assert found(run(scene_seen([wall], hole, high), **settings)) == [("missing-part", "component-1")]
