"""Attitude of nearly symmetric structures: boxes with small plates on their sides, sampled with noise."""

import numpy as np
import pytest
import trimesh

from processor.geometry import mesh_distance, rigid
from processor.registration import pose_choice, principal, surface_registration

GIRDER = (6000.0, 800.0, 1400.0)
PLATE = (400.0, 140.0, 14.0)  # a bracket, its upper side in the girder's middle


def bracket(x, y=1.0, up=0.0, away=0.0):
    return trimesh.creation.box(PLATE, rigid.transform(np.eye(3), [x, y * (470.0 + away), -7.0 + up]))


def structure(*brackets):
    return trimesh.util.concatenate([trimesh.creation.box(GIRDER), *brackets])


def placed(design, built, seed, count=15_000, noise=1.0):
    """Pose of a scan relative to the true one, and whether it is ambiguous."""
    rng = np.random.default_rng(seed)
    points = np.asarray(trimesh.sample.sample_surface(built, count, seed=seed)[0])
    points += rng.normal(0.0, noise, points.shape)
    T = rigid.transform(rigid.rotation_from_vector(2.0 * rng.normal(size=3)), 2e4 * rng.normal(size=3))
    surface = mesh_distance.of_design(np.asarray(design.vertices), np.asarray(design.faces).astype(np.int64))
    found = surface_registration.place(rigid.apply(rigid.invert(T), points), surface, np.eye(4), "auto")
    return found.T @ rigid.invert(T), found.ambiguous


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_a_bracket_distinguishes_the_attitudes_of_a_box(seed):
    # By half a turn about the length the brackets come to lie on themselves but for their thickness.
    design = structure(bracket(-1500.0, 1.0), bracket(-1500.0, -1.0), bracket(700.0, 1.0), bracket(700.0, -1.0))
    off, ambiguous = placed(design, design, seed)
    assert rigid.rotation_angle(off[:3, :3]) < 2e-4
    assert not ambiguous


def test_displaced_and_missing_brackets_do_not_turn_the_attitude():
    at = [-2400.0, -1200.0, 300.0, 1800.0]
    design = structure(*(bracket(x, y) for x in at for y in (1.0, -1.0)))
    built = structure(*(bracket(x, y) for x in at[1:] for y in (1.0, -1.0)), bracket(at[0], 1.0, up=14.0))
    for seed in range(3):
        off, ambiguous = placed(design, built, seed)
        assert rigid.rotation_angle(off[:3, :3]) < 2e-4
        assert not ambiguous


@pytest.mark.parametrize("thickness", [6.0, 20.0, 40.0])
def test_scanned_side_of_a_plate_is_registered_to_the_same_side(thickness):
    box = trimesh.creation.box(
        (240.0, 170.0, 160.0), rigid.transform(np.eye(3), [-170.0, -115.0, 80.0 + thickness / 2])
    )
    design = trimesh.util.concatenate([trimesh.creation.box((760.0, 640.0, thickness)), box])
    points, face = trimesh.sample.sample_surface(design, 40_000, seed=3)
    points = points[design.face_normals[face, 2] > -0.5]  # nothing from below
    points += np.random.default_rng(3).normal(0.0, 0.6, points.shape)
    T = rigid.transform(rigid.rotation_from_vector([0.0, 0.0, 2.7]), [3e4, -8e3, 1e4])
    surface = mesh_distance.of_design(np.asarray(design.vertices), np.asarray(design.faces).astype(np.int64))
    found = surface_registration.place(rigid.apply(rigid.invert(T), points), surface, np.eye(4), "auto")
    off = found.T @ rigid.invert(T)
    assert rigid.rotation_angle(off[:3, :3]) < 5e-4
    assert np.abs(off[:3, 3]).max() < 0.2
    assert not found.ambiguous


def angle():
    """An L of two plates, 1500 and 400 by 600 mm."""
    section = [(0.0, 0.0), (1500.0, 0.0), (1500.0, 20.0), (20.0, 20.0), (20.0, 400.0), (0.0, 400.0)]
    vertices = np.array([(x, y, z) for y in (0.0, 600.0) for x, z in section])
    ends = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    faces = [*ends, *((c + 6, b + 6, a + 6) for a, b, c in ends)]
    for a, b in zip(range(6), (1, 2, 3, 4, 5, 0), strict=True):
        faces += [(a, a + 6, b + 6), (a, b + 6, b)]
    return trimesh.Trimesh(vertices, faces)


@pytest.mark.parametrize("seed", range(4))
def test_two_plates_of_which_one_side_each_was_scanned_lie_on_their_own_sides(seed):
    """An angle of plates of 20 mm, seen from within: one plate after the other has to change sides."""
    design = angle()
    points, face = trimesh.sample.sample_surface(design, 12_000, seed=seed)
    seen = (design.face_normals[face] @ np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]) > 0.5).any(
        axis=1
    )
    rng = np.random.default_rng(seed)
    points = points[seen] + rng.normal(0.0, 0.3, (int(seen.sum()), 3))
    T = rigid.transform(rigid.rotation_from_vector(2.0 * rng.normal(size=3)), 2e3 * rng.normal(size=3))
    surface = mesh_distance.of_design(np.asarray(design.vertices), np.asarray(design.faces).astype(np.int64))
    found = surface_registration.place(rigid.apply(rigid.invert(T), points), surface, np.eye(4), "auto")
    off = rigid.apply(found.T @ rigid.invert(T), points) - points
    assert np.linalg.norm(off, axis=1).max() < 1.0


def test_a_scan_the_wrong_way_round_in_the_design_s_frame_is_turned():
    design = structure(*(bracket(x, y) for x in (-2400.0, -1200.0, 300.0) for y in (1.0, -1.0)))
    points = np.asarray(trimesh.sample.sample_surface(design, 15_000, seed=2)[0])
    points += np.random.default_rng(2).normal(0.0, 1.0, points.shape)
    surface = mesh_distance.of_design(np.asarray(design.vertices), np.asarray(design.faces).astype(np.int64))
    turned = rigid.apply(rigid.transform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)), points)
    right, wrong = (surface_registration.place(scan, surface, np.eye(4), "auto") for scan in (points, turned))
    assert right.registration is surface_registration.Registration.AS_GIVEN
    assert wrong.registration is surface_registration.Registration.COARSE
    np.testing.assert_allclose(wrong.T[:3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-3)


def test_attitude_without_distinguishing_features_is_ambiguous():
    design = structure(bracket(1500.0, 1.0))
    assert placed(structure(), structure(), 0)[1]
    assert placed(design, structure(), 0)[1]  # the bracket was left out: nothing shows where it belongs
    assert not placed(design, design, 0)[1]


def test_attitude_is_ambiguous_if_contradiction_equals_evidence():
    design = structure(bracket(-1500.0, 1.0), bracket(900.0, 1.0))
    points = np.asarray(trimesh.sample.sample_surface(structure(bracket(-1500.0, 1.0)), 15_000, seed=1)[0])
    surface = mesh_distance.of_design(np.asarray(design.vertices), np.asarray(design.faces).astype(np.int64))
    turned = rigid.transform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    assert pose_choice.choose(points, surface, [np.eye(4), turned]) == pose_choice.Choice(best=0, rivals=())
    both = structure(bracket(-1500.0, 1.0), bracket(1500.0, -1.0))  # one where each of the attitudes has one
    points = np.asarray(trimesh.sample.sample_surface(both, 15_000, seed=1)[0])
    assert len(pose_choice.choose(points, surface, [np.eye(4), turned]).rivals) == 1


def test_turns_of_a_plate_with_a_box_on_it_keep_the_plate_in_its_plane():
    # The box tilts the principal axes by 3 degrees; a scan that is turned about them would lie across the plate.
    box = trimesh.creation.box((240.0, 170.0, 160.0), rigid.transform(np.eye(3), [-170.0, -115.0, 90.0]))
    design = trimesh.util.concatenate([trimesh.creation.box((760.0, 640.0, 20.0)), box])
    surface = mesh_distance.of_design(np.asarray(design.vertices), np.asarray(design.faces).astype(np.int64))
    axes = principal.of_mesh(surface.vertices, surface.faces)
    assert np.abs(axes.axes[2]).max() < np.cos(np.radians(2.0))
    turns = surface_registration._turns(axes, surface)
    assert len(turns) == 4
    for turn in turns:
        np.testing.assert_allclose(np.abs(turn[:3, :3]), np.eye(3), atol=1e-9)


def test_axes_of_a_body_without_flat_faces_along_them_stay():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=100.0)
    surface = mesh_distance.of_design(np.asarray(ball.vertices), np.asarray(ball.faces).astype(np.int64))
    axes = rigid.rotation_from_vector(np.array([0.3, -0.2, 0.1]))
    np.testing.assert_array_equal(surface_registration._along_faces(axes, surface), axes)


@pytest.mark.parametrize("seed", range(3))
def test_a_scan_at_its_design_stays_there_beside_another_structure_of_its_size(seed):
    """Six in ten points are the structure's; the other one is seen better, as the largest piece of the scan."""
    design = structure(bracket(-1500.0, 1.0), bracket(700.0, -1.0))
    points = np.asarray(trimesh.sample.sample_surface(design, 25_000, seed=seed)[0])
    here = points[:15_000][points[:15_000, 0] > -2000.0]
    other = points[15_000:] + np.array([0.0, 9000.0, 0.0])
    surface = mesh_distance.of_design(np.asarray(design.vertices), np.asarray(design.faces).astype(np.int64))
    found = surface_registration.place(np.vstack([here, other]), surface, np.eye(4), "auto")
    assert found.registration is surface_registration.Registration.AS_GIVEN
    assert np.abs(found.T_best_fit - np.eye(4))[:3, 3].max() < 1.0
