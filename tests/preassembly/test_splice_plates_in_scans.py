"""Splice plates bolted to the end of a scanned part are not taken for the part."""

import numpy as np
import pytest

from processor.geometry import rigid
from processor.model import Scan, Status
from processor.preassembly.ends import section
from processor.preassembly.ends.joint_frame import EndPlace, joint_frame
from processor.preassembly.params import SystematicParams
from processor.preassembly.parts import attitude, beyond_ends, measure
from tests.support.results.reasons import codes
from tests.support.scenes import known_attitudes
from tests.support.scenes.bolted_girders import bolted_girders

HALF = np.array([0.0, 210.0, 300.0])
REACH, WIDTH, PLATE = 180.0, 200.0, 12.0  # of the splice plates, along from the joint, across, and their thickness


def sheet(rng, along, across, axis, at, spacing=12.0, sigma=0.5):
    """Points of a rectangle square to an axis, 1 = left or 2 = up, of a joint's frame."""
    count = rng.poisson(np.ptp(along) * np.ptp(across) / spacing**2)
    points = np.zeros((count, 3))
    points[:, 0], points[:, 3 - axis] = rng.uniform(*along, count), rng.uniform(*across, count)
    points[:, axis] = at + sigma * rng.standard_normal(count)
    return points


def girder(rng, length, end=0.0, sigma=0.5):
    """The flanges' outer sides and the web of an I girder that ends at a joint, or beyond it."""
    span = (-length, end)
    flanges = [sheet(rng, span, (-HALF[1], HALF[1]), 2, sense * HALF[2], sigma=sigma) for sense in (-1, 1)]
    web = [sheet(rng, span, (-280.0, 280.0), 1, sense * 6.0, sigma=sigma) for sense in (-1, 1)]
    return np.vstack([*flanges, *web])


def plates(rng, spacing=12.0):
    """Points of plates on both flanges: the outer side all along, the inner one beyond the end."""
    sides = [
        one
        for sense in (-1, 1)
        for one in (
            sheet(rng, (-REACH, REACH), (-WIDTH, WIDTH), 2, sense * (HALF[2] + PLATE), spacing),
            sheet(rng, (0.0, REACH), (-WIDTH, WIDTH), 2, sense * HALF[2], spacing),
        )
    ]
    return np.vstack(sides)


def found(points):
    return beyond_ends.plates(points, EndPlace(np.eye(4), section.of_box(HALF), 1.0))


@pytest.mark.parametrize("seed", range(2))
def test_plates_beyond_an_end_are_told_from_a_part_that_is_too_long(seed):
    rng = np.random.default_rng(seed)
    assert found(np.vstack([girder(rng, 1400.0), plates(rng)]))
    assert not found(girder(rng, 1400.0))
    assert not found(girder(rng, 1400.0, end=70.0, sigma=2.0))
    clutter = rng.uniform([20.0, -250.0, -350.0], [200.0, 250.0, 350.0], (50, 3))
    assert not found(np.vstack([girder(rng, 1400.0), clutter]))


@pytest.mark.parametrize("seed", range(2))
def test_what_a_part_rests_on_is_no_splice_plate(seed):
    """A beam below the end, wider than it and past it, seen at its top and its front."""
    rng = np.random.default_rng(seed)
    top = sheet(rng, (-150.0, 200.0), (-300.0, 300.0), 2, -HALF[2] - 30.0)
    front = rng.uniform([199.0, -300.0, -HALF[2] - 200.0], [201.0, 300.0, -HALF[2] - 30.0], (700, 3))
    assert not found(np.vstack([girder(rng, 1400.0), top, front]))


def test_a_girder_scanned_with_its_splice_plates_has_no_key_points(monkeypatch):
    scene, truth, _ = bolted_girders(1, {"spacing_mm": 8.0, "sigma_mm": 0.5})
    monkeypatch.setattr(attitude, "find", known_attitudes.find_by(truth))
    rng, frame, first = np.random.default_rng(1), joint_frame(scene.arch.joint_points[0]), scene.scans[0]
    T = rigid.invert(frame) @ truth.arch.T_bridge_scan[0]
    local = rigid.apply(T, first.points + first.origin)
    covered = (np.abs(local[:, :2]) < [REACH, WIDTH]).all(axis=1) & (np.abs(local[:, 2]) > HALF[2] - 3.0)
    local = np.vstack([local[~covered], plates(rng, spacing=8.0)])
    plated = Scan(first.name, rigid.apply(rigid.invert(T), local), component=first.component, sigma_mm=first.sigma_mm)
    systematic = SystematicParams()
    fitted = measure.fit([plated], 0, attitude.Shapes(scene.arch), 1.0, systematic)
    (result,) = measure.estimate([fitted], systematic)
    assert result.status == Status.FAILED
    assert "preassemble.splice-plates" in codes(result.reasons)
    assert np.isnan(result.member.ends[1].departure).all()
