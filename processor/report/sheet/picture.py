"""The picture of the sheet: the structure as it looks, with callouts at what fails or is nearest to its limit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath

from processor.language.messages import Message, messages, text
from processor.limits.judging import Judged
from processor.model import ArchDesign, Floats, Ints, Scene, Verdict
from processor.report import characteristics
from processor.report.style import LATIN, drawable, png

TONES = {Verdict.PASS: "#1b7a3d", Verdict.FAIL: "#b3261e", Verdict.INDETERMINATE: "#9a6700", Verdict.NONE: "#44505c"}
PLAIN = np.array([0.86, 0.89, 0.92])  # of steel without a callout
MOST_FACETS = 40_000  # drawn in a second; of more, vertices in a grid of CELLS are one
CELLS = 250  # along the longest side: a cell is some pixels
FLAT = 0.3  # height by breadth below which a structure is seen from well above, as a roof is
LOW, HIGH, ASIDE = np.radians(14.0), np.radians(48.0), np.radians(12.0)  # the viewer's height, and turn from the side
LIGHT = np.array([-0.35, -0.75, 0.56])  # from the left, the viewer and above: no two faces of a box are alike
WIDE, SIZE = 12.6, 11.5  # inches, and points of the callouts: 182 mm and 6.6 points on the sheet
LINE = 1.45 * SIZE / 72.0  # inches
TALLEST = 4.6  # inches of the structure: 66 mm on the sheet
BOLD = FontProperties(family=LATIN, weight="bold")
MOST_CALLOUTS, LANES = 8, 4  # that can be read; lines of callouts above and below
MOST_NAMED = 24  # parts


@dataclass(frozen=True)
class Callout:
    """A sentence on a place (3,) of the design, in mm; ``part`` is drawn in the verdict's colour."""

    place: Floats
    said: Message
    verdict: Verdict = Verdict.NONE
    part: str = ""


def of_judged(place: Floats, judged: Sequence[Judged], name: Message | str, part: str = "") -> Callout:
    """Return the callout of a place where several quantities were judged: the worst, or the nearest to its limit.

    It is of the ``name``, or if that is empty of what was judged.
    """
    one = characteristics.worst_first(sorted(judged, key=characteristics.nearness, reverse=True))[0]
    value: Message | str = text("not measured")
    if np.isfinite(one.value):
        value = characteristics.with_interval(one.value, one.ci95, one.unit)
    said = text("{name} {value}", name=name or characteristics.name_of(one), value=value)
    if one.verdict is not Verdict.NONE:
        limits = characteristics.allowed(one.low, one.high)
        said = text("{said}, limit {limits}: {verdict}", said=said, limits=limits, verdict=one.verdict)
    return Callout(place, said, one.verdict, part)


def draw(scene: Scene, callouts: Sequence[Callout]) -> bytes:
    """Draw the design, without one the places of all callouts, with the worst callouts as PNG; b"" of nothing."""
    known = [one for one in callouts if np.isfinite(one.place).all()]
    chosen = sorted(known, key=lambda one: characteristics.rank(one.verdict))[:MOST_CALLOUTS]
    parts = list(_surfaces(scene))
    lines = [] if scene.arch is None else list(_bare(scene.arch))
    places = [*(vertices for _, vertices, _ in parts), *lines, *([] if scene.frame is None else [scene.frame.centres])]
    if not places:  # without a design the places alone
        places = [np.reshape([one.place for one in known], (-1, 3))]
    everything = np.concatenate(places)
    if len(everything) < 2:
        return b""
    view = _view(everything)
    seen = everything @ view[:2].T
    low, high = seen.min(axis=0), seen.max(axis=0)
    across, up = np.maximum(high - low, 1e-3 * float(np.ptp(seen[:, 0]) + np.ptp(seen[:, 1])))
    labels = _placed(chosen, [view[:2] @ one.place for one in chosen], (low, high))
    above, below = (max([0, *(label.lane for label in labels if label.above is side)]) * LINE for side in (True, False))
    tall = float(np.clip(WIDE * up / across, 1.2, TALLEST))
    figure = Figure(figsize=(WIDE, tall + above + below + 0.5))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.axis("off")
    tones = {one.part: one.verdict for one in reversed(chosen) if one.part and one.verdict is not Verdict.NONE}
    for name, vertices, faces in parts:
        _draw_surface(axes, vertices, faces, view, tones.get(name))
    axes.add_collection(LineCollection([line @ view[:2].T for line in lines], colors="#8a96a2", linewidths=2.0))
    if scene.frame is not None:
        _draw_frame(axes, scene, view)
    elif not parts and not lines:
        axes.plot(*(everything @ view[:2].T).T, "o", markersize=5.0, color="#66727e", zorder=2)
    if scene.arch is not None:
        _draw_joints(axes, scene.arch, view)
    scale = max(across / (0.94 * WIDE), up / tall)  # mm of the structure by inch
    middle = 0.5 * (low + high)
    ends = middle[1] - scale * (0.5 * tall + 0.25 + below), middle[1] + scale * (0.5 * tall + 0.25 + above)
    axes.set(xlim=(middle[0] - 0.5 * WIDE * scale, middle[0] + 0.5 * WIDE * scale), ylim=ends)
    for label in labels:
        _write(axes, label, scale, (middle[0], ends[1] if label.above else ends[0]))
    return png(figure)


@dataclass(frozen=True)
class Label:
    """A callout as it is written: at a place of the picture (2,), in a lane from the outer one, 1, inward.

    ``x`` is its middle from that of the picture, in inches.
    """

    callout: Callout
    said: str
    seen: Floats
    above: bool
    lane: int
    x: float


def width_of(said: str) -> float:
    """Return the width of a callout in inches, with a margin."""
    return float(TextPath((0, 0), said, size=SIZE, prop=BOLD).get_extents().width) / 72.0 + 0.25


def _placed(callouts: Sequence[Callout], seen: Sequence[Floats], ends: tuple[Floats, Floats]) -> list[Label]:
    """Give each callout a lane above or below the structure, none over another."""
    middle = 0.5 * (ends[0] + ends[1])
    scale = max(float(ends[1][0] - ends[0][0]) / (0.94 * WIDE), float(ends[1][1] - ends[0][1]) / TALLEST, 1e-9)
    used: dict[tuple[bool, int], float] = {}
    labels = []
    for k in sorted(range(len(callouts)), key=lambda k: float(seen[k][0])):
        said = drawable(messages("en").text(callouts[k].said))
        width = width_of(said)
        x, reach = float(seen[k][0] - middle[0]) / scale, max(0.0, 0.5 * (WIDE - width))
        x, side = float(np.clip(x, -reach, reach)), bool(seen[k][1] >= middle[1])
        slots = [(above, lane) for lane in range(1, LANES + 1) for above in (side, not side)]
        slot = next((one for one in slots if used.get(one, -WIDE) <= x - 0.5 * width), slots[-1])
        used[slot] = x + 0.5 * width
        labels.append(Label(callout=callouts[k], said=said, seen=seen[k], above=slot[0], lane=slot[1], x=x))
    return labels


def _surfaces(scene: Scene) -> Iterator[tuple[str, Floats, Ints]]:
    bodies = [] if scene.arch is None else [(one.name, one.vertices, one.faces) for one in scene.arch.parts]
    if scene.structure is not None:
        bodies.append((scene.structure.name, scene.structure.vertices, scene.structure.faces))
    yield from (body for body in bodies if len(body[2]))


def _bare(arch: ArchDesign) -> Iterator[Floats]:
    """Yield the bottom edges of parts without a surface."""
    for part in arch.parts:
        if not len(part.faces):
            yield from (edge for edge in (part.bottom_edge_left, part.bottom_edge_right) if len(edge))


def _view(places: Floats) -> Floats:
    """Return the axes right, up and towards the viewer (3, 3), for what is seen along its longer side."""
    size = np.ptp(places, axis=0)
    height = HIGH if size[2] < FLAT * min(size[:2]) else LOW
    turn = ASIDE + (0.5 * np.pi if size[1] > 1.2 * size[0] else 0.0)
    right = np.array([np.cos(turn), np.sin(turn), 0.0])
    ahead = np.array([-right[1], right[0], 0.0])
    towards = np.sin(height) * np.array([0.0, 0.0, 1.0]) - np.cos(height) * ahead
    return np.stack([right, np.cross(towards, right), towards])


def _draw_surface(axes: Axes, vertices: Floats, faces: Ints, view: Floats, verdict: Verdict | None) -> None:
    """Draw the facets from the farthest to the nearest, by the light on each."""
    if len(faces) > MOST_FACETS:
        cell = np.ptp(vertices, axis=0).max() / CELLS
        _, first, of = np.unique(np.rint(vertices / cell), axis=0, return_index=True, return_inverse=True)
        vertices, faces = vertices[first], of.ravel()[faces]
    corners = (vertices @ view.T)[faces]
    normals = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    area = np.linalg.norm(normals, axis=1)
    order = np.argsort(corners[:, :, 2].mean(axis=1), kind="stable")
    order = order[area[order] > 0.0]
    facing = normals / np.maximum(area, 1e-12)[:, None] * np.sign(normals @ view[2])[:, None]
    light = 0.74 + 0.26 * facing @ LIGHT
    colour = PLAIN if verdict is None else 0.35 * np.array(to_rgb(TONES[verdict])) + 0.65
    drawn = np.clip(light[order, None] * colour, 0.0, 1.0)
    axes.add_collection(
        PolyCollection(corners[order][:, :, :2], facecolors=drawn, edgecolors=drawn, linewidths=0.4, zorder=1)
    )


def _draw_frame(axes: Axes, scene: Scene, view: Floats) -> None:
    assert scene.frame is not None
    frame, seen = scene.frame, scene.frame.centres @ view[:2].T
    row = {int(i): k for k, i in enumerate(frame.ids)}
    ends = [(row[int(a)], row[int(b)]) for a, b in zip(frame.member_a, frame.member_b, strict=True)]
    axes.add_collection(LineCollection([seen[list(pair)] for pair in ends], colors="#aab4be", linewidths=1.6, zorder=1))
    axes.plot(*seen.T, "o", markersize=5.0, color="#66727e", zorder=2)


def _draw_joints(axes: Axes, arch: ArchDesign, view: Floats) -> None:
    """Draw the section at each joint, and name the parts."""
    for corners in arch.joint_points[:, :4] @ view[:2].T:
        axes.fill(*corners.T, facecolor="none", edgecolor="#44505c", linewidth=1.0, zorder=2)
    for part in arch.parts if len(arch.parts) <= MOST_NAMED else ():
        if len(part.vertices):
            x, y = view[:2] @ part.vertices.mean(axis=0)
            axes.annotate(
                drawable(part.name), (x, y), (0, -1.8 * SIZE), textcoords="offset points", fontsize=SIZE,
                color="#2b3640", ha="center", va="center", zorder=3,
            )  # fmt: skip


def _write(axes: Axes, label: Label, scale: float, edge: tuple[float, float]) -> None:
    """Write a label and join it with its place; ``edge`` is the middle across, and the upper or lower end."""
    colour = TONES[label.callout.verdict]
    side = 1.0 if label.above else -1.0
    x, y = edge[0] + label.x * scale, edge[1] - side * scale * (0.12 + LINE * (label.lane - 1))
    axes.plot([label.seen[0], x], [label.seen[1], y], color=colour, linewidth=1.0, zorder=3)
    axes.plot(*label.seen, "o", markersize=8.0, markerfacecolor="none", color=colour, markeredgewidth=1.6, zorder=4)
    axes.text(
        x, y, label.said, fontsize=SIZE, fontweight="bold", color=colour, ha="center", va="center",
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0}, zorder=5,
    )  # fmt: skip
