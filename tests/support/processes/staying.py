"""Processes that make scenes, kept for all tests of a file: each takes a second to load what it needs."""

from unittest import mock

import pytest

from processor.jobs import process


@pytest.fixture(scope="module", autouse=True)
def processes_stay():
    """Keep idle processes after a run, and end them after the file; autouse in the files that import it."""
    close = process.POOL.close
    with mock.patch.object(process.POOL, "close"):
        yield
    close()
