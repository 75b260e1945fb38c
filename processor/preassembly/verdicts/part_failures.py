"""Parts that fail limits of their own, named at the joints beside them.

A part that is too short leaves no gap where the chain can follow it: its joints pass, and yet there is work to do.
"""

from __future__ import annotations

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
    failing = {component.name: why for component in components if (why := _failures(component))}
    if adjustment is None or not failing:
        return result
    joints, proposals = result.joints, []
    for left, right, proposal in zip(joints.left, joints.right, adjustment.joints.proposal, strict=True):
        beside = tuple(
            reason("preassemble.part-fails", part=name, failures=failing[name])
            for name in (left, right)
            if name in failing
        )
        stated = proposal.reasons
        if beside:
            stated = (*beside, *(one for one in stated if one.code not in OF_NO_WORK))
        proposals.append(replace(proposal, reasons=stated))
    judged = replace(adjustment.joints, proposal=tuple(proposals))
    return replace(result, adjustment=replace(adjustment, joints=judged))


def _failures(component: Any) -> tuple[Reason, ...]:
    """State the characteristics of an inspected component that fail their limits."""
    found = component.characteristics
    return tuple(
        reason(
            "preassemble.part-failure",
            id=found.id[k],
            deviation=float(found.deviation[k]),
            ci95=float(found.ci95[k]),
            unit=found.unit[k],
        )
        for k, verdict in enumerate(found.verdict)
        if verdict is Verdict.FAIL
    )
