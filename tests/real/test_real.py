"""Public real data that is at hand keeps what docs/real.md states of it; absent sets are skipped."""

import pytest

from tests.real import measured

SLOW = ("column", "rooms", "steel_files")  # seconds of inspection, of stitching, and of a CAD kernel


@pytest.mark.parametrize(
    "of", [pytest.param(of, marks=[pytest.mark.slow] if of.__name__ in SLOW else []) for of in measured.SETS],
    ids=lambda of: of.__name__,
)  # fmt: skip
def test_no_figure_of_real_data_is_outside_without_a_flag(of):
    rows, absent = measured.table((of,))
    if absent:
        pytest.skip(absent[0])
    assert {row for row in rows if row.verdict == "OUTSIDE"} == set()
