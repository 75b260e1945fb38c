"""The title block and the characteristics of the report: from project.toml to the page."""

import base64
import dataclasses
import datetime
import io
import itertools
import re

import numpy as np
import pytest
from PIL import Image

from processor.evaluation.evaluate import ErrorReport
from processor.model import InputError, TitleBlock, Verdict
from processor.report import all_tables, title_block
from processor.report import table as report_table
from processor.results import to_json
from processor.scan_folder.folder import read_input
from processor.store import store
from tests.support.pages import page_layout
from tests.support.pages.browser import opened
from tests.support.pages.report_pages import BAD, Page, rendered
from tests.support.results.bridge_results import PROVENANCE, of_bridge

FULL = """
[report]
weather = "dry, 4 C"
company = "Steelwork Ltd"
project = "East  bridge"
drawing = "D-1042"
order = 7781
operator = "Li Wei"
scanner = ""
scanned = 2026-11-20
approved = "A. Meyer"
"""


def folder_of(tmp_path, toml):
    (tmp_path / "project.toml").write_text(toml, "utf-8")
    (tmp_path / "scan.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n0 0 1\n")
    return tmp_path


def picture(format_="PNG", size=(40, 20)):
    out = io.BytesIO()
    Image.new("RGB", size, (200, 30, 30)).save(out, format_)
    return out.getvalue()


# --- project.toml ---


def test_title_block_lists_known_keys_first_and_omits_empty_ones(tmp_path):
    block = read_input(folder_of(tmp_path, FULL)).title_block
    assert dict(zip(block.keys, block.values, strict=True)) == {
        "company": "Steelwork Ltd", "project": "East bridge", "drawing": "D-1042", "order": "7781",
        "operator": "Li Wei", "scanned": "2026-11-20", "approved": "A. Meyer", "weather": "dry, 4 C",
    }  # fmt: skip
    assert block.keys[-1] == "weather"
    assert not len(block.logo)


@pytest.mark.parametrize("format_", ["PNG", "JPEG"])
def test_a_logo_is_kept_as_it_is(tmp_path, format_):
    (tmp_path / "logo.any").write_bytes(picture(format_))
    scene = read_input(folder_of(tmp_path, '[report]\nlogo = "logo.any"\n'))
    assert scene.title_block.logo.tobytes() == picture(format_)
    assert title_block.of(scene, PROVENANCE)["logo"].startswith(f"data:image/{format_.lower()};base64,")


def test_title_block_does_not_change_the_hash_of_a_scene(tmp_path):
    """A name can be added after the run: the results are those of the same scene."""
    with_block = read_input(folder_of(tmp_path, FULL))
    without = dataclasses.replace(with_block, title_block=None)
    assert store.scene_hash(with_block) == store.scene_hash(without)
    assert store.scene_hash(dataclasses.replace(without, temperature_C=20.0)) != store.scene_hash(without)
    store.write_scene(tmp_path / "s.h5", with_block, None, {})
    assert store.read_scene(tmp_path / "s.h5").title_block.values == with_block.title_block.values


@pytest.fixture(scope="module")
def bad_logos():
    """Files that are no logo, by their names."""
    return {
        "half.png": picture(size=(400, 400))[:-300],
        "logo.svg": b"<svg xmlns='http://www.w3.org/2000/svg'><script>alert(1)</script></svg>",
        "large.png": picture(size=(3000, 2000)),
        "long.png": picture() + bytes(1_000_000),
    }


@pytest.mark.parametrize(
    ("toml", "said"),
    [
        ("report = 3", "expected a table"),
        ("[report]\nproject = true", "expected a text, number or date as 'project', found true or false"),
        ("[report]\n'' = 'a'", "expected keys of 1 to 40 characters"),
        (f"[report]\nproject = '{'a' * 201}'", "expected at most 200 characters as 'project', found 201"),
        ("[report]\n" + "\n".join(f"k{i} = 1" for i in range(31)), "expected at most 30 keys, found 31"),
        ("[report]\nlogo = 'none.png'", "there is no file 'none.png'"),
        ("[report]\nlogo = 'scan.xyz'", "expected a picture in PNG or JPEG, found a file that is none"),
        ("[report]\nlogo = 'half.png'", "expected a picture in PNG or JPEG, found a file that is none, or is damaged"),
        ("[report]\nlogo = 'logo.svg'", "expected a picture in PNG or JPEG"),
        ("[report]\nlogo = 'large.png'", "3000 x 2000 pixels, more than"),
        ("[report]\nlogo = 'long.png'", "expected a logo of at most 1000000 bytes"),
    ],
)
def test_bad_input_is_one_clear_error(tmp_path, bad_logos, toml, said):
    for name, content in bad_logos.items():
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=re.escape(said)) as raised:
        read_input(folder_of(tmp_path, toml))
    assert str(tmp_path) in str(raised.value)


# --- the page ---


def with_block(execution, *entries, logo=b""):
    block = TitleBlock(tuple(k for k, _ in entries), tuple(v for _, v in entries), np.frombuffer(logo, np.uint8))
    return dataclasses.replace(execution, scene=dataclasses.replace(execution.scene, title_block=block))


INNER = "(all) => all.map((one) => one.innerText).join(' ')"
EVIL = BAD + '"}</style><img src=x onerror=alert(1)>\\'


def test_every_text_of_the_title_block_is_text(tmp_path):
    keys = ("company", "project", "drawing", "operator", "approved", EVIL[:40])
    execution = with_block(of_bridge(), *((key, EVIL) for key in keys), logo=picture())
    text = rendered(execution)
    assert "<img src=x" not in text
    assert "</style><" not in text.replace("</style>\n</head>", "")
    path = tmp_path / "r.html"
    path.write_text(text, "utf-8")
    with opened(path) as shown:
        assert shown.locator("header, .signatures").evaluate_all(INNER).count(EVIL) == len(keys)
        assert shown.locator("header img").evaluate("(img) => img.naturalWidth") == 40
        rules = shown.evaluate("[...document.styleSheets[0].cssRules].map((rule) => rule.cssText).join('\\n')")
    assert "counter(pages)" in rules
    assert f"data:image/png;base64,{base64.b64encode(picture()).decode()}" in text


def test_without_a_title_block_there_are_lines_to_sign_all_the_same():
    found = title_block.of(of_bridge().scene, PROVENANCE)
    assert (found["company"], found["logo"]) == ("", "")
    assert [(str(who), name) for who, name in found["signatures"]] == [("Inspected", ""), ("Approved", "")]
    assert [str(value) for _, value in found["rows"]] == ["phase (class, assumed)", "b.h5, SHA-256 00", "processor 0"]


def test_the_page_has_no_date_but_those_of_the_input():
    text = Page(rendered(with_block(of_bridge(), ("scanned", "2011-02-03")))).text
    assert re.findall(r"\d{4}-\d\d-\d\d", text) == ["2011-02-03"]
    assert str(datetime.date.today().year) not in text


@pytest.mark.parametrize(("width", "height"), [(1400, 900), (390, 844)])
def test_the_first_screen_has_headline_and_verdict(tmp_path, width, height):
    keys = ("company", "project", "drawing", "order", "operator", "scanner", "serial", "scanned", "approved", "a", "b")
    path = tmp_path / "r.html"
    path.write_text(rendered(with_block(of_bridge(), *((key, "thirty characters of some text") for key in keys))))
    with opened(path, width, height) as shown:
        for at in (".banner strong", ".banner p", "h1"):
            box = shown.locator(at).first.bounding_box()
            assert box["y"] + box["height"] < 0.6 * height
        assert shown.locator(".banner strong").inner_text() == "FAIL"
        assert page_layout.faults(shown) == []


# --- characteristics ---


def test_characteristics_are_those_of_results_json_worst_first():
    execution = of_bridge()
    step = to_json.results_json(execution, ErrorReport())["steps"]["preassemble"]
    wanted = {}
    for of_place in (*step["joint_measures"], *step["chain_limits"]):
        for limit in of_place["limits"]:
            what = limit["limit"].removesuffix("_mm").replace("_", " ")
            wanted[f"{of_place.get('name', 'chain')} {what}"] = limit
    (table,) = [t for t in all_tables.tables_of_run(execution, ErrorReport()) if t.file == "characteristics"]
    rows = [dict(zip((column.name for column in table.columns), row, strict=True)) for row in table.rows]
    assert {str(row["id"]) for row in rows} == set(wanted)
    for row in rows:
        limit = wanted[str(row["id"])]
        assert (row["verdict"], row["unit"]) == (limit["verdict"], "mm")
        assert row["deviation"] == pytest.approx(limit["value"])
        assert row["actual"] - row["nominal"] == pytest.approx(limit["value"])
        assert row["ci95"] == pytest.approx(limit["ci95"])
        for mine, theirs in (("lower", "low"), ("upper", "high")):
            assert report_table.shown(row[mine]) == ("–" if limit[theirs] is None else f"{limit[theirs]:.3f}")
    order = [verdict for verdict, _ in itertools.groupby(row["verdict"] for row in rows)]
    assert order == [Verdict.FAIL, Verdict.INDETERMINATE, Verdict.PASS][: len(order)]
    span = next(row for row in rows if str(row["id"]) == "chain span")
    # Left edges of three parts of 4 m one after the other; the right edges of this scene all lie at the first.
    assert span["nominal"] == pytest.approx(0.5 * (12_000.0 + 4_000.0))


def test_verdict_is_shown_by_colour_sign_and_word(tmp_path):
    path = tmp_path / "r.html"
    path.write_text(rendered(of_bridge()), "utf-8")
    with opened(path) as shown:
        cells = shown.locator("td.verdict.bad")
        assert set(cells.all_text_contents()) == {"fail"}
        style = "(cell) => [getComputedStyle(cell, '::before').content, getComputedStyle(cell).color]"
        sign, colour = cells.first.evaluate(style)
        assert "✗" in sign
        assert colour != shown.locator("td.number").first.evaluate(style)[1]
        open_ = shown.locator("td.verdict.open").first.evaluate(style)
        assert open_[1] not in (colour, shown.locator("td.number").first.evaluate(style)[1])
        assert shown.locator(".banner").get_attribute("class") == "banner bad"
