"""The current folder as an input has the name of the folder, and is found again from results that lie in it."""

from pathlib import Path

from processor import pipeline
from processor.scan_folder import files
from processor.store import store


def test_the_current_folder_has_a_name_and_is_found_around_its_results(tmp_path, monkeypatch):
    folder = tmp_path / "bridge"
    (folder / "R").mkdir(parents=True)
    monkeypatch.chdir(folder)
    assert files.existing(Path(".")) == folder
    assert files.existing(Path("R")) == Path("R")
    monkeypatch.setattr(store, "read_provenance", lambda path: {"input": "bridge"})
    assert pipeline.find_input(Path("R/results.h5")) == folder
