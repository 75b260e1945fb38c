"""Figures of defects: a map of deviations about each, and the deflection curves of bent components."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from processor.defects.result import Result
from processor.language.messages import Message, messages, text
from processor.report.style import (
    COLOURS,
    DASHES,
    DIVERGING,
    LEAST_SHOWN_MM,
    MARKERS,
    CaptionedPngs,
    number,
    pdf,
    png,
    printable_name,
    with_interval,
    write_beside,
)

MAPS, CURVES = "defects-maps.png", "defects-curves.png"
ACROSS = 3  # drawn size: maps beside each other are read on A4
MOST_CURVES = 4  # drawn size: more curves cannot be told apart; the caption counts them
MOST_MAPS = 12  # drawn size: four rows on the page; the document has all
DOCUMENT = "defects.pdf"
LINE = 0.07  # of a panel's height
REMARK_WIDTH, REMARK_LINES = 52, 4  # characters and lines: drawn size, of a map's margin


def draw(result: Result) -> CaptionedPngs:
    """Draw the maps and deflection curves of defects; nothing without defects."""
    drawn: CaptionedPngs = {}
    if result.pictures:
        drawn[MAPS] = _maps(result)
    if _bent(result):
        drawn[CURVES] = _curves(result)
    return drawn


def files(result: Result) -> dict[str, bytes]:
    """Draw a page for each defect: its map, its measures, and its deflection curve where it has one."""
    return {DOCUMENT: pdf(_page(result, k) for k in range(len(result.pictures)))} if result.pictures else {}


def _bent(result: Result) -> list[int]:
    """Return the rows of the defects with a deflection curve."""
    return [k for k, curve in enumerate(result.defects.deflection) if len(curve.along)]


def _page(result: Result, k: int) -> Figure:
    curve = len(result.defects.deflection[k].along) > 0
    figure = Figure(figsize=(10.5, 8.2 if curve else 5.0), layout="constrained")
    grid = figure.add_gridspec(2 if curve else 1, 2, width_ratios=[1.6, 1.0])
    _map(figure.add_subplot(grid[0, 0]), figure, result, k)
    write_beside(figure.add_subplot(grid[0, 1]), _measures(result, k), LINE, 9.0)
    if curve:
        _draw_curves(figure.add_subplot(grid[1, :]), result, [k])
    return figure


def _maps(result: Result) -> tuple[Message, bytes]:
    count = min(len(result.pictures), MOST_MAPS)
    down = math.ceil(count / ACROSS)
    figure = Figure(figsize=(10.5, 3.4 * down + 0.3), layout="constrained")
    panels = figure.subplots(down, ACROSS, squeeze=False).ravel()
    for k, axes in enumerate(panels[:count]):
        _map(axes, figure, result, k)
    for axes in panels[count:]:
        axes.set_visible(False)
    caption = text(
        "Deviation from the design about each defect, outward positive (blue), inward negative (orange), mm, on the "
        "face of the defect. Thin line: the defect. Hatched: no points."
    )
    if count < len(result.defects):
        caption = text(
            "{caption} The {count} largest of {total}; {document} has a page for each.",
            caption=caption,
            count=count,
            total=len(result.defects),
            document=DOCUMENT,
        )
    return caption, png(figure)


def _map(axes: Axes, figure: Figure, result: Result, k: int) -> None:
    defects, picture = result.defects, result.pictures[k]
    depth = with_interval(defects.depth_max[k], defects.depth_ci95[k], 2, " mm")
    name = printable_name(defects.component[k], k)
    axes.set_title(f"{defects.id[k]}: {defects.defect_class[k]}, {depth}\n{name}", fontsize=9)
    if not picture.deviation.size:
        axes.axis("off")
        axes.text(0.5, 0.5, "no face to draw", ha="center", fontsize=8, transform=axes.transAxes)
        return
    values, part = np.asarray(picture.deviation, float), picture.part
    x, y = (low + picture.cell * np.arange(n + 1) for low, n in zip(picture.low, values.shape, strict=True))
    magnitudes = np.abs(values[np.isfinite(values)])
    limit = max(float(np.quantile(magnitudes, 0.995)) if len(magnitudes) else 0.0, LEAST_SHOWN_MM)
    axes.patch.set(facecolor="white", hatch="////", edgecolor="0.8")
    mesh = axes.pcolormesh(
        x, y, np.ma.masked_invalid(values.T), cmap=DIVERGING, vmin=-limit, vmax=limit, rasterized=True
    )
    if 0 < int(part.sum()) < part.size and min(part.shape) >= 2:
        middles = [0.5 * (edges[1:] + edges[:-1]) for edges in (x, y)]
        axes.contour(*middles, part.T.astype(float), levels=[0.5], colors="0.1", linewidths=0.8)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=7)
    axes.set_xlabel("along, mm", fontsize=8)
    axes.set_ylabel("across, mm", fontsize=8)
    bar = figure.colorbar(mesh, ax=axes, shrink=0.8, extend="both")
    bar.ax.tick_params(labelsize=7)
    bar.set_label("mm", fontsize=8)


def _measures(result: Result, k: int) -> list[tuple[str, str | None]]:
    """Return the measures of a defect as names and values."""
    defects = result.defects
    length, width = defects.extent[k].tolist()
    rows: list[tuple[str, str | None]] = [
        ("class", f"{defects.defect_class[k]}, {defects.confidence[k]:.2f}"),
        ("otherwise", str(defects.otherwise[k])),
        ("component", printable_name(defects.component[k], k)),
        ("area", number(defects.area_mm2[k], ".0f", " mm2")),
        ("length, width", f"{length:.0f}, {width:.0f} mm"),
        ("depth, greatest", with_interval(defects.depth_max[k], defects.depth_ci95[k], 2, " mm")),
        ("depth, mean", number(defects.depth_mean[k], ".2f", " mm")),
        ("volume", f"{defects.volume_mm3[k]:.0f} ± {defects.volume_ci95[k]:.0f} mm3"),
        ("from the face's border", number(defects.edge_distance[k], ".0f", " mm")),
        ("curvature", number(defects.curvature_per_m[k], ".2f", " 1/m")),
        ("by chance on 100 m2", f"{defects.chance[k]:.1g}" + (", doubtful" if defects.doubtful[k] else "")),
        ("LOD95 of its depth", number(defects.lod95[k], ".2f", " mm")),
        *((f"centre {axis}", f"{at:.1f} mm") for axis, at in zip("xyz", defects.centre[k].tolist(), strict=True)),
    ]
    remark = messages("en").text(defects.reasons[k])
    return rows + [(line, "") for line in textwrap.wrap(remark, REMARK_WIDTH)[:REMARK_LINES]]


def _curves(result: Result) -> tuple[Message, bytes]:
    figure = Figure(figsize=(8.5, 4.0), layout="constrained")
    bent = _bent(result)
    _draw_curves(figure.subplots(), result, bent[:MOST_CURVES])
    caption = text("Deflection curves of bent components, with their 95 % bands where known")
    if len(bent) > MOST_CURVES:
        caption = text("{caption}; the first {count} of {total}", caption=caption, count=MOST_CURVES, total=len(bent))
    return caption, png(figure)


def _draw_curves(axes: Axes, result: Result, bent: Sequence[int]) -> None:
    for style, k in enumerate(bent):
        curve = result.defects.deflection[k]
        axes.plot(
            curve.along,
            curve.displacement,
            color=COLOURS[style],
            linestyle=DASHES[style],
            marker=MARKERS[style],
            markersize=3,
            label=f"{result.defects.id[k]}: {printable_name(result.defects.component[k], k)}",
        )
        if np.isfinite(curve.ci95).all():
            low, high = curve.displacement - curve.ci95, curve.displacement + curve.ci95
            axes.fill_between(curve.along, low, high, color=COLOURS[style], alpha=0.25, linewidth=0)
    axes.axhline(0.0, color="0.5", linewidth=0.8)
    axes.set(xlabel="along the component from its middle, mm", ylabel="displacement outward, mm")
    axes.legend(fontsize=8)
