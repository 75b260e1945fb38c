"""The rigid motion that the largest part of a structure agrees with, from movements at core points in closed form."""

import numpy as np
import pytest

from processor.deviation import stable_fit
from processor.deviation.local_translation import Movement
from processor.geometry import rigid
from processor.geometry.mesh_distance import Samples

SPACING, SD, POINTS = 100.0, 2.0, 40


def beams(seed=0):
    """Core points on the four sides of six beams, 12 m long, along x and y."""
    rng = np.random.default_rng(seed)
    points, normals = [], []
    for at in (0.0, 4000.0, 8000.0):
        for along, across in ((0, 1), (1, 0)):
            for axis, sign in ((across, 1), (across, -1), (2, 1), (2, -1)):
                p = np.zeros((360, 3))
                p[:, along] = rng.uniform(0.0, 12_000.0, 360)
                p[:, across] = at
                p[:, 3 - along - axis if axis != 2 else across] += rng.uniform(-150.0, 150.0, 360)
                p[:, axis] += 150.0 * sign
                points.append(p)
                normals.append(np.tile(sign * np.eye(3)[axis], (360, 1)))
    points, normals = np.concatenate(points), np.concatenate(normals)
    return Samples(points, normals, np.zeros(len(points), np.int64))


def moved(core, displacement, seed):
    k = len(core.points)
    noise = np.random.default_rng(seed).normal(0.0, SD / np.sqrt(POINTS), k)
    along = np.einsum("ni,ni->n", displacement, core.normals) + noise
    return Movement(along, np.full(k, POINTS), np.full(k, SD), np.zeros((k, 3)), np.ones(k, np.int64))


def displaced(core, turn, shift):
    T = rigid.transform(rigid.rotation_from_vector(np.array(turn)), np.array(shift))
    return rigid.apply(T, core.points) - core.points


def off(fit, core, turn, shift):
    """By how much a motion found is off at the structure's middle, mm, and turned, mrad."""
    T = rigid.transform(rigid.rotation_from_vector(np.array(turn)), np.array(shift))
    between = fit.motion @ rigid.invert(T)
    middle = core.points.mean(axis=0)
    return np.linalg.norm(rigid.apply(between, middle) - middle), 1e3 * rigid.rotation_angle(between[:3, :3])


@pytest.mark.parametrize("seed", range(4))
def test_half_of_a_structure_that_moved_does_not_take_the_other_half_along(seed):
    core = beams()
    turn, shift = [1e-4, -2e-4, 3e-4], [2.0, -3.0, 4.0]
    u = displaced(core, turn, shift)
    share = np.clip((core.points[:, 0] - 5900.0) / 6000.0, 0.0, 1.0)
    u[:, 2] -= 20.0 * 0.5 * (1.0 - np.cos(np.pi * share))
    found = stable_fit.fits(core, moved(core, u, seed), 2.0 * SPACING, SPACING, 0)
    shift_off, turn_off = off(found.stable, core, turn, shift)
    # 5,000 core points of 0.32 mm, a third of them along each axis, are 0.0076 mm an axis, and 0.002 mrad with arms
    # of 3.5 m; those that moved by less than the limit count too. Largest of 12 draws 0.032 mm and 0.007 mrad.
    assert shift_off < 0.05
    assert turn_off < 0.015
    assert off(found.best, core, turn, shift)[0] > 2.0  # dragged along: 3.4 to 3.6 mm in 12 draws
    assert 0.5 < found.stable.share < 0.75  # 7 of 12 points did not move, some by less than the limit
    assert found.limit_mm < 0.65  # 1.96 sds of a core point are 0.62


def test_covariances_agree_with_errors_of_a_stable_structure():
    core = beams()
    turn, shift = [1e-4, -2e-4, 3e-4], [2.0, -3.0, 4.0]
    u = displaced(core, turn, shift)
    z = []
    for seed in range(20):
        found = stable_fit.fits(core, moved(core, u, seed), 2.0 * SPACING, SPACING, 0)
        assert found.stable.share > 0.95  # nothing moved: 1.0 in 60 draws
        T = rigid.transform(rigid.rotation_from_vector(np.array(turn)), np.array(shift))
        between = found.stable.motion @ rigid.invert(T)
        error = np.concatenate([rigid.vector_from_rotation(between[:3, :3]), between[:3, 3]])
        z.append(error / np.sqrt(np.diag(found.stable.covariance)))
    # The rms of 120 numbers scatters by 6.5 %: 2.6 of these.
    assert 0.83 < np.sqrt(np.mean(np.square(z))) < 1.17


def test_where_all_moved_otherwise_no_half_agrees():
    core = beams()
    x, y = core.points[:, 0] / 12_000.0, core.points[:, 1] / 12_000.0
    u = np.zeros_like(core.points)
    u[:, 2] = -25.0 * np.sin(3.0 * x + 1.0) * np.cos(2.0 * y) - 9.0 * np.sin(11.0 * x)
    u[:, 1] = 12.0 * np.sin(9.0 * x)
    found = stable_fit.fits(core, moved(core, u, 0), 2.0 * SPACING, SPACING, 0)
    assert found.stable.share < 0.5  # of the name; 0.13 to 0.14 in three draws


def test_a_plane_determines_no_motion_along_itself_but_an_error_along_its_normal():
    core = beams()
    up = core.normals[:, 2] > 0.5
    plane = Samples(core.points[up], core.normals[up], core.facet[up])
    found = stable_fit.fits(plane, moved(plane, np.zeros_like(plane.points), 1), 2.0 * SPACING, SPACING, 0)
    assert not found.determined
    assert 0.0 < found.stable.error_mm < SD / np.sqrt(POINTS)
    few = Samples(core.points[:8], core.normals[:8], core.facet[:8])
    assert not stable_fit.fits(few, moved(few, np.zeros((8, 3)), 1), 2.0 * SPACING, SPACING, 0).determined


@pytest.mark.parametrize("bend_mm", [200.0, 400.0])
def test_where_no_block_agrees_there_is_no_stable_motion_but_a_best_one(bend_mm):
    core = beams()
    u = np.zeros_like(core.points)
    u[:, 2] = bend_mm * ((core.points[:, :2] / 12_000.0) ** 2).sum(axis=1)
    found = stable_fit.fits(core, moved(core, u, 0), 2.0 * SPACING, SPACING, 0)
    assert found.stable.share < 0.05  # no more than lies where the bend is level: 0.011 to 0.017 in six draws
    assert np.isnan(found.stable.motion).all()
    assert np.isnan(found.stable.error_mm)
    assert not found.determined
    mean = (found.best.motion[:3, :3] @ core.points.T).T + found.best.motion[:3, 3] - core.points
    # A rigid motion: its tilt has no mean, but points lie unevenly.
    assert mean[:, 2].mean() == pytest.approx(u[:, 2].mean(), rel=0.05)
