"""Figures of a run, drawn by Matplotlib without a screen: PNG bytes by file name."""

from __future__ import annotations

import matplotlib as mpl

from processor.evaluate import ErrorReport
from processor.pipeline import Execution
from processor.report import figures_balls, figures_preassembly
from processor.report.drawing import Drawn
from processor.report.tables import grouped


def of_run(execution: Execution, report: ErrorReport) -> Drawn:
    """Draw all figures of a run: file name -> (caption, PNG)."""
    found: Drawn = {}
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams["text.parse_math"] = False  # a name from outside may hold dollar signs
        for run, others in grouped(execution.runs):
            runs = [run, *others]
            if run.step == "preassemble":
                found |= figures_preassembly.of_runs(execution.scene, runs)
            if run.step == "spheres":
                found |= figures_balls.of_runs(execution.scene, runs, report, execution.stored)
    return found
