"""Reasons why gaps may be wrong altogether, beyond what their intervals cover."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from processor.model import Floats, Reason, Status, reason
from processor.preassembly.parts.assignment import ScanParts
from processor.preassembly.parts.measure import MeasuredPart
from processor.preassembly.topology import Side


def of_assignment(parts: Sequence[MeasuredPart]) -> tuple[Reason, ...]:
    """Name the scans that are of other parts than stated, and the parts of all scans; empty where none is."""
    scans = sorted((scan for part in parts for scan in part.identities), key=lambda one: one.scan)
    wrong = tuple(why for scan in scans for why in scan.wrong)
    if not wrong:
        return ()
    matching = tuple(f"{scan.scan} = {_which(scan, len(parts))}" for scan in scans)
    return (reason("preassemble.wrong-assignment", scans=wrong, matching=matching),)


def _which(scan: ScanParts, count: int) -> str:
    """Write the parts that a scan may be of; a question mark where nothing is known of it."""
    return " / ".join(scan.parts) if 0 < len(scan.parts) < count else "?"


def of_joint(parts: Sequence[MeasuredPart], sides: tuple[Side, Side]) -> tuple[Reason, ...]:
    """Why a joint's gaps may be wrong: an ambiguous part, a scan of another, an end of maybe another plate side."""
    left, right = (parts[side.part] for side in sides)
    others = (*left.of_others, *right.of_others)
    ends = ((part, part.member.ends[side.end]) for part, side in zip((left, right), sides, strict=True))
    doubts = (reason("preassemble.at", place=part.name, reasons=end.doubts) for part, end in ends if end and end.doubts)
    return (*others, *_ambiguous((left, right)), *doubts)


def of_chain(parts: Sequence[MeasuredPart], joints: Sequence[str], gaps: Floats) -> tuple[Reason, ...]:
    """Why the chain as a whole cannot be judged, by its joints' names and gaps (j, 8, 3)."""
    unknown = (name for name, gap in zip(joints, gaps, strict=True) if not np.isfinite(gap).all())
    return (*_ambiguous(parts), *(reason("preassemble.joint-unknown", joint=name) for name in unknown))


def weak_parts(left: MeasuredPart, right: MeasuredPart) -> tuple[Reason, ...]:
    """Name the weak parts beside a joint, with the reasons of each."""
    weak = (part for part in (left, right) if part.status == Status.WEAK)
    return tuple(reason("preassemble.at", place=part.name, reasons=part.reasons) for part in weak)


def _ambiguous(parts: Sequence[MeasuredPart]) -> Iterator[Reason]:
    for part in parts:
        if part.status == Status.AMBIGUOUS:
            yield reason("preassemble.ambiguous-part", part=part.name)
