"""Records of one kind in one table of a file: written, read again, and refused where the table does not add up."""

import dataclasses

import h5py
import numpy as np
import pytest

from processor.inspection.result import AxisDepartures, Characteristics, InspectedComponent, Result
from processor.model import Checked, Status, StepRun, column, reason
from processor.store import codec, joined_records, store
from tests.support.results.records import assert_equal


def characteristics(*names):
    n = len(names)
    numbers = {name: np.arange(n) + 0.5 for name in ("nominal", "actual", "deviation", "ci95", "lower", "upper")}
    texts = dict.fromkeys(("id", "unit", "limit", "clause"), names)
    return Characteristics(
        **numbers,
        **texts,
        quantity=("length",) * n,
        verdict=("pass",) * n,
        verified=np.ones(n, bool),
        reasons=((reason("inspect.end-not-measured", ends=names),),) * n,
    )


AXIS = AxisDepartures(*np.arange(15.0).reshape(5, 3))
COMPONENTS = (
    InspectedComponent("B1", characteristics=characteristics("length", "twist"), axis=AXIS),
    InspectedComponent("B2", status=Status.FAILED, reasons=(reason("inspect.none-seen"),)),
    InspectedComponent("B3", characteristics=characteristics("width")),
)
RESULT = Result(status=Status.PARTIAL, method="default", reasons=(), components=COMPONENTS)


def test_components_of_a_results_file_are_tables_and_come_back(tmp_path):
    store.write_results(tmp_path / "results.h5", (StepRun("inspect", "default", "{}", RESULT),), {})
    assert_equal(store.read_results(tmp_path / "results.h5", {"inspect": Result})[0].result, RESULT)
    with h5py.File(tmp_path / "results.h5") as file:
        components = file["results/0000/result/components"]
        assert list(components["name"].asstr()) == ["B1", "B2", "B3"]
        assert components["characteristics_rows"][:].tolist() == [2, 0, 1]
        assert list(components["characteristics/id"].asstr()) == ["length", "twist", "width"]


def test_components_of_a_file_of_before_2_3_are_read(tmp_path):
    """There each record is a group of its own."""
    with h5py.File(tmp_path / "old.h5", "w") as file:
        codec.write_record(file, RESULT, skip=("components",))
        for k, component in enumerate(COMPONENTS):
            codec.write_record(file.create_group(f"components/{k:04d}"), component)
        assert_equal(codec.read_record(file, Result), RESULT)


def test_a_result_without_components_comes_back(tmp_path):
    empty = dataclasses.replace(RESULT, components=())
    with h5py.File(tmp_path / "empty.h5", "w") as file:
        codec.write_record(file, empty)
        assert_equal(codec.read_record(file, Result), empty)


@pytest.mark.parametrize("rows", [[2, 0, 2], [2, 0, 0], [4, -2, 1]])
def test_rows_that_do_not_add_up_are_refused_with_their_place(tmp_path, rows):
    table = dataclasses.replace(joined_records.joined(COMPONENTS), characteristics_rows=np.array(rows))
    with h5py.File(tmp_path / "bad.h5", "w") as file:
        codec.write_record(file, RESULT, skip=("components",))
        codec.write_record(file.create_group("components"), table)
        with pytest.raises(codec.DecodeError, match=r"/components: characteristics: expected \d rows.*found 3"):
            codec.read_record(file, Result)


def test_a_record_with_arrays_of_its_own_has_no_table():
    @dataclasses.dataclass(frozen=True)
    class Part(Checked):
        places: np.ndarray = column("n", 3)

    with pytest.raises(TypeError, match=r"Part\.places"):
        joined_records.table_of(Part)
