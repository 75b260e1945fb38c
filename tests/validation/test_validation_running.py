"""Cells in processes: they end with the one that started them, and on a cluster each cell's outcome comes back."""

import os
import subprocess
import sys
import time

import pytest

from processor.validation import cell_runner
from processor.validation.cells import Case, Cell, Outcome
from processor.writers import toml
from tests.support.processes.living import children, ends_soon
from tests.support.results import validation_nights

CELL = Cell(Case("frame", "frame-small", "", False, (), ("spheres",), ()), 1, True)
PARENT = """
import sys
from processor.validation import cell_runner
from tests.validation.test_validation_running import CELL
cell_runner.do(CELL, scratch=sys.argv[1])
"""


def test_a_cell_ends_with_the_process_that_started_it(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", PARENT, str(tmp_path)])
    deadline = time.monotonic() + 30.0
    while not (below := children(process.pid)) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert below
    process.kill()
    assert process.wait(10.0) == -9
    assert all(ends_soon(one) for one in below)


def test_a_cell_that_takes_too_long_fails(tmp_path):
    found = cell_runner.do(CELL, scratch=str(tmp_path), timeout_s=0.05)
    assert found.failed == "took longer than 0.05 s"
    assert list(tmp_path.iterdir()) == []


def test_parameters_are_written_as_toml():
    tomllib = pytest.importorskip("tomllib")

    table = {"spheres": {"radius_mm": 50.0, "catalogue": 'a "b"', "deep": {"list": [1.0, 2.0], "on": True}}}
    assert tomllib.loads(toml.document(table)) == table


def test_closing_the_runner_ends_running_cells(tmp_path):
    cell = Cell(validation_nights.case(), 1, True)
    started = time.monotonic()
    with cell_runner.cell_runner(None, 1, tmp_path, print) as run:
        coming = run([cell, cell])
        next(coming)  # fails soon: its recipe is no recipe
        coming.close()
    assert time.monotonic() - started < 60.0  # not the minutes that the cell would take
    assert list(tmp_path.iterdir()) == []


@pytest.mark.filterwarnings("ignore")
def test_cells_on_a_cluster(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")

    def do(cell):
        if cell.seed == 2:
            raise MemoryError("none left")
        return Outcome("", {"seed": cell.seed, "pid": os.getpid()}, 1.0, 1.0)

    monkeypatch.setattr(cell_runner, "do", do)
    cells = [Cell(validation_nights.case(), seed, True) for seed in (1, 2, 3)]
    with (
        distributed.LocalCluster(1, processes=False, threads_per_worker=2, dashboard_address=None) as cluster,
        cell_runner.cell_runner(cluster.scheduler_address, 1, tmp_path, print) as run,
    ):
        found = {cell.seed: outcome for cell, outcome in run(cells)}
    assert {seed: outcome.results.get("seed") for seed, outcome in found.items()} == {1: 1, 2: None, 3: 3}
    assert found[2].failed == "a worker could not run it (MemoryError: none left)"
