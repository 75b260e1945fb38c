"""Figures of a run, drawn by Matplotlib without a screen."""

from __future__ import annotations

import matplotlib as mpl

from processor.evaluation.evaluate import ErrorReport
from processor.pipeline import Execution
from processor.report.all_tables import grouped
from processor.report.step_report import step_report
from processor.report.style import CaptionedPngs


def draw_figures(execution: Execution, report: ErrorReport) -> dict[str, CaptionedPngs]:
    """Return by step the figures of a run: file name -> (caption, PNG)."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams["text.parse_math"] = False  # names from input may contain dollar signs
        return {
            run.step: step_report(run.step).figures(execution, [run, *others], report)
            for run, others in grouped(execution.runs)
        }
