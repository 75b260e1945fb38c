"""Epochs of step ``preassemble``: the gaps at each joint, and the span."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np

from processor.epochs.quantity_series import Kind, Series, by_key
from processor.language.messages import text
from processor.model import KEY_POINTS, Reason, Status, reason
from processor.preassembly.result import Result

BY_DESIGN = True  # values are relative to the design
AXES = "xyz"
SPAN = "span"


def series(results: Sequence[Result | None]) -> Iterator[Series]:
    """Yield the gap of each key point along each axis of the bridge, and the span's departure from the design."""
    for (joint, point, axis), (value, ci95, doubtful) in by_key(results, _gaps).items():
        yield Series(
            component=joint, kind=Kind.JOINT, quantity=text("gap {point} {axis}", point=point, axis=axis), value=value,
            ci95=ci95, doubtful=doubtful > 0.0,
        )  # fmt: skip
    for value, ci95, doubtful in by_key(results, _span).values():
        if np.isfinite(value).any():
            yield Series(
                component=SPAN, kind=Kind.SPAN, quantity=text("departure from the design"), value=value, ci95=ci95,
                doubtful=doubtful > 0.0,
            )  # fmt: skip


def remarks(results: Sequence[Result | None]) -> Iterator[Reason]:
    """Say what gaps of two epochs have in common."""
    if sum(result is not None for result in results) > 1:
        yield reason("epochs.gaps-as-assembled")


def _gaps(result: Result) -> Iterator[tuple[Any, ...]]:
    """Yield joint, key point and axis of each gap, with gap, half-width and doubt."""
    joints, state = result.joints, dict(zip(result.components.name, result.components.status, strict=True))
    for j, joint in enumerate(joints.name):
        parts = (joints.left[j], joints.right[j])  # one that is weak or has a rival pose makes a joint doubtful
        doubtful = any(state.get(part, Status.OK) is not Status.OK for part in parts)
        for (k, point), (axis, name) in product(enumerate(KEY_POINTS), enumerate(AXES)):
            yield (joint, point, name), joints.gaps[j, k, axis], joints.gap_ci95[j, k, axis], doubtful


def _span(result: Result) -> Iterator[tuple[Any, ...]]:
    """Yield the span: doubtful where any part of the bridge is weak or has a rival pose, as it is over all of them."""
    if result.adjustment is not None:
        doubtful = any(status is not Status.OK for status in result.components.status)
        yield SPAN, result.adjustment.span_departure, result.adjustment.span_ci95, doubtful
