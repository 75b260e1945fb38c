"""The arrows of the README's picture, read from the imports."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
STORE = {
    "processor.store",
    "processor.store.store",
    "processor.store.codec",
    "processor.store.tiles",
    "processor.store.scan_tiles",
    "processor.store.safety",
}
SOURCES = sorted([*(ROOT / "processor").rglob("*.py"), *(ROOT / "designgen").rglob("*.py")])


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(path):
    """Every module that a file imports, those inside functions too; of `from a import b` both a and a.b."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def within(names, *packages):
    return {n for n in names if any(n == p or n.startswith(p + ".") for p in packages)}


@pytest.mark.parametrize("path", SOURCES, ids=module_name)
def test_arrows_run_one_way(path):
    name, used = module_name(path), imports(path)
    own = within(used, "processor", "designgen")
    if name.startswith("processor"):
        assert not within(used, "designgen", "cadquery", "OCP"), "processor knows nothing of CAD"
        if not name.startswith("processor.store"):
            assert not within(used, "h5py"), "only the store uses HDF5"
    else:
        shared = ("processor.model", "processor.store", "processor.progress", "processor.jobs")
        reached = {n for n in within(own, "processor") if not within({n}, *shared)}
        assert reached <= {"processor"}, "designgen shares records, store and jobs with processor, and no geometry"
        assert not within(used, "h5py")
    if name.startswith("processor.jobs"):
        assert own <= {"processor"} | within(own, "processor.jobs", "processor.model")
    if within(own, "processor.batch", "processor.validation"):
        assert name.startswith(("processor.batch", "processor.validation", "processor.cli"))
    if within(own, "processor.cli"):
        assert name == "processor.__main__" or name.startswith("processor.cli")
    if name == "processor.model":
        assert not own - {"processor"}
    if name.startswith("processor.language"):
        assert not own - within(own, "processor.language", "processor.model") - {"processor"}
    if name.startswith("processor.geometry"):
        assert not own - within(own, "processor.geometry", "processor.model", "processor")


def test_only_evaluation_reads_the_truth():
    readers = {module_name(p) for p in SOURCES if "read_truth" in p.read_text("utf-8")}
    assert readers <= {"processor.evaluation.evaluate", *STORE}
    assert "processor.evaluation.evaluate" in readers


@pytest.mark.parametrize("module", ["processor.cli.run", "designgen.cli"])
def test_help_comes_at_once(module):
    code = (
        f"import sys; from {module} import commands\n"
        "try: commands(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'scipy', 'matplotlib', 'trimesh', 'h5py', 'cadquery', 'laspy', 'pye57'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    took = []
    for _ in range(2):
        before = os.times()
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, cwd=ROOT)
        after = os.times()  # of processors: other work on the machine does not count
        took.append(after.children_user + after.children_system - before.children_user - before.children_system)
    assert min(took) < 1.0
