"""Pages in a browser: they react, load no files, leave the console empty, and have the numbers of results.json."""

import csv
import io

import pytest

from processor.evaluation.evaluate import ErrorReport
from processor.results import to_json
from tests.support.pages import page_layout
from tests.support.pages.browser import dragged, opened, picture, read_over
from tests.support.pages.report_pages import BAD, rendered
from tests.support.results.ball_results import of_frame
from tests.support.results.bridge_results import of_bridge


def written(folder, text, name="r.html"):
    path = folder / name
    path.write_text(text, "utf-8")
    return path


def cells_below(shown, title):
    """Cells of the table below a heading, row by row."""
    return shown.evaluate(
        "(title) => { const head = [...document.querySelectorAll('h3')].find((h) => h.textContent === title);"
        " let at = head; while (!at.matches('.scroll')) at = at.nextElementSibling;"
        " return [...at.querySelectorAll('tr')].map((row) => [...row.children].map((cell) => cell.textContent)); }",
        title,
    )


@pytest.mark.parametrize("width", [pytest.param(1200, marks=pytest.mark.slow), 500])
def test_a_bridge_in_space_reacts(tmp_path, width):
    path = written(tmp_path, rendered(of_bridge(names=(BAD, "rib1", "foot2"))), "<script>alert(1)<script>.html")
    with opened(path, width) as shown:
        assert shown.locator("canvas").count() == 4
        first = picture(shown)
        shown.locator("canvas.space").scroll_into_view_if_needed()
        assert any("mm from the design at" in one for one in read_over(shown, 20, (0.4, 0.5, 0.6)))
        turned = dragged(shown, 80, 30)
        assert turned != first
        shown.locator(".live fieldset input").first.uncheck()
        assert picture(shown) != turned
        names = shown.locator(".live fieldset label").all_text_contents()
        assert [name.strip() for name in names] == [BAD, "rib1", "foot2"]
        assert page_layout.faults(shown) == []


@pytest.mark.parametrize("width", [1400, 390])
def test_everything_on_the_page_of_a_frame_can_be_reached(tmp_path, width):
    with opened(written(tmp_path, rendered(of_frame()[0])), width) as shown:
        assert page_layout.faults(shown) == []


def test_a_table_without_a_scroll_bar_is_a_fault_of_the_page(tmp_path):
    with opened(written(tmp_path, rendered(of_bridge())), 390) as shown:
        shown.add_style_tag(content=".scroll { overflow: hidden !important }")
        assert page_layout.faults(shown) != []


def test_balls_in_space_react_and_their_table_holds_the_results(tmp_path):
    execution, report = of_frame()
    path = written(tmp_path, rendered(execution))
    step = to_json.results_json(execution, report)["steps"]["spheres"]
    with opened(path) as shown:
        first = picture(shown)
        shown.locator("canvas.space").focus()
        shown.keyboard.press("ArrowLeft")
        assert picture(shown) != first
        head, *cells = cells_below(shown, "Balls, method ray (mm)")
        rows = {row[0]: dict(zip(head, row, strict=True)) for row in cells}
        assert len(rows) == len(step["balls"])
        for ball in step["balls"]:
            for column, value in zip(("x", "y", "z", "radius"), (*ball["centre"], ball["radius"]), strict=True):
                said = rows[str(ball["id"])][column]
                assert said == "–" if value is None else float(said) == pytest.approx(value, abs=0.05)


def test_tables_hold_the_results_and_can_be_copied(tmp_path):
    execution = of_bridge()
    path = written(tmp_path, rendered(execution))
    step = to_json.results_json(execution, ErrorReport())["steps"]["preassemble"]
    with opened(path) as shown:
        shown.context.grant_permissions(["clipboard-read"])
        rows = {row[0]: row[1:] for row in cells_below(shown, "Splicing error, method adjustment (mm)")}
        for key in ("P1", "P5", "P8"):
            gaps = [value for joint in step["joints"] for value in joint["points"][key]["gap"]]
            assert rows[key] == ["–" if value is None else f"{value + 0.0:.2f}" for value in gaps]
        button = shown.locator("button.copy").first
        button.click()
        assert button.text_content() == "copied"
        copied = list(csv.reader(io.StringIO(shown.evaluate("navigator.clipboard.readText()")), delimiter="\t"))
        first = shown.locator("table").first.evaluate(
            "(t) => [...t.rows].map((row) => [...row.cells].map((c) => c.textContent))"
        )
        assert [[cell.strip() for cell in row] for row in copied if any(row)][2:] == first[2:]


@pytest.mark.parametrize("width", [1200, 400])
def test_a_table_has_the_whole_width_and_shows_all_its_rows(tmp_path, width):
    with opened(written(tmp_path, rendered(of_bridge())), width) as shown:
        tables = shown.evaluate(
            "[...document.querySelectorAll('.scroll')].map((scroll) => ({"
            " width: scroll.offsetWidth, section: scroll.closest('section').clientWidth,"
            " hidden: scroll.scrollHeight - scroll.clientHeight, rows: scroll.querySelectorAll('tbody tr').length,"
            " below: scroll.getBoundingClientRect().top"
            "   - scroll.closest('section').querySelector('.copy').getBoundingClientRect().bottom}))"
        )
    assert max(table["rows"] for table in tables) > 20
    for table in tables:
        assert table["width"] == table["section"]
        assert table["below"] >= 0.0
        assert table["hidden"] <= 0 or table["rows"] > 60


def test_no_other_script_runs(tmp_path):
    script = "<script>document.title = 'run'</script>"
    path, titles = written(tmp_path, rendered(of_bridge()).replace("</body>", f"{script}</body>")), []
    with pytest.raises(AssertionError, match="Content Security Policy"), opened(path) as shown:
        titles.append(shown.title())
    assert titles != ["run"]
