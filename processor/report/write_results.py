"""Write the folder of results, and check where it may be written."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from processor.evaluation.evaluate import ErrorReport
from processor.model import UsageError
from processor.pipeline import Execution
from processor.report import all_figures, all_tables, headline, page, pdf_report, workbook
from processor.report import table as report_table
from processor.report.reports_of_steps import step_report
from processor.report.sheet import content as sheet_content
from processor.report.style import default_settings
from processor.results.file_names import FIGURES, JOB_RECORD, REPORT_PAGE, RESULTS_H5, RESULTS_JSON, STEPS
from processor.results.to_json import results_json, text_of
from processor.store import store
from processor.store.whole_output import check_folder, is_log, whole_folder
from processor.writers import step_clouds

# The record of a batch's job is replaced with its results: without it, the batch does the job again.
OWN_NAMES = (RESULTS_JSON, RESULTS_H5, REPORT_PAGE, FIGURES, JOB_RECORD, STEPS)
OWN_ENDINGS = (".csv", ".dxf", ".pdf", ".xlsx")
STRUCTURE = "structure.png"  # the picture of the sheet
FURTHER = ("pdf", "xlsx")  # forms of the report that are written on request


def check_output(out: Path, source: Path | None, mark: str = RESULTS_JSON, names: Collection[str] = OWN_NAMES) -> None:
    """Raise UsageError for a folder with anything but earlier results and logs, as it will be replaced as a whole.

    Earlier results are recognised by the file ``mark`` among files of the ``names`` of results.
    """
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out}: is a file; name a folder for the results")
    if source is not None and source.resolve().is_relative_to(out.resolve()):
        raise UsageError(f"{out}: holds the input {source}, which the results would replace; name another folder")
    inside = sorted(path.name for path in out.iterdir() if not is_log(path)) if out.is_dir() else []
    if inside and mark not in inside:
        raise UsageError(f"{out}: is not empty and holds no earlier results; name another folder")
    others = [name for name in inside if name not in names and not name.endswith(OWN_ENDINGS)]
    if others:
        raise UsageError(f"{out}: holds more than earlier results ({others[0]}); take it out or name another folder")
    check_folder(out)


def write_results(
    out: Path, execution: Execution, report: ErrorReport, lang: str = "en", further: Collection[str] = ()
) -> None:
    """Write results.h5, results.json, CSV tables, figures, drawings and report.html into ``out``, in place of others.

    Only the page is in the language ``lang``. ``further`` names forms of the report, of FURTHER, that are written too.
    Raises InputError where they cannot be written, and leaves ``out`` as it was.
    """
    with whole_folder(out, replaces=True) as making:
        store.write_results(making / RESULTS_H5, execution.runs, execution.provenance)
        content = results_json(execution, report, headline.of_run(execution))
        (making / RESULTS_JSON).write_text(text_of(content), "utf-8")
        for table in all_tables.tables_of_run(execution, report):
            if table.file:
                (making / f"{table.file}.csv").write_text(report_table.csv_text(table), "utf-8")
        for run, _ in execution.by_step():
            for name, data in step_report(run.step).files(execution, run).items():
                (making / name).write_bytes(data)
        drawn = all_figures.draw_figures(execution, report)
        with default_settings():
            sheet = sheet_content.of(execution)
        if sheet.picture or any(of_step.figures for of_step in drawn.values()):
            (making / FIGURES).mkdir()
        if sheet.picture:
            (making / FIGURES / STRUCTURE).write_bytes(sheet.picture)
        for of_step in drawn.values():
            for name, (_, png) in of_step.figures.items():
                (making / FIGURES / name).write_bytes(png)
            for name, data in of_step.documents.items():
                (making / name).write_bytes(data)
        (making / REPORT_PAGE).write_text(page.html(execution, report, drawn, lang, sheet), "utf-8")
        if execution.clouds:
            stages = [
                step_clouds.OfRun(
                    run.step,
                    run.method,
                    [one.cloud for one in execution.clouds if (one.step, one.method) == (run.step, run.method)],
                    run.diagnostics,
                )
                for run in execution.runs
            ]
            step_clouds.write(making / STEPS, stages)
        if "pdf" in further:
            with default_settings():
                (making / pdf_report.NAME).write_bytes(pdf_report.document(execution, sheet, lang))
        if "xlsx" in further:
            (making / workbook.NAME).write_bytes(workbook.workbook(execution, report))
