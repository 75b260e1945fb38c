"""Parts that fail limits of their own, named at the joints beside them.

A part that is too short leaves no gap where the chain can follow it: its joints pass, and yet there is work to do.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from processor.model import Reason, Verdict, reason
from processor.preassembly.result import Result

# What a proposal says of a joint that needs no work, which is not all where a part beside it fails.
OF_NO_WORK = ("preassemble.nothing-to-do", "preassemble.all-limits")


def named_at_joints(result: Result, components: Sequence[Any]) -> Result:
    """Return a result whose proposals name the ``components`` beside the joint that fail, as step inspect found."""
    adjustment = result.adjustment
    failing: dict[str, list[Reason]] = defaultdict(list)
    for component in components:
        for row in component.characteristics.items():
            if row["verdict"] is Verdict.FAIL:
                values = {name: row[name] for name in ("id", "deviation", "ci95", "unit")}
                failing[component.name].append(reason("preassemble.part-failure", **values))
    if adjustment is None or not failing:
        return result
    joints, proposals = result.joints, []
    for left, right, proposal in zip(joints.left, joints.right, adjustment.joints.proposal, strict=True):
        beside = tuple(
            reason("preassemble.part-fails", part=name, failures=tuple(failing[name]))
            for name in (left, right)
            if name in failing
        )
        stated = proposal.reasons
        if beside:
            stated = (*beside, *(one for one in stated if one.code not in OF_NO_WORK))
        proposals.append(replace(proposal, reasons=stated))
    judged = replace(adjustment.joints, proposal=tuple(proposals))
    return replace(result, adjustment=replace(adjustment, joints=judged))
