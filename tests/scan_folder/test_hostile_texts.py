"""Damaged and hostile project.toml, design.json, stations.json and CSV tables: read, or refused by one plain error."""

import csv
import dataclasses
import io
import json
import os
import random
import re

import numpy as np
import pytest

import designgen.__main__
from processor import record_checks
from processor.cli import main
from processor.evaluation.evaluate import ErrorReport
from processor.model import InputError, UsageError
from processor.report import all_tables
from processor.report import table as report_table
from processor.report.stitching.tables import poses_csv
from processor.scan_folder import cad, folder
from processor.store import store
from tests.support.files.impossible_texts import impossible_texts
from tests.support.results import step_results

POINTS = np.random.default_rng(3).uniform(0.0, 3.0, (60, 3)).round(3)
FILES = {
    "project.toml": """name = "site"
kind = "space-frame"
units = "m"
design = "design.json"
temperature_C = 21.5

[[scan]]
file = "a.xyz"
station = "S1"
sigma_mm = 2.0
position = [0.0, 0.0, 0.0]
pose = [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]

[[scan]]
file = "b.xyz"

[tolerance]
standard = "JGJ 7-2010"
root_gap_mm = 0.0
""",
    "design.json": json.dumps(
        {
            "units": "m",
            "kind": "space-frame",
            "nodes": [{"id": k, "centre": [1.5 * (k % 3), 1.5 * (k // 3), 0.3], "radius": 0.05} for k in range(6)],
            "members": [{"a": k, "b": k + 1, "tube_diameter": 0.06} for k in range(5)],
        },
        indent=1,
    ),
    "stations.json": json.dumps({"S1": {"position": [0.0, 0.0, 0.0]}, "S2": {"position": [3.0, 0.0, 0.0]}}, indent=1),
    "control.csv": "name,scan,x,y,z,sd_mm\nT1,,1.0,2.0,3.0,1\nT2,,2.0,2.0,1.0,1\n"
    "T1,a,1.0,2.0,3.0,0.5\nT2,a,2.0,2.0,1.0,0.5\n",
    "picks.csv": "scan_a,scan_b,point,xa,ya,za,xb,yb,zb\na,b,P1,1,2,3,1,2,3\na,b,P2,2,2,3,2,2,3\na,b,P3,2,1,3,2,1,3\n",
}  # fmt: skip
TOKENS = (
    "nan", "NaN", "inf", "-Infinity", "1e400", "-1", "0", "1e300", "9" * 400, "null", "true", "[]", "{}",
    '""', '"', "'",
    "=1+1", "\x1b[2J", "\0", "\ud800", "a" * 100_000, "\n", ",", ";", "]", "}", "[" * 2_000, "../x",
    "/etc/passwd", "T1", "b",
)  # fmt: skip


def write(place):
    for name, text in FILES.items():
        (place / name).write_text(text)
    for name in "ab":
        np.savetxt(place / f"{name}.xyz", POINTS, "%.3f")
    return place


def mutated(text, rng):
    """Return a text with one to three damages: a token replaced, a line taken out or doubled, a cut, bytes changed."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        lines, way = text.splitlines(keepends=True), rng.randrange(6)
        if way < 3:
            found = list(re.finditer(r"[\w.+-]+", text))
            if found:
                one = rng.choice(found)
                text = text[: one.start()] + rng.choice(TOKENS) + text[one.end() :]
        elif way == 3 and lines:
            at = rng.randrange(len(lines))
            text = "".join(lines[:at] + lines[at : at + 1] * rng.choice((0, 2)) + lines[at + 1 :])
        elif way == 4:
            text = text[: rng.randrange(len(text) + 1)]
        elif text:
            at = rng.randrange(len(text))
            text = text[:at] + chr(rng.choice((0, 10, 34, 44, 45, 46, 48, 57, 0xFF, 0x202E))) + text[at + 1 :]
    return text


@pytest.mark.parametrize("count", [40, pytest.param(10_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FILES)
def test_damaged_files(tmp_path, name, count):
    place, rng = write(tmp_path), random.Random(name)
    assert folder.read_input(place).frame is not None
    refused, said = 0, ""
    for _ in range(count):
        text = mutated(FILES[name], rng)
        (place / name).write_bytes(text.encode("utf-8", "surrogatepass"))
        try:
            scene = folder.read_input(place)
        except (InputError, UsageError) as error:
            refused, said = refused + 1, str(error)
        else:
            assert record_checks.problems(scene) == []
            continue
        assert str(place) in said, (text[:500], said[:500])
        assert len(said) < 6_100, (text[:500], said[:200])
    assert refused > 0.3 * count  # the others are harmless: a name, a coordinate


TEXTS = list(impossible_texts(FILES))


@pytest.mark.parametrize("file", FILES)
def test_impossible_texts_are_refused_with_their_place(tmp_path, file):
    assert len(TEXTS) >= 180
    write(tmp_path)
    wrong = {}
    for name, _, text, named in (case for case in TEXTS if case[1] == file):
        (tmp_path / file).write_text(text)
        try:
            folder.read_input(tmp_path)
            wrong[name] = "is read"
        except (InputError, UsageError) as error:
            said = str(error)
            # A scan's record is of the whole folder.
            placed = said.startswith((f"{tmp_path / file}: ", f"{tmp_path}: scans.")) and len(said) < 1_500
            # Tables are named by their lines; a cell of megabytes ends the reading of the table.
            by_name = any(one and one in said for one in named) or re.search(r"(line|row) \d|field limit", said)
            if not (placed and by_name):
                wrong[name] = said[:500]
    assert wrong == {}


# --- the cache of meshes ---------------------------------------------------------------------------------------------


def test_a_cache_that_others_can_change_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def is_used():
        with cad._cache() as place:
            return place.is_relative_to(tmp_path)

    with cad._cache() as cache:
        assert cache.is_relative_to(tmp_path)
        assert cache.stat().st_mode & 0o077 == 0
    for mode, used in ((0o777, False), (0o757, False), (0o700, True)):
        cache.chmod(mode)
        assert is_used() == used
    for mode, used in ((0o777, False), (0o1777, True)):  # another folder could be put in its place; not as in /tmp
        cache.parent.chmod(mode)
        assert is_used() == used
    if os.geteuid() == 0:  # root alone gives files to others
        for owner, group in ((12_345, -1), (0, 12_345)):
            os.chown(cache, owner, group)
            cache.chmod(0o770)
            assert not is_used()


# --- names in what is written ----------------------------------------------------------------------------------------


def test_names_are_harmless_in_pages_tables_and_terminals(tmp_path, capsys):
    """One scene whose every name attacks the page, the spreadsheet or the terminal."""
    script, formula, clear = "</script><script>alert(1)</script>", "=HYPERLINK(1)", "a\x1b[2Jb\u202ec"
    hostile = dataclasses.replace(step_results.scene((formula, script, clear)), name=script)
    place = tmp_path / "scene.h5"
    store.write_scene(place, hostile, None, {})
    main.commands.main(["run", str(place), "-o", str(tmp_path / "out"), "--steps", "deviation"], standalone_mode=False)
    shown = "".join(capsys.readouterr())
    texts = {path: path.read_text("utf-8") for path in (tmp_path / "out").glob("*") if path.suffix in (".html", ".csv")}
    assert texts
    for path, text in {**texts, "terminal": shown}.items():
        assert "\x1b" not in text, path
        assert "\u202e" not in text, path
        if str(path).endswith(".html"):
            assert "<script>alert" not in text
            assert "alert(1)" in text  # as text


@pytest.mark.parametrize(
    "arguments", [("make", "{0}", "-o", "x.h5"), ("scan", "{0}", "-o", "x.h5"), ("import", "{0}", "-o", "x")]
)
def test_names_are_harmless_in_errors_of_designgen(tmp_path, monkeypatch, capsys, arguments):
    name = tmp_path / "a\x1b[2Jb\u202ec.toml"
    name.write_text("x = ")
    monkeypatch.setattr("sys.argv", ["designgen", *(one.format(name) for one in arguments)])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        designgen.__main__.main()
    said = capsys.readouterr().err
    assert end.value.code in (2, 3)
    assert "a\N{REPLACEMENT CHARACTER}[2Jb\N{REPLACEMENT CHARACTER}c" in said
    assert all(line.isprintable() for line in said.splitlines())


def test_names_are_harmless_in_tables_of_scans():
    names = ("=HYPERLINK(1)", "+1+2", "@a", "-x", "\t=y", "S6", "S7", "S8", "S9")
    result = step_results.stitching(names)
    scans = dataclasses.replace(result.scans, from_frame=names, to_frame=names[::-1])
    result = dataclasses.replace(result, scans=scans)
    run = step_results.execution(("stitch", "automatic", "{}", result), names=names)
    tables = {table.file: report_table.csv_text(table) for table in all_tables.tables_of_run(run, ErrorReport())}
    tables["poses.csv"] = poses_csv(result).decode()
    cells = [cell for text in tables.values() for row in csv.reader(io.StringIO(text)) for cell in row]
    assert "'=HYPERLINK(1)" in cells
    assert not [cell for cell in cells if re.match(r"[=@\t]|[+-](?![\d.])|\+\d\+", cell)]
