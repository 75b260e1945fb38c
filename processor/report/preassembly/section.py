"""How preassembly reports."""

from __future__ import annotations

import collections
from collections.abc import Sequence

import numpy as np

from processor.preassembly import step as preassembly_step
from processor.report import view
from processor.report.preassembly import figures, results, tables
from processor.report.section import StepReport
from processor.report.table import shown


def _summary(result: preassembly_step.Result) -> tuple[str, str]:
    placed = sum(status != "failed" for status in result.component_status)
    verdicts = collections.Counter(result.verdict)
    judged = ", ".join(f"{verdicts[name]} {name}" for name in ("pass", "fail", "indeterminate") if verdicts[name])
    halves = result.errors_ci95.tolist() or [float("nan")] * 4
    splicing = _mean_max(result.splicing_mean, result.splicing_max, halves[:2])
    linear = _mean_max(result.linear_mean, result.linear_max, halves[2:4])
    head = f"{result.status}, {placed} of {len(result.components)} parts placed"
    if result.judged:
        head = f"of {len(result.joints)} joints {judged}; assembly {head}"
    unverified = any((one.verified == 0).any() for one in (*result.judged, *result.chain_judged))
    said = f"Splicing error {splicing}. Linear error {linear}. Joints: {judged or 'none'}."
    said += "".join(f" Whole chain: {one.verdict}." for one in result.chain_judged if one.key)
    return head, said + (" The limits are NOT VERIFIED against the standard's text." if unverified else "")


def _mean_max(mean: float, largest: float, halves: Sequence[float]) -> str:
    shown_of = [
        f"{shown(value)} ± {shown(half)}" if np.isfinite(half) else shown(value)
        for value, half in zip((mean, largest), halves, strict=True)
    ]
    return f"{shown_of[0]} mm mean, {shown_of[1]} mm at most"


def _further(result: preassembly_step.Result) -> list[tuple[str, str]]:
    """Say beside the verdict what the adjustment knows of the whole bridge."""
    if not result.measures:
        return []
    span = f"{shown(result.span_departure)} ± {shown(result.span_ci95)} mm against the design"
    shift = " / ".join(
        f"{shown(value)} ± {shown(half)}"
        for value, half in zip(result.closure[:3].tolist(), result.closure_ci95[:3].tolist(), strict=True)
    )
    known = np.isfinite(result.closure).any()
    closure = f" Closure by the joints alone, along / across / up: {shift} mm." if known else ""
    rows = (
        ("Span", f"{span}.{closure}" if np.isfinite(result.span_departure) else ""),
        ("What limits the accuracy", result.limiting),
        ("Which scan would help", result.advice),
    )
    return [(head, text) for head, text in rows if text]


REPORT = StepReport(
    title="Preassembly",
    summary=_summary,
    written=results.written,
    tables=tables.of_runs,
    figures=lambda execution, runs, _: figures.of_runs(execution.scene, runs),
    further=_further,
    live=view.of_runs,
)
