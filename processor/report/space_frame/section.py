"""The report of step ``spheres``."""

from __future__ import annotations

import collections
from collections.abc import Iterator

import numpy as np

from processor.language.messages import Message, text
from processor.model import NORMAL_95, Status, StepRun
from processor.pipeline import Execution
from processor.report.characteristics import with_interval
from processor.report.space_frame import dxf, figures, hanger_report, interactive_view, tables
from processor.report.step_report import StepReport
from processor.report.stitching import targets
from processor.report.table import decimals
from processor.space_frame.result import Flag, GaugeBasis, Gauges, MovementGauge, Result

MOST_NAMED = 3  # balls of a headline
MOST_TO_DO = 6  # balls named one by one


def _summary(result: Result) -> tuple[Message, Message | str]:
    flags = collections.Counter(result.balls.flag)
    counts = [
        text("{count} {flag}", count=flags[flag], flag=flag) for flag in Flag if flag is not Flag.OK and flags[flag]
    ]
    head = text(
        "{status}, {count} of {balls} balls without a flag",
        status=result.status,
        count=flags[Flag.OK],
        balls=len(result.balls),
    )
    if flagged := [k for k, flag in enumerate(result.balls.flag) if flag is not Flag.OK][: MOST_NAMED + 1]:
        named = [text("{node} {flag}", node=result.balls.names[k], flag=result.balls.flag[k]) for k in flagged]
        named[MOST_NAMED:] = [text("...")] if len(named) > MOST_NAMED else []
        head = text("{head} ({named})", head=head, named=named)
    located = [k for k in range(len(result.balls)) if np.isfinite(result.balls.centres[k]).all()]
    if len(located) <= MOST_NAMED and len(result.balls) <= MOST_NAMED:
        head = text("{each:;}", each=[head, *(_place(result, k) for k in located)])
    if result.gauges is not None:
        head = text("{head}; {movements}", head=head, movements=_movements(result, result.gauges))
    return head, text("Flagged: {counts}.", counts=counts) if counts else ""


def _place(result: Result, k: int) -> Message:
    """Say where a ball is, in metres, and how large."""
    balls = result.balls
    half = NORMAL_95 * np.sqrt(np.maximum(np.diag(balls.covariance[k]), 0.0))
    widest = float(half[:3].max())
    return text(
        "ball {name} at {x:.4f}, {y:.4f}, {z:.4f} m ± {centre} mm, radius {radius}",
        name=balls.names[k], **dict(zip("xyz", (balls.centres[k] / 1000.0).tolist(), strict=True)),
        centre=f"{widest:.{decimals(widest)}f}", radius=with_interval(balls.radii[k], half[3], "mm", ""),
    )  # fmt: skip


def _movements(result: Result, gauges: Gauges) -> Message:
    """Say by which gauge the movements are, how large, and how far the other gauge is from it."""
    size = result.balls.movement_size
    node, largest = result.balls.names[int(np.nanargmax(size))], float(np.nanmax(size))
    if gauges.gauge is MovementGauge.DESIGN:
        agreed = gauges.basis is GaugeBasis.AGREEMENT
        what = text("differences of coordinates (assumed)") if agreed else text("differences of coordinates")
        other = text("a best fit differs")
    else:
        what, other = text("what a best fit leaves"), text("differences of coordinates differ")
    by = text(
        "movements of nodes as {what}: up to {largest:.1f} mm (node {node})", what=what, largest=largest, node=node
    )
    if not len(gauges.difference):
        return by
    return text("{by}, {other} by up to {difference:.1f} mm", by=by, other=other, difference=gauges.largest_difference)


def _files(execution: Execution, run: StepRun) -> dict[str, bytes]:
    hangers = run.result.hangers
    files = {"nodes.dxf": dxf.drawing(run.result)} if len(run.result.tubes) or hangers is not None else {}
    if hangers is not None:
        files[hanger_report.STAKE_OUT] = hanger_report.stake_out(run.result)
    return files | targets.files(execution.scene)


def _why(result: Result) -> Iterator[Message]:
    """Yield the reasons of flags, the most frequent flag's ball first as an example; those of the step before them."""
    if (result.matching is not None and result.matching.status is not Status.OK) or not len(result.balls):
        yield from result.reasons
    balls = result.balls
    for flag in (Flag.NOT_FOUND, Flag.WRONG_SIZE, Flag.LOW_CONFIDENCE):
        rows = [row for row, one in enumerate(balls.flag) if one is flag]
        if rows:
            ball = balls.names[rows[0]]
            yield text(
                "{count} {flag}, e.g. ball {ball}: {reasons}",
                count=len(rows), flag=flag, ball=ball, reasons=balls.reasons[rows[0]],
            )  # fmt: skip


def _to_do(result: Result) -> Iterator[Message]:
    """Yield the balls to look at, and why."""
    flagged = [k for k, flag in enumerate(result.balls.flag) if flag is not Flag.OK]
    for k in flagged[:MOST_TO_DO]:
        reasons = text("{reasons:;}", reasons=result.balls.reasons[k])
        yield text("ball {name} ({flag}): {reasons}", name=result.balls.names[k], flag=result.balls.flag[k],
                   reasons=reasons)  # fmt: skip
    if len(flagged) > MOST_TO_DO:
        yield text("and {count} more", count=len(flagged) - MOST_TO_DO)


REPORT = StepReport(
    title=text("Bolt balls"),
    summary=_summary,
    tables=tables.step_tables,
    figures=lambda execution, runs, report: figures.draw(execution.scene, runs, report, execution.stored),
    files=_files,
    to_do=_to_do,
    characteristics=tables.characteristics,
    callouts=tables.callouts,
    sheet_tables=tables.listed,
    why=_why,
    interactive_data=interactive_view.interactive_data,
)
