"""The sheet as a document (PDF, A4): verdict, answer and picture, what to do, tables, notes, lines to sign.

Chinese characters are drawn with a font of the system; where it has none they are question marks, and a document in
Chinese is written in English. The picture is in English.
"""

from __future__ import annotations

import io
import unicodedata
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont, get_font
from matplotlib.patches import Rectangle
from PIL import Image

from processor.language.messages import Messages, messages, text
from processor.model import Verdict
from processor.pipeline import Execution
from processor.report import title_block
from processor.report.headline import BANNER
from processor.report.page import written_table
from processor.report.sheet import content
from processor.report.sheet.picture import TONES
from processor.report.style import LATIN, chinese_font, drawable, pdf
from processor.report.table import Table

NAME = "report.pdf"
PAGE = (210.0, 297.0)  # mm, A4
LEFT, TOP, WIDTH, FOOT = 14.0, 15.0, 182.0, 280.0  # mm, from the upper left corner; FOOT ends what is written
POINT = 25.4 / 72.0  # mm
BODY, CELL, SMALL, HEADING = 8.4, 7.4, 6.8, 10.0  # points
GAP, WIDEST_GAP = 2.2, 7.0  # mm between columns
LEAST_CELL = 4.6  # points: what a table that is too wide is written in at least
WIDER = 1.08  # times the width of common letters: those of verdicts are bold
SOFT, RULE = "#5a6675", "#c9d1d8"
LOGO = (30.0, 14.0)  # mm at most


def document(execution: Execution, sheet: content.Sheet, lang: str = "en") -> bytes:
    """Write the sheet of a run; the same run gives the same bytes on systems with the same fonts."""
    with rc_context({"font.family": [LATIN, *filter(None, [chinese_font()])]}):
        lang = lang if lang == "en" or chinese_font() else "en"
        pages = Pages(messages(lang))
        _front(pages, execution, sheet)
        for sentence in sheet.to_do:
            if sentence is sheet.to_do[0]:
                pages.heading(text("What to do"))
            pages.write(pages.say.text(sentence), bullet=True)
        for table in (*sheet.first, *sheet.further):
            pages.table(table, lang)
        if sheet.remarks:
            pages.heading(text("Remarks"))
        for remark in sheet.remarks:
            pages.write(pages.say.text(remark), bullet=True)
        _end(pages, execution, sheet)
        return pdf(_numbered(pages, execution))


class Pages:
    """Pages that are filled from above; ``y`` is how far the last one is, in mm."""

    def __init__(self, say: Messages) -> None:
        self.say = say
        self.pages: list[Figure] = []
        self.begin()

    def begin(self) -> None:
        """Begin a page."""
        self.pages.append(Figure(figsize=(PAGE[0] / 25.4, PAGE[1] / 25.4)))
        self.y = TOP

    def room(self, height: float) -> None:
        """Begin a page where the last has no room for a height, mm."""
        if self.y + height > FOOT:
            self.begin()

    def put(self, x: float, written: str, size: float, **style: Any) -> None:
        """Write at a place across, mm, with the top of the line at ``y``."""
        at = self.y + 1.02 * size * POINT  # the base line
        self.pages[-1].text(
            x / PAGE[0], 1.0 - at / PAGE[1], drawable(written), fontsize=size, va="baseline", **style
        )  # fmt: skip

    def box(self, x: float, width: float, height: float, colour: str) -> None:
        """Fill a box below ``y``; a rule is a box of no height."""
        self.pages[-1].patches.append(
            Rectangle(
                (x / PAGE[0], 1.0 - (self.y + height) / PAGE[1]), width / PAGE[0], max(height, 0.2) / PAGE[1],
                facecolor=colour, edgecolor="none", transform=self.pages[-1].transFigure,
            )
        )  # fmt: skip

    def image(self, image: Any, x: float, width: float) -> float:
        """Show an image of a width below ``y``, mm; returns its height."""
        height: float = width * image.shape[0] / image.shape[1]
        place = (x / PAGE[0], 1.0 - (self.y + height) / PAGE[1], width / PAGE[0], height / PAGE[1])
        axes = self.pages[-1].add_axes(place)
        axes.axis("off")
        axes.imshow(image, aspect="auto", interpolation="antialiased")
        return height

    def heading(self, said: Any) -> None:
        """Write a heading, which stays with some lines of what follows."""
        self.room(18.0)
        self.y += 3.0
        self.put(LEFT, self.say.text(said), HEADING, fontweight="bold")
        self.y += 1.35 * HEADING * POINT
        self.box(LEFT, WIDTH, 0.0, "black")
        self.y += 1.2

    def write(self, written: str, size: float = BODY, bullet: bool = False, **style: Any) -> None:
        """Write a paragraph."""
        x = LEFT + (3.2 if bullet else 0.0)
        for k, line in enumerate(lines_of(written, LEFT + WIDTH - x, size)):
            self.room(1.4 * size * POINT)
            if bullet and k == 0:
                self.put(LEFT, "•", size)
            self.put(x, line, size, **style)
            self.y += 1.4 * size * POINT

    def table(self, table: Table, lang: str) -> None:
        """Write a table, its heading again on each page; one that is too wide in smaller letters."""
        made = written_table(table, lang)
        self.heading(made["title"])
        if made["note"]:
            self.write(self.say.text(made["note"]), SMALL, color=SOFT)
        headings = [heading for heading, _ in made["columns"]]
        right = [numeric for _, numeric in made["columns"]]
        size, widths = _fitted(headings, [[cell for _, cell in row] for row in made["rows"]])
        self._row([("heading", heading) for heading in headings], widths, right, size)
        for row in made["rows"]:
            if self.y + 1.5 * size * POINT > FOOT:
                self.begin()
                self._row([("heading", heading) for heading in headings], widths, right, size)
            self._row(row, widths, right, size)

    def _row(self, row: Sequence[tuple[str, str]], widths: Sequence[float], right: Sequence[bool], size: float) -> None:
        cells = [lines_of(cell, width + 0.1, size) or [""] for (_, cell), width in zip(row, widths, strict=True)]
        height = 1.4 * size * POINT
        top = self.y
        lines = max(map(len, cells))
        for (kind, _), cell, x, width, is_right in zip(row, cells, _starts(widths), widths, right, strict=True):
            style: dict[str, Any] = {"color": SOFT} if kind == "heading" else {}
            if kind.startswith("verdict"):
                style = {"color": COLOURS.get(kind.removeprefix("verdict").strip(), "black"), "fontweight": "bold"}
            self.y = top + (height * (lines - len(cell)) if kind == "heading" else 0.0)
            for line in cell:
                self.put(x + width if is_right else x, line, size, ha="right" if is_right else "left", **style)
                self.y += height
        self.y = top + lines * height + 0.25
        self.box(LEFT, WIDTH, 0.0, "black" if row and row[0][0] == "heading" else RULE)
        self.y += 0.45


COLOURS = {"good": TONES[Verdict.PASS], "bad": TONES[Verdict.FAIL], "open": TONES[Verdict.INDETERMINATE]}


def _starts(widths: Sequence[float]) -> list[float]:
    """Return where columns begin; room that is left stands between them, as far as a row is still read across."""
    gap = min((WIDTH - sum(widths)) / max(len(widths) - 1, 1), WIDEST_GAP)
    return [LEFT + sum(widths[:k]) + gap * k for k in range(len(widths))]


def _fitted(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> tuple[float, list[float]]:
    """Return the size of letters, and the widths of columns, mm; words of headings, and long cells, go on new lines."""
    least = [max((width_of(word, 1.0) for word in heading.split(" ")), default=0.0) for heading in headings]
    widest = [max([low, *(width_of(row[k], WIDER) for row in rows)]) for k, low in enumerate(least)]
    room = WIDTH - GAP * (len(headings) - 1)
    size = CELL
    while sum(widest) * size > room and size > LEAST_CELL:
        longest = int(np.argmax(widest))
        others = sum(widest) - widest[longest]
        if widest[longest] > 45.0 / CELL and others * size < 0.7 * room:  # a column of sentences takes what is left
            widest[longest] = (room / size - others) * 0.999
            break
        size -= 0.1
    return size, [size * width for width in widest]


def width_of(written: str, size: float) -> float:
    """Return the width of a text in mm; characters of full width are as wide as high."""
    return sum(map(_advance, written)) * size * POINT


@cache
def _advance(character: str) -> float:
    if unicodedata.east_asian_width(character) in "WF":
        return 1.0
    font = get_font(findfont(LATIN))
    font.set_size(100.0, 72)
    return float(font.load_char(ord(character) if font.get_char_index(ord(character)) else ord("?")).horiAdvance) / 6400


def lines_of(written: str, most: float, size: float = BODY) -> list[str]:
    """Break a text into lines of a width, mm, at spaces and beside Chinese characters."""
    lines, line = [], ""
    for piece in _pieces(written):
        if line.strip() and width_of((line + piece).rstrip(), size) > most:
            lines.append(line.rstrip())
            line = ""
        line += piece if line else piece.lstrip()
    return [*lines, *filter(None, [line.rstrip()])]


def _pieces(written: str) -> Iterator[str]:
    """Yield what stays whole: words with the space behind them, and single wide characters."""
    word = ""
    for character in written:
        wide = unicodedata.east_asian_width(character) in "WF"
        word += "" if wide else character
        if wide or character.isspace():
            yield from filter(None, [word, character if wide else ""])
            word = ""
    yield from filter(None, [word])


def _front(pages: Pages, execution: Execution, sheet: content.Sheet) -> None:
    """Write title block and verdict side by side, then the picture."""
    say, block = pages.say, title_block.of(execution.scene, execution.provenance)
    scene = execution.scene
    logo = None if scene.title_block is None or not len(scene.title_block.logo) else scene.title_block.logo.tobytes()
    if logo is not None:
        with Image.open(io.BytesIO(logo)) as opened:
            image = np.asarray(opened.convert("RGBA"))
        width = min(LOGO[0], LOGO[1] * image.shape[1] / image.shape[0])
        pages.image(image, LEFT + WIDTH - width, width)
    for written, size in ((block["company"], BODY), (scene.name, 15.0)):
        for line in lines_of(written, WIDTH - LOGO[0] - GAP, size):
            pages.put(LEFT, line, size, fontweight="bold")
            pages.y += 1.35 * size * POINT
    pages.y += 1.0
    word = lines_of(say.text(BANNER[sheet.verdict]), WIDTH, 17.0)
    said = [line for one in sheet.answer for line in lines_of(say.text(one), WIDTH - 8.0, BODY)]
    height = 5.0 + 1.3 * 17.0 * POINT + 1.4 * BODY * POINT * len(said)
    pages.box(LEFT, WIDTH, height, TONES[sheet.verdict])
    pages.y += 2.2
    for line, size in [*((one, 17.0) for one in word), *((one, BODY) for one in said)]:
        pages.put(LEFT + 4.0, line, size, color="white", fontweight="bold" if size > BODY else "normal")
        pages.y += (1.3 if size > BODY else 1.4) * size * POINT
    pages.y += 4.2
    third = WIDTH / 3.0
    for start in range(0, len(block["rows"]), 3):
        top, lowest = pages.y, pages.y
        for k, (name, value) in enumerate(block["rows"][start : start + 3]):
            pages.y = top
            pages.put(LEFT + k * third, say.text(name), SMALL, color=SOFT)
            pages.y += 1.3 * SMALL * POINT
            for line in lines_of(say.text(value), third - GAP, CELL):
                pages.put(LEFT + k * third, line, CELL)
                pages.y += 1.35 * CELL * POINT
            lowest = max(lowest, pages.y)
        pages.y = lowest + 0.8
    if sheet.picture:
        with Image.open(io.BytesIO(sheet.picture)) as opened:
            pages.y += pages.image(np.asarray(opened), LEFT, WIDTH)


def _end(pages: Pages, execution: Execution, sheet: content.Sheet) -> None:
    """Write the notes, and below them the lines to sign."""
    pages.y += 2.5
    for note in sheet.notes:
        pages.write(pages.say.text(note), SMALL, color=SOFT)
    pages.room(20.0)
    pages.y += 11.0
    half = 0.5 * WIDTH - 5.0
    for k, (who, name) in enumerate(title_block.of(execution.scene, execution.provenance)["signatures"]):
        x = LEFT + k * (half + 10.0)
        pages.box(x, half, 0.0, "black")
        top = pages.y
        pages.y += 0.8
        pages.put(x, f"{pages.say.text(who)}   {name}", SMALL)
        pages.put(x + 0.72 * half, pages.say.text(text("Date")), SMALL)
        pages.y = top


def _numbered(pages: Pages, execution: Execution) -> Iterator[Figure]:
    head, foot = title_block.head(execution.scene), title_block.foot(execution.provenance)
    for number, page in enumerate(pages.pages, 1):
        for x, y, written, side in (
            (LEFT, 8.0, head, "left"), (LEFT, 289.0, foot, "left"),
            (LEFT + WIDTH, 289.0, f"{number} / {len(pages.pages)}", "right"),
        ):  # fmt: skip
            page.text(x / PAGE[0], 1.0 - y / PAGE[1], drawable(written)[:130], fontsize=6.5, color=SOFT, ha=side)
        yield page
