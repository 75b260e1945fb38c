"""Figures of a run, drawn by Matplotlib without a screen."""

from __future__ import annotations

from processor.evaluation.evaluate import ErrorReport
from processor.pipeline import Execution
from processor.report.reports_of_steps import step_report
from processor.report.style import Drawn, default_settings


def draw_figures(execution: Execution, report: ErrorReport) -> dict[str, Drawn]:
    """Return by step the figures and documents of a run."""
    with default_settings():
        return {
            run.step: step_report(run.step).figures(execution, [run, *others], report)
            for run, others in execution.by_step()
        }
