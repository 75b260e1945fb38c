"""The pages of batches, comparisons, nights and defects in a browser: no console messages, requests or run names."""

import json

import pytest

from processor.batch import summary_values
from processor.report import all_figures, page
from tests.support.pages import page_layout, pages
from tests.support.pages.browser import dragged, opened, picture, read_over
from tests.support.processes.batches import folder, run

BAD = "<script>alert(1)</script>.ply"
BOTH = (("en", 1200), ("zh", 400))


@pytest.mark.parametrize(("lang", "width"), BOTH)
def test_the_index_of_a_batch(tmp_path, lang, width):
    pages.indexed(tmp_path, lang)
    with opened(tmp_path / "index.html", width) as shown:
        assert shown.locator("html").get_attribute("lang") == lang
        assert shown.locator("thead").first.locator("th").count() == 4 + len(summary_values.COLUMNS) - 1
        assert page_layout.faults(shown) == []


def test_a_file_named_as_a_script_is_shown_as_text(tmp_path):
    """A slash in a name is a folder's: the path of its file below the root is the whole name."""
    outer = tmp_path / "root" / BAD.split("/")[0]
    folder(outer / "other")
    (outer / BAD.split("/")[1]).write_text("1 2 3\n")
    (tmp_path / "root" / "<script>alert(2)<script>.ply").write_text("1 2 3\n")
    for name in ("truth.h5", "notes"):
        (tmp_path / "root" / name).write_text("")
    folder(tmp_path / "root" / "<img src=x onerror=alert(3)>", "segfault")
    run(tmp_path / "root", "-o", tmp_path / "out", "--lang", "zh", code=1)
    inputs = {one["input"] for one in json.loads((tmp_path / "out/summary.json").read_text("utf-8"))["inputs"]}
    others = {"<script>alert(2)<script>.ply", "<img src=x onerror=alert(3)>"}
    assert inputs == {BAD, f"{BAD.split('/')[0]}/other"} | others
    with opened(tmp_path / "out" / "index.html") as shown:
        cells = shown.locator("tbody td:first-child").all_text_contents()
        assert {cell.removesuffix(" (日志)").strip() for cell in cells} == inputs
        assert shown.locator("script, img").count() == 0


@pytest.mark.parametrize(("lang", "width"), [pytest.param(*BOTH[0], marks=pytest.mark.slow), BOTH[1]])
def test_the_pages_of_nights(tmp_path, lang, width):
    pages.two_nights(tmp_path, lang)
    for name in ("nights.html", "certificate.html"):
        with opened(tmp_path / name, width) as shown:
            assert shown.locator("html").get_attribute("lang") == lang
            assert shown.locator("tbody tr").count() > 2
            assert page_layout.faults(shown) == []


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    execution, report = pages.searched()
    drawn = all_figures.draw_figures(execution, report)
    folder_of = tmp_path_factory.mktemp("pages")
    for lang in ("en", "zh"):
        (folder_of / f"{lang}.html").write_text(page.html(execution, report, drawn, lang), "utf-8")
    return folder_of, execution.runs[0].result


@pytest.mark.parametrize(("lang", "width"), BOTH)
def test_defects_in_space_react(searched, lang, width):
    folder_of, result = searched
    with opened(folder_of / f"{lang}.html", width) as shown:
        assert page_layout.faults(shown) == []
        shown.locator("canvas.space").scroll_into_view_if_needed()
        first = picture(shown)
        turned = dragged(shown, 60, 20)
        assert turned != first
        ticks = shown.locator(".live fieldset label")
        assert ticks.count() == 1 + len(result.defects)
        assert ticks.nth(1).text_content().strip() == ("0: dent" if lang == "en" else "0：凹坑")
        ticks.nth(3).locator("input").uncheck()
        assert picture(shown) != turned


def test_a_place_of_a_defect_is_read_with_its_deviation_and_region(searched):
    folder_of, result = searched
    with opened(folder_of / "en.html") as shown:
        shown.locator("canvas.space").scroll_into_view_if_needed()
        picture(shown)
        everything = picture(shown)
        shown.locator("select").select_option(label="2: bend")
        assert picture(shown) != everything
        read = read_over(shown, 20, [down / 10 for down in range(1, 10)])
        k = result.defects.defect_class.index("bend")
        mark = [one for one in read if one.startswith("2: bend, depth")]
        assert mark == [f"2: bend, depth 1.500 ± 0.300 mm, area 13500 mm2, {result.defects.component[k]}"]
        places = [one for one in read if one.startswith("surface: ") and "mm from the design at" in one]
        values = {f"surface: {value:.3f} mm" for value in result.surface.deviation.tolist()}
        assert len(places) > 3
        assert all(one.split(" from ")[0] in values for one in places)
        assert any("; " in one for one in places)
