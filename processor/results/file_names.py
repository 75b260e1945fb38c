"""Names of the files of a folder of results, and of the format of results.json."""

from __future__ import annotations

RESULTS_JSON, RESULTS_H5, REPORT_PAGE = "results.json", "results.h5", "report.html"
FIGURES = "figures"
STEPS = "steps"  # of the stages of steps, on request
JOB_RECORD = "job.json"  # of a batch
FORMAT, FORMAT_VERSION = "processor-results", "1.0"
