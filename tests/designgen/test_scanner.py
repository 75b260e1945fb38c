"""Scans by rays: hits against closed forms and another caster, noise against its law, what must not depend on what."""

import dataclasses

import numpy as np
import open3d
import pytest
import scipy.stats
import trimesh
from scipy.optimize import brentq

from designgen.designs import boxes_and_tubes, space_frame
from designgen.designs.parametric_face import Patch
from designgen.scanning import clutter, ray_kernels, raycast, scanner, space_frame_surfaces, survey
from designgen.scanning import returns as scanning_returns
from designgen.scanning.surfaces import Builder
from processor.model import InputError, UsageError, instruments

QUIET = scanner.Scanner(**{**scanner.preset("plain-2mm"), "noise_mm": 0.0})
ORIGIN = np.eye(4)
EXACT_MM = 1e-6  # of closed forms in float64, whose digits end at 1e-12 of 10 m
STORED_MM = 1e-4  # of points in a scan, and of nets that are refined to 1e-5 mm


def frame_of_balls():
    frame = space_frame.build(space_frame.Params(nodes_x=3, nodes_y=3, layers=2, radii_mm=(45.0, 60.0)))
    rng = np.random.default_rng(5)
    members = len(frame.members)
    bows = np.zeros((members, 3))
    for m in range(members):
        a, b = frame.ends(m)
        bows[m] = np.cross(b - a, rng.normal(size=3)) / np.linalg.norm(b - a)
    return dataclasses.replace(frame, bows=bows)


def surfaces_of(frame, things=0):
    builder = Builder()
    space_frame_surfaces.add_frame(builder, frame)
    low, high = frame.centres.min(axis=0), frame.centres.max(axis=0)
    clutter.add_below_roof(builder, low, high, things, np.random.default_rng(0))
    return builder.to_surfaces()


def standing(*position):
    return survey.levelled_pose(np.array(position, np.float64), 0.4)


def named(surfaces, returns, name):
    return returns.surface == surfaces.surface_names.index(name)


def scan(shapes, T=ORIGIN, device=QUIET, seed=0, params=None, **settings):
    """What a station sees of the shapes of a builder, with the places of its hits."""
    surfaces = shapes.to_surfaces() if isinstance(shapes, Builder) else shapes
    params = params or scanner.Params(**settings)
    return scanning_returns.scan_station(surfaces, T, device, params, seed, "S1", keep_hits=True).returns


def sheet(builder, part, name, y):
    """A square plate of 4 m across the y axis."""
    corners = np.array([[-2000.0, y, -2000.0], [2000.0, y, -2000.0], [2000.0, y, 2000.0], [-2000.0, y, 2000.0]])
    builder.polygon(part, name, corners)


def in_scene(T, points):
    return points @ T[:3, :3].T + T[:3, 3]


@pytest.fixture(scope="module")
def seen():
    """The frame as one station sees it with encoders that turn the rays, and no other noise."""
    frame = frame_of_balls()
    device = dataclasses.replace(QUIET, encoder_urad=20.0)
    T = standing(2500.0, 2800.0, 1600.0)
    surfaces = surfaces_of(frame)
    return (
        frame,
        surfaces,
        T,
        scan(surfaces, T, device, 3, step_mrad=3.0),
    )


def test_hits_lie_on_spheres_tubes_and_sleeves(seen):
    frame, surfaces, T, returns = seen
    hits = in_scene(T, returns.hits)
    ball = named(surfaces, returns, "ball")
    off = np.linalg.norm(hits[ball] - frame.centres[returns.part[ball]], axis=1) - frame.radii[returns.part[ball]]
    assert ball.sum() > 700
    assert np.abs(off).max() < EXACT_MM
    # A bowed tube: the distance from its axis, moved by the bow of where it is along the tube, found member by member.
    tube = hits[named(surfaces, returns, "tube")]
    nearest = np.full(len(tube), np.inf)
    for m in range(len(frame.members)):
        a, b = frame.ends(m)
        unit = (b - a) / np.linalg.norm(b - a)
        starts = [frame.ball(int(n)).flat_distance + 35.0 + 50.0 for n in frame.members[m]]
        length = np.linalg.norm(b - a) - sum(starts)
        z = (tube - a) @ unit - starts[0]
        axis = a + np.outer(z + starts[0], unit) + np.outer(4.0 * z * (length - z) / length**2, frame.bow(m))
        off = np.abs(np.linalg.norm(tube - axis, axis=1) - 30.0)
        nearest = np.minimum(nearest, np.where((z > -1e-6) & (z < length + 1e-6), off, np.inf))
    assert len(tube) > 25_000
    assert nearest.max() < EXACT_MM
    assert {"sleeve", "cone"} <= {surfaces.surface_names[k] for k in np.unique(returns.surface)}


def test_the_process_hole_is_a_bore_of_20_mm_that_ends_35_mm_below_the_surface_of_the_ball():
    """Seen from straight below: its wall begins where the ball ends, and there is no ball within it."""
    frame = frame_of_balls()
    node = int(np.argmax(frame.radii))
    centre, R = frame.centres[node], frame.radii[node]
    T = standing(*(centre - [0.0, 0.0, R + 60.0]))
    surfaces = surfaces_of(frame)
    returns = scan(surfaces, T, dataclasses.replace(QUIET, min_range_mm=0.0), step_mrad=16.0)
    of_node = returns.part == node
    wall, floor, ball = (
        (in_scene(T, returns.hits) - centre)[of_node & named(surfaces, returns, name)]
        for name in ("process hole", "process hole floor", "ball")
    )
    assert min(len(wall), len(floor), len(ball)) > 50
    off = [np.hypot(*points[:, :2].T) for points in (wall, floor, ball)]
    np.testing.assert_allclose(off[0], 10.0, atol=EXACT_MM)
    np.testing.assert_allclose(floor[:, 2], 35.0 - R, atol=EXACT_MM)
    assert wall[:, 2].min() > -np.sqrt(R**2 - 10.0**2) - EXACT_MM
    assert off[1].max() < 10.0 < off[2][ball[:, 2] < 0.0].min()


def test_points_lie_at_the_angles_of_the_encoders_with_their_errors(seen):
    _, _, _, returns = seen
    np.testing.assert_allclose(
        np.linalg.norm(returns.points, axis=1), np.linalg.norm(returns.hits, axis=1), atol=STORED_MM
    )

    def angles(x):
        return np.stack([np.arctan2(x[:, 1], x[:, 0]), np.arctan2(x[:, 2], np.hypot(x[:, 0], x[:, 1]))], axis=1)

    off = angles(returns.points) - angles(returns.hits)
    off[:, 0] = (off[:, 0] + np.pi) % (2.0 * np.pi) - np.pi
    # Both encoders are 20 urad off, whatever the elevation; sideways that is less, the higher a ray looks.
    elevation = np.degrees(angles(returns.hits)[:, 1])
    for low, high in ((45.0, 60.0), (60.0, 70.0), (70.0, 80.0)):
        own = off[(elevation > low) & (elevation < high)]
        assert len(own) > 9_000
        np.testing.assert_allclose(own.std(axis=0), 20e-6, rtol=4.0 / np.sqrt(2.0 * len(own)))


def test_hits_and_ranges_agree_with_open3d():
    """Open3D on fine meshes of the same shapes: the same ones in front, the same ranges to the facets' error."""
    builder, meshes = Builder(), []
    rng = np.random.default_rng(8)
    for i in range(12):
        centre = rng.uniform(-2500.0, 2500.0, 3) + np.array([0.0, 6000.0, 0.0])
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        builder.sphere(i, "ball", centre, 150.0, [])
        meshes.append(trimesh.creation.icosphere(5, 150.0).apply_translation(centre))
        start = centre + 400.0 * axis
        builder.cone(i, "tube", start, axis, (40.0, 40.0), 1500.0)
        matrix = trimesh.geometry.align_vectors([0, 0, 1], axis)
        matrix[:3, 3] = start + 750.0 * axis
        meshes.append(_mantle(40.0, 1500.0, matrix))
        corners = centre + np.array([[-600.0, 300.0, -200.0], [600.0, 300.0, -200.0], [600.0, 350.0, 300.0]])
        builder.polygon(i, "plate", corners)
        meshes.append(trimesh.Trimesh(corners, [[0, 1, 2]]))
    surfaces = builder.to_surfaces()
    T = standing(0.0, 0.0, 0.0)
    found = scan(surfaces, T, step_mrad=2.5)
    scene = open3d.t.geometry.RaycastingScene()
    owner = []
    for number, mesh in enumerate(meshes):
        scene.add_triangles(
            open3d.core.Tensor(np.asarray(mesh.vertices, np.float32)),
            open3d.core.Tensor(np.asarray(mesh.faces, np.uint32)),
        )
        owner.append(number // 3)
    grid = raycast.Grid(2.5e-3, np.radians(-60.0), int(np.radians(150.0) / 2.5e-3), round(2.0 * np.pi / 2.5e-3))
    # All shapes are in front: rays backward meet nothing.
    assert min(mesh.bounds[0][1] for mesh in meshes) > 0.0
    row, column = (x.ravel() for x in np.meshgrid(np.arange(grid.rows), np.arange(grid.columns), indexing="ij"))
    forward = grid.directions(np.zeros(grid.columns), np.arange(grid.columns)) @ T[:3, :3].T
    row, column = (x[forward[column, 1] >= 0.0] for x in (row, column))
    rays = grid.directions(row, column) @ T[:3, :3].T
    answer = scene.cast_rays(open3d.core.Tensor(np.hstack([np.zeros_like(rays), rays]).astype(np.float32)))
    t, number = answer["t_hit"].numpy(), answer["geometry_ids"].numpy().astype(np.int64)
    met = np.isfinite(t)
    theirs = row[met] * grid.columns + column[met]
    ours = found.row.astype(np.int64) * grid.columns + found.column
    assert len(theirs) > 13_000
    both, i, j = np.intersect1d(ours, theirs, assume_unique=True, return_indices=True)
    # Facets lie inside of the shapes: rays past a silhouette may see one of the two only.
    assert len(both) > 0.995 * max(len(ours), len(theirs))
    same = found.part[i] == np.array(owner)[number[met][j]]
    apart = np.abs(np.linalg.norm(found.points[i], axis=1) - t[met][j])
    assert same.mean() > 0.999
    # A facet of an icosphere of 5 divisions lies 150 (1 - cos 1.1 deg) = 0.03 mm deep at most, more along grazing rays.
    assert np.median(apart[same]) < 0.02  # two thirds of a facet's depth
    assert np.quantile(apart[same], 0.99) < 1.0  # grazing rays: 0.03 mm over a cosine of 0.03


def _mantle(radius, length, matrix):
    """A cylinder without its ends."""
    turn = np.linspace(0.0, 2.0 * np.pi, 361)[:-1]
    ring = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=1)
    low, high = (np.column_stack([ring, np.full(360, z)]) for z in (-0.5 * length, 0.5 * length))
    i, j = np.arange(360), np.roll(np.arange(360), -1)
    faces = np.vstack([np.stack([i, j, i + 360], axis=1), np.stack([j, j + 360, i + 360], axis=1)])
    return trimesh.Trimesh(np.vstack([low, high]), faces, process=False).apply_transform(matrix)


def law(device, R, signal, cosine):
    """The variance of a range as the documentation has it, written down once more."""
    w = 0.5 * np.hypot(device.beam_waist_mm, device.divergence_mrad * 1e-3 * (R - device.beam_focus_mm))
    tangent = np.minimum(np.sqrt(1.0 - cosine**2) / cosine, 20.0)
    return (
        device.noise_mm**2
        + (device.noise_ppm * 1e-6 * R) ** 2
        + (device.noise_signal_mm * signal**device.signal_power) ** 2
        + (device.footprint_share * w * tangent) ** 2
    )


def signal(params, R, cosine):
    """The strength of a return as the documentation has it, written down once more."""
    return (
        params.reflectance
        * ((1.0 - params.specular) * cosine + 4.0 * params.specular * cosine**30)
        * (10_000.0 / R) ** 2
    )


def check_noise(device, params, R, error, cosine, classes=5):
    """Compare ranges' errors with the law, class by class of incidence."""
    pull = error / np.sqrt(law(device, R, signal(params, R, cosine), cosine))
    which = np.digitize(np.degrees(np.arccos(cosine)), [20.0, 40.0, 60.0, 75.0][: classes - 1])
    for k in range(classes):
        own = pull[which == k]
        assert len(own) > 500
        allowed = 4.0 / np.sqrt(len(own))  # of chance itself, beside the law's tables
        assert abs(own.mean()) < 0.02 + allowed
        assert own.std() == pytest.approx(1.0, abs=0.03 + allowed)


def without_systematics(name):
    return dataclasses.replace(scanner.Scanner(**scanner.preset(name)), offset_mm=0.0, scale_ppm=0.0, tilt_urad=0.0)


@pytest.mark.parametrize("name", [pytest.param("phase", marks=pytest.mark.slow), "long-range"])  # pulse: terms of both
def test_clean_ranges_have_the_specified_noise_at_every_incidence(name):
    device, params = without_systematics(name), scanner.Params(scanner=name, step_mrad=2.6)
    frame = frame_of_balls()
    surfaces, T = surfaces_of(frame, things=9), standing(2500.0, 2800.0, 1600.0)
    returns = scan(surfaces, T, device, seed=1, params=params)
    clean = returns.source == scanning_returns.SURFACE
    R = np.linalg.norm(returns.hits[clean], axis=1)
    error = np.linalg.norm(returns.points[clean], axis=1) - R  # not what the scanner says of it, but where points are
    np.testing.assert_allclose(error, returns.range_error_mm[clean], atol=1e-3)  # kept as float32
    cosine = returns.incidence_cos[clean].astype(np.float64)
    np.testing.assert_allclose(returns.intensity[clean], signal(params, R, cosine), rtol=1e-4)  # kept as float32
    check_noise(device, params, R, error, cosine)
    # On balls the incidence follows from the hits alone.
    ball = named(surfaces, returns, "ball") & clean
    radial = in_scene(T, returns.hits[ball]) - frame.centres[returns.part[ball]]
    rays = (returns.hits[ball] / np.linalg.norm(returns.hits[ball], axis=1)[:, None]) @ T[:3, :3].T
    facing = -np.einsum("ni,ni->n", rays, radial) / frame.radii[returns.part[ball]]
    np.testing.assert_allclose(returns.incidence_cos[ball], facing, atol=EXACT_MM)


TUBE = (np.array([3000.0, -2500.0, 1500.0]), np.array([3400.0, 2500.0, 2200.0]), 150.0)


def tube_of_patches(start, end, radius):
    builder = Builder()
    for patch in boxes_and_tubes.Tube(start, end, radius).patches():
        builder.patch(0, patch)
    return builder


def off_axis(start, end, points):
    """Vectors (n, 3) from a line to points."""
    unit = (end - start) / np.linalg.norm(end - start)
    return points - start - np.outer((points - start) @ unit, unit)


def test_noise_on_a_net_follows_the_surface_and_not_its_facets():
    device, params = without_systematics("phase"), scanner.Params(step_mrad=1.6)
    start, end, radius = TUBE
    T = standing(0.0, 0.0, 1600.0)
    returns = scan(tube_of_patches(*TUBE), T, device, seed=1, params=params)
    clean = returns.source == scanning_returns.SURFACE
    hits = returns.hits[clean]
    R = np.linalg.norm(hits, axis=1)
    radial = off_axis(start, end, in_scene(T, hits))
    np.testing.assert_allclose(np.linalg.norm(radial, axis=1), radius, atol=STORED_MM)
    cosine = -np.einsum("ni,ni->n", (hits / R[:, None]) @ T[:3, :3].T, radial) / radius
    np.testing.assert_allclose(returns.incidence_cos[clean], cosine, atol=STORED_MM)
    check_noise(device, params, R, np.linalg.norm(returns.points[clean], axis=1) - R, cosine)


def test_mixed_pixels_on_a_net_lie_where_they_do_on_the_exact_tube():
    """A sheet before the tube's middle: the footprint's halves on the tube are as far as on a cone without facets."""
    start, end, radius = TUBE
    exact, net = Builder(), tube_of_patches(*TUBE)
    length = np.linalg.norm(end - start)
    exact.cone(0, "tube", start, (end - start) / length, (radius, radius), float(length))
    found = []
    device = dataclasses.replace(QUIET, divergence_mrad=1.5)
    for builder in (exact, net):
        corners = np.array([[2500.0, 300.0, 0.0], [2500.0, 300.0, 1790.0], [2500.0, -600.0, 1600.0]])
        builder.polygon(1, "sheet", corners)
        found.append(scan(builder, device=device, step_mrad=0.8, specular=0.0, field_of_view_deg=80.0))
    mixed = [scanning_returns.rows_of(one, one.source == scanning_returns.MIXED) for one in found]
    cells = [one.row.astype(np.int64) * 100_000 + one.column for one in mixed]
    _, i, j = np.intersect1d(*cells, assume_unique=True, return_indices=True)
    R, ours = np.linalg.norm(mixed[0].points[i], axis=1), np.linalg.norm(mixed[1].points[j], axis=1)
    apart, rays = ours - R, mixed[0].points[i] / R[:, None]
    # Not at the tube's silhouette, where rays meet the exact tube and pass by its net.
    across = np.cross(start, end) / np.linalg.norm(np.cross(start, end))
    on_both = (np.abs(rays @ across) < 0.7 * radius / 3500.0) & (np.abs(rays[:, 1]) < 0.3)
    assert on_both.sum() > 150
    assert R[on_both].max() > R[on_both].min() + 100.0
    assert np.abs(apart[on_both]).max() < 5e-4  # by energies, which differ by what the normals do; the net is 0.32 off


@pytest.mark.slow
def test_rays_meet_cones_where_bisection_does():
    """From anywhere, also from inside and along the axis, where a cone is steeper than the ray."""
    rng = np.random.default_rng(2)
    met = 0
    for trial in range(1200):
        start, axis = rng.uniform(-500.0, 500.0, 3), rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        radii, length = rng.uniform(50.0, 800.0, 2), rng.uniform(100.0, 900.0)
        ray = rng.normal(size=3) if trial % 3 else start + 0.5 * length * axis + 30.0 * rng.normal(size=3)
        if trial % 3 == 1:
            ray = axis + rng.normal(size=3) * rng.choice([0.0, 1e-9, 1e-3, 0.1])
        ray /= np.linalg.norm(ray)
        builder = Builder()
        builder.cone(0, "c", start, axis, (float(radii[0]), float(radii[1])), float(length))
        shapes = builder.to_surfaces()
        found = ray_kernels.hit(1, shapes.numbers[0], shapes.cuts, 0, 0, *ray)

        def off(t, start=start, axis=axis, radii=radii, length=length, ray=ray):
            along = (np.multiply.outer(t, ray) - start) @ axis
            away = np.linalg.norm(np.multiply.outer(t, ray) - start - np.multiply.outer(along, axis), axis=-1)
            return np.where(
                (along >= 0.0) & (along <= length), away - radii[0] - (radii[1] - radii[0]) * along / length, np.nan
            )

        t = np.linspace(1e-6, 3500.0, 40_001)
        value = off(t)
        crossing = np.flatnonzero(value[:-1] * value[1:] < 0.0)
        if not len(crossing):
            assert not np.isfinite(found) or abs(off(np.array([found]))[0]) < 1e-6  # it may be grazed between two steps
            continue
        met += 1
        expected = brentq(off, t[crossing[0]], t[crossing[0] + 1], xtol=1e-9)
        assert found == pytest.approx(expected, abs=EXACT_MM) or found < expected - 0.01  # two roots within one step
        if found < expected - 0.01:
            assert abs(off(np.array([found]))[0]) < EXACT_MM
    assert met > 300


@pytest.mark.parametrize(("off", "met"), [(29.8, True), (-29.8, True), (30.2, False), (-30.2, False)])
def test_a_ray_past_the_silhouette_of_a_bowed_tube_misses_it(off, met):
    """A tube of 30 mm whose middle is bowed by 100 mm towards x; the ray passes the middle's axis ``off`` mm aside."""
    builder = Builder()
    start, bow = np.array([off - 100.0, 1000.0, -500.0]), (np.array([100.0, 0.0, 0.0]), 0.0, 1000.0)
    builder.cone(0, "t", start, np.array([0.0, 0.0, 1.0]), (30.0, 30.0), 1000.0, bow)
    shapes = builder.to_surfaces()
    found = ray_kernels.hit(1, shapes.numbers[0], shapes.cuts, 0, 0, 0.0, 1.0, 0.0)
    assert found == (pytest.approx(1000.0 - np.sqrt(30.0**2 - off**2), abs=EXACT_MM) if met else np.inf)


@pytest.mark.parametrize("bow", [0.0, 40.0])
def test_pieces_of_a_bar_cover_its_surface(bow):
    """Rims of pieces lie on their spheres: a bar of 1 m and radii up to 100 mm has three pieces."""
    bowed = (np.array([bow, 0.0, 0.0]), 0.0, 1000.0)
    builder = Builder()
    builder.cone(0, "bar", np.zeros(3), np.array([0.0, 0.0, 1.0]), (100.0, 100.0), 1000.0, bowed)
    shapes = builder.to_surfaces()
    z, turn = (grid.ravel() for grid in np.meshgrid(np.linspace(0.0, 1000.0, 301), np.linspace(-np.pi, np.pi, 37)))
    sag = 4.0 * bow * z / 1000.0 * (1.0 - z / 1000.0)
    points = np.stack([100.0 * np.cos(turn) + sag, 100.0 * np.sin(turn), z], axis=1)
    off = np.linalg.norm(points[:, None] - shapes.piece_centre, axis=2) - shapes.piece_radius
    assert shapes.piece_centre.shape == (3, 3)
    assert off.min(axis=1).max() < EXACT_MM
    if not bow:
        assert off.min(axis=1).max() > -EXACT_MM  # and are no larger than that


def test_normals_of_shapes_are_those_of_closed_forms():
    """A ball; a cone from 80 to 50 mm over 400 mm, whose normal leans by 30 : 400; a ring; a triangle."""
    rng, axis = np.random.default_rng(3), np.array([2.0, -1.0, 2.0]) / 3.0
    centre, side = np.array([10.0, 20.0, 300.0]), np.cross(axis, [0.0, 0.0, 1.0]) / np.linalg.norm(axis[:2])
    builder = Builder()
    builder.sphere(0, "ball", centre, 60.0, [])
    builder.cone(0, "cone", centre, axis, (80.0, 50.0), 400.0)
    builder.disc(0, "ring", centre, axis, 90.0, 30.0)
    builder.polygon(0, "plate", np.array([centre, centre + 100.0 * axis, centre + 70.0 * side]))
    shapes, unit = builder.to_surfaces(), rng.normal(size=(50, 3))
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    of_ball = ray_kernels.normals(shapes.kind, shapes.numbers, np.zeros(50, np.int32), centre + 60.0 * unit)
    np.testing.assert_allclose(of_ball, unit, atol=1e-12)  # float64
    points = centre + 100.0 * axis + 72.5 * side
    found = ray_kernels.normals(shapes.kind, shapes.numbers, np.array([1, 2, 3], np.int32), np.array([points] * 3))
    expected = [(400.0 * side + 30.0 * axis) / np.hypot(400.0, 30.0), axis, np.cross(axis, side)]
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", found, expected)), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)


def test_large_and_slim_triangles_are_met_wherever_they_are():
    """Around the scanner, over its head, seen edge on: each ray against each plane's equation, without boxes."""
    rng = np.random.default_rng(6)
    builder, triangles = Builder(), []
    for i in range(60):
        middle = rng.uniform(-6000.0, 6000.0, 3)
        corners = middle + rng.normal(size=(3, 3)) * rng.choice([300.0, 2000.0, 8000.0])
        if i % 3 == 0:  # slim
            corners[2] = corners[1] + rng.uniform(-80.0, 80.0, 3)
        if i % 10 == 1:  # in one plane with the scanner
            corners[2] = 0.7 * corners[0] + 0.6 * corners[1]
        triangles.append(corners)
        builder.polygon(i, "face", corners)
    device = dataclasses.replace(QUIET, min_range_mm=0.0, max_range_mm=1e6, divergence_mrad=0.0)
    returns = scan(builder, device=device, step_mrad=16.0, sub_rays=1)
    grid = raycast.Grid(0.016, np.radians(-60.0), int(np.radians(150.0) / 0.016), round(2.0 * np.pi / 0.016))
    row, column = (x.ravel() for x in np.meshgrid(np.arange(grid.rows), np.arange(grid.columns), indexing="ij"))
    rays, nearest = grid.directions(row, column), np.full(len(row), np.inf)
    for corners in triangles:
        # The ray t d is in the cone of the corners where d is a sum of them with shares above 0: t = 1 / their sum.
        if abs(np.linalg.det(corners)) < 1e-9 * np.prod(np.linalg.norm(corners, axis=1)):
            continue
        shares = rays @ np.linalg.inv(corners)
        met = (shares >= 0.0).all(axis=1)
        nearest[met] = np.minimum(nearest[met], 1.0 / shares[met].sum(axis=1))
    found = np.full(len(row), np.inf)
    found[returns.row * grid.columns + returns.column] = np.linalg.norm(returns.points, axis=1)
    assert np.isfinite(nearest).sum() > 25_000
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(nearest))
    np.testing.assert_allclose(found, nearest, rtol=1e-9)  # float64, planes through the scanner left out


def test_only_flat_faces_are_intersected_by_their_nets():
    """A dent, a wave that is 0 at every knot, a tube: none of them is taken for its net; a face of a box is."""

    def flat(p, q):
        return np.stack([2000.0 * p, 500.0 + 300.0 * p, 1000.0 * q + 100.0 * p * q], axis=1)

    def dented(p, q):
        return flat(p, q) + np.outer(30.0 * np.exp(-((p - 0.3) ** 2 + (q - 0.4) ** 2) / 0.01**2), [0.0, 1.0, 0.0])

    def wavy(p, q):
        return flat(p, q) + np.outer(1e-4 * np.sin(np.pi * 8.0 * p), [0.0, 1.0, 0.0])

    two, many = np.linspace(0.0, 1.0, 2), np.linspace(0.0, 1.0, 9)
    builder = Builder()
    cases = [(flat, two), (flat, many), (dented, two), (wavy, many), (flat, two)]
    for i, (at, knots) in enumerate(cases):
        builder.patch(i, Patch("face", at, knots, two))
    for patch in boxes_and_tubes.Tube(*TUBE).patches():
        builder.patch(len(cases), patch)
    surfaces = builder.to_surfaces()
    on_net = [set(surfaces.patch[surfaces.part == i]) == {-1} for i in range(len(cases) + 1)]
    assert on_net == [True, True, False, False, True, False]


def test_grazing_rays_stay_near_their_net():
    """A face whose function is undefined far outside of 0 to 1, seen along its bends: no ray evaluates it there."""
    asked = [0.0]

    def at(p, q):
        asked[0] = max(asked[0], np.abs(p).max(), np.abs(q).max())
        return np.stack(
            [3000.0 * (p - 0.5), 2000.0 + 3000.0 * q, 3.0 * np.sin(9.0 * p) + 3.0 * np.cos(9.0 * q)], axis=1
        )

    builder = Builder()
    knots = np.linspace(0.0, 1.0, 12)
    builder.patch(0, Patch("wavy", at, knots, knots))
    T = standing(0.0, 0.0, 6.0)
    returns = scan(builder, T, step_mrad=0.8)
    assert asked[0] < 1.0 + 4.0 / 11.0 + 1e-3
    x, y, z = in_scene(T, returns.hits).T
    p, q = x / 3000.0 + 0.5, (y - 2000.0) / 3000.0
    np.testing.assert_allclose(z, 3.0 * np.sin(9.0 * p) + 3.0 * np.cos(9.0 * q), atol=1e-5)  # as refined
    assert len(x) > 3_000


def test_object_nearer_than_the_minimum_range_shadows_what_lies_behind():
    builder = Builder()
    sheet(builder, 0, "plate", 3000.0)
    builder.sphere(1, "head", np.array([0.0, 200.0, 0.0]), 50.0, [])
    device = dataclasses.replace(QUIET, divergence_mrad=1.0, min_range_mm=300.0)
    points = scan(builder, device=device, step_mrad=1.5).points
    away = np.degrees(np.arccos(points[:, 1] / np.linalg.norm(points, axis=1)))
    assert away.min() > np.degrees(np.arcsin(50.0 / 200.0)) - 0.1  # a step is 0.09
    assert away.min() < np.degrees(np.arcsin(50.0 / 200.0)) + 0.1


def test_sub_rays_share_the_energy_of_a_gaussian_beam():
    for count in (1, 7, 19):
        offsets, share = scanning_returns.beam(count)
        assert len(offsets) == count
        assert share.sum() == pytest.approx(1.0)
        np.testing.assert_allclose(share @ offsets, 0.0, atol=1e-12)  # float64
        # Moments of exp(-2 r^2): r^2 has an exponential distribution of mean 1/2, so r^4 has the mean 1/2, r^6 3/4
        square = (offsets**2).sum(axis=1)
        for power, moment in [(1, 0.5), (2, 0.5), (3, 0.75)][: (count > 1) + (count > 1) + (count > 7)]:
            assert share @ square**power == pytest.approx(moment)


# Standard deviation of edges in the energy of a Z+F 5016, mm, by range, m: horizontally and vertically (Chaudhry et al.
# 2021, table 2), mean of two edges each.
EDGES = [
    (6.02, 0.96, 1.008),
    (21.44, 3.504, 3.834),
    (25.02, 4.088, 4.542),
    (40.02, 6.764, 7.594),
    (51.83, 8.631, 9.972),
]


@pytest.mark.parametrize(("range_m", "across", "upward"), EDGES)
def test_the_beam_of_class_phase_is_as_wide_as_was_measured(range_m, across, upward):
    device = scanner.Scanner(**scanner.preset("phase"))
    offsets, share = scanning_returns.beam(7, device.beam_aspect)
    radius = 1e3 * range_m * float(device.beam_angle(np.array([1e3 * range_m]))[0])
    found = radius * np.sqrt(share @ offsets**2)
    np.testing.assert_allclose(found, [across, upward], rtol=0.1)  # required


# Noise on white and black targets, mm, by range, m, and reflectance of black relative to white: median of three
# repeats of a field test (github.com/20korvin01/TLS_Ue1), robust about each target's plane.
@pytest.mark.parametrize(
    ("range_m", "ratio", "white", "black"),
    [(3.57, 20.5, 0.75, 2.73), (10.76, 16.9, 0.80, 2.82), (19.55, 18.5, 1.14, 4.32), (21.36, 17.2, 1.62, 6.68)],
)
def test_the_noise_of_class_pulse_is_as_was_measured(range_m, ratio, white, black):
    device, R = scanner.Scanner(**scanner.preset("pulse")), np.array([1e3 * range_m])
    signals = (10.0 / range_m) ** 2 * np.array([1.0, 1.0 / ratio])  # white is 1 at 10 m
    found = [float(device.noise(R, one, np.zeros(1), np.zeros(1))[0]) for one in signals]
    np.testing.assert_allclose(found, [white, black], rtol=0.3)  # required
    assert 0.2 < float(device.bias(np.array(0.5)) - device.bias(np.array(0.5 / ratio))) < 0.7  # black is nearer


def test_strongest_echo_by_hand():
    ranges = np.array([[1000.0, 1010.0, 2000.0, np.inf], [3000.0, 1000.0, 3005.0, np.inf]])
    energy = np.array([[0.2, 0.2, 0.3, 0.0], [0.2, 0.3, 0.2, 0.0]])
    found = scanning_returns.strongest_echo(ranges, energy, 100.0)
    np.testing.assert_array_equal(found, [[0.2, 0.2, 0.0, 0.0], [0.2, 0.0, 0.2, 0.0]])


def test_hidden_and_out_of_range_objects_return_no_points():
    builder = Builder()
    sheet(builder, 0, "near", 3000.0)
    builder.sphere(1, "hidden", np.array([0.0, 5000.0, 0.0]), 500.0, [])
    builder.sphere(2, "too far", np.array([0.0, -90_000.0, 0.0]), 500.0, [])
    builder.sphere(3, "too near", np.array([0.0, -200.0, 0.0]), 50.0, [])
    device = dataclasses.replace(QUIET, max_range_mm=80_000.0)
    returns = scan(builder, device=device, step_mrad=4.0)
    assert set(returns.part) == {0}


def test_weak_signals_are_lost_and_some_returns_stray():
    surfaces = surfaces_of(frame_of_balls())
    T = standing(2500.0, 2800.0, 1600.0)
    params = scanner.Params(step_mrad=4.0)
    every = scan(surfaces, T, seed=1, params=params)
    dim = scan(surfaces, T, dataclasses.replace(QUIET, threshold=0.5), seed=1, params=params)
    # Speckle of eight looks multiplies the signal: the share that stays is a gamma law's.
    stays = scipy.stats.gamma.sf(0.5 / every.intensity, 8.0, scale=1.0 / 8.0)
    assert len(dim.points) == pytest.approx(stays.sum(), abs=5.0 * np.sqrt((stays * (1.0 - stays)).sum()))
    assert np.median(dim.incidence_cos) > np.median(every.incidence_cos) + 0.05  # steel shines away from the scanner
    stray = scan(surfaces, T, dataclasses.replace(QUIET, flying_share=0.02), seed=1, params=params)
    outliers = stray.source == scanning_returns.OUTLIER
    assert outliers.mean() == pytest.approx(0.02, abs=0.003)  # of 50,000: sd 0.0006
    assert (stray.part[outliers] == -1).all()
    assert (stray.surface[outliers] == -1).all()
    R = np.linalg.norm(stray.points[outliers], axis=1)
    assert R.min() >= QUIET.min_range_mm
    assert (stray.range_error_mm[outliers] <= 0.0).mean() > 0.99


def test_range_and_tilt_errors_of_a_station_equal_those_of_its_truth():
    surfaces = surfaces_of(frame_of_balls())
    T = standing(2500.0, 2800.0, 1600.0)
    device = dataclasses.replace(QUIET, offset_mm=2.0, scale_ppm=50.0, tilt_urad=100.0)
    params = scanner.Params(step_mrad=4.0, sub_rays=1)
    found = scanning_returns.scan_station(surfaces, T, device, params, 7, "S1", keep_hits=True)
    hits, points = found.returns.hits, found.returns.points
    R = np.linalg.norm(hits, axis=1)
    scale, offset = np.polyfit(R, np.linalg.norm(points, axis=1) - R, 1)
    assert (offset, 1e6 * scale) == pytest.approx(found.systematic[:2], abs=0.02)  # points are rounded to 1e-4 mm
    # A small turn w moves p by w x p.
    turn = np.linalg.lstsq(
        np.concatenate([np.cross(np.eye(3)[k], hits / R[:, None]).reshape(-1, 1) for k in range(3)], axis=1),
        (points / np.linalg.norm(points, axis=1)[:, None] - hits / R[:, None]).ravel(),
        rcond=None,
    )[0]
    np.testing.assert_allclose(turn, [*found.systematic[2:], 0.0], atol=1e-8)  # rad: the second order of 100 urad
    assert abs(found.systematic[0]) > 0.0


def test_merged_scans_lie_where_the_stations_saw_them():
    surfaces = surfaces_of(frame_of_balls())
    poses = {"S1": standing(2500.0, 2800.0, 1600.0), "S2": standing(100.0, 400.0, 1500.0)}
    found = survey.survey(surfaces, (), poses, QUIET, scanner.Params(step_mrad=6.0, sub_rays=1), 5)
    origin = np.array([5.0e8, 4.3e9, 1.0e5])
    one, each = (scanner.Params(origin_mm=tuple(origin), merged=merged) for merged in (True, False))
    (scan,), (labels,), stations, truth = survey.in_project(found, one, registered=True)
    assert stations.ids == truth.ids == ("S1", "S2")
    np.testing.assert_allclose(stations.positions - origin, [T[:3, 3] for T in poses.values()], atol=EXACT_MM)
    scans, _, _, _ = survey.in_project(found, each, registered=True)
    at = 0
    for k, single in enumerate(scans):
        own = scan.point_station == k
        assert own.sum() == len(single.points)
        np.testing.assert_allclose(scan.points[own], in_scene(poses[single.name], single.points), atol=EXACT_MM)
        np.testing.assert_allclose(single.T_project_scan[:3, 3] - origin, poses[single.name][:3, 3], atol=EXACT_MM)
        at += own.sum()
    assert at == len(scan.points) == len(labels.surface)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"behaviour": "magic"}, "scanner.behaviour: expected phase or pulse"),
        ({"noise_mm": -1.0}, "scanner.noise_mm: expected 0 or more"),
        ({"max_range_mm": 1.0}, "scanner.max_range_mm: expected more than min_range_mm"),
    ],
)
def test_impossible_scanners_are_refused(changed, said):
    with pytest.raises(UsageError, match=said):
        dataclasses.replace(scanner.Scanner(), **changed)


def test_presets_are_scanners_with_a_source():
    for name, numbers in instruments.classes().items():
        scanner.Scanner(**scanner.preset(name))
        assert set(numbers) - {"about", "source", "verified", *instruments.TERMS} | {"scale_ppm"} == {
            f.name for f in dataclasses.fields(scanner.Scanner)
        }
        assert len(numbers["source"]) > 5
    with pytest.raises(UsageError, match="expected one of phase, pulse"):
        scanner.preset("magic")


def test_a_scanner_toml_is_a_scanner_too(tmp_path):
    """The file that a field check writes: what it does not give is that of its class."""
    path = tmp_path / "scanner.toml"
    path.write_text(
        'scanner_class = "pulse"\nnoise_mm = 0.2\nview_mm = {value = 0.3, sd = 0.1}\n'
        "scale_ppm = {value = 3.0, sd = 4.0}\n"
    )
    changed = {"noise_mm": 0.2, "offset_mm": 0.3, "scale_ppm": 5.0}
    assert scanner.preset(str(path)) == scanner.preset("pulse") | changed
    path.write_text('scanner_class = "pulse"\nnoise_mm = -1.0\n')
    with pytest.raises(InputError, match="expected a number of 0 or more as 'noise_mm', found -1"):
        scanner.preset(str(path))
