"""The bench of what each step costs: exponents, what a run takes, the tables and the chart of docs/cost.md."""

import json
import sys

import numpy as np
import pytest

from docs.scripts import make_cost
from tests.bench import cost, cost_series

SIZES = (1e5, 2e5, 4e5)
CONTENT = {
    "machine": {"cores": 2, "python": "3.11.7", "numpy": "2.4.6"},
    "start": {"spheres": {"size": 2000.0, "points": 2000, "step": 0.2, "cpu": 3.0, "wall": 3.5, "mb": 250.0}},
    "series": [
        {
            "step": "spheres", "over": "points", "recipe": "frame-1040", "held": "61 balls",
            "rows": [
                {"size": n, "points": n, "step": 1e-5 * n, "cpu": 3.0 + 1e-5 * n, "wall": 5.0, "mb": 250.0 + 1e-4 * n}
                for n in SIZES
            ],
            "exponent": 1.0, "memory exponent": 1.0, "bytes a point": 104.86,
        }
    ],
    "peers": {},
}  # fmt: skip
PEERS = {
    "outliers": [{"name": "processor", "cpu": 1.0, "wall": 0.6, "ratio": 1.0, "agree": 1.0, "points": 1_000_000}],
    "registration": [
        {
            "name": "processor", "cpu": 4.0, "wall": 3.0, "ratio": 1.0, "points": 12_500,
            "poses": 5, "found": 5, "error": 0.4,
        }
    ],
    "missing": ["py4dgeo"],
}  # fmt: skip


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_exponent_of_a_power_law_is_its_power(power):
    sizes = np.array([1.0, 2.0, 4.0, 8.0]) * 1e6
    assert cost.exponent(sizes, 3.0 * sizes**power) == pytest.approx(power)
    scattered = 3.0 * sizes**power * np.array([1.02, 0.98, 0.98, 1.02])
    # A scatter of 2 % over an eightfold range shifts a slope by at most 0.04 / ln 8 = 0.02.
    assert cost.exponent(sizes, scattered) == pytest.approx(power, abs=0.02)


def test_fitted_series_has_the_memory_of_the_smallest_scene_subtracted():
    rows = [{"size": n, "points": int(n), "step": 1e-5 * n, "mb": 100.0 + 100.0 * n / 2.0**20} for n in SIZES]
    found = cost.fitted(cost_series.SERIES[0], rows, {"mb": 100.0})
    assert found["exponent"] == pytest.approx(1.0)
    assert found["memory exponent"] == pytest.approx(1.0)
    assert found["bytes a point"] == pytest.approx(100.0)


def test_measured_returns_seconds_and_memory_of_a_child_process(tmp_path):
    run = [sys.executable, "-S", "-c", "x = bytearray(60_000_000); t = sum(range(3_000_000))"]
    found = cost.measured(run, tmp_path)
    assert 60.0 < found["mb"] < 150.0  # the array, and an interpreter of some 10 MB
    assert 0.01 < found["cpu"] < 5.0  # 0.1 s of work, with room for a busy machine
    with pytest.raises(RuntimeError, match="exit code 3"):
        cost.measured([sys.executable, "-S", "-c", "raise SystemExit(3)"], tmp_path)


def test_tables_show_sizes_and_exponents():
    lines = make_cost.tables(CONTENT)
    assert lines[0] == "Machine: 2 cores, python 3.11.7, numpy 2.4.6."
    row = next(line for line in lines if line.startswith("| spheres |"))
    assert "100k/200k/400k" in row
    assert "1/2/4 | 4/5/7" in row
    assert "| 1.00 | 1.00 | 105 |" in row
    assert not any("Outlier" in line for line in lines)
    with_peers = make_cost.tables(make_cost.joined([CONTENT, {**CONTENT, "series": [], "peers": PEERS}]))
    assert "| processor | 4 | 3 | 1.00 | 5 of 5 | 0.40 |" in with_peers
    assert with_peers[-1] == "Not installed in that run: py4dgeo."


def test_page_is_written_between_its_marks(tmp_path, monkeypatch, drawn_pictures):
    page, bench = tmp_path / "cost.md", tmp_path / "bench.json"
    page.write_text(f"before\n{make_cost.START}\nold\n{make_cost.END}\nafter\n")
    bench.write_text(json.dumps(CONTENT))
    monkeypatch.setattr(make_cost, "PAGE", page)
    monkeypatch.setattr(make_cost, "PICTURE", tmp_path / "cost.png")
    make_cost.main([str(bench)])
    text = page.read_text()
    assert text.startswith("before\n")
    assert text.endswith(f"{make_cost.END}\nafter\n")
    assert "old" not in text
    assert "| spheres | points |" in text
    assert 1_000 < (tmp_path / "cost.png").stat().st_size < 150_000
