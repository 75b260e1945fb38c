"""The live figures of the page: their data, what may run, and how they react in a browser."""

import html
import json
import re

import pytest

from processor.evaluation.evaluate import ErrorReport
from processor.report.preassembly import interactive_view as preassembly_data
from processor.report.scripts import page_script
from processor.results import to_json
from tests.support.pages.report_pages import BAD, Page, rendered
from tests.support.results.bridge_results import of_bridge


def test_page_embeds_the_data_of_its_script():
    execution = of_bridge()
    kinds = Page(rendered(execution)).scripts
    assert [kind for kind, _ in kinds] == ["application/json", ""]
    data = json.loads(kinds[0][1])["steps"]["preassemble"]
    step = to_json.results_json(execution, ErrorReport())["steps"]["preassemble"]
    for drawn, joint in zip(data["joints"], step["joints"], strict=True):
        assert drawn["gap"] == [pytest.approx(joint["points"][key]["gap"]) for key in data["keys"]]
        assert drawn["ci95"] == [pytest.approx(joint["points"][key]["ci95"]) for key in data["keys"]]
    assert data["linear"][0]["deviation"] == pytest.approx(step["linear_error"]["deviation"])
    assert data["trade"]["lambda"] == [1.0, 0.1, 0.01]
    assert data["trade"]["linear_max"] == [2.0, 3.0, 9.0]
    assert [len(part["points"]) for part in data["parts"]] == [1800] * 3


def test_no_name_ends_the_data_or_becomes_markup():
    execution = of_bridge(names=(BAD, "rib1", "<img src=x onerror=alert(2)>"), joints=(BAD, "<!--"))
    text = rendered(execution)
    found = Page(text)
    assert [kind for kind, _ in found.scripts] == ["application/json", ""]
    data = json.loads(found.scripts[0][1])["steps"]["preassemble"]
    assert (data["parts"][0]["name"], data["joints"][1]["name"]) == (BAD, "<!--")
    assert not re.search("[<>&]", found.scripts[0][1])
    assert "<img src=x" not in text
    assert BAD in found.text
    assert "innerHTML" not in found.scripts[1][1]


def test_the_page_runs_its_own_script_alone_and_loads_nothing():
    text = rendered(of_bridge())
    script, digest = page_script.script()
    assert "default-src 'none'" in text
    assert f"script-src {html.escape(digest)}" in text.replace("&#39;", "&#x27;")
    assert script in text
    assert not any(word in text for word in ("@import", "url(", "http://", "https://", "fetch(", "XMLHttpRequest"))


def test_many_points_keep_the_page_small(monkeypatch):
    """24,000 points take at most 0.6 MB, 25 bytes each, beside 0.2 MB of tables and scripts."""
    assert preassembly_data.MOST_POINTS == 24_000
    monkeypatch.setattr(preassembly_data, "MOST_POINTS", 3_000)
    text = rendered(of_bridge(per_part=preassembly_data.MOST_POINTS))  # three times as many
    assert len(text.encode()) < 200_000 + 25 * preassembly_data.MOST_POINTS
    data = json.loads(Page(text).scripts[0][1])["steps"]["preassemble"]
    assert sum(len(part["residual"]) for part in data["parts"]) <= preassembly_data.MOST_POINTS
