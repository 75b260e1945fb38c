"""Figures of a run, drawn by Matplotlib without a screen: PNG bytes by file name."""

from __future__ import annotations

import matplotlib as mpl

from processor.evaluation.evaluate import ErrorReport
from processor.pipeline import Execution
from processor.report import section
from processor.report.all_tables import grouped
from processor.report.style import Drawn


def of_run(execution: Execution, report: ErrorReport) -> dict[str, Drawn]:
    """Draw all figures of a run, by step: file name -> (caption, PNG)."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams["text.parse_math"] = False  # names from input may contain dollar signs
        return {
            run.step: section.of(run.step).figures(execution, [run, *others], report)
            for run, others in grouped(execution.runs)
        }
