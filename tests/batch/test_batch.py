"""Batches: inputs found, bad inputs recorded, killed batches resumed, and no half-written results."""

import csv
import fcntl
import html.parser
import json
import os
import pty
import random
import re
import shlex
import shutil
import signal
import struct
import subprocess
import termios
import time
import urllib.parse
from pathlib import Path

import numpy as np
import pytest

from processor.batch import batch, find_inputs, job, summary
from processor.batch.summary_values import summary_values
from processor.cli import main as cli_main
from processor.jobs import runner
from processor.model import InputError, UsageError
from processor.scan_folder import fingerprint
from tests.support.processes import dask_cluster
from tests.support.processes.batches import ENV, FAILING, REAL, ROOT, folder, run, run_one
from tests.support.processes.commands import until

SPHERES = ("--steps", "spheres", "--method", "least-squares", "--seed", "3")
SUMMARY = ("index.html", "summary.csv", "summary.json")


def command(*arguments):
    return [*FAILING, "batch", *map(str, arguments)]


def started(*arguments):
    return subprocess.Popen(command(*arguments), stderr=subprocess.PIPE, text=True, env=ENV, start_new_session=True)


def said(out):
    return {one["input"]: one for one in json.loads((out / "summary.json").read_text("utf-8"))["inputs"]}


def summaries(out):
    return [(out / name).read_bytes() for name in SUMMARY]


def attempts(out):
    """How often each input was begun, by its log."""
    logs = (out / "logs").rglob("*.log") if (out / "logs").is_dir() else ()
    return {str(one.relative_to(out / "logs"))[:-4]: one.read_text("utf-8", "replace").count("--- ") for one in logs}


def finished(out):
    """Inputs of which a result or a failure is kept; may be asked while they come to be."""
    done = set()
    for place, folders, names in os.walk(out):
        folders[:] = [name for name in folders if name != ".batch"]
        if "job.json" in names:
            done.add(str(Path(place).relative_to(out)))
    failed = [one for one in (out / ".batch/failed").glob("*.json") if not one.name.startswith(".")]
    return done | {json.loads(one.read_text("utf-8"))["input"] for one in failed}


def processes_of(mark):
    """Command lines with ``mark`` of living processes."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = path.read_bytes().replace(b"\0", b" ").decode("utf-8", "replace")
        except OSError:
            continue
        if mark in line:
            found.append(line)
    return found


# --- what is found --------------------------------------------------------------------------------------------------


def found_in(root, out="out"):
    found, left_out = find_inputs.find(root, root / out)
    return [one.name for one in found], left_out


def tree(root, *names):
    """Files below a folder; with a blank line in those of scans, so that they have a row."""
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("1 2 3\n" if name.endswith(".xyz") else "")
    return root


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (
            ("east/scan.xyz", "deep/er/west/scan.xyz", "named/scans/scan.xyz", "named/project.toml", "roof.h5",
             "plain/scans/scan.xyz", "designed/design.json", "target.e57", "集/扫描 '1'.ply", "closed/a.fls",
             "photos/p.jpg"),
            ["closed", "deep/er/west", "designed", "east", "named", "plain", "roof.h5", "target.e57", "集"],
        ),
        (("site/bridge/scan.xyz", "site/target.xyz"), ["site/bridge", "site/target.xyz"]),
        (("scan.xyz",), ["scan.xyz"]),
        (("project.toml", "scans/scan.xyz"), ["."]),
        (("scans/scan.xyz",), ["."]),
        (("scans/scan.xyz", "more/scan.xyz"), ["more", "scans"]),
    ],
    ids=["all kinds", "a scan beside a folder", "a scan", "a scan folder", "its scans alone", "two folders"],
)  # fmt: skip
def test_inputs_are_scan_folders_scenes_and_stray_scans(tmp_path, files, expected):
    assert found_in(tree(tmp_path, *files)) == (expected, {})


def test_tables_beside_scans_are_no_inputs(tmp_path):
    (tmp_path / "scan.xyz").write_text("1 2 3\n")
    for name in ("control.csv", "picks.csv", "deviation.csv", "index.csv"):
        (tmp_path / name).write_text("1,1000,2000,3000\n2,1000,2500,3000\n")
    assert found_in(tmp_path) == (["scan.xyz"], {})


def test_skipped_folders_files_and_links_are_reported_with_reasons(tmp_path):
    tree(tmp_path, "bridge/scan.xyz", "bridge/project.toml", "bridge/inner/scan.xyz", "bridge/inner/project.toml")
    (tmp_path / "README.txt").write_text("3 bridges, scanned on 4 May\n")
    (tmp_path / "points.txt").write_text("# from the scanner\nx;y;z\n1,5;2,5;3,25\n4,5;5,5;6,25\n")
    (tmp_path / "link").symlink_to("/")
    (tmp_path / "own link").symlink_to(tmp_path / "bridge")
    tree(tmp_path, "out/bridge/scan.xyz", "older/bridge/scan.xyz", "older/.batch/lock")
    (tmp_path / "run").mkdir()
    for name in ("results.json", "results.h5", "balls.csv"):
        (tmp_path / "run" / name).write_text("1,2,3\n4,5,6\n")
    names, left_out = found_in(tmp_path)
    assert names == ["bridge", "points.txt"]
    assert sorted(left_out) == ["README.txt", "bridge/inner", "link", "older", "own link", "run"]
    assert left_out["link"].code == "batch.link"
    assert left_out["run"].code == "batch.holds-results"


# --- the hash of an input -------------------------------------------------------------------------------------------


def test_content_hash_depends_on_bytes_and_names_alone(tmp_path):
    one = folder(tmp_path / "one")
    (one / "empty").mkdir()
    first = fingerprint.content_hash(one)
    shutil.copytree(one, tmp_path / "two")
    os.utime(tmp_path / "two/scan.xyz", (1, 1))
    assert fingerprint.content_hash(tmp_path / "two") == first
    folder(one / "out")
    assert fingerprint.content_hash(one, one / "out") == first
    changes = (
        lambda place: (place / "scan.xyz").rename(place / "scan.pts"),
        lambda place: (place / "scan.xyz").write_text("1 2 4\n"),
        lambda place: (place / "more").touch(),
        lambda place: folder(place / "out"),
    )
    for k, change in enumerate(changes):
        shutil.copytree(tmp_path / "two", tmp_path / f"changed {k}")
        change(tmp_path / f"changed {k}")
        assert fingerprint.content_hash(tmp_path / f"changed {k}") != first, k


def test_links_out_and_pipes_are_not_read(tmp_path):
    one = folder(tmp_path / "one")
    os.mkfifo(one / "pipe")
    (one / "link").symlink_to("/dev/zero")
    (one / "loop").symlink_to(one)
    assert fingerprint.content_hash(one) == fingerprint.content_hash(one)
    with pytest.raises(InputError, match="was deleted while it was read"):
        fingerprint.content_hash(tmp_path / "none")


# --- one bad input stops nothing ------------------------------------------------------------------------------------


PLANTS = {
    "segfault": "crashed: SIGSEGV (signal 11)",
    "hang": "took longer than 4 s (--timeout-s)",
    "memory": "needs more memory than 200 MB (--memory-mb)",
    "memory elsewhere": "needs more memory than 200 MB (--memory-mb)",
    "panic": "ended with exit code 1 and without results: BaseException: panicked at src/lib.rs",
    "exit 0": "ended with exit code 0 and without results: error: planted",
    "exit 3": "planted",
}


def test_every_way_to_fail_is_recorded_with_its_reason(tmp_path):
    for plant in PLANTS:
        folder(tmp_path / "root" / plant, plant)
    for name in ("good", "talk"):
        folder(tmp_path / "root" / name, name)
    limits = ("--timeout-s", 4, "--memory-mb", 200, "--jobs", 4)
    done = run(tmp_path / "root", "-o", tmp_path / "out", *limits, code=1)
    found = said(tmp_path / "out")
    assert {name: one["reason"] for name, one in found.items() if one["status"] == "failed"} == PLANTS
    assert [name for name, one in found.items() if one["status"] == "done"] == ["good", "talk"]
    assert "hang: failed: took longer" in done.stderr
    assert not processes_of(str(tmp_path))
    assert (tmp_path / "out/logs/talk.log").stat().st_size < 300_000
    # Failures are not tried again, but those of a limit where it is higher now, and all where that is asked for.
    before = attempts(tmp_path / "out")
    bytes_ = summaries(tmp_path / "out")
    run(tmp_path / "root", "-o", tmp_path / "out", *limits, code=1)
    assert attempts(tmp_path / "out") == before == dict.fromkeys(before, 1)
    assert summaries(tmp_path / "out") == bytes_
    run(tmp_path / "root", "-o", tmp_path / "out", "--timeout-s", 4.5, "--memory-mb", 200, code=1)
    assert attempts(tmp_path / "out") == before | {"hang": 2}
    run(tmp_path / "root", "-o", tmp_path / "out", *limits, "--retry", code=1)
    assert attempts(tmp_path / "out") == {**dict.fromkeys(PLANTS, 2), "hang": 3, "good": 1, "talk": 1}


def test_a_job_that_something_else_killed_is_tried_again(tmp_path):
    folder(tmp_path / "root/a", "killed")
    for count in (1, 2):
        run(tmp_path / "root", "-o", tmp_path / "out", code=1)
        assert said(tmp_path / "out")["a"]["reason"].startswith("was killed by another process")
        assert attempts(tmp_path / "out") == {"a": count}
    (tmp_path / "root/a/plant").write_text("")
    run(tmp_path / "root", "-o", tmp_path / "out")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Six inputs of the real processor, two of them bad, with its results; all in this process."""
    place = tmp_path_factory.mktemp("site")
    rng = np.random.default_rng(5)
    for i, name in enumerate(("a <b>&", "桥 '\"东", "c/d")):
        unit = rng.normal(size=(500, 3))
        points = np.array([1.0, 2.0, 3.0]) + (0.05 + 0.01 * i) * unit / np.linalg.norm(unit, axis=1)[:, None]
        (place / "root" / name).mkdir(parents=True)
        np.savetxt(place / "root" / name / "target.xyz", points, fmt="%.6f")
    (place / "root/cut").mkdir()
    (place / "root/cut/scan.ply").write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1000\nproperty float x\nproperty float y\n"
        b"property float z\nend_header\n" + bytes(600)
    )
    (place / "root/empty").mkdir()
    (place / "root/empty/project.toml").write_text('[[scan]]\nfile = "scans/none.ply"\n')
    shutil.copy(place / "root/c/d/target.xyz", place / "root/=stray.xyz")
    done = run(place / "root", "-o", place / "out", *SPHERES, code=1, program=None)
    return place, done


def copied(site, tmp_path):
    shutil.copytree(site[0], tmp_path / "site")
    return tmp_path / "site/root", tmp_path / "site/out"


class Links(html.parser.HTMLParser):
    def __init__(self):
        super().__init__()
        self.links, self.tags = [], set()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.links += [value for name, value in attrs if name in ("href", "src")]


def test_summary_of_real_inputs(site):
    place, done = site
    out = place / "out"
    found = said(out)
    assert list(found) == ["=stray.xyz", "a <b>&", "c/d", "cut", "empty", "桥 '\"东"]
    assert [one["status"] for one in found.values()] == ["done", "done", "done", "failed", "failed", "done"]
    assert "cut/scan.ply" in found["cut"]["reason"]
    assert "there is no file 'scans/none.ply'" in found["empty"]["reason"]
    assert found["c/d"]["balls_found"] == 1
    assert "4 done, 2 failed" in done.stdout
    rows = list(csv.DictReader((out / "summary.csv").read_text("utf-8").splitlines()))
    assert [row["input"] for row in rows] == ["'=stray.xyz", *list(found)[1:]]  # no formula for a spreadsheet
    page = Links()
    text = (out / "index.html").read_text("utf-8")
    page.feed(text)
    assert not page.tags & {"b", "script", "img"}, "names are text"
    page.links.remove("data:,")  # an empty icon, so that browsers ask for none
    assert "a &lt;b&gt;&amp;" in text
    for link in page.links:
        assert (out / urllib.parse.unquote(link)).is_file()
    assert {urllib.parse.unquote(link) for link in page.links} >= {"桥 '\"东/report.html", "logs/cut.log"}
    assert "seconds" in (out / "timings.csv").read_text("utf-8").splitlines()[0]
    single = json.loads((out / "c/d/results.json").read_text("utf-8"))
    assert (single["seed"], single["steps"]["spheres"]["method"]) == (3, "least-squares")
    assert single["steps"]["spheres"]["balls"][0]["radius"] == pytest.approx(70.0, abs=0.01)  # mm: digits of 1e-3


def test_a_job_is_the_processor_in_a_process_of_its_own(site, tmp_path):
    """As the command line runs it: the same bytes as in this process."""
    shutil.copytree(site[0] / "root/c", tmp_path / "root")
    run(tmp_path / "root", "-o", tmp_path / "out", *SPHERES, program=REAL)
    made = sorted(path.name for path in (site[0] / "out/c/d").iterdir())
    assert sorted(path.name for path in (tmp_path / "out/d").iterdir()) == made
    for name in ("results.json", "results.h5", "report.html"):
        assert (tmp_path / "out/d" / name).read_bytes() == (site[0] / "out/c/d" / name).read_bytes()
    assert not processes_of(str(tmp_path))


def test_only_changed_inputs_are_processed_again(site, tmp_path):
    root, out = copied(site, tmp_path)
    before, bytes_ = attempts(out), summaries(out)
    done = run(root, "-o", out, *SPHERES, "--json", code=1, program=None)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["event"] for line in lines] == ["input"] * 6 + ["summary"]
    assert all(line["kept"] for line in lines[:6])
    assert lines[-1]["counts"] == {"done": 4, "in-part": 0, "limit-missed": 0, "failed": 2}
    assert attempts(out) == before
    assert summaries(out) == bytes_
    with (root / "c/d/target.xyz").open("a") as file:
        file.write("1.07 2.0 3.0\n")
    shutil.copy(root / "c/d/target.xyz", root / "cut/scan.xyz")
    (root / "cut/scan.ply").unlink()
    (out / "a <b>&/results.json").write_text("{}")  # damaged
    shutil.rmtree(root / "桥 '\"东")
    run(root, "-o", out, *SPHERES, code=1, program=None)
    assert attempts(out) == before | dict.fromkeys(("c/d", "cut", "a <b>&"), 2)
    assert list(said(out)) == ["=stray.xyz", "a <b>&", "c/d", "cut", "empty"]
    assert said(out)["cut"]["status"] == "done"


def test_changed_parameters_or_software_run_an_input_again(tmp_path, monkeypatch):
    root, out = folder(tmp_path / "root/a").parent, tmp_path / "out"
    params, seeded = tmp_path / "p.toml", ("--seed", 1)
    params.write_text("[spheres]\nradius_mm = 50.0\n")
    for count, options in enumerate(((), seeded, ("--units", "mm"), ("--params", params), ("--steps", "spheres")), 1):
        for _ in range(2):
            run(root, "-o", out, *options)
            assert attempts(out)["a"] == count, options
    params.write_text("[spheres]\nradius_mm = 60.0\n")
    run(root, "-o", out, "--params", params)
    assert attempts(out)["a"] == 6
    monkeypatch.setattr(job, "software", lambda: {"processor": "another"})
    run(root, "-o", out, "--params", params)
    assert attempts(out)["a"] == 7


# --- killed and stopped -----------------------------------------------------------------------------------------------


def planted_site(root, count):
    """Folders of which five are bad, each in another way."""
    bad = dict(zip(range(3, count, count // 5), ("segfault", "hang", "memory", "panic", "exit 3"), strict=False))
    for i in range(count):
        folder(root / f"{i % 4}/bridge {i}", bad.get(i, ""), f"1 2 {i}\n")
    return ("--jobs", 2, "--timeout-s", 2, "--memory-mb", 200)


@pytest.mark.parametrize(("count", "kills"), [(12, 1), pytest.param(30, 3, marks=pytest.mark.slow)])
def test_killed_and_resumed_batch_equals_an_undisturbed_one(tmp_path, count, kills):
    limits = planted_site(tmp_path / "root", count)
    run(tmp_path / "root", "-o", tmp_path / "whole", *limits, code=1)
    assert [one["status"] for one in said(tmp_path / "whole").values()].count("failed") == 5
    rng, out = random.Random(6), tmp_path / "out"
    known, counts = set(), {}
    for share in range(1, kills + 1):
        process = started(tmp_path / "root", "-o", out, *limits)
        least = len(known) + rng.randint(3, 6)
        until(lambda least=least, process=process: len(finished(out)) >= least or process.poll() is not None, 300)
        time.sleep(rng.uniform(0, 0.2))
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        until(lambda: not processes_of(str(out)), 10)
        after = attempts(out)
        assert {name: after[name] for name in known} == {name: counts[name] for name in known}, f"kill {share}"
        known, counts = finished(out), after
        assert len(known) < count, "was killed too late to say anything"
        assert not (out / "summary.json").exists()
    run(tmp_path / "root", "-o", out, *limits, code=1)
    after = attempts(out)
    assert {name: after[name] for name in known} == {name: counts[name] for name in known}
    assert summaries(out) == summaries(tmp_path / "whole")
    assert sum(after.values()) <= count + kills * 2, "two at a time: a kill costs two jobs at most"
    for place in (out, tmp_path / "whole"):
        assert not [one for one in place.rglob("*") if one.name.startswith(".") and one.name != ".batch"]
        assert sorted(os.listdir(place / ".batch")) == ["failed", "lock"]
    names = [sorted(str(p.relative_to(place)) for p in place.rglob("*")) for place in (out, tmp_path / "whole")]
    assert names[0] == names[1]


def test_batch_killed_while_it_wrote_the_record_of_a_failure_goes_on(tmp_path):
    folder(tmp_path / "root/a")
    half = tmp_path / "out/.batch/failed" / f".{'0' * 16}.steel-scan-check"
    half.mkdir(parents=True)
    (half / "record.json").write_text("{")
    run(tmp_path / "root", "-o", tmp_path / "out")
    assert os.listdir(tmp_path / "out/.batch/failed") == []


@pytest.mark.parametrize("stop", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_signal_stops_it_cleanly(tmp_path, stop):
    folder(tmp_path / "root/a")
    folder(tmp_path / "root/b", "hang")
    folder(tmp_path / "root/c")
    out = tmp_path / "out"
    process = started(tmp_path / "root", "-o", out)
    until(lambda: attempts(out).get("b") and finished(out) == {"a"})
    os.kill(process.pid, stop)
    _, said_ = process.communicate(timeout=20)
    assert process.returncode == 1
    assert "stopped: 1 of 3 inputs are done; run again to go on" in said_
    assert "Traceback" not in said_
    assert not processes_of(str(out))
    assert finished(out) == {"a"}
    assert not (out / ".batch/work").exists()


def test_child_process_that_ignores_signals_ends_at_its_time_limit(tmp_path):
    folder(tmp_path / "root/a", "deaf")
    run(tmp_path / "root", "-o", tmp_path / "out", "--timeout-s", 0.5, code=1)
    assert said(tmp_path / "out")["a"]["reason"].startswith("took longer")


def test_two_batches_in_one_folder_are_refused(tmp_path):
    folder(tmp_path / "root/a")
    run(tmp_path / "root", "-o", tmp_path / "out")
    with runner.locked(tmp_path / "out/.batch/lock", "as another batch holds it"):
        assert "another batch" in run(tmp_path / "root", "-o", tmp_path / "out", code=2).stderr


def test_progress_bar_is_shown_on_a_terminal_alone(tmp_path):
    folder(tmp_path / "root/a")
    assert run(tmp_path / "root", "-o", tmp_path / "out").stderr == ""
    try:
        ours, theirs = pty.openpty()
    except OSError:
        pytest.skip("this machine has no pseudo-terminals")
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    with os.fdopen(theirs, "w") as terminal:
        done = run(tmp_path / "root", "-o", tmp_path / "out", "--json", stderr=terminal)
        shown = os.read(ours, 100_000).decode()
    os.close(ours)
    assert "1/1" in shown
    assert json.loads(done.stdout.splitlines()[0])["kept"] is True


# --- inputs that change, disks that are full --------------------------------------------------------------------------


def test_an_input_that_changes_while_it_runs_is_not_kept(tmp_path):
    folder(tmp_path / "root/a", "change")
    done = run(tmp_path / "root", "-o", tmp_path / "out", code=1)
    assert done.stderr.count("changed while it was processed") == 1
    assert not (tmp_path / "out/a").exists()
    assert finished(tmp_path / "out") == set()
    run(tmp_path / "root", "-o", tmp_path / "out")
    assert said(tmp_path / "out")["a"]["status"] == "done"


def test_results_of_an_input_that_is_bad_now_are_taken_away(tmp_path):
    folder(tmp_path / "root/a")
    run(tmp_path / "root", "-o", tmp_path / "out")
    (tmp_path / "root/a/plant").write_text("segfault")
    run(tmp_path / "root", "-o", tmp_path / "out", code=1)
    assert not (tmp_path / "out/a").exists()


def test_output_folder_with_foreign_files_is_not_changed(tmp_path):
    folder(tmp_path / "root/a")
    (tmp_path / "out/a").mkdir(parents=True)
    (tmp_path / "out/a/mine").write_text("mine")
    done = run(tmp_path / "root", "-o", tmp_path / "out", code=1)
    assert "a: is there and holds no results" in done.stderr
    assert (tmp_path / "out/a/mine").read_text() == "mine"


@pytest.fixture
def small_disk(tmp_path):
    """Mounts a file system of so many kilobytes, or one that cannot be written to."""
    place = tmp_path / "disk"
    place.mkdir()

    def mount(options):
        if subprocess.run(
            ["mount", "-t", "tmpfs", "-o", options, "tmpfs", place], capture_output=True, check=False
        ).returncode:
            pytest.skip("this user cannot mount file systems")
        return place

    yield mount
    if os.path.ismount(place):  # nothing that was read or written there is still open
        subprocess.run(["umount", place], check=True)


def test_a_full_disk_stops_the_batch_with_one_line_and_it_goes_on_later(tmp_path, small_disk):
    for i in range(6):
        folder(tmp_path / f"root/{i}", content="1 2 3\n" * 10_000)  # results of 200 kB
    out = small_disk("size=600k") / "out"
    done = run(tmp_path / "root", "-o", out, code=3)
    assert done.stderr.count("No space left on device") == 1
    assert "run again to go on" in done.stderr
    kept = finished(out)
    assert 1 <= len(kept) < 6
    assert sorted(os.listdir(out)) == sorted([".batch", "logs", *kept])
    for name in kept:
        assert json.loads((out / name / "results.json").read_text())["content"] == "1 2 3\n" * 10_000
    subprocess.run(["mount", "-o", "remount,size=4m", out.parent], check=True)
    run(tmp_path / "root", "-o", out)
    assert {name: attempts(out)[name] for name in kept} == dict.fromkeys(kept, 1)


@pytest.mark.parametrize("size", [4, 28])
def test_a_run_on_a_full_disk_leaves_nothing(site, small_disk, size):
    place = small_disk(f"size={size}k")
    source = site[0] / "root/c/d"
    done = run_one(source, "-o", place / "out", *SPHERES, code=3)
    assert done.stderr.splitlines()[-1].startswith(f"error: {place}/out")
    assert "cannot be written (No space left on device)" in done.stderr
    assert not os.listdir(place)


def test_unwritable_output_is_refused_before_the_work(tmp_path, site, small_disk):
    place = small_disk("ro")
    folder(tmp_path / "root/a")
    done = run(tmp_path / "root", "-o", place / "out", code=3)
    assert done.stderr.startswith(
        f"error: {place}/out/logs: cannot be written (Read-only file system); nothing was done"
    )
    done = run_one(site[0] / "root/c/d", "-o", place / "out", *SPHERES, code=3)
    assert f"error: {place}/out: cannot be written (Read-only file system)" in done.stderr


def test_a_run_whose_input_changes_writes_nothing(site, tmp_path, monkeypatch):
    from click.testing import CliRunner

    from processor.cli import main as cli_main
    from processor.evaluation import evaluate

    root, _ = copied(site, tmp_path)
    real = evaluate.evaluate

    def late(path, execution):
        with (path / "target.xyz").open("a") as file:
            file.write("1 2 3\n")
        return real(path, execution)

    monkeypatch.setattr(evaluate, "evaluate", late)
    done = CliRunner().invoke(cli_main.commands, ["run", str(root / "c/d"), "-o", str(tmp_path / "out"), *SPHERES])
    assert isinstance(done.exception, InputError)
    assert "target.xyz: changed while it was processed" in str(done.exception)
    assert not (tmp_path / "out").exists()


# --- usage ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["--jobs", "0"], 2, "--jobs"),
        (["--memory-mb", "1"], 2, "--memory-mb"),
        (["--jobs", "1", "--cluster", "tcp://127.0.0.1:1"], 2, "exclude each other"),
        (["--steps", "none"], 2, "no step 'none'"),
        (["--params", "/none.toml"], 2, "not a readable parameter file"),
    ],
)
def test_usage_refused(arguments, code, says, tmp_path):
    folder(tmp_path / "root/a")
    assert says in run(tmp_path / "root", "-o", tmp_path / "out", *arguments, code=code).stderr
    assert not (tmp_path / "out").exists()


def test_roots_and_outputs_refused(tmp_path):
    (tmp_path / "root").mkdir()
    (tmp_path / "file").touch()
    for root, out, error, says in (
        ("root", "out", InputError, "found none"),
        ("none", "out", InputError, "there is no such file or folder"),
        ("file", "out", InputError, "expected a folder, found a file"),
        ("root", ".", UsageError, "holds the inputs"),
        ("root", "root", UsageError, "holds the inputs"),
    ):
        with pytest.raises(error, match=says):
            batch.run(batch.Settings(tmp_path / root, tmp_path / out), print, print)
    folder(tmp_path / "root/a")
    with pytest.raises(InputError, match="is a file"):
        batch.run(batch.Settings(tmp_path / "root", tmp_path / "file"), print, print)
    (tmp_path / "root/a/project.toml").touch()
    with pytest.raises(UsageError, match="lies in the scan folder"):
        batch.run(batch.Settings(tmp_path / "root/a", tmp_path / "root/a/out"), print, print)


# --- figures ----------------------------------------------------------------------------------------------------------


def test_figures_of_all_steps():
    joints = [{"verdict": verdict} for verdict in ("pass", "indeterminate", "pass")]
    steps = {
        "preassemble": {
            "status": "ok", "joints": joints, "splicing_error": {"mean": 1.5, "max": 2.5},
            "linear_error": {"mean": None, "max": 4.0},
        },
        "spheres": {"status": "weak", "balls": [{"flag": f} for f in ("ok", "not-found", "wrong-size")]},
        "stitch": {"status": "ok", "scans": [{"status": "ok"}, {"status": "failed"}]},
        "deviation": {"status": "ok", "min": -3.0, "max": 2.0, "significant_share": 0.25},
        "defects": {"status": "ok", "defects": [{}, {}]},
    }  # fmt: skip
    results = {"steps": steps, "checks": [{"passed": True}, {"passed": False}], "verdict": "indeterminate"}
    assert summary_values(results) == {
        "steps": "preassemble, spheres (weak), stitch, deviation, defects", "verdict": "indeterminate",
        "joints_pass": 2, "joints_fail": 0, "joints_indeterminate": 1,
        "splicing_mean_mm": 1.5, "splicing_max_mm": 2.5, "linear_max_mm": 4.0,
        "balls_found": 2, "balls_flagged": 2, "scans_stitched": 1, "scans_not_stitched": 1,
        "deviation_min_mm": -3.0, "deviation_max_mm": 2.0, "deviation_significant_share": 0.25,
        "defects": 2, "checks_passed": 1, "checks_missed": 1,
    }  # fmt: skip
    assert summary_values({"steps": {}, "checks": [], "verdict": "fail"})["verdict"] == "fail"
    assert "verdict" not in summary_values({"steps": {}, "checks": [], "verdict": "none"})


def test_undecodable_names_are_shown_escaped():
    assert summary.readable("a\udcff\n") == "a\\xff\N{REPLACEMENT CHARACTER}"
    assert json.dumps(summary.readable("桥")) == '"\\u6865"'


# --- on a cluster -----------------------------------------------------------------------------------------------------


@pytest.fixture
def cluster(tmp_path):
    with dask_cluster.forked(tmp_path, environment=ENV) as one:
        yield one


@pytest.mark.slow
def test_lost_worker_changes_no_summary_and_lost_scheduler_is_reported(tmp_path, cluster):
    address, (scheduler, worker, _) = cluster
    for i in range(7):
        folder(tmp_path / f"root/{i}", "segfault" if i == 4 else "slow" if i == 5 else "", f"1 2 {i}\n")
    out = tmp_path / "out"
    process = started(tmp_path / "root", "-o", out, "--cluster", address)
    until(lambda: len(finished(out)) >= 2)
    worker.kill()
    _, text = process.communicate(timeout=120)
    assert process.returncode == 1, text
    assert "Traceback" not in text
    run(tmp_path / "root", "-o", tmp_path / "here", "--jobs", 4, code=1)
    assert summaries(out) == summaries(tmp_path / "here")
    counts = sorted(attempts(out).values())
    assert counts[:-1] == [1] * 6, "the worker's job alone was begun twice"
    assert counts[-1] <= 2
    # The same cluster, with the worker that it has left, loses its scheduler; the next run goes on without it.
    for i in range(3):
        folder(tmp_path / f"more/{i}", "slow", f"1 2 {i}\n")
    out = tmp_path / "of more"
    process = started(tmp_path / "more", "-o", out, "--cluster", address)
    until(lambda: len(finished(out)) >= 1)
    scheduler.kill()
    _, text = process.communicate(timeout=120)
    assert process.returncode == 3, text
    assert f"--cluster {address}: the connection is lost; run again to go on" in text
    assert "Traceback" not in text
    kept = finished(out)
    run(tmp_path / "more", "-o", out, "--jobs", 3)
    assert {name: attempts(out)[name] for name in kept} == dict.fromkeys(kept, 1)


@pytest.mark.slow
def test_a_cluster_with_tls_as_the_page_describes_takes_only_those_with_the_key(tmp_path):
    """The certificate and the configuration of docs/batch-and-nightly.md, in another folder."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    page = (ROOT / "docs/batch-and-nightly.md").read_text("utf-8").replace("/etc/dask", str(tmp_path))
    made = next(line for line in page.splitlines() if line.startswith("openssl "))
    subprocess.run(shlex.split(made), check=True, capture_output=True)
    (tmp_path / "tls.yaml").write_text(page.split("```yaml\n")[1].split("```")[0])
    folder(tmp_path / "root/a")
    folder(tmp_path / "root/b")
    env = {**ENV, "DASK_CONFIG": str(tmp_path / "tls.yaml")}
    with dask_cluster.forked(tmp_path, 1, "tls", env) as (address, _):
        batch_ = command(tmp_path / "root", "-o", tmp_path / "out", "--cluster", address)
        done = subprocess.run(batch_, capture_output=True, text=True, env=env, check=False)
        assert done.returncode == 0, done.stderr
        assert finished(tmp_path / "out") == {"a", "b"}
        for other, why in (
            (address, "expected a certificate and a key"),
            (address.replace("tls", "tcp"), "that answers"),
        ):
            assert why in run(tmp_path / "root", "-o", tmp_path / "other", "--cluster", other, code=2).stderr


@pytest.mark.parametrize(
    ("protocol", "said"),
    [("tcp", "expected the address of a Dask scheduler that answers"), ("tls", "expected a certificate and a key")],
)
def test_unreachable_cluster_is_refused_before_anything_is_written(tmp_path, monkeypatch, protocol, said):
    pytest.importorskip("distributed")
    monkeypatch.setattr(runner, "CONNECT_S", 0.2)
    folder(tmp_path / "root/a")
    address = f"{protocol}://127.0.0.1:{dask_cluster.free_port()}"
    done = run(tmp_path / "root", "-o", tmp_path / "out", "--cluster", address, code=2)
    assert f"--cluster {address}: {said}" in done.stderr
    assert not (tmp_path / "out").exists(), "nothing was begun"


# --- by Snakemake -----------------------------------------------------------------------------------------------------


SNAKEFILE = ROOT / "fixtures/Snakefile"


def test_the_command_of_the_snakefile_is_one_that_processor_takes():
    """Without Snakemake: its shell command for a folder, as bash and the command line read it."""
    line = next(one.strip() for one in SNAKEFILE.read_text("utf-8").splitlines() if '"processor run' in one)
    names = {"params.source": "/scans/桥 '东'", "params.results": "/results/桥 '东'"}
    text = re.sub(r"\{(params\.\w+):q\}", lambda match: shlex.quote(names[match[1]]), line.strip('"'))
    text = text.replace("{{", "{").replace("}}", "}")
    assert subprocess.run(["bash", "-n", "-c", text], check=False).returncode == 0
    words = shlex.split(text.split(">")[0])
    context = cli_main.commands.commands["run"].make_context("run", words[2:])
    assert [str(context.params[name]) for name in ("input_", "output")] == list(names.values())
    for code, taken in ((0, 0), (1, 0), (3, 1), (4, 0)):
        stub = f"processor() {{ return {code}; }}; set -e; {text}"
        assert subprocess.run(["bash", "-c", stub], check=False).returncode == taken
