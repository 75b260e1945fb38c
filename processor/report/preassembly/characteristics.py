"""What of a bridge is compared with limits: each joint, and the whole chain."""

from __future__ import annotations

from processor.language.messages import Message, label, text
from processor.limits.judging import Judged
from processor.model import ArchDesign, Scene, StepRun
from processor.preassembly.chain.span_and_closure import design_span
from processor.preassembly.result import Result
from processor.preassembly.verdicts.joints import Conformity
from processor.report.table import NAN

LIMITS = {
    "misalignment_mm": text("misalignment"),
    "groove_gap_mm": text("groove gap"),
    "splice_eccentricity_mm": text("splice eccentricity"),
    "span_mm": text("span"),
    "unit_length_mm": text("unit length"),
    "inner_arc_mm": text("inner arc"),
    "lateral_axis_mm": text("lateral axis"),
    "elevation_mm": text("elevation"),
}
GROOVE_GAP, CHORDS = "groove_gap", ("span", "unit_length")
CHAIN = text("chain")


def of_run(scene: Scene, run: StepRun) -> list[Judged]:
    """Return a characteristic for each limit of each joint and of the chain; none of a method without intervals."""
    result: Result = run.result
    adjustment = result.adjustment
    if adjustment is None:
        return []
    judged: list[tuple[str | Message, Conformity]] = [
        *zip(adjustment.joints.name, adjustment.joints.conformity, strict=True),
        *((CHAIN, conformity) for conformity in adjustment.chain),
    ]
    found = []
    for name, limits in ((name, conformity.limits) for name, conformity in judged):
        for row, bounds_known in zip(limits.items(), limits.bounds_known, strict=True):
            clause = label(row["clause"])
            if not bounds_known:
                clause = text("{clause}; depends on a size that is not known", clause=clause)
            key = row["key"]
            of = text("{place} {what}", place=name, what=LIMITS.get(key, label(key)))
            worded = {"of": of, "what": label(row["what"]), "nominal": _nominal(key, scene), "clause": clause}
            found.append(Judged(**row | worded))
    return found


def _nominal(key: str, scene: Scene) -> float:
    """Return the design's value: of what departs from the design itself it is 0."""
    if key.startswith(GROOVE_GAP):
        return 0.0 if scene.tolerance is None else scene.tolerance.root_gap_mm
    if key.startswith(CHORDS):
        return design_span(scene.arch) if isinstance(scene.arch, ArchDesign) else NAN
    return 0.0
