"""The picture of a ball: the points about it in elevation and plan, the fitted and the nominal sphere, its numbers."""

from __future__ import annotations

import textwrap
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.text import Text

from processor.language.messages import messages
from processor.model import NORMAL_95, Floats
from processor.report.style import COLOURS, DPI, number, png_of, value_or_dash, with_interval, write_beside
from processor.space_frame.result import Balls, Flag, Result

LINE = 0.052  # of the panel's height
SLICE_MM = 8.0  # on either side of the plane through the centre
# Points are painted into an image: Matplotlib keeps each page's marks, 13 MB, until a document is complete.
PIXELS, DOT_PIXELS = 400, 3  # along a panel, and of a point
NOTHING, BESIDE, WITHIN = 0, 1, 2  # of a pixel: points before and behind the slice, points in it
# In inches: the figure, and its panels with a heading of one line (left, bottom, width, height).
SIZE_IN = (12.4, 5.3)
VIEWS_IN = ((0.72, 0.72, 4.03, 4.03), (5.57, 0.72, 4.03, 4.03))
NUMBERS_IN = (9.73, 0.43, 2.63, 4.59)
HEADING_IN, EDGE_IN = 0.19, 0.04  # a line of the heading, and the margin of heading and legend
X_LABEL_IN, Y_LABEL_IN = 0.29, 0.53  # from a view to the labels of its axes
VIEWS = (("from the side", (0, 2)), ("from above", (0, 1)))  # and the axes of each


class BallPicture:
    """One figure, to show ball after ball.

    What is the same for all balls is made once, and of PNGs drawn once a scale and then copied: axes and texts take
    most of the time. What differs is animated: Matplotlib draws it into documents, and leaves it out of a canvas.
    """

    def __init__(self) -> None:
        self.figure = Figure(figsize=SIZE_IN, dpi=DPI)
        self._canvas: Any = FigureCanvasAgg(self.figure)
        *panels, self._beside = (self.figure.add_axes((0.0, 0.0, 1.0, 1.0)) for _ in (*VIEWS_IN, NUMBERS_IN))
        self._views = [_View(axes, *view) for axes, view in zip(panels, VIEWS, strict=True)]
        self._heading = self._beside.text(
            0.5, 1.0 - EDGE_IN / SIZE_IN[1], "", fontsize=11, ha="center", va="top", transform=self.figure.transFigure,
            animated=True,
        )  # fmt: skip
        self._values: list[Text] = []
        self._scale = 0, 0.0  # lines of the heading, and the reach of the views
        self._backgrounds: dict[tuple[int, float], Any] = {}
        _put_legend(self.figure)

    def show(self, result: Result, i: int, middle: Floats, nominal: Floats, points: Floats, reach: float) -> None:
        """Show ball ``i`` about ``middle`` (3,) to a distance ``reach``, mm.

        ``points`` (n, 3) and the place ``nominal`` (3,) are less the middle; one that is not finite is not shown.
        """
        balls = result.balls
        heading = f"Ball {int(balls.ids[i])}: {balls.flag[i]}. {messages('en').sentences(balls.reasons[i])}"
        lines = textwrap.wrap(heading, 130)[:3]
        self._heading.set_text("\n".join(lines))
        members = _members(result, i, middle, reach)
        fitted = np.nan if balls.flag[i] is Flag.NOT_FOUND else float(balls.radii[i])
        for view in self._views:
            view.show(points, members, reach)
            view.nominal.show(nominal[list(view.across)], float(balls.nominal_radii[i]))
            view.fitted.show(np.zeros(2), fitted)
        rows = numbers(balls, i, nominal)
        if not self._values:
            self._values = write_beside(self._beside, rows, LINE, 8.0)
            for text in self._values:
                text.set_animated(True)
        for text, (_, value) in zip(self._values, rows, strict=True):
            text.set_text(value_or_dash(value))
        if self._scale != (scale := (len(lines), reach)):
            self._place(*scale)
            self._scale = scale

    def png(self) -> bytes:
        """Return the picture as PNG."""
        if self._scale not in self._backgrounds:
            self._canvas.draw()
            self._backgrounds[self._scale] = self._canvas.copy_from_bbox(self.figure.bbox)
        self._canvas.restore_region(self._backgrounds[self._scale])
        for artist in (*(artist for view in self._views for artist in view.changing), *self._values, self._heading):
            artist.draw(self._canvas.get_renderer())
        return png_of(self._canvas)

    def _place(self, lines: int, reach: float) -> None:
        """Lower the upper edges of the panels by the lines of the heading; views stay squares, and show ``reach``."""
        lowered = HEADING_IN * (lines - 1)
        for view, (left, bottom, wide, high) in zip(self._views, VIEWS_IN, strict=True):
            view.place(left + 0.5 * lowered, bottom, wide - lowered, high - lowered)
            view.axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
        left, bottom, wide, high = NUMBERS_IN
        self._beside.set_position(_shares(left, bottom, wide, high - lowered))


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
    """The panel of a view ``across`` two axes: to the right and up."""

    def __init__(self, axes: Axes, name: str, across: tuple[int, int]) -> None:
        self.axes, self.across = axes, across
        self._points = axes.imshow(
            np.zeros((PIXELS, PIXELS), np.uint8), cmap=ListedColormap(["#ffffff00", "0.72", "black"]),
            vmin=NOTHING, vmax=WITHIN, origin="lower", interpolation="none", aspect="auto", zorder=2.0, animated=True,
        )  # fmt: skip
        (self._members,) = axes.plot([], [], "-.", color=COLOURS[2], linewidth=1.1, zorder=3.0, animated=True)
        self.nominal, self.fitted = _sphere(axes, COLOURS[1], "--"), _sphere(axes, COLOURS[0], "-")
        axes.set(xlabel="x less the centre's, mm", ylabel=f"{'xyz'[across[1]]} less the centre's, mm")
        axes.set_title(name, y=1.0)  # a title without a height is placed above all ticks, which are laid out for that
        axes.grid(alpha=0.3)

    @property
    def changing(self) -> tuple[AxesImage | Line2D | Circle, ...]:
        """What differs from ball to ball, in the order in which it is drawn."""
        return (self._points, self._members, *self.nominal, *self.fitted)

    def show(self, points: Floats, members: Floats, reach: float) -> None:
        """Show points (n, 3) to a distance ``reach``, and members (m, 3), lines between rows that are not finite."""
        self._points.set_data(painted(points[:, self.across], points[:, 3 - sum(self.across)], reach))
        self._points.set_extent((-reach, reach, -reach, reach))
        self._members.set_data(*members[:, self.across].T)

    def place(self, left: float, bottom: float, wide: float, high: float) -> None:
        """Place the panel, in inches, and the labels of its axes: Matplotlib lays all ticks out to place them."""
        self.axes.set_position(_shares(left, bottom, wide, high))
        self.axes.xaxis.set_label_coords(0.5, -X_LABEL_IN / high)
        self.axes.yaxis.set_label_coords(-Y_LABEL_IN / wide, 0.5)


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
    axes.add_patch(outline).set_animated(True)
    (middle,) = axes.plot([], [], "+", color=colour, markersize=9.0, zorder=4.0, animated=True)
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
