"""Attitude of nearly symmetric structures: boxes with small plates on their sides, sampled with noise."""

import dataclasses

import numpy as np
import pytest
import trimesh

from processor.geometry import mesh_distance, rigid
from processor.registration import pose_choice, pose_search, principal, surface_registration

GIRDER = (6000.0, 800.0, 1400.0)
PLATE = (400.0, 140.0, 14.0)  # a bracket, its upper side in the girder's middle


def bracket(x, y=1.0, up=0.0, away=0.0):
    return trimesh.creation.box(PLATE, rigid.transform(np.eye(3), [x, y * (470.0 + away), -7.0 + up]))


def structure(*brackets):
    return trimesh.util.concatenate([trimesh.creation.box(GIRDER), *brackets])


def sampled(mesh, count, seed, noise=1.0):
    """Points (count, 3) on a mesh with noise, and the normals of their facets."""
    points, face = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return points + np.random.default_rng(seed).normal(0.0, noise, points.shape), mesh.face_normals[face]


def surface_of(design):
    return mesh_distance.of_design(np.asarray(design.vertices), np.asarray(design.faces).astype(np.int64))


def placed(design, points, seed):
    """Pose found for a scan relative to the true one, and whether it is ambiguous."""
    rng = np.random.default_rng(100 + seed)
    T = rigid.transform(rigid.rotation_from_vector(2.0 * rng.normal(size=3)), 2e4 * rng.normal(size=3))
    found = surface_registration.place(rigid.apply(rigid.invert(T), points), surface_of(design), np.eye(4), "auto")
    return found.T @ rigid.invert(T), found.ambiguous


MORE = [pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3)]
ANGLE = 2e-4  # rad: 0.6 mm at the ends, less than the noise of one point; another attitude is off by pi


@pytest.mark.parametrize("seed", [0, *MORE])
def test_brackets_distinguish_the_attitudes_of_a_box_though_one_is_displaced_and_one_missing(seed):
    # By half a turn about the length the brackets come to lie on themselves but for their thickness.
    at = [-2400.0, -1200.0, 300.0, 1800.0]
    design = structure(*(bracket(x, y) for x in at for y in (1.0, -1.0)))
    built = structure(*(bracket(x, y) for x in at[1:] for y in (1.0, -1.0)), bracket(at[0], 1.0, up=14.0))
    off, ambiguous = placed(design, sampled(built, 8_000, seed)[0], seed)
    assert rigid.rotation_angle(off[:3, :3]) < ANGLE
    assert not ambiguous


@pytest.mark.parametrize("thickness", [6.0, pytest.param(40.0, marks=pytest.mark.slow)])
def test_scanned_side_of_a_plate_is_registered_to_the_same_side(thickness):
    box = trimesh.creation.box(
        (240.0, 170.0, 160.0), rigid.transform(np.eye(3), [-170.0, -115.0, 80.0 + thickness / 2])
    )
    design = trimesh.util.concatenate([trimesh.creation.box((760.0, 640.0, thickness)), box])
    points, normals = sampled(design, 15_000, 3, 0.6)
    off, ambiguous = placed(design, points[normals[:, 2] > -0.5], 3)  # nothing from below
    assert rigid.rotation_angle(off[:3, :3]) < 5e-4  # 0.2 mm at 400 mm
    assert np.abs(off[:3, 3]).max() < 0.2  # the shares of 15,000 points on each face: sd 0.6 / sqrt(1000) and more
    assert not ambiguous


def test_gates_of_a_structure_grow_with_its_size():
    """A scan of a hall of 34 m beside other things began 1.5 m off: 400 mm, enough for a part, did not reach it."""
    hall, part = (pose_search.prepared(surface_of(structure()), is_structure=one) for one in (True, False))
    shares, most = (0.05, 0.02), (400.0, 150.0)
    assert hall.gates(most, shares) == pytest.approx([0.05 * hall.size, 0.02 * hall.size])
    for size, expected in ((34_000.0, [400.0, 150.0]), (4_000.0, [200.0, 80.0])):
        assert dataclasses.replace(part, size=size).gates(most, shares) == pytest.approx(expected)
    assert dataclasses.replace(hall, size=34_000.0).gates(most, shares) == pytest.approx([1700.0, 680.0])


def angle():
    """An L of two plates, 1500 and 400 by 600 mm."""
    section = [(0.0, 0.0), (1500.0, 0.0), (1500.0, 20.0), (20.0, 20.0), (20.0, 400.0), (0.0, 400.0)]
    vertices = np.array([(x, y, z) for y in (0.0, 600.0) for x, z in section])
    ends = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    faces = [*ends, *((c + 6, b + 6, a + 6) for a, b, c in ends)]
    for a, b in zip(range(6), (1, 2, 3, 4, 5, 0), strict=True):
        faces += [(a, a + 6, b + 6), (a, b + 6, b)]
    return trimesh.Trimesh(vertices, faces)


@pytest.mark.parametrize("seed", [0, *MORE])
def test_two_plates_of_which_one_side_each_was_scanned_lie_on_their_own_sides(seed):
    """An angle of plates of 20 mm, seen from within: one plate after the other has to change sides."""
    design = angle()
    points, normals = sampled(design, 4_000, seed, 0.3)
    points = points[(normals @ np.diag([1.0, -1.0, 1.0]) > 0.5).any(axis=1)]
    off, _ = placed(design, points, seed)
    # The wrong side is 20 mm off; the plate's edges, of some 60 points of 0.3 mm, hold it along itself.
    assert np.linalg.norm(rigid.apply(off, points) - points, axis=1).max() < 1.0


def test_a_scan_the_wrong_way_round_in_the_design_s_frame_is_turned():
    design = structure(*(bracket(x, y) for x in (-2400.0, -1200.0, 300.0) for y in (1.0, -1.0)))
    points, half_turn = sampled(design, 8_000, 2)[0], np.diag([-1.0, -1.0, 1.0])
    turned = points @ half_turn
    right, wrong = (surface_registration.place(p, surface_of(design), np.eye(4), "auto") for p in (points, turned))
    assert right.registration is surface_registration.Registration.AS_GIVEN
    assert wrong.registration is surface_registration.Registration.COARSE
    np.testing.assert_allclose(wrong.T[:3, :3], half_turn, atol=ANGLE)


def test_attitude_without_distinguishing_features_is_ambiguous():
    # A bracket was left out: nothing shows where it belongs.
    assert placed(structure(bracket(1500.0, 1.0)), sampled(structure(), 3_000, 0)[0], 0)[1]


def test_attitude_is_ambiguous_if_contradiction_equals_evidence():
    design = structure(bracket(-1500.0, 1.0), bracket(900.0, 1.0))
    points, surface = sampled(structure(bracket(-1500.0, 1.0)), 15_000, 1, 0.0)[0], surface_of(design)
    turned = rigid.transform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    poses = [(surface, np.eye(4)), (surface, turned)]
    assert pose_choice.choose(points, poses) == [0]
    both = structure(bracket(-1500.0, 1.0), bracket(1500.0, -1.0))  # one where each of the attitudes has one
    points = sampled(both, 15_000, 1, 0.0)[0]
    assert len(pose_choice.choose(points, poses)) == 2
    assert pose_choice.choose(points[:3], poses) == [0, 1]  # too few to show anything


def strip(low, high, cells):
    """A rectangle between two corners that share one coordinate, in so many cells along its last axis."""
    low, high = np.array(low), np.array(high)
    along, last = np.flatnonzero(low != high)
    corners = np.repeat(low[None], 2 * (cells + 1), axis=0)
    corners[:, last] = np.repeat(np.linspace(low[last], high[last], cells + 1), 2)
    corners[1::2, along] = high[along]
    first = 2 * np.arange(cells)[:, None]
    return corners, np.vstack([first + np.array(facet) for facet in ((0, 1, 2), (1, 3, 2))])


def test_points_beside_a_strip_of_small_facets_are_on_their_own_face():
    """The samples nearest to it may all be of the strip, 8 mm off it, as those of the face are some 12 mm apart."""
    plate, of_plate = strip([0.0, 0.0, 0.0], [500.0, 500.0, 0.0], 1)
    end, of_end = strip([0.0, 0.0, 0.0], [0.0, 500.0, 24.0], 1600)
    surface = mesh_distance.of_mesh(np.vstack([plate, end]), np.vstack([of_plate, of_end + len(plate)]))
    rng = np.random.default_rng(1)
    points = np.column_stack([np.full(20_000, 8.0), rng.uniform(0.0, 500.0, 20_000), np.zeros(20_000)])
    assert not pose_choice.off_surface(points, surface, 7.0).any()


def test_turns_of_a_plate_with_a_box_on_it_keep_the_plate_in_its_plane():
    # The box tilts the principal axes by 3 degrees; a scan that is turned about them would lie across the plate.
    box = trimesh.creation.box((240.0, 170.0, 160.0), rigid.transform(np.eye(3), [-170.0, -115.0, 90.0]))
    design = trimesh.util.concatenate([trimesh.creation.box((760.0, 640.0, 20.0)), box])
    surface = pose_search.prepared(surface_of(design))
    assert np.abs(surface.axes[2]).max() < np.cos(np.radians(2.0))
    turns = pose_search.symmetries(surface)
    assert len(turns) == 4
    for turn in turns:
        np.testing.assert_allclose(np.abs(turn[:3, :3]), np.eye(3), atol=1e-9)  # float64


def test_axes_of_a_body_without_flat_faces_along_them_stay():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=100.0)
    axes = rigid.rotation_from_vector(np.array([0.3, -0.2, 0.1]))
    np.testing.assert_array_equal(principal.along_faces(axes, surface_of(ball)), axes)


def test_a_scan_at_its_design_stays_there_beside_another_structure_of_its_size():
    """Six in ten points are the structure's; the other one is seen better, as the largest piece of the scan."""
    design = structure(bracket(-1500.0, 1.0), bracket(700.0, -1.0))
    points = sampled(design, 25_000, 0, 0.0)[0]
    here = points[:15_000][points[:15_000, 0] > -2000.0]
    other = points[15_000:] + np.array([0.0, 9000.0, 0.0])
    found = surface_registration.place(np.vstack([here, other]), surface_of(design), np.eye(4), "auto")
    assert found.registration is surface_registration.Registration.AS_GIVEN
    assert np.abs(found.T_best_fit - np.eye(4))[:3, 3].max() < 1.0  # the points are exact; the other one is 9 m off
