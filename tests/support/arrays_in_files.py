"""Arrays of a few rows are put into files, and passed over in blocks of a few rows."""

import pytest

from processor import large_arrays


def limit(monkeypatch: pytest.MonkeyPatch, block_rows: int, at_once: int | None = None) -> None:
    """Put every array of ``large_arrays.in_files`` into a file, and set the rows of a block and of a selection."""
    monkeypatch.setattr(large_arrays, "MEMORY_BYTES", 0)
    monkeypatch.setattr(large_arrays, "LEAST_BYTES", 1)
    monkeypatch.setattr(large_arrays, "BLOCK_ROWS", block_rows)
    if at_once is not None:
        monkeypatch.setattr(large_arrays, "AT_ONCE", at_once)
