"""The files of fixtures: read with the points they were made of, and run with the results that were kept."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from processor import readers
from processor.cli.main import commands
from processor.scan_folder.folder import read_input

FIXTURES = Path(__file__).resolve().parents[1] / "fixtures"
FORMATS = sorted((FIXTURES / "formats").iterdir())
TEXT_ONLY = {".asc", ".txt"}  # the same reader as .xyz
WHOLE_KB = 200


def reference():
    """Points (200, 3) in mm, by numpy alone."""
    return 1000.0 * np.loadtxt(FIXTURES / "formats/ball.csv", delimiter=",", skiprows=1)


def in_order(points):
    points = np.round(points, 3)
    return points[np.lexsort(points.T)]


def test_there_is_a_file_of_every_format():
    assert {path.suffix for path in FORMATS} == set(readers.SUFFIXES) - TEXT_ONLY
    assert len(reference()) == 200
    assert all(path.stat().st_size < WHOLE_KB * 1000 for path in FIXTURES.rglob("*.laz"))


@pytest.mark.parametrize("path", FORMATS, ids=lambda path: path.suffix)
def test_every_format_holds_the_same_points(path):
    scene = read_input(path, "mm" if path.suffix == ".ply" else None)
    (scan,) = scene.scans
    assert scene.units == ("mm" if path.suffix == ".ply" else "m")
    # Compared in steps of 1e-3 mm, so two of them where a format's own step lies between
    np.testing.assert_allclose(in_order(scan.points + scan.origin), in_order(reference()), atol=2e-3)


def numbers(content, where=""):
    """All numbers of a JSON object by their place; None is NaN."""
    if isinstance(content, dict):
        return {key: value for name, item in content.items() for key, value in numbers(item, f"{where}/{name}").items()}
    if isinstance(content, list):
        return {key: value for i, item in enumerate(content) for key, value in numbers(item, f"{where}/{i}").items()}
    if content is None:
        return {where: math.nan}
    return {where: float(content)} if isinstance(content, (int, float)) and not isinstance(content, bool) else {}


def test_the_stored_results_come_out_again(tmp_path):
    arguments = ["run", str(FIXTURES / "scan-folder"), "-o", str(tmp_path / "out")]
    done = CliRunner().invoke(commands, arguments, standalone_mode=False)
    assert done.exception is None or done.return_value == 0, done.output
    stored = json.loads((FIXTURES / "golden/scan-folder.json").read_text("utf-8"))
    made = json.loads((tmp_path / "out/results.json").read_text("utf-8"))
    for part in ("steps", "checks"):
        wanted, found = numbers(stored[part]), numbers(made[part])
        assert len(wanted) > 50
        assert set(wanted) <= set(found)
        differing = {
            key: (value, found[key])
            for key, value in wanted.items()
            # other processors and versions of libraries add in another order; values near 0 are differences
            if found[key] != pytest.approx(value, rel=1e-6, abs=1e-9, nan_ok=True)
        }
        assert not differing
