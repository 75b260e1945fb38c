"""Reasons why gaps may be wrong altogether, beyond what their intervals cover."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processor.model import Floats
from processor.preassembly.parts.measure import MeasuredPart


def of_joint(left: MeasuredPart, right: MeasuredPart) -> str:
    """Why a joint's gaps may be wrong: an ambiguous part, an end taken for another plate side; or nothing."""
    reasons = [f"{part.name} is ambiguous" for part in (left, right) if part.status == "ambiguous"]
    for part, end in ((left, left.member.ends[1]), (right, right.member.ends[0])):
        reasons += [f"{part.name}: {end.trouble}"] if end is not None and end.trouble else []
    return "; ".join(reasons)


def of_chain(parts: Sequence[MeasuredPart], joints: Sequence[str], gaps: Floats) -> str:
    """Why the chain as a whole cannot be judged, by its joints' names and gaps (j, 8, 3); or nothing."""
    reasons = [f"{part.name} is ambiguous" for part in parts if part.status == "ambiguous"]
    reasons += [f"{name} has no answer" for name, gap in zip(joints, gaps, strict=True) if not np.isfinite(gap).all()]
    return "; ".join(reasons)


def weak_parts(left: MeasuredPart, right: MeasuredPart) -> str:
    """Name the weak parts beside a joint, with the reason of each."""
    return ", ".join(f"{part.name} ({part.message})" for part in (left, right) if part.status == "weak")
