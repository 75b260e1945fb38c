"""The report as a document (PDF, A4): title block and verdicts, what is compared with limits, and the figures.

Chinese characters are drawn with a font of the system; where it has none they are question marks, and a document in
Chinese is written in English. The figures are in English.
"""

from __future__ import annotations

import io
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.image import imread

from processor.language.messages import Messages, label, messages, text
from processor.limits.judging import Judged
from processor.model import Verdict, worst
from processor.pipeline import Execution
from processor.report import characteristics, headline, title_block
from processor.report.reports_of_steps import characteristics_of
from processor.report.style import LATIN, Drawn, chinese_font, drawable, pdf
from processor.report.table import shown

NAME = "report.pdf"
A4 = (8.27, 11.69)  # inches
LEFT, RIGHT, TOP, BOTTOM = 0.08, 0.94, 0.93, 0.06  # shares of the page
LINE = 0.0165  # share of the page: 4.9 mm, of texts of 8 to 9 points
LINE_WIDTH = 98  # characters
LOGO = (1.8, 0.9)  # inches at most
ROWS_A_PAGE = 44  # what fits on A4 at that height
COLOURS = {Verdict.PASS: "#005a94", Verdict.FAIL: "#b34700"}
# Where the columns of the table stand: share of the page, and how they are aligned.
COLUMNS = (
    ("id", 0.08, "left"), ("verdict", 0.32, "left"), ("nominal", 0.51, "right"), ("actual", 0.61, "right"),
    ("deviation", 0.70, "right"), ("± 95 %", 0.77, "right"), ("lower", 0.84, "right"), ("upper", 0.91, "right"),
    ("unit", 0.92, "left"),
)  # fmt: skip


@dataclass(frozen=True)
class Line:
    """A line of text, its size in points, weight and colour."""

    text: str
    size: float = 9.0
    weight: str = "normal"
    colour: str = "black"


def document(execution: Execution, figures: Mapping[str, Drawn], lang: str = "en") -> bytes:
    """Write the document; the same run gives the same bytes on systems with the same fonts."""
    with rc_context({"font.family": [LATIN, *filter(None, [chinese_font()])]}):
        return _document(execution, figures, messages(lang if lang == "en" or chinese_font() else "en"))


def _document(execution: Execution, figures: Mapping[str, Drawn], say: Messages) -> bytes:
    pages = [*_front(execution, say), *_characteristics(execution, say)]
    drawn = [(say.text(caption), png) for of_step in figures.values() for caption, png in of_step.figures.values()]
    count = len(pages) + len(drawn)
    head, foot = drawable(title_block.head(execution.scene)), drawable(title_block.foot(execution.provenance))

    def finished() -> Iterator[Figure]:
        for number in range(count):
            page = pages[number] if number < len(pages) else _picture(*drawn[number - len(pages)])
            page.text(LEFT, 0.97, head[:110], fontsize=7, color="0.35")
            page.text(LEFT, 0.025, foot[:110], fontsize=7, color="0.35")
            page.text(RIGHT, 0.025, f"{number + 1} / {count}", fontsize=7, color="0.35", ha="right")
            yield page

    return pdf(finished())


def _front(execution: Execution, say: Messages) -> Iterator[Figure]:
    """Yield the pages of title block, verdict, headlines and lines to sign."""
    runs = [run for run, _ in execution.by_step()]
    scene, verdict = execution.scene, worst(run.verdict for run in runs)
    word = say.text(text("NO VERDICT") if verdict is Verdict.NONE else verdict).upper()
    held = [one for run in runs for one in characteristics_of(scene, run)]
    lines = [Line(scene.name, 16, "bold"), Line("")]
    lines += [
        Line(word, 18, "bold", COLOURS.get(verdict, "black")),
        Line(""),
        *_wrapped(say.text(characteristics.summary(held))),
    ]
    lines.append(Line(""))
    for name, value in title_block.entries(scene).items():
        lines += _wrapped(f"{say.text(title_block.LABELS.get(name, label(name.replace('_', ' '))))}: {value}")
    lines += _wrapped(f"{say.text(text('Instrument'))}: {say.text(title_block.instrument(scene))}")
    for fact, value in title_block.facts(execution.provenance):
        lines += _wrapped(f"{say.text(fact)}: {value}")
    lines.append(Line(""))
    if scene.title_block is not None:
        for who, _ in title_block.SIGNATURES:
            lines += [Line(""), Line(f"{say.text(who)}: {'_' * 36}   {say.text(text('Date'))}: {'_' * 14}")]
        lines.append(Line(""))
    for run in runs:
        lines += _wrapped(say.text(headline.of_step(run)), weight="bold")
        reasons = getattr(run.result, "reasons", ())
        lines += [*_wrapped(say.sentences(reasons)), Line("")] if reasons else [Line("")]
    if (to_confirm := headline.to_confirm(execution)) is not None:
        lines += _wrapped(say.text(to_confirm))
    for start in range(0, len(lines), ROWS_A_PAGE):
        page = _page(lines[start : start + ROWS_A_PAGE])
        if start == 0 and scene.title_block is not None and len(scene.title_block.logo):
            _put_logo(page, scene.title_block.logo.tobytes())
        yield page


def _put_logo(page: Figure, data: bytes) -> None:
    """Show the logo in the upper right corner, in its own proportions."""
    from PIL import Image

    with Image.open(io.BytesIO(data)) as opened:
        image = np.asarray(opened.convert("RGBA"))
    scale = min(LOGO[0] / image.shape[1], LOGO[1] / image.shape[0])
    width, height = scale * image.shape[1] / A4[0], scale * image.shape[0] / A4[1]
    axes = page.add_axes((RIGHT - width, TOP - height, width, height))
    axes.axis("off")
    axes.imshow(image, aspect="auto", interpolation="antialiased")


def _wrapped(written: str, weight: str = "normal") -> list[Line]:
    return [Line(part, weight=weight) for part in lines_of(written)]


def lines_of(written: str, most: int = LINE_WIDTH) -> list[str]:
    """Break a text into lines of a width, at spaces and beside Chinese characters, which are twice as wide."""
    lines, line = [], ""
    for piece in _pieces(written):
        if line.strip() and _width(line) + _width(piece.rstrip()) > most:
            lines.append(line.rstrip())
            line = ""
        line += piece if line else piece.lstrip()
    return [*lines, *filter(None, [line.rstrip()])]


def _pieces(written: str) -> Iterator[str]:
    """Yield what stays whole: words with the space behind them, and single wide characters."""
    word = ""
    for character in written:
        if _width(character) == 2:
            yield from filter(None, [word])
            yield character
            word = ""
            continue
        word += character
        if character.isspace():
            yield word
            word = ""
    yield from filter(None, [word])


def _width(written: str) -> int:
    return sum(2 if unicodedata.east_asian_width(character) in "WF" else 1 for character in written)


def _page(lines: Sequence[Line]) -> Figure:
    page = Figure(figsize=A4)
    for row, line in enumerate(lines):
        page.text(
            LEFT, TOP - 1.15 * LINE * row, drawable(line.text), fontsize=line.size, fontweight=line.weight,
            color=line.colour, va="top",
        )  # fmt: skip
    return page


def _characteristics(execution: Execution, say: Messages) -> Iterator[Figure]:
    """Yield the pages of the table, worst first in each step."""
    for run, _ in execution.by_step():
        held = characteristics_of(execution.scene, run)
        for start in range(0, len(held), ROWS_A_PAGE):
            page = Figure(figsize=A4)
            heading = say.text(text("Characteristics, step {step}", step=run.step))
            page.text(LEFT, TOP, heading, fontsize=11, fontweight="bold", va="top")
            for name, x, side in COLUMNS:
                page.text(x, TOP - 2 * LINE, say.text(label(name)), fontsize=7, color="0.35", ha=side, va="top")
            for row, one in enumerate(held[start : start + ROWS_A_PAGE]):
                _row(page, TOP - (3.2 + row) * 1.15 * LINE, one, say)
            yield page


def _row(page: Figure, y: float, one: Judged, say: Messages) -> None:
    verdict = say.text(one.verdict)
    verdict = verdict.upper() if one.verdict is Verdict.FAIL else verdict
    numbers = (one.nominal, one.actual, one.value, one.ci95, one.low, one.high)
    cells = (say.text(one.of)[:34], verdict, *(shown(number) for number in numbers), one.unit)
    for (name, x, side), cell in zip(COLUMNS, cells, strict=True):
        colour = COLOURS.get(one.verdict, "black") if name == "verdict" else "black"
        weight = "bold" if name == "verdict" else "normal"
        page.text(x, y, drawable(cell), fontsize=7.5, ha=side, va="top", color=colour, fontweight=weight)


def _picture(caption: str, png: bytes) -> Figure:
    """Show a figure as large as the page holds it, above its caption."""
    image = imread(io.BytesIO(png), format="png")
    page = Figure(figsize=A4)
    lines = lines_of(drawable(caption))
    room = (RIGHT - LEFT) * A4[0], (TOP - BOTTOM - LINE * (len(lines) + 2)) * A4[1]
    scale = min(room[0] / image.shape[1], room[1] / image.shape[0])
    width, height = scale * image.shape[1] / A4[0], scale * image.shape[0] / A4[1]
    axes = page.add_axes((LEFT, TOP - height, width, height))
    axes.axis("off")
    axes.imshow(image, aspect="auto", interpolation="antialiased")
    for row, line in enumerate(lines):
        page.text(LEFT, TOP - height - LINE * (row + 1.2), line, fontsize=8, color="0.25", va="top")
    return page
