"""What a run found, in a sentence a step: at the top of the page, of the terminal and of results.json."""

from __future__ import annotations

from processor.language.messages import Text, messages, text
from processor.model import StepRun
from processor.pipeline import Execution
from processor.report.step_report import step_report


def of_run(execution: Execution, lang: str = "en") -> str:
    """Return the headlines of all steps on one line."""
    return "; ".join(messages(lang).text(of_step(run)) for run, _ in execution.by_step())


def of_step(run: StepRun) -> Text:
    """Return the headline of one step."""
    report_of = step_report(run.step)
    return text("{step}: {head}", step=report_of.title, head=report_of.summary(run.result)[0])
