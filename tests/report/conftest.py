"""One browser for all files of tests of pages."""

import pytest

from tests.support.pages import browser


@pytest.fixture(scope="package", autouse=True)
def browser_of_a_file():
    """Close the browser after the last file of this folder, instead of that of tests/conftest.py: starting takes long.

    It is not left open for other folders: its event loop is that of the process, and Dask wants its own.
    """
    yield
    browser.SHARED.close()
