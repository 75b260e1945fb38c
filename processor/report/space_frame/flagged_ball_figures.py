"""Pictures of the flagged balls, the points about each: for the page, and as a document of a page each."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import numpy.typing as npt

from processor.language.messages import Message, text
from processor.model import Floats, Scene
from processor.report.space_frame.ball_picture import SLICE_MM, BallPicture
from processor.report.space_frame.nominal_positions import designed_places
from processor.report.style import CaptionedPngs, Drawn, pdf_document
from processor.space_frame.result import Flag, Result
from processor.store.streaming import StoredPoints, points_of
from processor.views import Views, views

PREFIX = "flagged-ball-"
MOST_BALLS = 12  # on the page
MOST_PAGES = 100  # work: where more are flagged something common to all is wrong
DOCUMENT = "flagged-balls.pdf"
ORDER = (Flag.WRONG_SIZE, Flag.NOT_FOUND, Flag.LOW_CONFIDENCE)  # of what is drawn first
ROUND_MM = 60.0  # shown about the ball at least
SCALE_MM = 10.0  # what is shown is a multiple of it, so that balls of a size are drawn to the same scale
SLACK_MM = 0.1  # of a box, beyond what is shown
MOST_KEPT = 200_000  # points of a ball, of which a panel shows a slice and the rest
LEAST_RADIUS_MM = 30.0  # drawn size: shown about a place whose radius is not known
CELL_MM, MOST_CELLS = 10.0, 1_000_000  # of the x axis, by which points near any ball are chosen


def draw(scene: Scene, result: Result, stored: Path | None = None) -> Drawn:
    """Draw the balls that are not ok: MOST_BALLS figures, and a document of MOST_PAGES pages at most.

    ``stored`` is the scene's file, where its points were left there. Nothing is drawn without points.
    """
    nominal = designed_places(scene, result)
    centres: Floats = np.where(np.isfinite(result.balls.centres), result.balls.centres, nominal)
    placed = np.flatnonzero(np.isfinite(centres).all(axis=1)).tolist()
    flagged = [i for flag in ORDER for i in placed if result.balls.flag[i] is flag]
    shown = flagged[:MOST_PAGES]
    if not shown or (stored is None and not all(len(scan.points) for scan in scene.scans)):
        return Drawn({})
    reach = [_reach(result, i) for i in shown]
    with points_of(stored) if stored is not None else nullcontext() as points:
        crops = crops_about(scene, centres[shown], np.array(reach), points)
    picture, figures = BallPicture(), CaptionedPngs()
    with pdf_document() as (document, out):
        for k, i in enumerate(shown):
            picture.show(result, i, centres[i], nominal[i] - centres[i], crops.pop(0), reach[k])
            if k < MOST_BALLS:
                figures[f"{PREFIX}{int(result.balls.ids[i])}.png"] = _caption(result, i, len(flagged)), picture.png()
            picture.add_to(document)
    return Drawn(figures, {DOCUMENT: out.getvalue()})


def _caption(result: Result, i: int, flagged: int) -> Message:
    more = text(
        " (the first {most} of {all} that are flagged, all in {file})", most=MOST_BALLS, all=flagged, file=DOCUMENT
    )
    return text(
        "Ball {id}, {flag}: the points about it{stations}; dark are those within {slice:g} mm of the plane through its "
        "centre{more}",
        id=result.balls.names[i],
        flag=result.balls.flag[i],
        stations=text(", each station as registered") if len(result.stations) else "",
        slice=SLICE_MM,
        more=more if flagged > MOST_BALLS else "",
    )


def crops_about(scene: Scene, centres: Floats, reach: Floats, stored: StoredPoints | None = None) -> list[Floats]:
    """Return the points (n, 3) within ``reach`` (k,) of each centre (k, 3), less the centre; one pass over all.

    Of points in a file only the tiles about the centres are read.
    """
    if stored is None:
        return _within(views(scene), centres, reach)
    return _within(views(scene, reader=stored.near(_boxes(scene, centres, reach))), centres, reach)


def _boxes(scene: Scene, centres: Floats, reach: Floats) -> list[tuple[Floats, Floats]]:
    """Box of each scan, less its origin, all that is within ``reach`` (k,) of places (k, 3) in the project's frame.

    The lower and the upper corners are (k, 3).
    """
    boxes = []
    for scan in scene.scans:
        T = scan.pose
        middles, far = (centres - T[:3, 3]) @ T[:3, :3] - scan.origin, reach[:, None] + SLACK_MM
        boxes.append((middles - far, middles + far))
    return boxes


def _within(seen: Views, centres: Floats, reach: Floats) -> list[Floats]:
    middles = centres - seen.origin
    by_cell = _NearInX(middles[:, 0], reach)
    pieces: list[list[Floats]] = [[] for _ in reach]
    step, kept = [1] * len(pieces), [0] * len(pieces)
    for chunk in seen.blocks():
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


def _reach(result: Result, i: int) -> float:
    """Return how far from its centre a ball is shown."""
    radii = [float(column[i]) for column in (result.balls.radii, result.balls.nominal_radii) if np.isfinite(column[i])]
    return float(np.ceil((max([LEAST_RADIUS_MM, *radii]) + ROUND_MM) / SCALE_MM) * SCALE_MM)
