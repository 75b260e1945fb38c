"""Outputs are made in temporary folders beside them; what a killed process left there is removed."""

import os
import signal
import subprocess
import sys

import pytest

from processor.model import InputError, UsageError
from processor.store import making, whole_output
from processor.store.whole_output import replace_text, whole_folder

PROGRAM = """
import sys, time
import signal
from pathlib import Path
import click
# A shell lets what it starts in the background ignore SIGINT, and so do the tests and what they start.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, 0), (signal.SIGHUP, 0)):
    signal.signal(number, handler)
from processor.jobs import program
from processor.store.whole_output import whole_folder
from processor.store.whole_output import whole_folder
@click.command()
@click.argument("out", type=Path)
def command(out):
    with whole_folder(out) as made:
        (made / "half").write_text("half")
        print("begun", flush=True)
        time.sleep(60)
program.run(command, lambda line: print(line, file=sys.stderr))
"""


def begun(out):
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, out], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "begun\n"
    return process


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_signal_ends_a_command_as_ctrl_c_does(tmp_path, number):
    process = begun(tmp_path / "out")
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert (process.returncode, said.strip()) == (128 + number, f"stopped by {number.name}")
    assert os.listdir(tmp_path) == []


def test_what_a_killed_command_left_is_removed_and_what_another_uses_is_not(tmp_path):
    other, killed = begun(tmp_path / "other"), begun(tmp_path / "out")
    killed.kill()
    killed.communicate()
    (tmp_path / ".out-holidays").mkdir()  # not ours
    assert len(os.listdir(tmp_path)) == 3
    making.remove_leftovers(tmp_path)
    assert len(os.listdir(tmp_path)) == 2
    other.kill()
    other.communicate()
    making._cleared.discard(tmp_path)  # as another process has not
    with whole_folder(tmp_path / "new"):
        pass
    assert sorted(os.listdir(tmp_path)) == [".out-holidays", "new"]


def test_results_that_were_being_replaced_when_a_command_was_killed_are_put_back(tmp_path):
    folder = tmp_path / f".{'0a' * 8}.steel-scan-check"
    for name in ("old/results", "new"):
        (folder / name).mkdir(parents=True)
    (folder / "old/results/report.html").write_text("earlier")
    making.remove_leftovers(tmp_path)
    assert (tmp_path / "results/report.html").read_text() == "earlier"
    assert os.listdir(tmp_path) == ["results"]


def test_a_log_stays_in_a_folder_that_is_replaced_and_is_still_written_to(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "old.csv").write_text("1")
    with (out / "run.log").open("a") as log:
        log.write("before\n")
        log.flush()
        with whole_folder(out, replaces=True) as made:
            (made / "report.html").write_text("new")
        log.write("after\n")
    assert sorted(os.listdir(out)) == ["report.html", "run.log"]
    assert (out / "run.log").read_text() == "before\nafter\n"


def test_a_file_is_replaced_only_by_its_suffix_and_where_it_is_a_plain_one(tmp_path):
    os.mkfifo(tmp_path / "pipe.h5")
    (tmp_path / "folder.h5").mkdir()
    for name, said in (
        ("scene.csv", "expected a scene .*, found .csv"),
        ("scene", "found no suffix"),
        ("pipe.h5", "device or pipe"),
        ("folder.h5", "is a folder"),
    ):
        with pytest.raises(UsageError, match=said):
            whole_output.check_file(tmp_path / name, ".h5", "a scene")
    with pytest.raises(InputError, match="device or pipe"):
        replace_text(tmp_path / "pipe.h5", "text")
    assert (tmp_path / "pipe.h5").is_fifo()
    whole_output.check_file(tmp_path / "new.H5", ".h5", "a scene")
    replace_text(tmp_path / "new.H5", "text")
