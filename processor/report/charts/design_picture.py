"""A picture of the design that `processor init` has found: parts, joints, nodes and members, what is unsure marked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from processor.model import ArchDesign, Floats, FrameDesign
from processor.report.style import COLOURS, DASHES, default_settings, drawable, png
from processor.scan_folder.shapes.body import Body, Unsure

Line = tuple[str, float, str]  # colour, width, dash
# Drawn: thin grey, thick coloured, thin dark.
EDGE, BOTTOM, MEMBER = ("0.7", 0.5, DASHES[0]), (COLOURS[2], 1.2, DASHES[1]), ("0.5", 0.8, DASHES[0])
SURE, UNSURE = COLOURS[0], COLOURS[1]
MOST_NAMED = 60  # names of nodes; of more the unsure ones alone
OBLIQUE = np.array([[0.8, 0.6, 0.0], [-0.27, 0.36, 0.89]])  # axes of the third view, to the right and up
VIEWS = (
    ("along Y", np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), ("X (m)", "Z (m)")),
    ("from above", np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), ("X (m)", "Y (m)")),
    ("oblique", OBLIQUE, ("", "")),
)


def draw(design: ArchDesign | FrameDesign, unsure: Sequence[Unsure]) -> bytes:
    """Draw a design (mm) in three views as PNG; joints, parts and nodes that are not sure have a question mark."""
    with default_settings():
        figure = Figure(figsize=(11.0, 12.0), layout="constrained")
        for axes, (title, view, labels) in zip(figure.subplots(3), VIEWS, strict=True):
            if isinstance(design, ArchDesign):
                _draw_parts(axes, design, view, {one.name for one in unsure})
            else:
                _draw_frame(axes, design, view)
            for one in unsure:
                place = 1e-3 * view @ one.place
                axes.plot(*place, "o", markersize=14, fillstyle="none", color=UNSURE, zorder=4)
                _name(axes, place, f"? {one.name}", UNSURE, (9, 6))
            axes.set_title(title, fontsize=10)
            axes.set_xlabel(labels[0])
            axes.set_ylabel(labels[1])
            axes.set_aspect("equal", adjustable="datalim")
            axes.autoscale_view()
        return png(figure)


def _draw_parts(axes: Axes, design: ArchDesign, view: Floats, unsure: set[str]) -> None:
    """Draw the edges of parts, their bottom edges, and the section at each joint."""
    for part in design.parts:
        body = Body(part.name, part.vertices, part.faces)
        _draw_lines(axes, body.vertices[body.sharp] @ view.T, EDGE)
        for edge in (part.bottom_edge_left, part.bottom_edge_right):
            if len(edge):
                _draw_lines(axes, [edge @ view.T], BOTTOM)
        if part.name not in unsure:
            _name(axes, 1e-3 * view @ body.centre, part.name, "black", (0, 0))
    for name, points in zip(design.joint_names, design.joint_points, strict=True):
        colour = UNSURE if name in unsure else SURE
        corners = 1e-3 * points[:4] @ view.T
        axes.add_patch(Polygon(corners, facecolor=colour, edgecolor=colour, alpha=0.5, linewidth=1.5, zorder=3))
        if name not in unsure:
            _name(axes, corners[corners[:, 1].argmax()], name, SURE, (0, 6))


def _draw_frame(axes: Axes, design: FrameDesign, view: Floats) -> None:
    """Draw the members of a frame as lines and its nodes as points."""
    row = {int(i): k for k, i in enumerate(design.ids)}
    centres = design.centres @ view.T
    pairs = [
        [centres[row[int(a)]], centres[row[int(b)]]] for a, b in zip(design.member_a, design.member_b, strict=True)
    ]
    _draw_lines(axes, np.array(pairs).reshape(-1, 2, 2), MEMBER)
    axes.plot(*(1e-3 * centres.T), "o", markersize=4, color=SURE, zorder=3)
    for i, place in zip(design.names, 1e-3 * centres, strict=True) if len(design.ids) <= MOST_NAMED else ():
        _name(axes, place, str(i), "black", (3, 3))


def _draw_lines(axes: Axes, lines_mm: Sequence[Floats] | Floats, line: Line) -> None:
    colour, width, dash = line
    scaled = [1e-3 * np.asarray(one) for one in lines_mm]
    axes.add_collection(LineCollection(scaled, colors=colour, linewidths=width, linestyles=dash))


def _name(axes: Axes, place: Floats, name: str, colour: str, off: tuple[float, float]) -> None:
    axes.annotate(
        drawable(name), (float(place[0]), float(place[1])), off, textcoords="offset points", fontsize=8,
        color=colour, ha="center" if off[0] == 0 else "left", zorder=5,
    )  # fmt: skip
