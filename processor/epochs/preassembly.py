"""Epochs of step ``preassemble``: the gaps at each joint, and the span."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from processor.epochs.quantity_series import Kind, Series
from processor.language.messages import text
from processor.model import KEY_POINTS, Floats, Reason, Status, reason
from processor.preassembly.result import Result

BY_DESIGN = True  # values are relative to the design
AXES = "xyz"
SPAN = "span"


def series(results: Sequence[Result | None]) -> Iterator[Series]:
    """Yield the gap of each key point along each axis of the bridge, and the span's departure from the design."""
    joints = dict.fromkeys(name for result in results if result is not None for name in result.joints.name)
    for joint in joints:
        rows = [None if result is None else _row(result, joint) for result in results]
        gaps, half = (np.stack([_of_row(result, row, column) for result, row in zip(results, rows, strict=True)])
                      for column in ("gaps", "gap_ci95"))  # fmt: skip
        doubtful = np.array([_doubtful(result, row) for result, row in zip(results, rows, strict=True)], np.bool_)
        for k, point in enumerate(KEY_POINTS):
            for axis, name in enumerate(AXES):
                quantity = text("gap {point} {axis}", point=point, axis=name)
                yield Series(
                    component=joint, kind=Kind.JOINT, quantity=quantity, value=gaps[:, k, axis],
                    ci95=half[:, k, axis], doubtful=doubtful,
                )  # fmt: skip
    spans = [None if result is None else result.adjustment for result in results]
    value = np.array([np.nan if one is None else one.span_departure for one in spans])
    if np.isfinite(value).any():
        ci95 = np.array([np.nan if one is None else one.span_ci95 for one in spans])
        # Where any part of the bridge is weak or has a rival pose: the span is over all of them
        doubtful = np.array(
            [
                result is not None and any(status is not Status.OK for status in result.components.status)
                for result in results
            ],
            np.bool_,
        )
        yield Series(
            component=SPAN, kind=Kind.SPAN, quantity=text("departure from the design"), value=value, ci95=ci95,
            doubtful=doubtful,
        )  # fmt: skip


def remarks(results: Sequence[Result | None]) -> Iterator[Reason]:
    """Say what gaps of two epochs have in common."""
    if sum(result is not None for result in results) > 1:
        yield reason("epochs.gaps-as-assembled")


def _row(result: Result, joint: str) -> int | None:
    return result.joints.name.index(joint) if joint in result.joints.name else None


def _of_row(result: Result | None, row: int | None, column: str) -> Floats:
    if result is None or row is None:
        return np.full((8, 3), np.nan)
    values: Floats = getattr(result.joints, column)[row]
    return values


def _doubtful(result: Result | None, row: int | None) -> bool:
    """Whether a part of the joint is weak or has a rival pose."""
    if result is None or row is None:
        return False
    state = dict(zip(result.components.name, result.components.status, strict=True))
    parts = (result.joints.left[row], result.joints.right[row])
    return any(state.get(part, Status.OK) is not Status.OK for part in parts)
