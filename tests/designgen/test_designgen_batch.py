"""Folders of scenes: the same bytes whoever makes them, taken up after a kill, failures recorded, usage refused."""

import csv
import fcntl
import functools
import hashlib
import json
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
from pathlib import Path

import h5py
import numpy as np
import pytest

from designgen import batch, recipe_files
from processor.jobs import process as processes
from processor.jobs import runner
from processor.jobs.child import Loss, Lost
from processor.model import UsageError
from processor.store import store
from tests.support.processes import commands, dask_cluster, dying_job
from tests.support.processes.staying import processes_stay  # noqa: F401

COMMAND = (sys.executable, "-m", "designgen", "make", "frame-small")
SMALL = ("scan.spacing_mm=60", "frame.nodes_x=2", "frame.nodes_y=2")
MAKE = (*COMMAND, *(part for setting in SMALL for part in ("--set", setting)))
LONG = (*COMMAND, "--set", "scan.spacing_mm=25", "--set", "frame.nodes_x=2")  # a second: time to kill the run
COUNTS = ["points", "scans", "points_surface", "points_mixed", "points_outlier", "defects"]
COLUMNS = ["file", "recipe", "seed", "split", *COUNTS, "scene_hash", "sha256", "status", "reason"]
OF_SET = ["card.json", "card.md"]
SCENES_OF_KILLED_RUNS = 8
MARK = "STARTED_FOR"


def run(*arguments, code=0, command=MAKE, stderr=None):
    """Run the command line in this process, whatever processes it starts itself."""
    done = commands.here("designgen", *command[3:], *arguments, stderr=stderr)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done


def digests(folder):
    """SHA-256 of every file in a folder, hidden ones too, by name."""
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.iterdir()}


def rows(folder):
    with (folder / "index.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def scenes(folder):
    return sorted(p.name for p in folder.iterdir() if p.suffix == ".h5")


def times(folder):
    return {p.name: p.stat().st_mtime_ns for p in folder.iterdir() if p.suffix == ".h5"}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two seeds made by one process; not to be changed."""
    folder = tmp_path_factory.mktemp("batch") / "set"
    run("-o", folder, "--count", 2, "--seed", 7)
    return folder


def copied(folder, to):
    to.mkdir()
    for path in folder.iterdir():
        (to / path.name).write_bytes(path.read_bytes())
    return to


# --- what is made -----------------------------------------------------------------------------------------------------


def test_index_states_the_hashes_and_counts_of_the_files(made):
    assert scenes(made) == [f"frame-small-0000{i}-seed{6 + i}.h5" for i in (1, 2)]
    assert sorted(os.listdir(made)) == [*OF_SET, *scenes(made), "index.csv"]
    found = rows(made)
    assert list(found[0]) == COLUMNS
    for row, name, seed in zip(found, scenes(made), ("7", "8"), strict=True):
        path = made / name
        with h5py.File(path) as file:  # the bytes and the counts, read without the code under test
            counts = [len(scan["part"]) for scan in file["truth/labels"].values()]
            sources = [np.bincount(scan["source"], minlength=3) for scan in file["truth/labels"].values()]
        assert row["file"] == name
        assert (row["recipe"], row["seed"], row["status"], row["reason"]) == ("frame-small", seed, "done", "")
        assert (int(row["scans"]), int(row["points"])) == (len(counts), sum(counts))
        assert [int(row[f"points_{name}"]) for name in ("surface", "mixed", "outlier")] == np.sum(sources, 0).tolist()
        assert row["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        assert row["scene_hash"] == store.scene_hash(store.read_scene(path))
    assert len({row["scene_hash"] for row in found}) == 2


def test_two_processes_make_the_same_bytes_and_so_does_a_single_scene(made, tmp_path):
    said = json.loads(run("-o", tmp_path / "two", "--count", 2, "--seed", 7, "--jobs", 2, "--json").stdout)
    assert digests(tmp_path / "two") == digests(made)
    assert (said["scenes"], said["done"], said["made"], said["kept"], said["failed"]) == (2, 2, 2, 0, [])
    assert said["points"] == sum(int(row["points"]) for row in rows(made))
    run("-o", tmp_path / "one.h5", "--seed", 8)
    assert (tmp_path / "one.h5").read_bytes() == (made / "frame-small-00002-seed8.h5").read_bytes()


def test_every_combination_in_the_order_given(tmp_path):
    varied = ("--vary", "scan.spacing_mm=30, 20", "--vary", "frame.radii_mm=[45.0, 50.0],[60.0]")
    run("-o", tmp_path / "set", *varied, command=(*COMMAND, "--set", "frame.nodes_x=2", "--set", "frame.nodes_y=2"))
    found = rows(tmp_path / "set")
    assert list(found[0]) == [*COLUMNS[:4], "scan.spacing_mm", "frame.radii_mm", *COLUMNS[4:]]
    pairs = [(row["scan.spacing_mm"], row["frame.radii_mm"]) for row in found]
    assert pairs == [("30", "[45.0, 50.0]"), ("30", "[60.0]"), ("20", "[45.0, 50.0]"), ("20", "[60.0]")]
    for row, radii in zip(found, [{45.0, 50.0}, {60.0}] * 2, strict=True):
        assert row["seed"] == "1"  # the recipe's own
        frame = store.read_scene(tmp_path / "set" / row["file"]).frame
        assert set(np.unique(frame.radii)) == radii
    # A point in a square of the spacing: of 5 balls and 8 members 5,000 and more, so three standard deviations.
    assert int(found[2]["points"]) / int(found[0]["points"]) == pytest.approx((30 / 20) ** 2, rel=0.05)


def test_more_seeds_later_leave_the_numbers_as_they_were(tmp_path):
    name, recipe = recipe_files.load("frame-small")
    varied = {"scan.spacing_mm": ["60", "80"], "scan.sigma_mm": ["0", "1"]}
    few, many = (batch.plan(tmp_path, name, recipe, varied, 4, count) for count in (2, 5))
    assert many[:8] == few
    assert [job.seed for job in few] == [4] * 4 + [5] * 4
    assert [job.varied for job in few[:4]] == [("60", "0"), ("60", "1"), ("80", "0"), ("80", "1")]


@pytest.mark.parametrize("name", ["../../../etc/x", "-rf", ".hidden", "a b;c|d", "桥 东/西", "x" * 300])
def test_file_names_are_safe(name, tmp_path):
    (job,) = batch.plan(tmp_path, name, {"kind": "space-frame"}, {}, None, 1)
    assert "/" not in job.file
    assert job.file[0] not in ".-"
    assert not re.search(r"[\s;|]", job.file)
    assert len(job.file.encode()) < 220
    (tmp_path / job.file).touch()


# --- run again --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("index", [None, "file,points\nframe-small-00001-seed7.h5,many\n", "\x00\xff\n,,,\n"])
def test_existing_scenes_are_kept_on_a_second_run_whatever_the_index(made, tmp_path, index):
    folder = copied(made, tmp_path / "set")
    when = times(folder)
    (folder / "index.csv").unlink()
    if index is not None:
        (folder / "index.csv").write_text(index, "latin-1")
    said = json.loads(run("-o", folder, "--count", 2, "--seed", 7, "--json").stdout)
    assert (said["made"], said["kept"]) == (0, 2)
    assert (digests(folder), times(folder)) == (digests(made), when)


def test_scenes_of_other_parameters_are_made_again_with_a_message(made, tmp_path):
    folder = copied(made, tmp_path / "set")
    done = run("-o", folder, "--count", 2, "--seed", 7, "--set", "scan.sigma_mm=0")
    assert done.stderr.count("was made with other parameters; made again") == 2
    assert not set(digests(folder).values()) & set(digests(made).values())
    done = run("-o", folder, "--count", 1, "--seed", 7)
    assert done.stderr.count("made again") == 1
    assert "1 scene(s) of other runs are left as they are, e.g. frame-small-00002-seed8.h5" in done.stderr
    assert [row["sha256"] for row in rows(folder)] == [row["sha256"] for row in rows(made)[:1]]


def test_other_software_is_made_again(made, tmp_path, monkeypatch):
    monkeypatch.setattr(batch, "__version__", "9.9")
    folder = copied(made, tmp_path / "set")
    name, recipe = recipe_files.load("frame-small")
    job = batch.plan(folder, name, recipe_files.overridden(recipe, list(SMALL)), {}, 7, 1)[0]
    outcome = batch.run_job(job)
    assert outcome.made
    assert outcome.replaced == "was made with other software; made again"
    assert store.read_provenance(folder / job.file)["software"]["designgen"] == "9.9"


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)


def cut(path):
    path.write_bytes(path.read_bytes()[:-1000])


@pytest.mark.parametrize("damage", [flip, cut, lambda path: path.write_text("no scene")])
def test_damaged_scene_is_made_again_with_a_message(made, tmp_path, damage):
    folder = copied(made, tmp_path / "set")
    damage(folder / "frame-small-00002-seed8.h5")
    if damage is cut:  # seen without an index, too
        (folder / "index.csv").unlink()
    done = run("-o", folder, "--count", 2, "--seed", 7)
    assert "1 made now" in done.stdout
    assert damage is cut or re.search(r"00002-seed8\.h5: is damaged.*made again", done.stderr)
    assert done.stderr.count("made again") == 1
    assert digests(folder) == digests(made)


def test_leftovers_are_removed_and_other_files_are_not(made, tmp_path):
    folder = copied(made, tmp_path / "set")
    for name in (f".{'0a' * 8}.steel-scan-check", ".notes.steel-scan-check"):
        (folder / name).mkdir()
        (folder / name / "index.csv").write_text("half")
    (folder / "mine.tmp").write_text("half")
    run("-o", folder, "--count", 2, "--seed", 7)
    assert set(os.listdir(folder)) - set(os.listdir(made)) == {"mine.tmp", ".notes.steel-scan-check"}


# --- stopped and killed -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What runs that are killed must come to in the end."""
    folder = tmp_path_factory.mktemp("whole") / "set"
    run("-o", folder, "--count", SCENES_OF_KILLED_RUNS, command=LONG)
    return folder


def started(folder, *more):
    command = [*LONG, "-o", folder, "--count", SCENES_OF_KILLED_RUNS, *more]
    # A shell in the background hands down interrupts that are ignored; here they are to arrive.
    listening = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    return subprocess.Popen(
        [*map(str, command)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=listening,
        env={**os.environ, MARK: str(folder)},
    )


def until_scenes(folder, number, process):
    """Wait until a run has made some scenes and is still at work."""
    commands.until(lambda: process.poll() is not None or (folder.exists() and len(scenes(folder)) >= number))
    assert process.poll() is None, process.communicate()[1]
    assert len(scenes(folder)) < SCENES_OF_KILLED_RUNS, "too late to disturb it"


def members(folder):
    """Processes alive that were started for a folder, by their environment in /proc; zombies have none."""
    mark, found = f"{MARK}={folder}\0".encode(), []
    for environ in Path("/proc").glob("[0-9]*/environ"):
        try:
            if mark in environ.read_bytes():
                found.append(int(environ.parent.name))
        except OSError:
            continue
    return found


def until_gone(folder):
    commands.until(lambda: not members(folder), 10)


def same_as(whole, folder):
    """Names of the scenes of a folder, which are whole: no half file has a final name."""
    for name in scenes(folder):
        assert (folder / name).read_bytes() == (whole / name).read_bytes()
    return scenes(folder)


def test_killed_or_stopped_and_run_again(whole, tmp_path):
    """A kill, then Ctrl-C, each after a scene of that run; a run beside them is refused."""
    folder = tmp_path / "set"
    process = started(folder)
    until_scenes(folder, 1, process)
    assert "another designgen" in run("-o", folder, "--count", 2, code=2).stderr
    assert len(members(folder)) >= 2  # the command and what makes scenes for it
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL, "killed too late"
    until_gone(folder)  # what it started goes with it
    kept = len(same_as(whole, folder))
    assert not (folder / "index.csv").exists()
    (folder / f".{'0a' * 8}.steel-scan-check").mkdir(exist_ok=True)
    process = started(folder)
    until_scenes(folder, kept + 1, process)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    assert "Traceback" not in said
    assert re.search(r"stopped: \d+ of 8 scene\(s\) are done; run again to go on", said)
    assert sorted(os.listdir(folder)) == same_as(whole, folder), "neither an index nor temporary files"
    until_gone(folder)
    when = times(folder)
    run("-o", folder, "--count", SCENES_OF_KILLED_RUNS, command=LONG)
    assert digests(folder) == digests(whole)
    assert when == {name: at for name, at in times(folder).items() if name in when}


# One handler is for both signals, and what the run starts leads groups of its own, to which neither comes.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("sent", "code", "to_all"), [(signal.SIGTERM, 143, False), (signal.SIGTERM, 143, True), (signal.SIGINT, 130, False)]
)
def test_stops_cleanly(whole, tmp_path, sent, code, to_all):
    folder = tmp_path / "set"
    process = started(folder, "--jobs", 2)
    until_scenes(folder, 2, process)
    os.killpg(process.pid, sent) if to_all else process.send_signal(sent)
    _, said = process.communicate(timeout=60)
    assert process.returncode == code, said
    assert "Traceback" not in said
    assert sorted(os.listdir(folder)) == same_as(whole, folder), "neither an index nor temporary files"
    until_gone(folder)


@pytest.mark.slow
def test_dying_process_loses_its_job_alone(tmp_path):
    do = functools.partial(processes.in_process, dying_job.kill_own_process)
    found = {path.name: result for path, result in runner.Local(2).run(do, [tmp_path / "always", tmp_path / "once"])}
    assert found["always"] == Lost(Loss.DIED)
    assert batch.LOSSES[found["always"].loss].startswith("the process that made it died twice")
    assert found["once"][:2] == ("once", "1")
    assert os.getpid() != found["once"][2]


# --- failures and usage -----------------------------------------------------------------------------------------------


def test_a_combination_that_fails_is_recorded_and_the_rest_goes_on(tmp_path):
    first = run("-o", tmp_path / "set", "--vary", "frame.depth_mm=-5,2100", code=1)
    found = rows(tmp_path / "set")
    assert [row["status"] for row in found] == ["failed", "done"]
    assert "depth_mm" in found[0]["reason"]
    assert [found[0][key] for key in ("points", "scans", "scene_hash", "sha256")] == [""] * 4
    assert f"{found[0]['file']}: failed: {found[0]['reason']}" in first.stderr
    assert scenes(tmp_path / "set") == [found[1]["file"]]
    before = digests(tmp_path / "set")
    said = json.loads(run("-o", tmp_path / "set", "--vary", "frame.depth_mm=-5,2100", "--json", code=1).stdout)
    assert said["failed"] == [{"file": found[0]["file"], "reason": found[0]["reason"]}]
    assert (said["made"], said["kept"]) == (0, 1)
    assert digests(tmp_path / "set") == before
    elsewhere = tmp_path / "another folder"
    run("-o", elsewhere, "--vary", "frame.depth_mm=-5,2100", "--jobs", 2, code=1)
    assert digests(elsewhere) == before


def test_all_failed_is_wrong_usage_and_leaves_no_older_scene_under_a_name(made, tmp_path):
    folder = copied(made, tmp_path / "set")
    run("-o", folder, "--count", 1, "--seed", 7, "--set", "frame.depth_mm=-5", code=2)
    assert scenes(folder) == scenes(made)[1:]
    assert [row["status"] for row in rows(folder)] == ["failed"]


def test_job_of_other_software_than_its_worker_writes_no_files(made, tmp_path):
    folder = copied(made, tmp_path / "set")
    name, recipe = recipe_files.load("frame-small")
    job = batch.plan(folder, name, recipe, {}, 7, 1)[0]
    job.software["numpy"] = "0.1"
    outcome = batch.run_job(job)
    assert outcome.content is None
    assert re.fullmatch(r"a worker has other software: numpy \S+, not 0\.1; .*", outcome.reason)
    assert digests(folder) == digests(made)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--count", "0"], "--count"),
        (["--count", "2", "--jobs", "0"], "--jobs"),
        (["--count", "100000"], "at most 99,999"),
        (["--count", "2", "--seed", str(2**63)], "below 2^63"),
        (["--vary", "scan.sigma_mm"], "expected section.key=v1,v2"),
        (["--vary", "scan.sigma_mm="], "an empty one"),
        (["--vary", "scan.sigma_mm=1,,2"], "an empty one"),
        (["--vary", "scan.sigma_mm=1,2,1"], "1 is given twice"),
        (["--vary", "frame.radii_mm=[45.0"], "not closed"),
        (["--vary", "seed=1,2"], "--seed and --count"),
        (["--vary", "scan.sigma_mm=1", "--vary", "scan.sigma_mm=2"], "varied twice"),
        (["--vary", "scan.spacing_mm=50"], "set by --set as well"),
        (["--vary", "kind.x=1"], "kind is not a section"),
        (["--jobs", "2"], "add --count or --vary"),
        (["--cluster", "tcp://127.0.0.1:1"], "add --count or --vary"),
        (["--count", "2", "--cluster", "tcp://127.0.0.1:1", "--jobs", "2"], "exclude each other"),
        (["--count", "2", "--set", "seed=-1"], "expected a whole number"),
    ],
)
def test_usage_refused(arguments, says, tmp_path):
    done = run("-o", tmp_path / "set", *arguments, code=2)
    assert says in done.stderr
    assert not (tmp_path / "set").exists()


def test_a_file_where_the_folder_should_be_and_the_other_way_round(made, tmp_path):
    (tmp_path / "file").write_text("mine")
    assert "many scenes need a folder" in run("-o", tmp_path / "file", "--count", 2, code=2).stderr
    assert "many scenes need a folder" in run("-o", tmp_path / "file" / "set", "--count", 2, code=2).stderr
    assert (tmp_path / "file").read_text() == "mine"
    assert "this is a folder" in run("-o", made, code=2).stderr


def test_progress_bar_is_shown_on_a_terminal_alone(made, tmp_path):
    folder = copied(made, tmp_path / "set")
    assert run("-o", folder, "--count", 2, "--seed", 7).stderr == ""
    try:
        ours, theirs = pty.openpty()
    except OSError:
        pytest.skip("this machine has no pseudo-terminals")
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    with os.fdopen(theirs, "w") as terminal:
        done = run("-o", folder, "--count", 2, "--seed", 7, "--json", stderr=terminal)
        shown = os.read(ours, 100_000).decode()
    os.close(ours)
    assert "2/2" in shown
    assert json.loads(done.stdout)["kept"] == 2


# --- on a cluster -----------------------------------------------------------------------------------------------------


@pytest.fixture
def cluster(tmp_path):
    with dask_cluster.forked(tmp_path) as one:
        yield one


def test_without_dask_the_error_states_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(UsageError, match=r"pip install 'steel-scan-check\[cluster\]'"),
        runner.executor("tcp://x:1", 1, print),
    ):
        pass
