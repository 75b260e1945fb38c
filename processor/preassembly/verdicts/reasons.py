"""Reasons why gaps may be wrong altogether, beyond what their intervals cover."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from processor.model import NORMAL_95, ArchDesign, Floats, Reason, Status, reason
from processor.preassembly.chain.adjustment import Adjusted
from processor.preassembly.parts.measure import MeasuredPart
from processor.preassembly.topology import Side


def of_assignment(parts: Sequence[MeasuredPart]) -> tuple[Reason, ...]:
    """Name the scans that are of other parts than stated, and the parts of all scans; empty where none is."""
    scans = sorted((scan for part in parts for scan in part.identities), key=lambda one: one.scan)
    wrong = tuple(why for scan in scans for why in scan.wrong)
    if not wrong:
        return ()
    # A question mark where nothing is known of a scan.
    which = (" / ".join(scan.parts) if 0 < len(scan.parts) < len(parts) else "?" for scan in scans)
    matching = tuple(f"{scan.scan} = {names}" for scan, names in zip(scans, which, strict=True))
    return (reason("preassemble.wrong-assignment", scans=wrong, matching=matching),)


def of_pieces(adjusted: Adjusted, design: ArchDesign, place_sd_mm: float) -> tuple[Reason, ...]:
    """State the pieces that no measured joint ties together, and what places them; empty of a single piece."""
    if not adjusted.in_pieces:
        return ()
    names = np.array([part.name for part in design.parts])
    pieces = tuple(" + ".join(names[adjusted.piece == piece]) for piece in range(adjusted.piece.max() + 1))
    joints = tuple(
        name for name, gap in zip(design.joint_names, adjusted.gaps, strict=True) if not np.isfinite(gap).all()
    )
    return (reason("preassemble.in-pieces", joints=joints, pieces=pieces, ci95=NORMAL_95 * place_sd_mm),)


def placed_by_design(parts: Sequence[MeasuredPart], in_pieces: tuple[Reason, ...]) -> list[MeasuredPart]:
    """Return the parts of an assembly, weak where it is in pieces: no joint ties any of them to all others."""
    if not in_pieces:
        return list(parts)
    why = reason("preassemble.placed-by-design", ci95=in_pieces[0].values["ci95"])
    return [
        part
        if part.status == Status.FAILED
        else replace(
            part,
            status=Status.WEAK if part.status == Status.OK else part.status,
            reasons=(why, *part.reasons),
        )
        for part in parts
    ]


def of_joint(parts: Sequence[MeasuredPart], sides: tuple[Side, Side]) -> tuple[Reason, ...]:
    """Why a joint's gaps may be wrong: an ambiguous part, a scan of another, an end of maybe another plate side."""
    left, right = (parts[side.part] for side in sides)
    others = (*left.of_others, *right.of_others)
    ends = ((part, part.member.ends[side.end]) for part, side in zip((left, right), sides, strict=True))
    doubts = (
        reason("preassemble.end-not-measured", part=part.name, reasons=() if end is None else end.doubts)
        if end is None or not np.isfinite(end.departure).all()
        else reason("preassemble.at", place=part.name, reasons=end.doubts)
        for part, end in ends
        if end is None or end.doubts or not np.isfinite(end.departure).all()
    )
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
