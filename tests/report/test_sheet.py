"""The sheet: what stands on it, and its picture."""

import dataclasses
import itertools
import re

import numpy as np
import pytest

from processor.language.messages import label, messages
from processor.limits.judging import Judged
from processor.model import Verdict
from processor.report import pdf_report
from processor.report.sheet import content, picture
from processor.report.style import default_settings
from tests.support.results.ball_results import of_frame, repeated, whole
from tests.support.results.bridge_results import of_bridge

VERDICTS = (Verdict.NONE, Verdict.PASS, Verdict.INDETERMINATE, Verdict.FAIL)


def pages(execution, sheet):
    with default_settings():
        return len(re.findall(rb"/Type /Page\b(?!s)", pdf_report.document(execution, sheet)))


def test_the_first_sentence_of_a_bridge_says_what_fails_by_how_much_and_the_table_the_rest():
    sheet = content.of(of_bridge())
    first, *_ = (messages("en").text(one) for one in sheet.answer)
    assert first == "2 of 5 characteristics fail: J1 groove gap +3.50 ± 0.23 mm, J2 groove gap -1.75 ± 0.24 mm"
    (table,) = sheet.first
    assert [row[4] for row in table.rows] == sorted((row[4] for row in table.rows), key=VERDICTS[::-1].index)
    assert str(table.rows[0][3]) == "-1 / 2"
    assert any("joint J1 (fail)" in messages("en").text(one) for one in sheet.to_do)
    assert sheet.further == ()  # nothing stands there twice


@pytest.mark.parametrize("times", [12, 200])
def test_a_roof_has_four_pages_at_most_and_names_the_file_of_what_is_left_out(times):
    execution, _ = of_frame(repeated(whole(), times))
    sheet = content.of(execution)
    assert pages(execution, sheet) <= 4
    (balls,) = [table for table in sheet.further if table.columns[1].name == "x_m"]
    assert len(balls.rows) == min(5 * times, 80)
    assert ("balls.csv" in messages("en").text(balls.note)) == (5 * times > 80)


def test_callouts_are_the_worst_and_do_not_lie_over_each_other():
    rng = np.random.default_rng(2)
    callouts = [
        picture.Callout(place, label(f"name of {k} " * (1 + k % 3)), VERDICTS[k % 4])
        for k, place in enumerate(rng.uniform(0.0, 1e4, (40, 3)))
    ]
    ends = np.zeros(2), np.full(2, 1e4)
    labels = picture._placed(callouts[: picture.MOST_CALLOUTS], [one.place[:2] for one in callouts], ends)
    spans = {}
    for one in labels:
        half = 0.5 * picture.width_of(one.said)
        spans.setdefault((one.above, one.lane), []).append((one.x - half, one.x + half))
    for inside in map(sorted, spans.values()):
        assert all(before[1] <= after[0] + 1e-9 for before, after in itertools.pairwise(inside))
        assert inside[0][0] >= -0.5 * picture.WIDE
        assert inside[-1][1] <= 0.5 * picture.WIDE


def test_of_several_quantities_the_worst_is_called_out_and_measured_ones_first():
    open_ = Judged(of="twist", value=float("nan"), ci95=float("nan"), low=-1.0, high=1.0, verdict=Verdict.FAIL)
    near, far = (
        Judged(of=name, value=value, ci95=0.14, low=-2.0, high=2.0, verdict=Verdict.FAIL)
        for name, value in (("near", 2.3), ("far", -5.98))
    )
    found = picture.of_judged(np.zeros(3), [open_, near, far], "")
    assert messages("en").text(found.said) == "far -5.98 ± 0.14 mm, limit ± 2: fail"
    assert found.verdict is Verdict.FAIL


def test_a_part_that_fails_is_drawn_in_another_colour_and_the_same_bytes_again(drawn_pictures):
    execution = of_bridge()
    box = np.array([[x, y, z] for x in (0.0, 4000.0) for y in (0.0, 400.0) for z in (0.0, 1000.0)])
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
                      [1, 5, 7], [1, 7, 3], [0, 2, 6], [0, 6, 4]])  # fmt: skip
    part = dataclasses.replace(execution.scene.arch.parts[0], vertices=box, faces=faces)
    arch = dataclasses.replace(execution.scene.arch, parts=(part, *execution.scene.arch.parts[1:]))
    scene = dataclasses.replace(execution.scene, arch=arch)
    drawn = [
        picture.draw(scene, [picture.Callout(np.zeros(3), label("a"), verdict, part.name)])
        for verdict in (Verdict.FAIL, Verdict.PASS, Verdict.FAIL)
    ]
    assert drawn[0] == drawn[2] != drawn[1]
