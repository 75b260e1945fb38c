"""README and docs: their commands exist and run, their links have targets, their tables agree with the code."""

import dataclasses
import functools
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
import processor.cli.main
from designgen.scenes import model
from docs.scripts import make_parameters, make_rooms
from processor import pipeline
from processor.batch import batch
from processor.evaluation import evaluate, truth_json
from processor.limits import standards
from processor.model import Status, Verdict
from processor.model.inputs import keys_of
from processor.scan_folder import project_file
from processor.scan_folder.folder import read_input
from tests.support import field_checks
from tests.support.processes import batches
from tests.support.scenes.coarse_scans import coarsely
from tests.support.solids import cad_in_process

pytestmark = pytest.mark.usefixtures("blank_pictures")

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PROGRAMS = {"processor": processor.cli.main.commands, "designgen": designgen.cli.commands}
README_LINES = 120
FIRST_PAGE_WORDS = 600  # of a reader's first page
LARGEST_PICTURE = 300_000
# Commands of the pages that take seconds, in an order in which each finds what it needs; as they stand in the pages.
RUN = (
    "designgen list",
    "processor init my-frame",
    "processor run my-frame -o results",
    "processor run my-frame -o results --params mine.toml",
    "processor run my-frame -o results --method ray,ransac",
    "processor convert my-frame -o my-frame.h5",
    "processor check results",
    "processor verify results",
    "processor report results",
    "processor export results -o registered --what registered --format e57",
    "processor export results -o merged --what merged --format laz --spacing-mm 5",
    "processor export results -o clean --what clean --format ply",
    "processor run target.e57 -o results --steps spheres",
    "processor batch projects -o all-results --jobs 2",
    "processor batch projects -o all-results --jobs 4",
    "processor compare before.laz after.laz -o change",
    "processor compare before.laz after.laz -o change --registration-error 0.002",
    "processor compare before.ply after.ply -o change --core places.csv "
    "--normal-diameter 0.4 --projection-diameter 0.2 --max-depth 0.5",
    "designgen export s1.h5 -o example --format ply",
    "designgen export roof.h5 -o roof --format e57",
    "designgen import design.step -o meshes",
    "designgen scan design.step -o part.h5",
    "processor run my-roof -o results --steps deviation",
    "processor export results -o deviation --what deviation --format ply",
    "processor run my-plates -o results --steps deviation,defects",
)
# Commands that take minutes or need other machines, and what runs them, or the same with less to do.
ELSEWHERE = {
    "processor field-check my-check -o my-scanner": "tests/field_check/test_field_check.py",
    "processor run my-frame -o results --lang zh": "tests/report/test_browser_pages.py",
    "processor run my-bridge -o results": "make demo",
    "processor run my-bridge -o results --method adjustment,design-aided": "make demo",
    "processor run my-bridge -o results --steps inspect": "tests/inspection/test_inspection.py",
    "processor run my-truss -o results --steps stitch": "tests/stitching/test_stitching.py",
    "processor run my-truss -o results --steps stitch --method three-point": "tests/stitching/test_stitching_picks.py",
    "processor export results -o assembled --what assembled --format e57": "tests/clouds/test_export.py",
    "processor batch /scans -o /results --cluster tcp://10.0.0.1:8786": "tests/batch/test_batch.py",
    "processor batch /scans -o /results --cluster tls://10.0.0.1:8786": "tests/batch/test_batch.py",
    "processor run my-hall -o results --steps deviation --cluster tcp://10.0.0.1:8786": "tests/jobs/test_tiles.py",
    "processor compare before.laz after.laz -o change --cluster tcp://10.0.0.1:8786": "tests/jobs/test_tiles.py",
    "processor validate --smallest -o nights --jobs 2": "make weekend",
    "processor validate mine.toml -o nights --jobs 2": "tests/validation/test_validation_running.py",
    "processor validate mine.toml -o nights --cluster tcp://10.0.0.1:8786": (
        "tests/validation/test_validation_running.py"
    ),
    "processor history runs -o history": "tests/epochs/test_epochs.py",
    "processor validate -o nights --accept": "tests/validation/test_validation.py",
    "processor papers -o papers": "make weekend",
    "processor run my-frame -o results --steps spheres --method ray,my_module:my_method": (
        "tests/pipeline/test_user_methods.py"
    ),
    "processor run my-frame -o results --steps density": "tests/pipeline/test_written_step.py",
    "processor init my-bridge": "tests/test_docs.py",
    "designgen make frame-small -o frame.h5 --seed 3": "tests/test_docs.py",
    "processor run frame.h5 -o results --method ray,ransac": "tests/test_docs.py",
    "designgen make frame-small -o set --count 2 --vary scan.sigma_mm=1,2": "tests/test_docs.py",
    "processor batch set -o set-results --jobs 2": "tests/test_docs.py",
    "designgen make frame-1040 -o roof.h5 --seed 3": "make weekend",
    "designgen scan hall.ifczip -o hall.h5 --stations places.json --scanner pulse --set scan.step_mrad=0.5": (
        "tests/designgen/test_models.py"
    ),
    "designgen make arch-s1-rays -o set --count 100 --vary scanner.noise_mm=0.3,1,2 --jobs 4": (
        "tests/designgen/test_designgen_batch.py"
    ),
    "designgen make frame-small -o set --count 100 --cluster tcp://10.0.0.1:8786": (
        "tests/designgen/test_designgen_batch.py"
    ),
}


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
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), flags=re.MULTILINE))


def wrong_words(line):
    """What a command or its parser does not know of a line; "" where nothing is wrong."""
    program, *words = shlex.split(line)
    if program == "make":
        return " ".join(set(words) - targets())
    group = PROGRAMS[program]
    if words[0].startswith("--"):
        return " ".join(set(words) - {name for option in group.params for name in option.opts} - {"--help"})
    if words[0] not in group.commands:
        return words[0]
    command = group.commands[words[0]]
    context = click.Context(command)
    # Whole lines only: `processor run` in a sentence has no arguments.
    if len(words) == 1 and any(parameter.required for parameter in command.params):
        return ""
    try:
        values, rest, order = command.make_parser(context).parse_args(list(words[1:]))
        for parameter in order:
            given = values.get(parameter.name)
            if isinstance(parameter.type, click.Choice | click.IntRange | click.FloatRange) and isinstance(given, str):
                parameter.type.convert(given, parameter, context)
    except click.ClickException as error:
        return error.message
    # Click gives what is missing as None, or since 8.3 as a value of its own: neither is text.
    missing = [one.name for one in command.params if one.required and not isinstance(values.get(one.name), str | tuple)]
    return " ".join([*rest, *missing])


def test_commands_exist_with_their_options():
    assert [(page, line, wrong) for page, line in COMMANDS if (wrong := wrong_words(line))] == []


def test_a_wrong_command_is_found():
    wrong = ["make nothing", "processor fly x", "processor run", "processor run x -o y --magic", "processor --magic"]
    wrong += ["processor compare x", "designgen make x -o y z --seed 1"]
    assert [bool(wrong_words(line)) for line in wrong] == [True, True, False, True, True, True, True]


def test_every_command_is_run_somewhere():
    whole = {line for path in PAGES for line in (text.partition(" # ")[0].strip() for text in blocks(path, "console"))}
    assert {line for line in whole if not line.startswith("make ")} == {*RUN, *ELSEWHERE}
    assert all(place.startswith("make ") or (ROOT / place).exists() for place in ELSEWHERE.values())


def invoke(line):
    program, *words = shlex.split(line)
    done = CliRunner().invoke(PROGRAMS[program], words, standalone_mode=False)
    assert done.exception is None, (line, done.output, done.exception)
    assert done.exit_code == 0, (line, done.output)


def merged_cloud(folder_of_scans):
    """Every fourth point (n, 3) of a folder's scans in the project's frame, m."""
    clouds = []
    for scan in read_input(folder_of_scans).scans:
        T = scan.T_project_scan
        clouds.append((scan.points + scan.origin) @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(clouds)[::4] / 1000.0


def write_plane(path, count, seed, header):
    """Write random points of a plane of 4 m, m; of a PLY file with its header."""
    x, y, noise = np.random.default_rng(seed).normal(size=(3, count))
    head = f"ply\nformat ascii 1.0\nelement vertex {count}\n" + "".join(f"property double {a}\n" for a in "xyz")
    text = f"{head}end_header" if header == "ply" else header
    np.savetxt(path, np.column_stack([x, y, 0.001 * noise]), header=text, comments="", fmt="%.6f")


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with everything that the commands in RUN name."""
    import cadquery

    fixtures = ROOT / "fixtures"
    frame = tmp_path / "my-frame"
    frame.mkdir()
    shutil.copy(fixtures / "scan-folder/design.json", frame)
    np.savetxt(frame / "roof.xyz", merged_cloud(fixtures / "scan-folder"), fmt="%.5f")
    shutil.copytree(fixtures / "scan-folder", tmp_path / "projects/frame-1")
    shutil.copytree(fixtures / "scan-folder", tmp_path / "projects/frame-2")
    shutil.copy(fixtures / "formats/ball.e57", tmp_path / "target.e57")
    for number, name in enumerate(("before", "after")):
        shutil.copy(fixtures / "formats/ball.laz", tmp_path / f"{name}.laz")
        write_plane(tmp_path / f"{name}.ply", 4000, number, "ply")
    write_plane(tmp_path / "places.csv", 20, 2, "x y z")
    (tmp_path / "mine.toml").write_text("\n".join(blocks(ROOT / "docs/parameters.md", "toml")))
    cadquery.exporters.export(cadquery.Workplane().box(50.0, 25.0, 5.0), str(tmp_path / "design.step"))
    monkeypatch.chdir(tmp_path)
    # What starts processes does so in the tests of it; here, jobs of a batch have made-up results at once.
    monkeypatch.setattr(batch, "Settings", functools.partial(batch.Settings, program=batches.FAILING))
    cad_in_process.read_here(monkeypatch)
    recipe_of = model.recipe_of
    monkeypatch.setattr(model, "recipe_of", lambda *of: recipe_of(*of[:-1], (*of[-1], "scan.step_mrad=5")))
    invoke("designgen make arch-s1 -o s1.h5 --set scan.spacing_mm=100")
    invoke(f"designgen make {fixtures / 'frame-of-four.toml'} -o roof.h5 --set scan.step_mrad=10")
    plates = "--set scan.step_mrad=8 --set structure.length_mm=500 --set structure.height_mm=500"
    plates += ' --set \'structure.components=["none", "none", "dent"]\''
    invoke(f"designgen make plates-defects -o plates.h5 {plates}")
    for name in ("my-plates", "my-roof"):
        invoke(f"designgen export plates.h5 -o {name} --format ply")
    return tmp_path


def test_cheap_commands_run(place):
    for line in RUN:
        invoke(line)
        if line == "processor run target.e57 -o results --steps spheres":
            balls = json.loads((place / "results/results.json").read_text("utf-8"))["steps"]["spheres"]["balls"]
            # Coordinates are rounded to 0.1 mm: as half of the ball is seen, a radius to a few tenths.
            assert [ball["radius"] for ball in balls] == pytest.approx([75.0], abs=0.5)
    assert json.loads((place / "results/results.json").read_text("utf-8"))["steps"]["defects"]["status"] == "ok"
    assert (place / "change/compare.csv").exists()
    assert len(read_input(place / "registered").scans) == len(read_input(place / "clean").scans) == 1
    assert (place / "merged/merged.laz").exists()
    assert (place / "deviation/deviation.ply").exists()
    assert read_input(place / "example").arch is not None


def test_first_pages_are_short_and_stand_first():
    index = (ROOT / "docs/index.md").read_text("utf-8").partition("## Reference")[0]
    pages = sorted((ROOT / "docs/start").glob("*.md"))
    assert re.findall(r"\]\(start/(\w+)\.md\)", index) == ["fabricator", "surveyor", "researcher", "night", "developer"]
    assert len(pages) == 5
    assert [path.name for path in pages if len(path.read_text("utf-8").split()) > FIRST_PAGE_WORDS] == []


def bridge_to_send(folder):
    """Make the demo's bridge as a fabricator has it: meshes and E57 files of the parts, and no more."""
    invoke(f"designgen make arch-s1-short -o {folder}/bridge.h5 --set scan.spacing_mm=10")
    invoke(f"designgen export {folder}/bridge.h5 -o {folder}/my-bridge --format e57 --without-truth")
    for name in ("project.toml", "design.json"):
        (folder / "my-bridge" / name).unlink()


def frame_to_survey(folder):
    """Make a merged cloud with a list of nodes, scans of spheres as targets, and one target."""
    fixtures = ROOT / "fixtures"
    (folder / "my-frame").mkdir()
    np.savetxt(folder / "my-frame/roof.xyz", merged_cloud(fixtures / "scan-folder"), fmt="%.5f")
    nodes = json.loads((fixtures / "scan-folder/design.json").read_text("utf-8"))["nodes"]
    rows = [",".join(map(str, (one["id"], *one["centre"], one["radius"]))) for one in nodes]
    (folder / "my-frame/nodes.csv").write_text("\n".join(["id,x_mm,y_mm,z_mm,radius_mm", *rows]), "utf-8")
    (folder / "my-check").mkdir()
    field_checks.folder(folder / "my-check", 1, view_mm=0.25)
    shutil.copy(fixtures / "formats/ball.e57", folder / "target.e57")


def folders_of_a_server(folder):
    """Make two projects."""
    for name in ("frame-1", "frame-2"):
        shutil.copytree(ROOT / "fixtures/scan-folder", folder / "projects" / name)


def checked_bridge(folder):
    record = json.loads((folder / "results/results.json").read_text("utf-8"))
    parts = {part["name"]: part["characteristics"] for part in record["steps"]["inspect"]["components"]}
    (length,) = [one for one in parts["rib2"] if one["id"] == "length"]
    assert record["verdict"] == "fail"
    assert abs(length["deviation"] + 6.0) <= length["ci95"]  # asbuilt of the recipe: cut 6 mm short
    assert (folder / "results/what-to-do.csv").exists()
    assert len(list((folder / "assembled/scans").iterdir())) == 5


def checked_survey(folder):
    assert (folder / "my-scanner/scanner.toml").exists()
    assert (folder / "merged/merged.laz").exists()


def checked_research(folder):
    exec("\n".join(blocks(ROOT / "docs/start/researcher.md", "python")), {})
    assert len(list((folder / "set-results").glob("*/results.json"))) == 4


def checked_night(folder):
    assert len((folder / "all-results/summary.csv").read_text("utf-8").splitlines()) == 3
    assert (folder / "nights/line.txt").exists()


@pytest.mark.slow  # whole runs, as a reader does them
@pytest.mark.parametrize(
    ("reader", "make", "check"),
    [
        ("fabricator", bridge_to_send, checked_bridge),
        ("surveyor", frame_to_survey, checked_survey),
        ("researcher", lambda folder: None, checked_research),
        ("night", folders_of_a_server, checked_night),
    ],
)
def test_the_commands_of_a_first_page_run_as_they_stand(reader, make, check, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make(tmp_path)
    for line in blocks(ROOT / f"docs/start/{reader}.md", "console"):
        invoke(line)
    check(tmp_path)


def anchors(path):
    """Anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", path.read_text("utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def leads_somewhere(path, link):
    """Whether a link of a page leads to a file of the project, and to a heading of it where it names one."""
    target, _, anchor = link.partition("#")
    if target.startswith(("http", "/")):
        return False
    linked = (path.parent / target).resolve() if target else path
    return linked.is_relative_to(ROOT) and linked.exists() and (not anchor or anchor in anchors(linked))


def test_links_lead_somewhere():
    links = [(path, link) for path in PAGES for link in re.findall(r"\]\(([^)\s]+)\)", path.read_text("utf-8"))]
    assert len(links) > 100
    assert [(path.name, link) for path, link in links if not leads_somewhere(path, link)] == []


def test_the_index_names_every_page():
    text = (ROOT / "docs/index.md").read_text("utf-8")
    pages = [path.relative_to(ROOT / "docs") for path in PAGES if path.is_relative_to(ROOT / "docs")]
    assert all(f"]({path.as_posix()})" in text for path in pages if path.name != "index.md")


def test_the_tour_names_what_its_files_define():
    tour = (ROOT / "docs/architecture.md").read_text("utf-8")
    named = re.findall(r"\[`(\w+)`\]\((\S+\.py)\)", tour)
    assert len(named) > 6
    assert [
        (name, file)
        for name, file in named
        if not re.search(rf"^((def|class) )?{name}\b", (ROOT / "docs" / file).read_text("utf-8"), re.M)
    ] == []
    files = [file for file in re.findall(r"`(processor/[\w./*-]+)`", tour) if "*" not in file]
    assert [file for file in files if not (ROOT / file).exists()] == []


def test_the_picture_of_the_rooms_is_that_of_the_imports():
    assert make_rooms.PICTURE.read_text("utf-8") == make_rooms.picture(), "make docs"


def test_readme_is_short_and_has_its_required_parts():
    text = (ROOT / "README.md").read_text("utf-8")
    assert len(text.splitlines()) <= README_LINES
    assert "No licence has been chosen" in text
    assert ".venv/bin/processor" in text
    assert "pip install ." in text
    assert "slow" in text
    assert (ROOT / "docs/pictures/report.png").stat().st_size < LARGEST_PICTURE


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


@pytest.fixture
def arguments(tmp_path):
    """Small arguments of the names that the Python page uses: a frame's folder, a ball, a body, two planes."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(3000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    corners = np.array([[0.0, 0.0, 0.0], [900.0, 0.0, 0.0], [0.0, 700.0, 0.0], [0.0, 0.0, 500.0]])
    sides = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    plane = np.column_stack([rng.uniform(-500.0, 500.0, (4000, 2)), rng.normal(0.0, 1.0, 4000)])
    folder_of_scans = ROOT / "fixtures/scan-folder"
    return {
        "path": folder_of_scans,
        "path_or_scene": folder_of_scans,
        "points": (75.0 + rng.normal(0.0, 0.5, (3000, 1))) * direction,
        "vertices": corners,
        "faces": sides,
        "reference": plane,
        "compared": plane + np.array([0.0, 0.0, 5.0]),
        "truth": evaluate.truth_of(folder_of_scans),
        "scene_file": tmp_path / "scene.h5",
        "folder": tmp_path / "clouds",
        "model": (corners, sides),
    }


def test_the_lines_of_the_python_page_run(arguments, monkeypatch):
    """Each returns what the page's table names. The ball is registered to no body: its pose fails."""
    coarsely(monkeypatch, "make", spacing_mm=100.0)
    coarsely(monkeypatch, "scan", step_mrad=20.0)
    exec("\n".join(blocks(ROOT / "docs/python.md", "python")), arguments)
    names = re.findall(
        r"^\| `(?:processor|designgen)\.(\w+)`", (ROOT / "docs/python.md").read_text("utf-8"), re.MULTILINE
    )
    assert len(names) == 10
    results, sphere, pose = (arguments[name] for name in ("results", "sphere", "pose"))
    assert results.verdict in tuple(Verdict)
    assert results.steps["spheres"].status is Status.OK
    assert len(results.checks) > 0
    assert (sphere.centre.shape, sphere.covariance.shape) == ((3,), (4, 4))
    assert (sphere.status, [one.code for one in sphere.reasons]) == (Status.OK, ["spheres.instrument-assumed"])
    assert sphere.radius == pytest.approx(75.0, abs=5.0 * 0.5 / np.sqrt(3000.0))  # five standard deviations
    assert (pose.T_design_scan.shape, pose.covariance.shape) == ((4, 4), (6, 6))
    assert pose.rival is None or pose.rival.shape == (4, 4)
    assert pose.status in tuple(Status)
    # Every point is moved by the same; discs differ at their edges by the tilt of their normals.
    assert np.median(arguments["table"].distance) == pytest.approx(5.0, abs=0.1)
    assert {(one.name, one.value, one.limit, one.unit, one.passed) for one in arguments["metrics"]}
    converted, files = arguments["converted"], arguments["files"]
    assert (converted.path, converted.units) == (arguments["scene_file"], "m")
    assert all((files.folder / name).exists() for name in files.files)
    assert sum(files.files.values()) == sum(converted.points.values())
    assert len(arguments["scene"].scans) == 6  # of the last line: a scan a station


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
    for key in (*keys_of(project_file.Project), *keys_of(project_file.ScanEntry)):
        assert re.search(rf"`(\[+)?{key}(\]+)?`", text), key
    examples = re.findall(r"```json\n(.*?)```", text, flags=re.DOTALL)
    assert [sorted(json.loads(example))[0] for example in examples] == ["components", "kind", "S1", "format"]
    truth = text.split("## truth.json")[1].split("## Results")[0]
    for kind, record in truth_json.RECORDS.items():
        for name in (kind, *(field.name for field in dataclasses.fields(record))):
            assert kind == "as_built" or f"`{name}`" in truth, (kind, name)


def test_workflow_installs_the_system_libraries_of_the_check():
    asked = set(re.findall(r"\.so\.\d+=(\S+?)[\s\"]", (ROOT / ".ci/system-libraries").read_text("utf-8")))
    assert len(asked) == 5
    for path in (ROOT / ".github/workflows").glob("*.yml"):
        line = re.search(r"apt-get install.*?\n\n|apt-get install.*?- name", path.read_text("utf-8"), flags=re.DOTALL)
        assert line is not None, path.name
        assert asked <= set(line[0].split()), path.name
