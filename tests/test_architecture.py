"""The rules of docs/architecture.md, read from the sources."""

import re
import subprocess
import sys

import pytest

from tests.support import structure, structure_counts
from tests.support.structure import MODULES, ROOT, SOURCES, imports, module_name, within


def test_no_module_imports_itself_through_others():
    assert structure.circles() == []


def test_imports_lead_to_lower_layers_and_not_from_step_to_step():
    assert structure.wrong_arrows() == []


def test_a_folder_has_at_most_twenty_files():
    assert structure.crowded_folders() == {}


def test_functions_have_at_most_sixty_lines_and_ten_arguments():
    assert structure.long_functions() == []


# At most what there was on 2026-11-29, with the aim beside it: a change that needs less lowers the number.
LINES = 94_525  # 75,000
RECORD_CLASSES = 669  # 400
CONSTANTS_WITHOUT_REASON = 0  # 0
CALLED_ONCE, CALLED_ONCE_OF_FEW_LINES = 94_525, 178  # 500, 150


def test_sources_only_shrink():
    once, once_of_few_lines = structure_counts.called_once()
    assert structure_counts.code_lines() <= LINES
    assert len(structure_counts.record_classes()) <= RECORD_CLASSES
    assert len(structure_counts.constants_without_reason()) <= CONSTANTS_WITHOUT_REASON
    assert len(once) <= CALLED_ONCE
    assert len(once_of_few_lines) <= CALLED_ONCE_OF_FEW_LINES
    assert structure_counts.circles_of_folders() == []


def test_records_have_at_most_five_positional_arguments():
    assert structure.positional_records() == []


def test_packages_share_only_what_they_may():
    assert structure.foreign_imports() == []


def test_only_evaluation_reads_the_truth():
    readers = {module_name(path) for path in SOURCES if "read_truth" in path.read_text("utf-8")}
    allowed = (
        "processor.evaluation.evaluate",
        "processor.store",
        "designgen.batch",
    )  # designgen made it, and counts it
    assert not {name for name in readers if not within({name}, *allowed)}
    assert "processor.evaluation.evaluate" in readers


def test_no_regular_expression_stands_where_texts_are_made_or_shown():
    """The catalogues are looked up by whole templates."""
    for name in MODULES:
        if within({name}, "processor.language", "processor.report"):
            allowed = {"processor.report.style"}  # numbers in SVG attributes of Matplotlib
            assert "re" not in imports(MODULES[name]) or name in allowed, name


def test_messages_are_not_parsed_again():
    """What a text for people states is data beside it: a code, a field, or ``path`` and ``problem`` of an error."""
    assert structure.messages_read_again() == []


def test_a_line_that_reads_a_message_is_found(tmp_path):
    allowed = "whole = ' '.join(str(error).split())"
    lines = [
        "label = scene.units_reason.split('; ')",
        "said = [text for text in doubts if not text.startswith('units')]",
        "rest = str(error).removeprefix(f'{path}: ')",
        "rest = message.strip().partition(':')[0].rpartition(',')",
        "rest = messages('en').text(reason).split(';')",
        "place = problems(record)[0].removeprefix('/')",
    ]
    for number, line in enumerate([*lines, allowed]):
        (tmp_path / f"{number}.py").write_text(f"{line}\n{allowed}\n", "utf-8")
    found = [bool(structure.messages_read_again([tmp_path / f"{number}.py"])) for number in range(len(lines) + 1)]
    assert found == [True] * len(lines) + [False]


def test_tests_share_code_through_support():
    foreign = re.compile(r"^\s*(?:from|import) tests\.(?!support\b|bench\b|mutation\b|real\b)", re.MULTILINE)
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        if foreign.search(path.read_text("utf-8")):  # a line of a text, maybe: reading the code of all takes a second
            found = {name for name in imports(path) if within({name}, "tests")}
            assert found == within(found, "tests.support", "tests.bench", "tests.mutation", "tests.real"), path.name


@pytest.mark.parametrize("module", ["processor.cli.main", "designgen.cli"])
def test_help_is_printed_without_heavy_imports(module):
    code = (
        f"import sys; from {module} import commands\n"
        "try: commands(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'scipy', 'matplotlib', 'trimesh', 'h5py', 'cadquery', 'laspy', 'pye57'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, cwd=ROOT)


@pytest.mark.slow
def test_run_starts_without_rarely_used_imports():
    """A batch starts a process for every input: half a second each of loading all distributions and PDF fonts."""
    code = (
        "import sys; from processor import pipeline; from processor.api import runs; import processor.cli.main\n"
        "from processor.report import write_results\n"
        "pipeline.step_modules()\n"
        "heavy = {'scipy.stats', 'fontTools.subset', 'matplotlib.pyplot', 'cadquery', 'ezdxf'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
