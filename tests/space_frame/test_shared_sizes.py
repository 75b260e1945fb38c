"""Sizes that balls share, by their radii alone."""

import numpy as np
import pytest

from processor.space_frame import ball_catalogue, shared_sizes
from processor.space_frame.spheres import stochastic_model

PLAUSIBLE = ball_catalogue.load()
NO_DESIGN = np.full(1, np.nan)


def radii(sizes, counts, seed=0, error=0.0, scatter=0.25, sd=0.05):
    rng = np.random.default_rng(seed)
    every = np.repeat(np.array(sizes, float), counts)
    return every + error + rng.normal(0.0, np.hypot(scatter, sd), len(every)), np.full(len(every), sd**2)


def test_many_balls_of_one_unlisted_size_are_a_size():
    found = shared_sizes.estimated(*radii([84.0], [40]), PLAUSIBLE, NO_DESIGN)
    assert found.radii == pytest.approx([84.0], abs=4.0 * 0.26 / np.sqrt(40))  # four sds: 40 balls
    assert found.estimated
    assert not PLAUSIBLE.estimated


def test_sizes_of_a_catalogue_of_another_maker_are_found():
    sizes, counts = [57.7, 64.7, 78.0, 84.3, 98.9], [19, 25, 20, 7, 4]
    found = shared_sizes.estimated(*radii(sizes, counts), PLAUSIBLE, NO_DESIGN)
    np.testing.assert_allclose(found.radii, sizes, atol=4.0 * 0.26 / np.sqrt(4))  # four sds: a size of four balls


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("error", [-0.7, 0.0, 0.7])
def test_listed_sizes_stay_whatever_the_error_common_to_all_ranges(seed, error):
    """At a probability of 0.001, 1 in 17 of such 60 sets would be taken for a catalogue of its own."""
    batch = np.random.default_rng(seed).normal(0.0, PLAUSIBLE.sd_mm, 3)
    measured = radii(np.array([55.0, 65.0, 90.0]) + batch, [12, 30, 5], seed=seed, error=error)
    assert shared_sizes.estimated(*measured, PLAUSIBLE, NO_DESIGN) is None


def test_two_balls_of_a_wrong_size_are_no_size():
    assert shared_sizes.estimated(*radii([65.0, 84.0], [30, 2]), PLAUSIBLE, NO_DESIGN) is None


def test_sizes_of_the_design_that_the_catalogue_lacks_are_the_sizes():
    """With that of a ball that is of none of them, and also where no ball shows its size."""
    design = np.array([84.0, 58.8, np.nan])
    found = shared_sizes.estimated(*radii([58.8, 71.0, 84.0], [9, 1, 40]), PLAUSIBLE, design)
    assert found.radii == pytest.approx([58.8, 71.0, 84.0], abs=4.0 * 0.26)  # four sds: one ball
    assert found.radii[[0, 2]].tolist() == [58.8, 84.0]
    assert not found.estimated
    hidden = shared_sizes.estimated(*radii([84.0], [40], sd=0.5), PLAUSIBLE, design)
    assert hidden.radii.tolist() == [58.8, 84.0]
    # Sizes that are listed leave the catalogue, and those of another maker contradict the design.
    assert shared_sizes.estimated(*radii([60.0, 65.0], [9, 40]), PLAUSIBLE, np.array([65.0])) is None
    assert shared_sizes.estimated(*radii([77.5], [40]), PLAUSIBLE, design).estimated


def test_balls_that_hardly_show_their_radius_make_no_size():
    assert shared_sizes.estimated(*radii([84.0], [40], sd=0.5), PLAUSIBLE, NO_DESIGN) is None


def test_the_prior_is_removed_from_radii():
    """Of a radius 60.2 +- 0.3 mm and a size 60 +- 0.4 mm the fit is their weighted mean."""
    weight = 1.0 / np.array([0.3, 0.4]) ** 2
    fitted = np.array([weight @ np.array([60.2, 60.0]) / weight.sum()])
    radius, variance = stochastic_model.without_prior(fitted, 1.0 / weight.sum(keepdims=True), np.array([60.0]), 0.4)
    assert (radius.item(), variance.item()) == pytest.approx((60.2, 0.09))
