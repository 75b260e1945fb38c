"""Common style of all figures: colours, dashes and markers, printable names, PNG and PDF bytes.

Lines and bars differ in dash, marker or hatch as well as in colour (those of Okabe and Ito, safe for colour-blind
readers). The same run gives the same bytes: no dates, and no settings of the user.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import colors, font_manager
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ft2font import FT2Font
from matplotlib.text import Text
from PIL import Image

from processor.language.messages import Message
from processor.model import Floats

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
DASHES = ("-", "--", ":", "-.")
HATCHES = ("", "///", "...", "xxx")
MARKERS = ("o", "^", "s", "D")
# Orange through grey to blue: safe for colour-blind readers, both ends darker than the middle. The page uses it too.
DIVERGING_STOPS = ("#7a3300", "#D55E00", "#e4e4e4", "#0072B2", "#00304d")
DIVERGING = colors.LinearSegmentedColormap.from_list("residual", DIVERGING_STOPS)
DECADES_APART = 20.0  # ratio between methods above which the axis is logarithmic
LEAST_SHOWN_MM = 1e-3  # of an axis that is logarithmic or without any error: a micrometre is nothing
BEHIND_TEXT = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
LONGEST_LABEL = 24  # characters: drawn size, beside a figure's axis
DPI = 110  # sharp at a page's width of 1000 pixels; twice as many are four times the bytes
COMPRESSION = 3  # of PNGs, of 9: half the time of 6, and 1 % more bytes

CaptionedPngs = dict[str, tuple[str | Message, bytes]]  # file name -> (caption, PNG)


@dataclass(frozen=True)
class Drawn:
    """The figures of a step, and documents of the same pictures by their file names."""

    figures: CaptionedPngs
    documents: dict[str, bytes] = field(default_factory=dict)


@contextmanager
def default_settings() -> Iterator[None]:
    """Draw with Matplotlib's own settings, not with those of the user; names may contain dollar signs."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams["text.parse_math"] = False
        yield


def png(figure: Figure) -> bytes:
    """Write a figure as PNG, without a date."""
    figure.set_dpi(DPI)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()  # Figure.savefig draws a figure with a layout twice
    out = io.BytesIO()
    pixels = np.asarray(canvas.buffer_rgba())[:, :, :3]  # all is opaque
    Image.fromarray(pixels).save(out, "png", dpi=(DPI, DPI), compress_level=COMPRESSION)
    return out.getvalue()


def pdf(pages: Iterable[Figure]) -> bytes:
    """Write figures as a document of a page each, without a date."""
    with pdf_document() as (document, out):
        for page in pages:
            document.savefig(page, dpi=DPI)
            page.clear()  # a figure is part of a circle: its points would stay until the next garbage collection
    return out.getvalue()


@contextmanager
def pdf_document() -> Iterator[tuple[Any, io.BytesIO]]:
    """Yield a document without a date to add pages to, and where it is written when all are added."""
    from matplotlib.backends.backend_pdf import PdfPages  # takes long to load, and few runs write documents

    out = io.BytesIO()
    with PdfPages(out, metadata={"CreationDate": None, "Creator": None, "Producer": None}) as document:
        yield document, out


def translucent(colour: str) -> str:
    """Return a colour for areas that lie on each other, as text: histograms take tuples for a list of colours."""
    return colors.to_hex((*colors.to_rgb(colour), 0.35), keep_alpha=True)


LATIN = "DejaVu Sans"  # comes with Matplotlib
# Fonts with Chinese characters, as systems have them; the first that is there is used.
CHINESE = (
    "Noto Sans CJK SC", "Noto Sans SC", "Source Han Sans SC", "Source Han Sans CN", "Noto Sans CJK JP",
    "WenQuanYi Micro Hei", "WenQuanYi Zen Hei", "Droid Sans Fallback", "Microsoft YaHei", "SimHei", "SimSun",
    "PingFang SC", "Heiti SC", "Arial Unicode MS",
)  # fmt: skip


@cache
def _font() -> FT2Font:
    return font_manager.get_font(font_manager.findfont(LATIN))


@cache
def chinese_font() -> str:
    """Return the name of a font of this system with Chinese characters; "" where there is none."""
    there = {font.name for font in font_manager.fontManager.ttflist}
    return next((name for name in CHINESE if name in there), "")


@cache
def _has(character: str) -> bool:
    code = ord(character)
    if _font().get_char_index(code):
        return True
    return bool(chinese_font()) and bool(
        font_manager.get_font(
            font_manager.findfont(font_manager.FontProperties(family=[chinese_font()]))
        ).get_char_index(code)
    )


def write_beside(axes: Axes, rows: Sequence[tuple[str, str | None]], line: float, size: float) -> list[Text]:
    """Write rows of a name and a value at spacing ``line``, a share of the panel's height; returns the values."""
    axes.axis("off")
    values = []
    for row, (what, value) in enumerate(rows):
        at: dict[str, Any] = {"y": 1.0 - line * row, "fontsize": size, "va": "top", "transform": axes.transAxes}
        axes.text(x=0.0, s=what, ha="left", **at)
        values.append(axes.text(x=1.0, s=value_or_dash(value), ha="right", **at))
    return values


def value_or_dash(value: str | None) -> str:
    """Return a value as it is written, "–" for None."""
    return "–" if value is None else value


def number(value: float, form: str, unit: str = "") -> str | None:
    """Write a number by a format; None for what is not finite."""
    return f"{value:{form}}{unit}" if np.isfinite(value) else None


def with_interval(value: float, half: float, digits: int, unit: str = "") -> str | None:
    """Write a value with the half-width of its interval; None where either is no number."""
    return f"{value:.{digits}f} ± {half:.2f}{unit}" if np.isfinite([value, half]).all() else None


def printable_name(name: str, row: int) -> str:
    """Return a name as Matplotlib can draw it; ``#row+1``, its place in the tables, if the font lacks a character."""
    if not all(character.isprintable() and _font().get_char_index(ord(character)) for character in name):
        return f"#{row + 1}"
    return name if len(name) <= LONGEST_LABEL else name[: LONGEST_LABEL - 1] + "…"


def drawable(text: str) -> str:
    """Return a text with question marks for what the fonts of :func:`families` lack."""
    return "".join(c if c.isprintable() and _has(c) else "?" for c in text)


def colour_limit(values: Floats) -> float:
    """Return the magnitude at which the colours of values (n,) end: 98 % of the finite ones are within."""
    magnitudes = np.abs(values[np.isfinite(values)])
    return max(float(np.quantile(magnitudes, 0.98)), LEAST_SHOWN_MM) if len(magnitudes) else LEAST_SHOWN_MM


def rounded(value: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten, and to 1 at least."""
    if not value > 1.0:
        return 1.0
    ten = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * ten <= value * (1.0 + 1e-9)) * ten)
