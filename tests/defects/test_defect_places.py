"""Profiles of places that deviate, waves, and plates held along a side: closed forms on cells with noise."""

import dataclasses

import numpy as np
import pytest

from processor.defects import classification
from processor.defects.places import profiles, waves
from processor.defects.places.profiles import Profile
from processor.defects.result import DefectClass

LOW, HIGH, CELL, NOISE = np.array([0.0, 0.0]), np.array([6000.0, 1100.0]), 25.0, 0.25


def place(height, centre, half, seed=0, seen=lambda u, v: np.ones(len(u), bool)):
    """Cells about a place, as a scan shows them: not within 20 mm of the face's border."""
    centre, half = np.array(centre, float), np.array(half, float)
    low, high = np.maximum(centre - 1.6 * half - 50.0, LOW), np.minimum(centre + 1.6 * half + 50.0, HIGH)
    grid = np.meshgrid(*(np.arange(a, b, CELL) + 0.5 * CELL for a, b in zip(low, high, strict=True)))
    uv = np.stack([x.ravel() for x in grid], axis=1)
    uv = uv[((uv > LOW + 20.0) & (uv < HIGH - 20.0)).all(axis=1)]
    uv = uv[seen(uv[:, 0], uv[:, 1])]
    value = height(uv[:, 0], uv[:, 1]) + NOISE * np.random.default_rng(seed).normal(size=len(uv))
    noise = np.full(len(uv), NOISE)
    return profiles.PlaceCells(
        uv=uv, value=value, noise=noise, low=LOW, high=HIGH, centre=centre, half=half, cell_mm=CELL
    )


def round_off(s):
    return np.where(np.abs(s) < 1.0, np.cos(0.5 * np.pi * np.clip(s, -1.0, 1.0)) ** 2, 0.0)


@pytest.mark.parametrize("seed", range(5))
def test_local_bump_is_classified_as_bump_with_its_depth(seed):
    cells = place(lambda u, v: -9.0 * round_off(np.hypot((u - 3000.0) / 170.0, (v - 500.0) / 220.0)),
                  (3000, 500), (140, 170), seed)  # fmt: skip
    fitted = profiles.fit(cells, -1)
    assert fitted.profile is Profile.BUMP
    assert fitted.depth == pytest.approx(-9.0, rel=0.02)  # four times the scatter of eight seeds, 0.04 mm


@pytest.mark.parametrize("seed", range(5))
def test_a_bent_edge_is_deepest_where_the_plate_ends(seed):
    cells = place(lambda u, v: 14.0 * round_off((u - 3000.0) / 430.0) * np.clip(1.0 - v / 150.0, 0.0, 1.0),
                  (3000, 70), (300, 60), seed)  # fmt: skip
    fitted = profiles.fit(cells, 1)
    assert fitted.profile is Profile.EDGE
    assert fitted.depth == pytest.approx(14.0, rel=0.04)  # the border itself has no cell; 0.12 mm by eight seeds
    before = classification.of_deviation(1, 300.0, 600.0, 120.0, 14.0, 30.0)
    assert classification.of_profile(fitted, 14.0, before).defect_class is DefectClass.BEND


@pytest.mark.parametrize(("reach", "depth", "kind"), [(500.0, 4.0, "step"), (55.0, 3.5, "crack")])
def test_a_step_jumps_along_a_line(reach, depth, kind):
    for seed in range(3):
        cells = place(
            lambda u, v: depth * (u > 3007.0) * round_off((u - 3007.0) / reach) * (np.abs(v - 500.0) < 220.0),
            (3000 + 0.3 * reach, 500), (0.35 * reach + 15.0, 220), seed,
        )  # fmt: skip
        fitted = profiles.fit(cells, 1)
        assert fitted.profile is Profile.STEP
        assert fitted.depth == pytest.approx(depth, rel=0.12)  # by six seeds 6 % more than a wide step is, ± 1 %
        before = classification.of_deviation(1, 300.0, 600.0, 300.0, 16.0, 30.0)
        assert classification.of_profile(fitted, 16.0, before).defect_class == kind


def test_border_of_the_seen_cells_is_not_classified_as_a_step():
    cells = place(
        lambda u, v: 6.0 * round_off((u - 3060.0) / 120.0) * round_off((v - 500.0) / 200.0),
        (3060, 500), (60, 150), 1, seen=lambda u, v: u > 3020.0,
    )  # fmt: skip
    assert profiles.fit(cells, 1).profile is not Profile.STEP


def lobes(heights, spacing=150.0, off=0.0, sides=(), length=100.0):
    """Return lobes of a plate of 20 mm: rows of cells of 25 mm, those of ``sides`` seen from below."""
    rng = np.random.default_rng(2)
    found = []
    for k, height in enumerate(heights):
        side = -1.0 if k in sides else 1.0
        middle = np.array([k * spacing, off * (-1) ** k, 10.0 * side])
        along = np.arange(-0.5 * length, 0.5 * length + 1.0, 25.0)
        grid = np.stack(np.meshgrid(along, np.arange(-200.0, 201.0, 25.0), 0.0), axis=-1).reshape(-1, 3)
        found.append(
            waves.Lobe(
                component=3, cells=middle + grid, middle=middle + np.append(rng.normal(size=2), 0.0),
                outward=np.array([0.0, 0.0, side]), height=side * height, width=length,
            )
        )  # fmt: skip
    return found


def test_alternating_lobes_in_a_line_are_joined_into_one_wave():
    assert waves.waves(lobes([5.0, -5.2, 4.8, -4.0])) == [[0, 1, 2, 3]]
    assert waves.waves(lobes([5.0, -5.2])) == []  # two are no row
    assert waves.waves(lobes([5.0, 5.2, 4.8])) == []  # to one side
    assert waves.waves(lobes([5.0, -5.2, 4.8], spacing=400.0)) == []  # far from each other
    assert waves.waves(lobes([5.0, -0.3, 4.8])) == []  # of one that is hardly there
    assert waves.waves(lobes([5.0, -5.2, 4.8], off=150.0)) == []  # not in a line


def test_half_waves_seen_on_either_side_of_a_plate_are_one_wave():
    assert waves.waves(lobes([5.0, -5.2, 4.8, -4.0], sides=(1, 2))) == [[0, 1, 2, 3]]
    assert waves.waves(lobes([5.0, 5.2, 4.8], sides=(1,))) == []  # to one side of the plate


def test_half_waves_are_joined_across_a_gap_into_which_no_other_one_fits():
    assert waves.waves(lobes([5.0, -5.2, 4.8], spacing=150.0, length=80.0)) == [[0, 1, 2]]
    assert waves.waves(lobes([5.0, -5.2, 4.8], spacing=170.0, length=75.0)) == []


def test_a_place_beside_a_wave_does_not_dissolve_it():
    row = lobes([5.0, -5.2, 4.8, -4.0])
    shift = np.array([60.0, 420.0, 0.0])
    beside = dataclasses.replace(row[1], middle=row[1].middle + shift, cells=row[1].cells + shift, height=4.9)
    assert waves.waves([*row, beside]) == [[0, 1, 2, 3]]
