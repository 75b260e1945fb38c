"""Movements of nodes held against a limit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.bolt_balls.result import Result
from processor.model import NORMAL_95, Floats

PASS, FAIL, INDETERMINATE, NO_LIMIT = "pass", "fail", "indeterminate", "no limit"


@dataclass(frozen=True)
class Judged:
    """Size (k,) of each movement, its 95 % half-width (k,), mm, and the verdict; NaN and "" where none is known.

    The half-width is along the movement itself: a size that is not well above it is mostly noise.
    """

    size: Floats
    ci95: Floats
    verdict: tuple[str, ...]


def of_result(result: Result) -> Judged:
    """Judge all movements of a result.

    Pass where size and interval keep within the limit, fail where it is beyond by more than the interval, else
    indeterminate; that also where the design fits the nodes in other ways as well, and of a ball that was not seen:
    where its axes meet is no ball's place.
    """
    size = np.linalg.norm(result.movement, axis=1)
    along = result.movement / np.where(size > 0.0, size, 1.0)[:, None]
    variance = np.einsum("ki,kij,kj->k", along, result.movement_covariance, along)
    ci95 = NORMAL_95 * np.sqrt(np.maximum(variance, 0.0))
    sure = result.matching == "ok"
    limit = result.movement_limit
    seen = [one != "axes" for one in result.evidence]
    return Judged(
        size,
        ci95,
        tuple(
            _verdict(s, half, limit, sure and ball)
            for s, half, ball in zip(size.tolist(), ci95.tolist(), seen, strict=True)
        ),
    )


def _verdict(size: float, half: float, limit: float, sure: bool) -> str:
    if np.isnan(size):
        return ""
    if np.isnan(limit):
        return NO_LIMIT
    if not sure or np.isnan(half):
        return INDETERMINATE
    return PASS if size + half <= limit else FAIL if size - half > limit else INDETERMINATE
