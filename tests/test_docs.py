"""README and docs: their commands exist and run, their links lead somewhere, their tables say what the code says."""

import itertools
import json
import re
import shlex
import shutil
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

import designgen.cli
import processor.cli.run
from docs import make_parameters
from processor import pipeline
from processor.limits import standards
from processor.scan_folder import folder
from processor.scan_folder.folder import read_input

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PROGRAMS = {"processor": processor.cli.run.commands, "designgen": designgen.cli.commands}
README_LINES = 120
LARGEST_PICTURE = 300_000
# Commands of the pages that take seconds, in an order in which each finds what it needs; as they stand in the pages.
RUN = (
    "designgen list",
    "processor init my-frame",
    "processor run my-frame -o results",
    "processor run my-frame -o results --lang zh",
    "processor run my-frame -o results --params mine.toml",
    "processor check results",
    "processor report results my-frame",
    "processor run target.e57 -o results --steps spheres",
    "processor batch projects -o all-results --jobs 2",
    "processor compare before.laz after.laz -o change",
    "designgen export s1.h5 -o example --format ply",
)


def blocks(path, language):
    """Lines of the fenced blocks of a language."""
    found, inside = [], None
    for line in path.read_text("utf-8").splitlines():
        if line.startswith("```"):
            inside = line[3:].strip() if inside is None else None
        elif inside == language:
            found.append(line)
    return found


def commands_of(path):
    """Every command of a page: lines of console blocks, and what stands between backticks without an ellipsis."""
    lines = [line.partition(" # ")[0] for line in blocks(path, "console")]
    text = re.sub(r"```.*?```", "", path.read_text("utf-8"), flags=re.DOTALL)
    lines += [span for span in re.findall(r"`([^`\n]+)`", text) if "..." not in span]
    found = []
    for line in itertools.chain.from_iterable(line.split("&&") for line in lines):
        words = line.strip().removeprefix(".venv/bin/")
        if words.split(" ")[0] in (*PROGRAMS, "make") and " " in words:
            found.append(words)
    return found


COMMANDS = sorted({(path.name, command) for path in PAGES for command in commands_of(path)})


def test_there_are_commands():
    assert len(COMMANDS) > 40
    assert {"make demo", "make test"} <= {command for _, command in COMMANDS}
    assert commands_of(ROOT / "README.md")[:2] == ["make demo", "make test"]
    for path in PAGES:
        assert not [line for line in blocks(path, "") if line.split(" ")[0] in (*PROGRAMS, "make")], path.name


def targets():
    return set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text("utf-8"), flags=re.MULTILINE))


@pytest.mark.parametrize(("page", "line"), COMMANDS)
def test_a_command_exists_with_its_options(page, line):
    program, *words = shlex.split(line)
    if program == "make":
        assert set(words) <= targets()
        return
    group = PROGRAMS[program]
    assert words[0] in group.commands or words[0].startswith("--")
    if words[0] not in group.commands:
        assert set(words) <= {name for option in group.params for name in option.opts} | {"--help"}
        return
    command = group.commands[words[0]]
    context = click.Context(command)
    # Whole lines only: `processor run` in a sentence has no arguments.
    if len(words) == 1 and any(parameter.required for parameter in command.params):
        return
    values, rest, order = command.make_parser(context).parse_args(list(words[1:]))
    assert not rest
    for parameter in order:
        given = values.get(parameter.name)
        if isinstance(parameter.type, click.Choice | click.IntRange | click.FloatRange) and isinstance(given, str):
            parameter.type.convert(given, parameter, context)
    for parameter in command.params:
        assert not parameter.required or values.get(parameter.name) is not None, parameter.name


def invoke(line):
    program, *words = shlex.split(line)
    return CliRunner().invoke(PROGRAMS[program], words, standalone_mode=False)


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with everything that the commands in RUN name."""
    fixtures = ROOT / "fixtures"
    frame = tmp_path / "my-frame"
    frame.mkdir()
    shutil.copy(fixtures / "scan-folder/design.json", frame)
    clouds = []
    for scan in read_input(fixtures / "scan-folder").scans:
        T = scan.T_project_scan
        clouds.append((scan.points + scan.origin) @ T[:3, :3].T + T[:3, 3])
    np.savetxt(frame / "roof.xyz", np.concatenate(clouds)[::2] / 1000.0, fmt="%.5f")
    shutil.copytree(fixtures / "scan-folder", tmp_path / "projects/frame-1")
    shutil.copytree(fixtures / "scan-folder", tmp_path / "projects/frame-2")
    shutil.copy(fixtures / "formats/ball.e57", tmp_path / "target.e57")
    for name in ("before.laz", "after.laz"):
        shutil.copy(fixtures / "formats/ball.laz", tmp_path / name)
    (tmp_path / "mine.toml").write_text("\n".join(blocks(ROOT / "docs/parameters.md", "toml")))
    monkeypatch.chdir(tmp_path)
    small = "designgen make arch-s1 -o s1.h5 --set scan.spacing_mm=100"
    assert invoke(small).exit_code == 0
    return tmp_path


def test_cheap_commands_run(place):
    written = {command for _, command in COMMANDS}
    assert set(RUN) <= written, set(RUN) - written
    for line in RUN:
        done = invoke(line)
        assert done.exit_code == 0, (line, done.output, done.exception)
        assert done.exception is None, line
    balls = json.loads((place / "results/results.json").read_text("utf-8"))["steps"]["spheres"]["balls"]
    assert [ball["radius"] for ball in balls] == pytest.approx([75.0], abs=0.5)
    assert json.loads((place / "all-results/summary.json").read_text("utf-8"))
    assert (place / "change/compare.csv").exists()
    assert read_input(place / "example").arch is not None


def anchors(path):
    """Anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", path.read_text("utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(path):
    links = re.findall(r"\]\(([^)\s]+)\)", path.read_text("utf-8"))
    for link in links:
        target, _, anchor = link.partition("#")
        assert not target.startswith(("http", "/")), link
        linked = (path.parent / target).resolve() if target else path
        assert linked.is_relative_to(ROOT), link
        assert linked.exists(), link
        assert not anchor or anchor in anchors(linked), link


def test_the_index_names_every_page():
    text = (ROOT / "docs/index.md").read_text("utf-8")
    assert all(f"]({path.name})" in text for path in PAGES if path.parent == ROOT / "docs" and path.name != "index.md")


def test_the_readme_is_short_and_says_what_it_must():
    text = (ROOT / "README.md").read_text("utf-8")
    assert len(text.splitlines()) <= README_LINES
    assert "No licence has been chosen" in text
    assert ".venv/bin/processor" in text
    assert "pip install ." in text
    assert "slow" in text
    assert (ROOT / "docs/report.png").stat().st_size < LARGEST_PICTURE


def test_the_page_of_parameters_is_that_of_the_code():
    stored = (ROOT / "docs/parameters.md").read_text("utf-8")
    assert stored == make_parameters.page(), "run make docs"


def test_parameters_in_the_pages_exist():
    for path in PAGES:
        for table in re.findall(r"`\[([a-z_.]+)\]( [a-z_]+)?`", path.read_text("utf-8")):
            first, *within = [*table[0].split("."), *table[1].split()]
            if first not in pipeline.step_modules():
                continue
            record = pipeline.step_modules()[first].Params()
            for name in within:
                record = getattr(record, name)


def test_the_table_of_standards_is_that_of_the_files():
    text = (ROOT / "docs/limits.md").read_text("utf-8")
    for path in sorted((ROOT / "processor/limits").glob("*.toml")):
        content = standards.tomllib.loads(path.read_text("utf-8"))
        rows = content["limit"]
        used = list(dict.fromkeys(f"`{row['key']}`" for row in rows if row.get("measure")))
        cells = (f"`{path.name}`", content["standard"], len(rows), sum(row["verified"] for row in rows))
        assert f"| {' | '.join(map(str, cells))} | {', '.join(used) or '-'} |" in text


def test_the_page_of_the_scan_folder_names_every_key():
    text = (ROOT / "docs/scan-folder.md").read_text("utf-8")
    for key in (*folder.KEYS, *folder.SCAN_KEYS):
        assert re.search(rf"`(\[+)?{key}(\]+)?`", text), key
    examples = re.findall(r"```json\n(.*?)```", text, flags=re.DOTALL)
    assert [sorted(json.loads(example))[0] for example in examples] == ["components", "kind", "S1"]


def test_the_runner_installs_what_the_check_asks_for():
    asked = set(re.findall(r"\.so\.\d+=(\S+?)[\s\"]", (ROOT / ".ci/system-libraries").read_text("utf-8")))
    assert len(asked) == 5
    for path in (ROOT / ".github/workflows").glob("*.yml"):
        line = re.search(r"apt-get install.*?\n\n|apt-get install.*?- name", path.read_text("utf-8"), flags=re.DOTALL)
        assert line is not None, path.name
        assert asked <= set(line[0].split()), path.name
