"""Attitudes by principal axes and their refinement: any attitude is found, symmetric bodies are ambiguous."""

import numpy as np
import pytest
import trimesh

from processor.geometry import mesh_distance, rigid
from processor.registration import pose_search, principal, surface_registration
from tests.support.solids.meshes import bracket


def coarse(mesh, T, seed):
    points = np.asarray(trimesh.sample.sample_surface(mesh, 8_000, seed=seed)[0])
    moved = rigid.apply(rigid.invert(T), points) + np.random.default_rng(seed).normal(0.0, 2.0, points.shape)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    design = pose_search.prepared(mesh_distance.of_mesh(vertices, faces))
    return surface_registration.decide(moved, design, pose_search.rivals_of(pose_search.search(moved, design)))


def test_any_attitude_is_found_and_never_a_mirror_image():
    rng = np.random.default_rng(9)
    for seed in range(2):
        T = rigid.transform(rigid.rotation_from_vector(rng.normal(size=3) * 2.0), rng.normal(size=3) * 1e4)
        found = coarse(bracket(), T, seed)
        assert np.linalg.det(found[0].T[:3, :3]) == pytest.approx(1.0)
        assert rigid.rotation_angle(found[0].T[:3, :3] @ T[:3, :3].T) < 2e-3
        assert len(found) == 1


def test_a_symmetric_body_is_ambiguous():
    found = coarse(trimesh.creation.box((3000.0, 900.0, 400.0)), np.eye(4), 1)
    assert len(found) == 4


def test_axes_are_swapped_where_two_are_alike_alone():
    one = np.array([9.0, 4.0, 1.0])
    assert len(principal.possible_turns(one, one)) == 4
    assert len(principal.possible_turns(np.array([9.0, 4.0, 3.9]), one)) == 8
    every = principal.possible_turns(np.ones(3), np.ones(3))
    assert len(every) == 24
    assert all(np.linalg.det(turn) == pytest.approx(1.0) for turn in every)
    assert len({tuple(turn.ravel()) for turn in every}) == 24
