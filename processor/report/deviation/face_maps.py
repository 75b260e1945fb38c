"""A map of deviations face by face: smooth steps of colour, with the band that is allowed or not sure in grey.

Core points belong to one face where they look along the same axis (of six directions) and lie side by side. Faces that
do not cover each other share a panel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Colormap
from matplotlib.figure import Figure
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree

from processor.distinct_rows import components
from processor.geometry.m3c2 import Distances
from processor.language.messages import Message, text
from processor.model import Bools, Floats, Ints
from processor.report.charts.stepped_colours import Band, stepped_colours
from processor.report.style import png

AXES = "xyz"
MOST_PANELS, LEAST_SHARE = 8, 0.01  # a panel with less of the core points is not drawn
FINEST = 1200  # cells along the longer side of a panel
REACH = 2.0  # times the spacing of core points: how far neighbours of a face are apart
NEIGHBOURS, SPARSEST, SAMPLE = 3, 0.9, 5_000  # of spacing: the third neighbour, nine in ten have it nearer
LONG = 0.4  # height by width below which panels are put one below the other
FEWEST = 12  # core points with a value of a face that is drawn
OVERLAP = 0.05  # share of a face that may lie over another of its panel


@dataclass(frozen=True)
class Panel:
    """Faces that look along one axis and do not cover each other: rows of core points, the axes right and up."""

    rows: Ints
    side: str
    right: int
    up: int
    cell: float  # side of a cell of the map


def face_maps(
    core: Floats, normals: Floats, distances: Distances, band: Band, labelled: tuple[str, str]
) -> tuple[Message, bytes]:
    """Draw core points (k, 3) with normals (k, 3) by distance; ``labelled``: what a distance is, and its unit."""
    label, unit = labelled
    known = np.isfinite(distances.lod95)
    panels, left_out = _panels(core, normals, known)
    norm, colours, levels = stepped_colours(distances.distance[known], band)
    figure, all_axes = _layout(panels, core)
    spots = _extremes(distances.distance, known)
    for axes, panel in zip(all_axes, panels, strict=False):
        _draw(axes, panel, core, np.where(known, distances.distance, np.nan), (norm, colours, levels))
        for k in spots:
            if k in panel.rows:
                _callout(axes, core[k][[panel.right, panel.up]], f"{distances.distance[k]:+.2f}{_in(unit)}")
        axes.set(xlabel=f"{AXES[panel.right]}{_comma(unit)}", ylabel=f"{AXES[panel.up]}{_comma(unit)}")
        axes.set_title(f"facing {panel.side}", fontsize=10)
    scale = ScalarMappable(norm, colours)
    bar = figure.colorbar(
        scale, ax=all_axes, location="bottom", aspect=50, extend="both", ticks=levels, spacing="uniform"
    )
    bar.ax.set_xticklabels([f"{level:+.3g}" for level in levels], fontsize=8)
    bar.set_label(f"{label}{_comma(unit)}; grey: {band.name}", fontsize=9)
    cell = min((panel.cell for panel in panels), default=0.0)
    parts = [
        text("Deviations face by face, means over {cell:.3g}{unit} or more", cell=cell, unit=_in(unit)),
        text("grey: {band}", band=band.name),
        text("hatched: no level of detection"),
        text("the least and the greatest are named"),
    ]
    if left_out:
        template = "{left_out:,} of {all:,} core points are on faces not drawn: small or not seen"
        parts.append(text(template, left_out=left_out, all=len(core)))
    return text("{parts:;}", parts=parts), png(figure)


def not_sure(distances: Distances, unit: str) -> Band:
    """Return the band of deviations below the median level of detection."""
    known = distances.lod95[np.isfinite(distances.lod95)]
    half = float(np.median(known)) if len(known) else 0.0
    name = text("below the median level of detection, {half:.2g}{unit}", half=half, unit=_in(unit))
    return Band(-half, half, name)


def spacing(points: Floats) -> float:
    """Return the distance within which most points (n, 3) have neighbours to all sides."""
    if len(points) <= NEIGHBOURS:
        return 0.0
    sample = points[:: max(1, len(points) // SAMPLE)]
    return float(np.quantile(cKDTree(points).query(sample, k=NEIGHBOURS + 1)[0][:, -1], SPARSEST))


def faces(core: Floats, normals: Floats) -> list[tuple[str, Ints]]:
    """Return the faces of core points (k, 3), the largest first: the axis they look along, and their rows."""
    axis = np.argmax(np.abs(normals), axis=1) if len(core) else np.empty(0, np.int64)
    positive = normals[np.arange(len(core)), axis] > 0.0
    found: list[tuple[str, Ints]] = []
    for along in range(3):
        for sign, ahead in (("+", True), ("-", False)):
            rows = np.flatnonzero((axis == along) & (positive == ahead))
            if not len(rows):
                continue
            pairs = cKDTree(core[rows]).query_pairs(REACH * spacing(core[rows]), output_type="ndarray")
            member = components(len(rows), *pairs.T)
            order = np.argsort(member, kind="stable")
            ends = np.cumsum(np.bincount(member))[:-1]
            found += [(f"{sign}{AXES[along]}", rows[part]) for part in np.split(order, ends)]
    return sorted(found, key=lambda face: -len(face[1]))


def _panels(core: Floats, normals: Floats, known: Bools) -> tuple[list[Panel], int]:
    """Lay faces out on panels; also count the core points that are on none."""
    panels: list[tuple[str, Bools, list[Ints]]] = []
    left_out = 0
    low = core.min(axis=0) if len(core) else np.zeros(3)
    cell = max(spacing(core), float(np.ptp(core, axis=0).max()) / FINEST if len(core) else 0.0, 1e-9)
    size = np.ceil((core.max(axis=0) - low) / cell).astype(int) + 1 if len(core) else np.ones(3, int)
    for side, rows in faces(core, normals):
        if known[rows].sum() < FEWEST:
            left_out += len(rows)
            continue
        right, up = _plane(side)
        covered = np.zeros((size[right], size[up]), bool)
        covered[tuple(((core[rows][:, [right, up]] - low[[right, up]]) / cell).astype(int).T)] = True
        for name, taken, members in panels:
            if name == side and (taken & covered).sum() <= OVERLAP * covered.sum():
                taken |= covered
                members.append(rows)
                break
        else:
            panels.append((side, covered, [rows]))
    made = [_panel(np.sort(np.concatenate(members)), side, core) for side, _, members in panels]
    made.sort(key=lambda panel: -int(known[panel.rows].sum()))
    drawn = [panel for panel in made if known[panel.rows].sum() >= LEAST_SHARE * known.sum()][:MOST_PANELS]
    return drawn, left_out + sum(len(panel.rows) for panel in made) - sum(len(panel.rows) for panel in drawn)


def _panel(rows: Ints, side: str, core: Floats) -> Panel:
    right, up = _plane(side)
    extent = float(np.ptp(core[rows][:, [right, up]], axis=0).max())
    return Panel(rows, side, right, up, max(spacing(core[rows]), extent / FINEST, 1e-9))


def _layout(panels: list[Panel], core: Floats) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel each, those of long structures one below the other."""
    extents = [np.ptp(core[panel.rows][:, [panel.right, panel.up]], axis=0) for panel in panels] or [np.ones(2)]
    tall = [float(height / max(width, 1e-9)) for width, height in extents]
    across = 1 if len(tall) == 1 or tall[0] < LONG else 2
    width = 8.6 if across == 1 else 4.2
    rows = [max(tall[k : k + across]) for k in range(0, len(tall), across)]
    heights = [float(np.clip(width * one, 0.5, 3.6)) + 0.7 for one in rows]
    figure = Figure(figsize=(10.5, max(sum(heights), 3.5)), layout="constrained")
    axes = list(figure.subplots(len(rows), across, squeeze=False, height_ratios=heights).ravel())
    for unused in axes[max(len(panels), 1) :]:
        unused.set_visible(False)
    return figure, axes


def _plane(side: str) -> tuple[int, int]:
    """Return the axes right and up of a face that looks along an axis; z is up where it can be."""
    along = AXES.index(side[1])
    right, up = (axis for axis in range(3) if axis != along)
    return right, up


def _draw(
    axes: Axes, panel: Panel, core: Floats, values: Floats, style: tuple[BoundaryNorm, Colormap, list[float]]
) -> None:
    norm, colours, levels = style
    cell = panel.cell
    places, found = core[panel.rows][:, [panel.right, panel.up]], values[panel.rows]
    low = places.min(axis=0) - 1.5 * cell
    shape = tuple(np.ceil((places.max(axis=0) + 1.5 * cell - low) / cell).astype(int).tolist())
    at = tuple(((places - low) / cell).astype(int).T)
    surface = np.zeros(shape, bool)
    surface[at] = True
    surface = binary_dilation(surface)
    smooth, has_value = _smooth(at, found, shape)
    x, y = (start + cell * (np.arange(count) + 0.5) for start, count in zip(low, shape, strict=True))
    axes.contourf(x, y, smooth.T, levels=levels, norm=norm, cmap=colours, extend="both")
    for mask, hatch in ((surface & ~has_value, "////"), (~surface, None)):
        if mask.any():
            axes.contourf(x, y, mask.T.astype(float), levels=[0.5, 1.5], colors=["white"], hatches=[hatch])
    axes.ticklabel_format(useOffset=True, style="plain")
    axes.tick_params(labelsize=8)
    axes.set_aspect("equal", anchor="W")


def _smooth(at: tuple[Ints, ...], values: Floats, shape: tuple[int, ...]) -> tuple[Floats, Bools]:
    """Return the mean of values in cells and their neighbours, extended to those without, and which have one."""
    known = np.isfinite(values)
    total, count = np.zeros(shape), np.zeros(shape)
    rows = tuple(axis[known] for axis in at)
    np.add.at(total, rows, values[known])
    np.add.at(count, rows, 1.0)
    has_value = binary_dilation(count > 0.0)
    weight = gaussian_filter(count, 0.7, mode="constant")
    smooth = gaussian_filter(total, 0.7, mode="constant") / np.maximum(weight, 1e-12)
    if not has_value.any():
        return np.zeros(shape), has_value
    nearest = distance_transform_edt(~has_value | (weight < 1e-6), return_distances=False, return_indices=True)
    extended: Floats = smooth[tuple(nearest)]
    return extended, has_value


def _extremes(values: Floats, known: Bools) -> list[int]:
    rows = np.flatnonzero(known)
    if not len(rows):
        return []
    return sorted({int(rows[np.argmin(values[rows])]), int(rows[np.argmax(values[rows])])})


def _callout(axes: Axes, at: Floats, said: str) -> None:
    axes.plot(*at, "o", markersize=6, markerfacecolor="none", markeredgecolor="black")
    axes.annotate(
        said,
        (float(at[0]), float(at[1])),
        xytext=(0, 12),
        textcoords="offset points",
        ha="center",
        fontsize=8,
        fontweight="bold",
        bbox={"facecolor": "white", "edgecolor": "0.4", "pad": 1.5},
    )


def _in(unit: str) -> str:
    return f" {unit}" if unit else ""


def _comma(unit: str) -> str:
    return f", {unit}" if unit else ""
