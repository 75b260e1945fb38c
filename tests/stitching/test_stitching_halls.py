"""Halls of nearly equal bays: only crates, brackets and the ends distinguish them."""

import numpy as np
import pytest

from processor.model import Scene
from processor.stitching import step as stitching_step
from tests.support.clouds.hall_clouds import hall

RIGHT_MM = 500.0


def wrong_but_ok(T, result):
    """Scans called ok that do not agree with most of these; T (k, 4, 4) are the true poses."""
    ok = [i for i, state in enumerate(result.scans.status) if state == "ok"]
    most = 0
    for i in ok:
        D = T[i] @ np.linalg.inv(result.scans.T_project_scan[i])
        off = [np.linalg.norm((D @ result.scans.T_project_scan[j] - T[j])[:3, 3]) for j in ok]
        most = max(most, sum(distance < RIGHT_MM for distance in off))
    return len(ok) - most


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5, 7, 8, 9, 10])
def test_a_hall_of_nine_bays_is_right_or_ambiguous(seed):
    """Folded about its middle it overlaps more: free space must not be contradicted by what lies between far rays."""
    T, scans = hall(seed, step_mrad=18.0)
    result = stitching_step.run(Scene("hall", "structure", scans), stitching_step.Params())
    assert wrong_but_ok(T, result) == 0
    assert sum(state == "ok" for state in result.scans.status) >= 2


@pytest.mark.slow
def test_a_hall_that_fits_as_well_folded_about_its_middle_is_ambiguous():
    """Three scans fit the first bays as well as the last; moves are tried from either scan of a pair."""
    T, scans = hall(6, step_mrad=18.0)
    result = stitching_step.run(Scene("hall", "structure", scans), stitching_step.Params())
    assert wrong_but_ok(T, result) == 0
    assert "ambiguous" in result.scans.status
