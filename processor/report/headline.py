"""What a run found, in a sentence a step: at the top of the page, of the terminal and of results.json."""

from __future__ import annotations

from processor.language.messages import Message, Text, messages, text
from processor.model import Clips, StepRun, Verdict, worst
from processor.pipeline import Execution
from processor.report import characteristics, verdict_counts
from processor.report.reports_of_steps import characteristics_of, step_report

BANNER = {
    Verdict.PASS: text("PASS"),
    Verdict.FAIL: text("FAIL"),
    Verdict.INDETERMINATE: text("INDETERMINATE"),
    Verdict.NONE: text("No verdict"),
}
TO_CONFIRM = "Limits of {sources}: to be confirmed against the published text before verdicts are relied on."


def clipped(clips: Clips) -> Text:
    """Say how many points were left out of what was read."""
    return text(
        "{count:,} of {read:,} points clipped by {boxes} {boxes:?box|boxes}",
        count=clips.read - clips.kept,
        read=clips.read,
        boxes=len(clips.keep),
    )


def of_run(execution: Execution, lang: str = "en") -> str:
    """Return the answer on one line."""
    return "; ".join(messages(lang).text(sentence) for sentence in answer(execution))


def answer(execution: Execution, word: bool = True) -> list[Message]:
    """Return what was found, in sentences: what fails by how much, after the verdict if ``word``, then each step's."""
    runs = [run for run, _ in execution.by_step()]
    held = [one for run in runs for one in characteristics_of(execution.scene, run)]
    headlines: list[Message] = [of_step(run) for run in runs]
    verdict = worst(run.verdict for run in runs)
    if not held or verdict is Verdict.NONE:
        return headlines
    summary = characteristics.summary(held)
    return [text("{verdict}: {summary}", verdict=BANNER[verdict], summary=summary) if word else summary, *headlines]


def of_step(run: StepRun) -> Text:
    """Return the headline of one step."""
    report_of = step_report(run.step)
    head = report_of.summary(run.result)[0]
    limits = characteristics.limits_of(run)
    if limits is None:
        return text("{step}: {head}", step=report_of.title, head=head)
    verdicts = verdict_counts.summary(verdict_counts.LIMITS, limits.of, limits.verdict)
    return text("{step}: {head}; {verdicts}", step=report_of.title, head=head, verdicts=verdicts)


def to_confirm(execution: Execution) -> Text | None:
    """State which limits were used that were not compared with the published text of their standard; None of none."""
    runs = [run for run, _ in execution.by_step()]
    every = [(characteristics.limits_of(run), *step_report(run.step).limits(run.result)) for run in runs]
    used = [
        row
        for tables in every
        for one in tables
        if one is not None
        for row in zip(one.clause, one.verified, strict=True)
    ]
    sources = sorted({clause for clause, verified in used if clause and not verified})
    return text(TO_CONFIRM, sources=sources) if sources else None
