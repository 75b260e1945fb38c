"""Figure of every part's distances from its design, unrolled: along the part against around its four faces."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, Colormap
from matplotlib.figure import Figure

from processor.geometry.m3c2 import Z95
from processor.language.messages import Message, text
from processor.model import DesignPart, Floats, Scene
from processor.preassembly.result import Result
from processor.report.charts.stepped_colours import Band, stepped_colours
from processor.report.style import LEAST_SHOWN_MM, png, printable_name
from processor.robust_statistics import MAD_TO_SD

FACES = ("bottom", "right", "top", "left")
MOST_PARTS = 24  # drawn size: of more the page would be longer than anybody reads; tables have all
ACROSS = 2  # drawn size: maps of long parts beside each other on A4
POINTS_A_CELL = 6.0  # a cell's mean has 0.4 of the noise of a point, and few cells are empty
SECTIONS = 30  # pieces of a part's length that the height of its section is read from


@dataclass(frozen=True)
class Unrolled:
    """Points of a part laid out flat, m: along the part, and around it from the bottom's left edge over the right."""

    along: Floats
    around: Floats
    edges: Floats  # (5,) where the four faces begin and the last ends


@dataclass(frozen=True)
class PartMap:
    """Distances of a part from its design: medians ``values`` (rows, columns) of the cells between ``x`` and ``y``, m.

    NaN where no point lies. ``points`` (n, 3) of the part have the medians ``of_points`` (n,) of their cells.
    """

    name: str
    flat: Unrolled
    values: Floats
    x: Floats
    y: Floats
    of_points: Floats
    points: Floats


def unroll(part: DesignPart, points: Floats) -> Unrolled:
    """Lay out points (n, 3) on a part's surface; a face's width is the median one, as sections may grow."""
    middle = 0.5 * (_evenly(part.bottom_edge_left) + _evenly(part.bottom_edge_right))
    half_width = 0.5 * np.linalg.norm(_evenly(part.bottom_edge_left) - _evenly(part.bottom_edge_right), axis=1)
    step = np.linalg.norm(np.diff(middle, axis=0), axis=1)
    arc = np.concatenate([[0.0], np.cumsum(step)])
    flat = np.linalg.norm(points[:, None, [0, 2]] - middle[None, :, [0, 2]], axis=2)
    at = np.argmin(flat, axis=1)
    tangent = np.gradient(middle, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    off = points - middle[at]
    along = arc[at] + np.einsum("ni,ni->n", off, tangent[at])
    left = off[:, 1]
    up = off[:, 2] * tangent[at, 0] - off[:, 0] * tangent[at, 2]
    height = _heights(along, up, float(arc[-1]))
    share_y = np.clip(0.5 - 0.5 * left / half_width[at], 0.0, 1.0)  # 0 at the left, 1 at the right
    share_z = np.clip(up / height, 0.0, 1.0)
    width, tall = 2.0 * half_width[at], height
    off_face = np.stack([share_z * tall, (1.0 - share_y) * width, (1.0 - share_z) * tall, share_y * width])
    face = np.argmin(off_face, axis=0)
    share = np.choose(face, [share_y, share_z, 1.0 - share_y, 1.0 - share_z])
    sizes = np.array([np.median(width), np.median(tall)] * 2) / 1e3
    edges = np.concatenate([[0.0], np.cumsum(sizes)])
    return Unrolled(along / 1e3, edges[face] + share * sizes[face], edges)


def _evenly(edge: Floats, count: int = 200) -> Floats:
    """Return points (count, 3) evenly along a polyline."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(edge, axis=0), axis=1))])
    at = np.linspace(0.0, arc[-1], count)
    return np.stack([np.interp(at, arc, edge[:, i]) for i in range(3)], axis=1)


def _heights(along: Floats, up: Floats, length: float) -> Floats:
    """Height of the section (n,) at each point, from the highest points about it."""
    piece = np.clip((along / max(length, 1e-9) * SECTIONS).astype(int), 0, SECTIONS - 1)
    top = np.array([np.quantile(up[piece == i], 0.98) if (piece == i).any() else np.nan for i in range(SECTIONS)])
    finite = np.isfinite(top)
    centres = (np.arange(SECTIONS) + 0.5) * length / SECTIONS
    heights: Floats = np.maximum(np.interp(along, centres[finite], top[finite]), 1e-6)
    return heights


def cells(flat: Unrolled, values: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Medians (across, along) of values (n,) in cells, NaN where there is none, the cells' limits, and medians (n,)."""
    length, girth = max(float(np.ptp(flat.along)), 1e-6), float(flat.edges[-1])
    total = max(len(values) / POINTS_A_CELL, 16.0)
    columns = int(np.clip(math.sqrt(total * length / girth), 4, 120))
    rows = int(np.clip(total / columns, 4, 40))
    x = np.linspace(flat.along.min(), flat.along.min() + length, columns + 1)
    y = np.unique(
        np.concatenate(
            [np.linspace(a, b, max(rows // 4, 1) + 1) for a, b in zip(flat.edges, flat.edges[1:], strict=False)]
        )
    )
    from scipy.stats import binned_statistic_2d  # takes long to load, and few reports draw this

    found = binned_statistic_2d(flat.around, flat.along, values, "median", bins=(y, x), expand_binnumbers=True)
    row, column = (np.clip(found.binnumber[k] - 1, 0, found.statistic.shape[k] - 1) for k in range(2))
    return found.statistic, x, y, found.statistic[row, column]


def maps(scene: Scene, result: Result) -> list[PartMap]:
    """Return the maps of the parts whose distances from the design are known."""
    if scene.arch is None or result.adjustment is None:
        return []
    residuals, parts = result.adjustment.residuals, {part.name: part for part in scene.arch.parts}
    found = []
    for i, name in enumerate(result.components.name):
        rows = (residuals.component == i) & np.isfinite(residuals.distance)
        part = parts.get(name)
        if not rows.any() or part is None or min(len(part.bottom_edge_left), len(part.bottom_edge_right)) < 2:
            continue
        points = residuals.points[rows]
        flat = unroll(part, points)
        found.append(PartMap(name, flat, *cells(flat, residuals.distance[rows]), points))
    return found


def scatter_band(drawn: Sequence[PartMap]) -> Band:
    """Return the band within which the values of maps differ by the scatter between neighbouring cells."""
    steps = np.concatenate([np.empty(0), *(np.diff(one.values, axis=1).ravel() for one in drawn)])
    steps = np.abs(steps[np.isfinite(steps)])
    half = Z95 * MAD_TO_SD * float(np.median(steps)) / math.sqrt(2.0) if len(steps) else 0.0
    half = max(half, LEAST_SHOWN_MM)
    return Band(-half, half, text("grey: within the scatter of neighbouring cells, {half:.2g} mm", half=half))


def colour_steps(drawn: Sequence[PartMap], band: Band) -> tuple[BoundaryNorm, Colormap, list[float]]:
    """Return the steps of colour that maps share."""
    return stepped_colours(np.concatenate([one.values.ravel() for one in drawn]), band)


def draw(scene: Scene, result: Result) -> tuple[Message, bytes] | None:
    """Draw the distances from the design's surface, a panel per part, up to MOST_PARTS of them; None without any."""
    known = maps(scene, result)
    drawn = known[:MOST_PARTS]
    if not drawn:
        return None
    down = math.ceil(len(drawn) / ACROSS)
    figure = Figure(figsize=(9.0, 2.9 * down + 0.6), layout="constrained")
    panels = figure.subplots(down, ACROSS, squeeze=False).ravel()
    band = scatter_band(drawn)
    norm, colours, levels = colour_steps(drawn, band)
    for k, (axes, one) in enumerate(zip(panels, drawn, strict=False)):
        _panel(axes, one.flat)
        mesh = axes.pcolormesh(one.x, one.y, np.ma.masked_invalid(one.values), cmap=colours, norm=norm)
        axes.set_title(printable_name(one.name, k), fontsize=11)
    for axes in panels[len(drawn) :]:
        axes.set_visible(False)
    bar = figure.colorbar(
        mesh, ax=panels.tolist(), location="bottom", shrink=0.8, aspect=50, extend="both", pad=0.02, ticks=levels,
        spacing="uniform",
    )  # fmt: skip
    bar.ax.set_xticklabels([f"{level:+.3g}" for level in levels], fontsize=8)
    bar.set_label("distance from the design's surface, outward positive, median of a cell, mm")
    caption = [text("Residuals of each part, its four faces unrolled"), band.name, text("hatched: no points")]
    if len(drawn) < len(known):
        caption.append(text("the first {shown} of {count} parts", shown=len(drawn), count=len(known)))
    return text("{parts:;}", parts=caption), png(figure)


def _panel(axes: Axes, flat: Unrolled) -> None:
    axes.patch.set(facecolor="white", hatch="////", edgecolor="0.8")
    for edge in flat.edges[1:-1]:
        axes.axhline(edge, color="0.2", linewidth=0.8, zorder=3)
    axes.set(xlabel="along the part, m", ylabel="around, m", xlim=(flat.along.min(), flat.along.max()))
    axes.set_ylim(0.0, flat.edges[-1])
    axes.tick_params(labelsize=8)
    names = axes.secondary_yaxis("right")
    names.set_yticks(0.5 * (flat.edges[1:] + flat.edges[:-1]), FACES, fontsize=8)
    names.tick_params(length=0)
