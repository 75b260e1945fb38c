"""Results and truths that are valid HDF5 and impossible in meaning are refused with the place.

For every field of numbers of every record an impossible value is drawn from what the field declares, so a record that
is added later is tested without further code.
"""

import dataclasses
import types
import typing

import numpy as np
import pytest

from processor import pipeline, record_checks
from processor.limits.judging import JudgedLimits
from processor.model import Checked, InputError, Rows, StepRun, Truth
from processor.pipeline import result_classes
from processor.store import store
from tests.support.scenes.impossible_scenes import with_value

ROWS = 2


def _kinds(hint):
    """The record types within a type hint."""
    parts = typing.get_args(hint) if isinstance(hint, types.UnionType | types.GenericAlias) else (hint,)
    return [kind for kind in parts if isinstance(kind, type) and issubclass(kind, Checked)]


def filled(kind):
    """A record of a kind with two rows in every table, all of it possible; optional records are there too."""
    hints, values = typing.get_type_hints(kind), {}
    for field in dataclasses.fields(kind):
        hint, metadata = hints[field.name], field.metadata
        inner = _kinds(hint)
        if inner:
            many = typing.get_origin(hint) is tuple
            values[field.name] = tuple(filled(inner[0]) for _ in range(ROWS)) if many else filled(inner[0])
        elif "shape" in metadata:
            values[field.name] = _array(metadata)
        elif "words" in metadata:
            word = next(iter(metadata["words"]))
            values[field.name] = (word,) * ROWS if "axis" in metadata else word
        elif "lists" in metadata:
            values[field.name] = (("a",),) * ROWS
        elif "reasons" in metadata:
            values[field.name] = ((),) * ROWS if metadata["reasons"] else ()
        elif typing.get_origin(hint) is tuple:
            values[field.name] = tuple(f"n{i}" for i in range(ROWS))
        else:
            values[field.name] = {int: 1, float: 1.0, str: "a", bool: True}[hint]
    return kind(**values)


def _array(metadata):
    shape = tuple(ROWS if isinstance(n, str) else n for n in metadata["shape"])
    means = metadata.get("means", record_checks.UNDECLARED)
    if means.covariance or means.pose:
        return np.broadcast_to(np.eye(shape[-1]), shape)
    if means.unique:
        return np.arange(shape[0])
    return np.broadcast_to(np.ones(shape) * (0 if means.rows_of else 0.5), shape).astype(metadata["dtype"])


def impossible(value, means):
    """Values that a field may not have, by what it declares."""
    dtype = np.asarray(value).dtype
    if means.pose:
        return [value * np.diag([1.0, 1.0, -1.0, 1.0]), np.full_like(value, np.inf)]
    if means.covariance:
        wrong = np.array(value)
        wrong[..., 0, 1] = 0.5
        return [-value, wrong, np.full_like(value, np.inf), value + 2.0 * (1.0 - np.eye(value.shape[-1]))]
    numbers = [] if means.infinite or dtype.kind != "f" else [np.inf]
    numbers += [2.0 * means.least - 1.0] if np.isfinite(means.least) else []
    numbers += [means.most * 2.0 + 1.0] if np.isfinite(means.most) else []
    numbers += [means.above] if np.isfinite(means.above) else []
    numbers += [99, means.lowest_row - 1] if means.rows_of else []
    if means.unique:
        return [np.full_like(value, 3)]
    bad = []
    for number in numbers:
        if np.isfinite(number) and dtype.kind in "iu" and not np.iinfo(dtype).min <= number <= np.iinfo(dtype).max:
            continue
        changed = np.array(value)
        changed[(-1,) * changed.ndim] = number
        bad.append(changed if changed.ndim else changed.item())
    return bad


def fields_of(record, path=()):
    """Every field of numbers within a record: path, field and value."""
    hints = typing.get_type_hints(type(record))
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if dataclasses.is_dataclass(value):
            yield from fields_of(value, (*path, field.name))
        elif isinstance(value, tuple) and value and dataclasses.is_dataclass(value[0]):
            yield from fields_of(value[-1], (*path, field.name, str(len(value) - 1)))
        elif field.metadata.get("dtype", np.bool_) is not np.bool_ or hints[field.name] in (int, float):
            yield (*path, field.name), field, value


def run_of(step):
    return StepRun(step, "default", "{}", filled(result_classes()[step]))


@pytest.mark.parametrize("step", [*sorted(result_classes()), "truth"])
def test_an_impossible_value_of_any_field_is_refused_with_its_place(step):
    whole = filled(Truth) if step == "truth" else run_of(step)
    assert record_checks.problems(whole) == []
    count = 0
    for path, field, value in fields_of(whole):
        means = field.metadata.get("means")
        assert means is not None, f"{step} {'.'.join(path)} does not say what its numbers mean"
        for bad in impossible(value, means):
            found = record_checks.problems(with_value(whole, path, lambda _, bad=bad: bad), "/results/0000")
            place = "/".join(f"{int(part):04d}" if part.isdigit() else part for part in path)
            assert found, f"{step} {'.'.join(path)} takes {bad}"
            assert found[0].startswith(f"/results/0000/{place}"), found
            assert "expected" in found[0]
            count += 1
    assert count >= 15


# Of each kind of meaning one, among them a component's table; the test above takes every field.
CASES = [
    ("spheres", "result/balls/radii", -1.0, "/result/balls/radii, row 1: expected numbers above 0, found -1"),
    ("spheres", "result/balls/radii", np.inf, "/result/balls/radii, row 1: expected finite numbers"),
    ("spheres", "result/balls/covariance", -np.eye(4), "/balls/covariance, row 1: expected a symmetric matrix"),
    ("stitch", "result/scans/T_project_scan", np.ones((4, 4)), "T_project_scan, row 1: expected a rotation"),
    ("deviation", "result/within_10mm_share", 7.0, "/within_10mm_share: expected numbers from 0 to 1, found 7"),
    ("inspect", "result/components/1/characteristics/ci95", -1.0, "/ci95, row 1: expected numbers of 0 or more"),
]


@pytest.mark.parametrize(("step", "path", "bad", "fault"), CASES, ids=[f"{case[0]} {case[1]}" for case in CASES])
def test_a_file_of_impossible_results_is_refused_with_its_place(tmp_path, step, path, bad, fault):
    def last_row(value):
        if not np.ndim(value):
            return bad
        new = np.array(value)
        new[-1] = bad
        return new

    file = tmp_path / "results.h5"
    store.write_results(file, [with_value(run_of(step), path.split("/"), last_row)], {"input": "x"})
    with pytest.raises(InputError) as caught:
        pipeline.read_runs(file)  # as report, export and history do
    assert str(caught.value).startswith(f"{file}: /results/0000/")
    assert fault in str(caught.value)


def test_possible_results_come_back(tmp_path):
    runs = [run_of(step) for step in sorted(result_classes())]
    store.write_results(tmp_path / "results.h5", runs, {})
    assert [run.step for run in store.read_results(tmp_path / "results.h5", result_classes())] == [r.step for r in runs]


def test_a_limit_may_be_open_to_a_side_and_a_value_may_be_unknown():
    judged = dataclasses.replace(filled(JudgedLimits), low=[-np.inf, np.nan], high=[np.inf, 1.0], value=[np.nan, 2.0])
    assert isinstance(judged, Rows)
    assert record_checks.problems(judged) == []
