"""A figure of each flagged ball: the points about it in elevation and plan, the fitted and the nominal sphere."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from processor.language.messages import messages, text
from processor.model import NORMAL_95, Floats, Scene
from processor.report.space_frame.nominal_positions import designed_places
from processor.report.style import COLOURS, CaptionedPngs, number, pdf, png, with_interval, write_beside
from processor.space_frame.points.scene_source import SceneSource, of_scene
from processor.space_frame.result import Balls, Flag, Result
from processor.store.streaming import StoredPoints, points_of

PREFIX = "flagged-ball-"
MOST_BALLS = 12  # on the page
MOST_PAGES = 500
DOCUMENT = "flagged-balls.pdf"
LINE = 0.052  # of the panel's height
ORDER = (Flag.WRONG_SIZE, Flag.NOT_FOUND, Flag.LOW_CONFIDENCE)  # of what is drawn first
ROUND_MM = 60.0  # shown about the ball
SLICE_MM = 8.0  # on either side of the plane through the centre
SLACK_MM = 0.1  # of a box, beyond what is shown
MOST_POINTS = 20_000  # of a panel; more are not visible
MOST_KEPT = 10 * MOST_POINTS  # of a ball, of which a panel shows a slice and the rest
LEAST_RADIUS_MM = 30.0
CELL_MM, MOST_CELLS = 10.0, 1_000_000  # of the x axis, by which points near any ball are chosen
# In inches: the figure, and its panels with a heading of one line (left, bottom, width, height).
SIZE_IN = (12.4, 5.3)
VIEWS_IN = ((0.72, 0.72, 4.03, 4.03), (5.57, 0.72, 4.03, 4.03))
NUMBERS_IN = (9.73, 0.43, 2.63, 4.59)
HEADING_IN, EDGE_IN = 0.19, 0.04  # a line of the heading, and the margin of heading and legend
VIEWS = (("from the side", (0, 2)), ("from above", (0, 1)))  # and the axes of each


def draw(scene: Scene, result: Result, stored: Path | None = None) -> CaptionedPngs:
    """Draw the balls that are not ok, MOST_BALLS of them at most; none where the scene's points are not at hand.

    ``stored`` is the scene's file, where its points were left there.
    """
    balls, every = result.balls, len(flagged_rows(scene, result))
    more = text(
        " (the first {most} of {all} that are flagged, all in {file})", most=MOST_BALLS, all=every, file=DOCUMENT
    )
    return {
        f"{PREFIX}{int(balls.ids[i])}.png": (
            text(
                "Ball {id}, {flag}: the points about it{stations}; dark are those within {slice:g} mm of the plane "
                "through its centre{more}",
                id=int(balls.ids[i]),
                flag=balls.flag[i],
                stations=text(", each station as registered") if len(result.stations) else "",
                slice=SLICE_MM,
                more=more if every > MOST_BALLS else "",
            ),
            png(figure),
        )
        for i, figure in _drawn(scene, result, stored, MOST_BALLS)
    }


def document(scene: Scene, result: Result, stored: Path | None = None) -> bytes:
    """Draw a page for each ball that is not ok, MOST_PAGES at most; empty where there is none, or no points."""
    first = next(drawn := _drawn(scene, result, stored, MOST_PAGES), None)
    return pdf(figure for _, figure in (first, *drawn)) if first is not None else b""


def flagged_rows(scene: Scene, result: Result) -> list[int]:
    """Rows of the flagged balls with a known place, in the order in which they are drawn."""
    there = np.isfinite(_places(result, designed_places(scene, result))).all(axis=1)
    return [i for flag in ORDER for i in np.flatnonzero(there).tolist() if result.balls.flag[i] is flag]


def _places(result: Result, nominal: Floats) -> Floats:
    """Return where each ball is (k, 3), or where the design has it."""
    centres: Floats = np.where(np.isfinite(result.balls.centres), result.balls.centres, nominal)
    return centres


def _drawn(scene: Scene, result: Result, stored: Path | None, most: int) -> Iterator[tuple[int, Figure]]:
    nominal = designed_places(scene, result)
    centres = _places(result, nominal)
    shown = flagged_rows(scene, result)[:most]
    if not shown or (stored is None and not all(len(scan.points) for scan in scene.scans)):
        return
    reach = [_radius(result, i) + ROUND_MM for i in shown]
    with points_of(stored) if stored is not None else nullcontext() as points:
        crops = crops_about(scene, centres[shown], np.array(reach), points)
    for k, i in enumerate(shown):
        yield i, _ball(result, i, centres[i], nominal[i] - centres[i], crops.pop(0), reach[k])


def crops_about(scene: Scene, centres: Floats, reach: Floats, stored: StoredPoints | None = None) -> list[Floats]:
    """Return the points (n, 3) within ``reach`` (k,) of each centre (k, 3), less the centre; one pass over all.

    Of points in a file only those of the tiles about each centre are read.
    """
    if stored is not None:
        return [
            _within(of_scene(scene, stored.within(_boxes(scene, centre, far))), centre[None], np.array([far]))[0]
            for centre, far in zip(centres, reach.tolist(), strict=True)
        ]
    return _within(of_scene(scene), centres, reach)


def _boxes(scene: Scene, centre: Floats, far: float) -> list[tuple[Floats, Floats]]:
    """Box a scan, less its origin, that holds all that is within ``far`` of a place (3,) in the project's frame."""
    boxes = []
    for scan in scene.scans:
        T = scan.pose
        middle = T[:3, :3].T @ (centre - T[:3, 3]) - scan.origin
        boxes.append((middle - far - SLACK_MM, middle + far + SLACK_MM))
    return boxes


def _within(source: SceneSource, centres: Floats, reach: Floats) -> list[Floats]:
    middles = centres - source.origin
    by_cell = _NearInX(middles[:, 0], reach)
    pieces: list[list[Floats]] = [[] for _ in reach]
    step, kept = [1] * len(pieces), [0] * len(pieces)
    for chunk in source.chunks():
        # By one axis first, for all centres at once: most of a roof is far away.
        some = np.compress(by_cell.holds(chunk.points[:, 0]), chunk.points, axis=0)
        for k, (middle, far) in enumerate(zip(middles, reach, strict=True)):
            near = np.compress(np.abs(some[:, 0] - middle[0]) <= far, some, axis=0) - middle
            pieces[k].append(near[np.einsum("ij,ij->i", near, near) <= far**2][:: step[k]])
            kept[k] += len(pieces[k][-1])
            if kept[k] > MOST_KEPT:
                pieces[k] = [np.vstack(pieces[k])[::2].copy()]
                step[k], kept[k] = 2 * step[k], len(pieces[k][0])
    return [np.vstack(parts) if parts else np.empty((0, 3)) for parts in pieces]


class _NearInX:
    """Cells of the x axis that hold the ranges ``far`` (k,) about centres (k,)."""

    def __init__(self, middle: Floats, far: Floats) -> None:
        self.low = float((middle - far).min())
        self.width = max(CELL_MM, float((middle + far).max() - self.low) / MOST_CELLS)
        first, last = self._cells(middle - far), self._cells(middle + far)
        self.near = np.zeros(last.max() + 3, np.bool_)  # the first and the last are for all that is beyond
        for start, end in zip(first.tolist(), last.tolist(), strict=True):
            self.near[max(start - 1, 1) : end + 2] = True  # with a cell on either side, for rounding

    def _cells(self, x: Floats) -> npt.NDArray[np.int64]:
        return np.floor((x - self.low) / self.width).astype(np.int64) + 1

    def holds(self, x: Floats) -> npt.NDArray[np.bool_]:
        """Whether places (n,) may be within a range of a centre; those within one are."""
        cells = (x - self.low) * (1.0 / self.width) + 1.0
        near: npt.NDArray[np.bool_] = self.near[np.clip(cells, 0.0, len(self.near) - 1.0).astype(np.int32)]
        return near


def _radius(result: Result, i: int) -> float:
    radii = [float(column[i]) for column in (result.balls.radii, result.balls.nominal_radii) if np.isfinite(column[i])]
    return max([LEAST_RADIUS_MM, *radii])


def _ball(result: Result, i: int, middle: Floats, nominal: Floats, points: Floats, reach: float) -> Figure:
    """Draw a ball about ``middle`` (3,), its numbers beside it; ``nominal`` (3,) is less it."""
    balls, figure = result.balls, Figure(figsize=SIZE_IN)
    heading = f"Ball {int(balls.ids[i])}: {balls.flag[i]}. {messages('en').sentences(balls.reasons[i])}"
    lines = textwrap.wrap(heading, 130)[:3]
    *views, beside = _panels(figure, HEADING_IN * (len(lines) - 1))
    for axes, (name, across) in zip(views, VIEWS, strict=True):
        _points(axes, points, across)
        _members(axes, result, i, middle, across, reach)
        if np.isfinite(nominal).all() and np.isfinite(balls.nominal_radii[i]):
            _circle(axes, nominal, float(balls.nominal_radii[i]), across, COLOURS[1], "--")
        if np.isfinite(balls.radii[i]) and balls.flag[i] is not Flag.NOT_FOUND:
            _circle(axes, np.zeros(3), float(balls.radii[i]), across, COLOURS[0], "-")
        axes.set(
            xlim=(-reach, reach), ylim=(-reach, reach),
            xlabel="x less the centre's, mm", ylabel=f"{'xyz'[across[1]]} less the centre's, mm",
        )  # fmt: skip
        axes.set_title(name, y=1.0)  # a title without a height is placed above all ticks, which are laid out for that
        axes.set_aspect("equal")
        axes.grid(alpha=0.3)
    figure.suptitle("\n".join(lines), fontsize=11, y=1.0 - EDGE_IN / SIZE_IN[1])
    write_beside(beside, _numbers(balls, i, nominal), LINE, 8.0)
    handles = [
        Line2D([], [], marker=".", linestyle="", color="black", label=f"points within {SLICE_MM:g} mm of the plane"),
        Line2D([], [], marker=".", linestyle="", color="0.72", label="points before and behind it"),
        Line2D([], [], color=COLOURS[0], marker="+", label="fitted"),
        Line2D([], [], color=COLOURS[1], linestyle="--", marker="+", label="nominal"),
        Line2D([], [], color=COLOURS[2], linestyle="-.", label="axes of members"),
    ]
    below = (0.5, EDGE_IN / SIZE_IN[1])
    figure.legend(handles=handles, loc="lower center", bbox_to_anchor=below, borderaxespad=0.0, ncols=5, fontsize=8)
    return figure


def _panels(figure: Figure, lowered_in: float) -> list[Axes]:
    """Add the panels of both views and that of the numbers, their upper edges lowered from those of a short heading.

    All balls have the same; a layout found for each takes as long as drawing it.
    """
    width, height = SIZE_IN
    made = []
    for left, bottom, wide, high in (*VIEWS_IN, NUMBERS_IN):
        less = lowered_in if wide == high else 0.0  # views stay squares
        made.append(
            figure.add_axes((
                (left + 0.5 * less) / width, bottom / height, (wide - less) / width, (high - lowered_in) / height
            ))
        )  # fmt: skip
    return made


def _numbers(balls: Balls, i: int, nominal: Floats) -> list[tuple[str, str | None]]:
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


def _points(axes: Axes, points: Floats, across: tuple[int, int]) -> None:
    depth = np.abs(points[:, 3 - sum(across)])
    for chosen, colour, order in ((depth > SLICE_MM, "0.72", 1.0), (depth <= SLICE_MM, "black", 2.0)):
        few = np.compress(chosen, points, axis=0)
        few = few[:: max(1, -(-len(few) // MOST_POINTS))]
        axes.plot(*few[:, across].T, ".", markersize=2.0, color=colour, zorder=order, rasterized=True)


def _members(axes: Axes, result: Result, i: int, middle: Floats, across: tuple[int, int], reach: float) -> None:
    """Draw the axes of the members that meet at a ball, through it to the border of the picture."""
    tubes, id_ = result.tubes, result.balls.ids[i]
    for tube in np.flatnonzero((tubes.a == id_) | (tubes.b == id_)).tolist():
        start, end = tubes.start[tube] - middle, tubes.end[tube] - middle
        direction = end - start if tubes.a[tube] == id_ else start - end
        direction = direction / np.linalg.norm(direction)
        foot = start - (start @ direction) * direction
        line = foot + np.array([[-0.25], [2.0]]) * reach * direction
        axes.plot(*line[:, across].T, "-.", color=COLOURS[2], linewidth=1.1, zorder=3.0)


def _circle(axes: Axes, centre: Floats, radius: float, across: tuple[int, int], colour: str, dash: str) -> None:
    x, y = float(centre[across[0]]), float(centre[across[1]])
    axes.add_patch(Circle((x, y), radius, fill=False, edgecolor=colour, linestyle=dash, linewidth=1.6, zorder=4.0))
    axes.plot(x, y, "+", color=colour, markersize=9.0, zorder=4.0)
