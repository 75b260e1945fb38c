"""Bands of the source paper's methods by parts as designed, against bridges with known errors."""

import dataclasses

import numpy as np
import open3d
import pytest

from processor.geometry import rigid
from processor.model import Scan
from processor.preassembly import step as preassembly_step
from processor.preassembly.baselines import bootstrap_bands, methods
from processor.preassembly.params import PAPER_METHODS
from processor.preassembly.parts import attitude
from tests.support.clouds import arch_clouds
from tests.support.scenes import known_attitudes


def extracted(scene, truth):
    """Features of a bridge's parts, with the attitudes that the search would find."""
    parts = []
    for i, (scan, part, T) in enumerate(zip(scene.scans, scene.arch.parts, truth.arch.T_bridge_scan, strict=True)):
        found = known_attitudes.attitude_of(scan.points, part, T)
        parts.append(methods.features_of(scan, i, found, scene.arch, preassembly_step.Params()))
    return parts


@pytest.fixture(scope="module")
def bridge():
    """A bridge and the features of its parts."""
    scene, truth = arch_clouds.bridge(spacing_mm=35.0, sigma_mm=1.0, seed=3)
    return scene.arch, extracted(scene, truth)


def banded(design, parts, method, **given):
    params = preassembly_step.Params(method=method, **given)
    repeated = bootstrap_bands.repeat_scans(parts, design, params)
    return bootstrap_bands.with_bands(methods.assemble(parts, design, params), repeated, design, params)


def test_bound_is_exceeded_by_one_more_draw_in_less_than_five_percent():
    rng = np.random.default_rng(1)
    every = np.array([5.0, 0.0, 0.0]) + rng.normal(0.0, 2.0, (6, 4_000, 3))
    exceeded = np.linalg.norm(every[5], axis=1) > bootstrap_bands.bound(every[:5])
    assert exceeded.mean() < 0.05
    assert bootstrap_bands.bound(np.full((4, 1, 2), 3.0)) == pytest.approx(3.0 * np.sqrt(2.0))
    # Of one number: its mean 2 and sd 1 by hand, Student's 97.5 % of 2 degrees of freedom.
    assert bootstrap_bands.bound(np.array([1.0, 2.0, 3.0])[:, None, None]) == pytest.approx(
        2.0 + 4.30265 * np.sqrt(4.0 / 3.0)
    )


def test_too_few_answers_have_no_bound():
    vectors = np.ones((5, 2, 3))
    vectors[1:4, 1] = np.nan
    assert np.isnan(bootstrap_bands.bound(vectors)).tolist() == [False, True]


def test_points_of_a_part_as_built_are_projected_onto_its_design():
    design, rng = arch_clouds.design().parts[2], np.random.default_rng(2)
    points = arch_clouds.scan_points(2, 20.0, 0.5, rng)
    middle = points.mean(axis=0)
    built = points + 0.001 * (points - middle)  # 6 mm longer
    built[:, 1] += 5.0 * np.cos(np.pi * (points[:, 0] - middle[0]) / np.ptp(points[:, 0]))
    strays = middle + rng.uniform(1_500.0, 3_000.0, (50, 3))
    T = arch_clouds.random_pose(rng)
    scan = Scan("rib2", rigid.apply(T, np.vstack([built, strays])), component="rib2")
    found = attitude.Attitude(rigid.invert(T), rigid.invert(T), "ok")
    part = methods.PartFeatures(
        name="rib2", scan=scan, attitude=found, ends=(None, None), lines=np.empty((0, 3)), edges=None, reasons=()
    )
    laid = bootstrap_bands._as_designed(part, design)
    assert laid.sigma_mm == pytest.approx(0.5, rel=0.2)  # and some of the bow of 5 mm, which the model follows
    assert (~laid.near).sum() == 50
    there = rigid.apply(laid.T_bridge_scan, laid.points)
    # Open3D's distances are float32: hundredths of a millimetre, about the part's middle.
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(np.float32(design.vertices - middle), np.uint32(design.faces))
    assert scene.compute_distance(np.float32(there[laid.near] - middle)).numpy().max() < 0.01
    # The part is 6 mm longer and bowed by 5 mm to one side, of which its pose has the mean.
    assert np.abs(rigid.apply(laid.T_bridge_scan @ T, middle[None]) - middle).max() < 3.0


@pytest.mark.slow
def test_bands_cover_the_errors_over_several_bridges():
    held = {method: [] for method in PAPER_METHODS}
    for seed in range(1, 9):
        scene, truth = arch_clouds.bridge(spacing_mm=15.0, sigma_mm=1.0, seed=seed)
        parts = extracted(scene, truth)
        for method, own in held.items():
            result = banded(scene.arch, parts, method, seed=seed)
            figures = [value for error in result.errors for value in (error.mean, error.max)]
            shares = [np.mean(figures <= result.errors_ci95)]
            for of in (result.linear.assembled, result.linear.best_fit):
                known = np.isfinite(of.ci95) & np.isfinite(of.deviation)
                # The last intervals of a part may have points in some repetitions only.
                assert known.sum() >= np.isfinite(of.deviation).sum() - len(parts) - 1
                shares.append((of.deviation <= of.ci95)[known].mean())
            own.append(shares)
    # Errors along one bridge are correlated: 8 bridges determine the mean share to some per cent.
    for own in held.values():
        assert (np.mean(own, axis=0) > 0.9).all()


@pytest.mark.slow
def test_where_the_chain_is_broken_there_is_no_band(bridge):
    design, parts = bridge
    ball = np.random.default_rng(0).normal(size=(5_000, 3))
    scan = dataclasses.replace(parts[2].scan, points=3_000.0 * ball / np.linalg.norm(ball, axis=1)[:, None])
    found = attitude.Attitude(np.eye(4), np.eye(4), "failed")
    broken = methods.features_of(scan, 2, found, design, preassembly_step.Params())
    result = banded(design, [*parts[:2], broken, *parts[3:]], "corner", repetitions=3)
    assert result.components.status[2:] == ("failed",) * 3
    of = result.linear.assembled
    assert np.isfinite(of.ci95).any()
    assert (np.isfinite(of.ci95) <= np.isfinite(of.deviation)).all()


@pytest.mark.slow
def test_bands_have_the_same_bytes_each_time(bridge):
    one, other = (banded(*bridge, "corner", repetitions=3).linear.assembled.ci95 for _ in range(2))
    assert one.tobytes() == other.tobytes()


def test_without_repetitions_no_uncertainty_is_stated(bridge):
    result = banded(*bridge, "corner", repetitions=0)
    assert not result.bands_as_designed
    assert [one.code for one in result.reasons] == ["preassemble.no-uncertainty", "preassemble.inner-edges"]
