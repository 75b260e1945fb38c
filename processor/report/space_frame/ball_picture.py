"""The picture of a ball: the points about it in elevation and plan, the fitted and the nominal sphere, its numbers."""

from __future__ import annotations

import textwrap
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.text import Text

from processor.language.messages import messages
from processor.model import NORMAL_95, Floats
from processor.report.style import COLOURS, DPI, number, png, value_or_dash, with_interval
from processor.space_frame.result import Balls, Flag, Result

LINE_SPACING = 2.1  # of the numbers
SLICE_MM = 8.0  # on either side of the plane through the centre
# Points are painted into an image: Matplotlib keeps each page's marks, 13 MB, until a document is complete.
PIXELS, DOT_PIXELS = 400, 3  # along a panel, and of a point
NOTHING, BESIDE, WITHIN = 0, 1, 2  # of a pixel: points before and behind the slice, points in it
PAGE_DPI = 165  # of what the pages of a document share
# In inches: the figure, and its panels (left, bottom, width, height).
SIZE_IN = (12.4, 5.65)
VIEWS_IN = ((0.72, 0.72, 4.03, 4.03), (5.57, 0.72, 4.03, 4.03))  # elevation and plan, to one scale
NUMBERS_IN, NUMBERS_WIDTH_IN = (9.73, 5.02), 2.63  # upper left corner
HEADING_IN, EDGE_IN = 5.07, 0.04  # lower edge of the heading; margin of the legend
HEADING_LINES = 3  # drawn size: more would lie over the views
X_LABEL_IN, Y_LABEL_IN = 0.29, 0.53  # from a view to the labels of its axes
VIEWS = (("from the side", (0, 2)), ("from above", (0, 1)))  # and the axes of each


class BallPicture:
    """One figure, to show ball after ball.

    Axes, legend and names of numbers take most of the time. They are the same for all balls that are shown to the same
    distance: drawn once as pixels, they lie under what differs, and pages of a document share them.
    """

    def __init__(self) -> None:
        self._figure, self._frame = Figure(figsize=SIZE_IN, dpi=DPI), Figure(figsize=SIZE_IN, dpi=DPI)
        self._under = _Pixels()
        self._figure.add_artist(self._under)
        self._framed = [_framed_view(self._frame, *view) for view in zip(VIEWS_IN, VIEWS, strict=True)]
        self._views = [
            _View(self._figure.add_axes(_shares(*place)), across)
            for place, (_, across) in zip(VIEWS_IN, VIEWS, strict=True)
        ]
        self._names = _list(self._frame, NUMBERS_IN[0], "left")
        self._values = _list(self._figure, NUMBERS_IN[0] + NUMBERS_WIDTH_IN, "right")
        self._heading = self._figure.text(0.5, HEADING_IN / SIZE_IN[1], "", fontsize=11, ha="center", va="bottom")
        self._reach = 0.0
        self._drawn: dict[tuple[float, int], npt.NDArray[np.uint8]] = {}
        _put_legend(self._frame)

    def show(self, result: Result, i: int, middle: Floats, nominal: Floats, points: Floats, reach: float) -> None:
        """Show ball ``i`` about ``middle`` (3,) to a distance ``reach``, mm.

        ``points`` (n, 3) and the place ``nominal`` (3,) are less the middle; one that is not finite is not shown.
        """
        balls = result.balls
        heading = f"Ball {balls.names[i]}: {balls.flag[i]}. {messages('en').sentences(balls.reasons[i])}"
        self._heading.set_text("\n".join(textwrap.wrap(heading, 130)[:HEADING_LINES]))
        members = _members(result, i, middle, reach)
        fitted = np.nan if balls.flag[i] is Flag.NOT_FOUND else float(balls.radii[i])
        for view in self._views:
            view.show(points, members, reach)
            view.nominal.show(nominal[list(view.across)], float(balls.nominal_radii[i]))
            view.fitted.show(np.zeros(2), fitted)
        rows = numbers(balls, i, nominal)
        self._names.set_text("\n".join(name for name, _ in rows))
        self._values.set_text("\n".join(value_or_dash(value) for _, value in rows))
        self._reach = reach

    def png(self) -> bytes:
        """Return the picture as PNG."""
        self._under.pixels = self._frame_at(DPI)
        return png(self._figure)

    def add_to(self, document: Any) -> None:
        """Add the picture as a page to a document of :func:`processor.report.style.pdf_document`."""
        self._under.pixels = self._frame_at(PAGE_DPI)
        document.savefig(self._figure, dpi=PAGE_DPI)

    def _frame_at(self, dpi: int) -> npt.NDArray[np.uint8]:
        """Return what is the same for all balls, as pixels (h, w, 4) from the lowest row upwards."""
        key = (self._reach, dpi)
        if key not in self._drawn:
            for axes in self._framed:
                axes.set(xlim=(-self._reach, self._reach), ylim=(-self._reach, self._reach))
            self._frame.set_dpi(dpi)
            canvas: Any = FigureCanvasAgg(self._frame)
            canvas.draw()
            self._drawn[key] = np.asarray(canvas.buffer_rgba())[::-1].copy()
        return self._drawn[key]


def _list(figure: Figure, x_in: float, side: Literal["left", "right"]) -> Text:
    """Add a text of many lines beside the views."""
    x, y = x_in / SIZE_IN[0], NUMBERS_IN[1] / SIZE_IN[1]
    return figure.text(x, y, "", fontsize=8, linespacing=LINE_SPACING, ha=side, va="top")


class _Pixels(Artist):
    """Pixels of the size of the figure, under all else. A document stores an array that many pages show once."""

    pixels: npt.NDArray[np.uint8]

    def __init__(self) -> None:
        super().__init__()
        self.set_zorder(-1.0)

    def draw(self, renderer: RendererBase) -> None:
        """Draw the pixels (h, w, 4), which have the resolution of the renderer."""
        gc = renderer.new_gc()
        renderer.draw_image(gc, 0.0, 0.0, self.pixels)
        gc.restore()


class _Sphere(NamedTuple):
    """The outline of a sphere in a view, and its middle."""

    outline: Circle
    middle: Line2D

    def show(self, place: Floats, radius: float) -> None:
        """Show a sphere with its middle at a place (2,); none where place or radius is not finite."""
        known = bool(np.isfinite([*place, radius]).all())
        for artist in self:
            artist.set_visible(known)
        if known:
            self.outline.set(center=place.tolist(), radius=radius)
            self.middle.set_data(*place[:, None])


class _View:
    """What is shown in a view ``across`` two axes, to the right and up; :func:`_framed_view` draws these."""

    def __init__(self, axes: Axes, across: tuple[int, int]) -> None:
        self._axes, self.across = axes, across
        axes.axis("off")
        self._points = axes.imshow(
            np.zeros((PIXELS, PIXELS), np.uint8), cmap=ListedColormap(["#ffffff00", "0.72", "black"]),
            vmin=NOTHING, vmax=WITHIN, origin="lower", interpolation="none", aspect="auto", zorder=2.0,
        )  # fmt: skip
        (self._members,) = axes.plot([], [], "-.", color=COLOURS[2], linewidth=1.1, zorder=3.0)
        self.nominal, self.fitted = _sphere(axes, COLOURS[1], "--"), _sphere(axes, COLOURS[0], "-")

    def show(self, points: Floats, members: Floats, reach: float) -> None:
        """Show points (n, 3) to a distance ``reach``, and members (m, 3), lines between rows that are not finite."""
        self._points.set_data(painted(points[:, self.across], points[:, 3 - sum(self.across)], reach))
        self._points.set_extent((-reach, reach, -reach, reach))
        self._members.set_data(*members[:, self.across].T)
        self._axes.set(xlim=(-reach, reach), ylim=(-reach, reach))


def _framed_view(figure: Figure, place: tuple[float, float, float, float], view: tuple[str, tuple[int, int]]) -> Axes:
    """Add the axes of a view, with labels at fixed places: Matplotlib lays all ticks out to place them."""
    axes, (name, across) = figure.add_axes(_shares(*place)), view
    axes.set(xlabel="x less the centre's, mm", ylabel=f"{'xyz'[across[1]]} less the centre's, mm")
    axes.set_title(name, y=1.0)  # a title without a height is placed above all ticks, which are laid out for that
    axes.grid(alpha=0.3)
    axes.xaxis.set_label_coords(0.5, -X_LABEL_IN / place[3])
    axes.yaxis.set_label_coords(-Y_LABEL_IN / place[2], 0.5)
    return axes


def painted(points: Floats, depth: Floats, reach: float) -> npt.NDArray[np.uint8]:
    """Return an image (PIXELS, PIXELS), rows upwards, of points (n, 2) to a distance ``reach``, mm.

    Those whose ``depth`` (n,) is within SLICE_MM are painted over the others.
    """
    half = DOT_PIXELS // 2
    column, row = np.floor((points.T + reach) * (0.5 * PIXELS / reach)).astype(np.int64) + half
    shown = (np.minimum(column, row) >= half) & (np.maximum(column, row) < PIXELS + half)
    within = np.abs(depth) <= SLICE_MM
    image = np.full((PIXELS + 2 * half, PIXELS + 2 * half), NOTHING, np.uint8)
    for value, chosen in ((BESIDE, shown & ~within), (WITHIN, shown & within)):
        for i in range(-half, half + 1):
            for j in range(-half, half + 1):
                image[row[chosen] + i, column[chosen] + j] = value
    return image[half:-half, half:-half]


def _sphere(axes: Axes, colour: str, dash: str) -> _Sphere:
    outline = Circle((0.0, 0.0), 1.0, fill=False, edgecolor=colour, linestyle=dash, linewidth=1.6, zorder=4.0)
    axes.add_patch(outline)
    (middle,) = axes.plot([], [], "+", color=colour, markersize=9.0, zorder=4.0)
    return _Sphere(outline, middle)


def _shares(left: float, bottom: float, wide: float, high: float) -> tuple[float, float, float, float]:
    """Return a place in inches as shares of the figure."""
    width, height = SIZE_IN
    return left / width, bottom / height, wide / width, high / height


def _put_legend(figure: Figure) -> None:
    handles = [
        Line2D([], [], marker=".", linestyle="", color="black", label=f"points within {SLICE_MM:g} mm of the plane"),
        Line2D([], [], marker=".", linestyle="", color="0.72", label="points before and behind it"),
        Line2D([], [], color=COLOURS[0], marker="+", label="fitted"),
        Line2D([], [], color=COLOURS[1], linestyle="--", marker="+", label="nominal"),
        Line2D([], [], color=COLOURS[2], linestyle="-.", label="axes of members"),
    ]
    below = (0.5, EDGE_IN / SIZE_IN[1])
    figure.legend(handles=handles, loc="lower center", bbox_to_anchor=below, borderaxespad=0.0, ncols=5, fontsize=8)


def _members(result: Result, i: int, middle: Floats, reach: float) -> Floats:
    """Return the axes of the members that meet at a ball, each through it to the border of the picture.

    These are lines (m, 3), less ``middle`` (3,), with a row of NaN behind each.
    """
    tubes, id_ = result.tubes, result.balls.ids[i]
    lines = [np.empty((0, 3))]
    for tube in np.flatnonzero((tubes.a == id_) | (tubes.b == id_)).tolist():
        start, end = tubes.start[tube] - middle, tubes.end[tube] - middle
        direction = end - start if tubes.a[tube] == id_ else start - end
        direction = direction / np.linalg.norm(direction)
        foot = start - (start @ direction) * direction
        lines.append(foot + np.array([[-0.25], [2.0], [np.nan]]) * reach * direction)
    return np.vstack(lines)


def numbers(balls: Balls, i: int, nominal: Floats) -> list[tuple[str, str | None]]:
    """Return names and values of a ball's figures; ``nominal`` (3,) is the design's place less the ball's."""
    sd = np.sqrt(np.where((variance := np.diag(balls.covariance[i])) >= 0.0, variance, np.nan))
    bound = balls.bound_sd[i]
    rows: list[tuple[str, str | None]] = [("mm", "± 95 %")]
    for k, axis in enumerate("xyz"):
        rows.append((f"centre {axis}", with_interval(balls.centres[i, k], NORMAL_95 * sd[k], 1)))
    rows += [
        ("radius", with_interval(balls.radii[i], NORMAL_95 * sd[3], 2)),
        ("size in the catalogue", number(balls.sizes[i], "g")),
        ("radius designed", number(balls.nominal_radii[i], "g")),
        ("lowest point z", with_interval(balls.lowest[i, 2], NORMAL_95 * balls.lowest_sd[i], 2)),
    ]
    off = zip("xyz", (-nominal).tolist(), strict=True)
    rows += [(f"off the design's place, {axis}", number(value, ".2f")) for axis, value in off]
    rows += [
        (f"least possible ±, {quantity}", number(NORMAL_95 * bound[k], ".2f"))
        for k, quantity in ((2, "z"), (3, "radius"))
    ]
    rows += [
        ("residuals, rms", number(balls.rms[i], ".2f")),
        ("points", f"{int(balls.points[i])}"),
        ("visible, %", number(100.0 * balls.visible_fraction[i], ".0f")),
        ("stations", f"{int(balls.stations[i])}"),
        ("axes of members", f"{int(balls.axes[i])}"),
        ("evidence", balls.evidence[i]),
    ]
    return rows
