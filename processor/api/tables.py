"""Tables of a run as DataFrames of pandas (extra ``notebook``): columns have the names and units of its CSV files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from processor.evaluation.evaluate import ErrorReport
from processor.model import UsageError, did_you_mean
from processor.pipeline import Execution
from processor.report import all_tables
from processor.report.table import shown

if TYPE_CHECKING:
    import pandas as pd


def frame(execution: Execution, report: ErrorReport, *names: str) -> pd.DataFrame:
    """Return the first table that a run has of these names, those of CSV files without their ending.

    Raises UsageError where the run has none of them, ImportError without pandas.
    """
    try:
        import pandas as pd
    except ImportError:
        raise ImportError("tables need pandas: pip install 'steel-scan-check[notebook]'") from None
    tables = {table.file: table for table in all_tables.tables_of_run(execution, report) if table.file}
    found = next((tables[name] for name in names if name in tables), None)
    if found is None:
        raise UsageError(f"no table {names[0]!r}{did_you_mean(names[0], tables)}; this run has {', '.join(tables)}")
    rows = [[cell if isinstance(cell, int | float) else shown(cell) for cell in row] for row in found.rows]
    return pd.DataFrame(rows, columns=[column.name for column in found.columns])
