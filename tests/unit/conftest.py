"""Fixtures of several test files."""

import json

import numpy as np
import pytest

from tests.support import browser, cad_in_process
from tests.support.scan_folders import BOX, arch_design, surface, write_ply, write_xyz


@pytest.fixture
def bridge(tmp_path):
    """A folder of two scans in metres and a design in mm."""
    place = tmp_path / "bridge"
    for i, name in enumerate(("foot1", "rib1")):
        write_xyz(place / f"scans/{name}.xyz", surface(i))
        write_ply(place / f"design/{name}.ply", (BOX + np.array([4.0 * i, 0, 0])) * 1000.0)
    (place / "design.json").write_text(json.dumps(arch_design()))
    return place


@pytest.fixture
def cad_here(monkeypatch):
    """CAD files are read by this process: see :mod:`tests.support.cad_in_process`."""
    cad_in_process.read_here(monkeypatch)


@pytest.fixture(scope="module", autouse=True)
def browser_of_a_file():
    """A browser that tests of a file have opened is closed with the last of them."""
    yield
    browser.SHARED.close()
