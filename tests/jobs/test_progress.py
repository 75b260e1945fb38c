"""Progress is shown on a terminal alone, and only for long stages."""

import io
import sys
import time

import pytest

from processor import progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(("terminal", "lasts"), [(True, True), (True, False), (False, True)])
def test_long_stage_is_shown_on_a_terminal_alone(monkeypatch, terminal, lasts):
    shown = Terminal() if terminal else io.StringIO()
    monkeypatch.setattr(sys, "stderr", shown)
    monkeypatch.setattr(progress, "PATIENCE_S", 0.01 if lasts else 60.0)
    monkeypatch.setattr(progress, "REFRESH_S", 0.01)
    with progress.stage("measuring"):
        for _ in progress.tracked("abc"):
            time.sleep(0.15 if lasts else 0.0)
    said = shown.getvalue()
    assert ("measuring" in said) == (terminal and lasts)
    assert ("2 of 3" in said) == (terminal and lasts)
    assert not progress._stages


@pytest.mark.parametrize("wanted", [True, False])
def test_a_command_prints_lines_of_a_long_stage_off_a_terminal(monkeypatch, wanted):
    shown = io.StringIO()
    monkeypatch.setattr(sys, "stderr", shown)
    monkeypatch.setattr(progress, "FIRST_LINE_S", 0.02)
    monkeypatch.setattr(progress, "LINE_S", 0.02)
    with progress.in_lines(wanted), progress.stage("measuring"):
        for _ in progress.tracked("abc"):
            time.sleep(0.1)
    assert ("measuring: 0 s, 1 of 3\n" in shown.getvalue()) is wanted
    with progress.stage("later"):
        time.sleep(0.05)
    assert "later" not in shown.getvalue()


def test_errors_within_a_stage_are_raised_and_items_without_one_are_returned(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    with pytest.raises(ValueError, match="no"), progress.stage("measuring"):
        raise ValueError("no")
    assert not progress._stages
    assert list(progress.tracked([1, 2])) == [1, 2]
