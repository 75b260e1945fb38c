"""The page in another language."""

import pytest

from processor.report import language


@pytest.fixture
def spoken(monkeypatch):
    found = language.Language("en")
    found.words = {"pass": "合格", "fail": "不合格", "gap": "间隙"}
    found._patterns = [
        (language._pattern(key), text)
        for key, text in {"{} of {} parts": "{1}件中{0}件", "joint {}: {}": "接头{0}：{1}"}.items()
    ]
    return found


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("pass", "合格"),
        ("3 of 5 parts", "5件中3件"),
        ("joint J1: pass", "接头J1：合格"),
        ("joint fail", "joint fail"),
        ("pass; 3 of 5 parts", "合格；5件中3件"),
        ("pass, gap.", "合格，间隙。"),
        ("rib1, x", "rib1, x"),
        ("<b>3</b> of {0} parts", "{0}件中<b>3</b>件"),
        ("", ""),
    ],
)
def test_texts_are_looked_up_matched_or_taken_apart(spoken, text, said):
    assert spoken.say(text) == said


def test_english_says_what_it_is_given():
    assert language.language("en").say("pass; fail.") == "pass; fail."
    assert language.language("en").of_scripts("pass") == {}


@pytest.mark.parametrize("code", [code for code in language.CODES if code != "en"])
def test_a_catalogue_fills_all_its_places(code):
    found = language.Language(code)
    for pattern, text in found._patterns:
        text.format(*range(pattern.groups))
        assert all(f"{{{i}}}" in text for i in range(pattern.groups)), text
