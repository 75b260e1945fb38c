"""Paper 003: nine scans from six stations chained by three picked points per pair, with six and seven parameters.

The scanner sees a window of 40 deg, as the paper's, and the points are corners of the structure. Each pair that has
three in common is used, not the consecutive ones alone.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from processor import diagnostics, scene_cloud
from processor.evaluation import evaluate
from processor.evaluation import stitching as against_truth
from processor.language.messages import Text, text
from processor.model import Floats, Reason, Scene, Statistic, Status, StepRun, reason
from processor.pipeline import Execution
from processor.report.charts.line_chart import Chart
from processor.stitching import step
from processor.stitching.params import Params
from processor.stitching.result import Result
from processor.store import store
from tests.bench.papers.data_sets import DataSet, Found, Measured
from tests.bench.papers.rows import Row, Rule

PAPER = "003"
BRIDGE = "truss bridge"
SCANS, STATIONS, POINTS = 9.0, 6.0, 3.0
SIX, SEVEN, OURS = "three-point, six", "three-point, seven", "automatic"
NAN = float("nan")
APART_MM = 1000.0  # scanners nearer than this are on one station
MOST_SHOWN = 8000  # points on the chart of the merged cloud


def data_sets(seed: int) -> list[DataSet]:
    """Return the data set of one seed."""
    return [DataSet(PAPER, BRIDGE, "truss-bridge-chain", (), seed)]


def measure(path: Path, data_set: DataSet) -> Measured:
    """Stitch the scans with six and seven parameters by picks, and by ours without any."""
    scene = store.read_scene(path)
    params = Params(method="three-point", seed=data_set.seed)
    figures = {"scans": float(len(scene.scans))}
    if scene.picks is not None:
        pairs = set(zip(scene.picks.scan_a, scene.picks.scan_b, strict=True))
        figures["points per pair"] = len(scene.picks.scan_a) / len(pairs)
    for method, used in ((SIX, params), (SEVEN, replace(params, scale="free"))):
        with diagnostics.at(method):
            result = step.run(scene, used)
            figures |= _figures(method, result, path, scene)
        if method == SIX:
            figures["stations"] = float(_stations(result))
            cloud = scene_cloud.merged(scene_cloud.stitched(scene, result), with_scanner=False)
            figures["merged points"] = float(len(cloud.points))
            shown = cloud.points[:: max(1, len(cloud.points) // MOST_SHOWN)] / 1000.0
    figures |= _figures(OURS, step.run(replace(scene, picks=None), Params(seed=data_set.seed)), path, scene)
    return Measured(data_set, figures, {"x": shown[:, 0].tolist(), "y": shown[:, 1].tolist()})


def _stations(result: Result) -> int:
    """Return the number of places that the placed scans were made from."""
    found: list[Floats] = []
    for at in result.scans.position[result.scans.placed]:
        if all(np.linalg.norm(at - other) > APART_MM for other in found):
            found.append(at)
    return len(found)


def _figures(method: str, result: Result, path: Path, scene: Scene) -> dict[str, float]:
    """Return how many scans were placed, the errors of their positions by the truth, and the scales' errors."""
    report = evaluate.evaluate(path, Execution(scene, (StepRun(step.NAME, method, "{}", result),), {}))
    errors = {(metric.quantity, metric.statistic): metric.value for metric in report.metrics}
    placed = result.scans.placed
    scales = 1e6 * np.abs(result.scans.scale[placed] - 1.0)
    return {
        f"{method}: placed": float(placed.sum()),
        f"{method}: position, rms": errors.get((against_truth.AFTER_FIT, Statistic.RMS), NAN),
        f"{method}: position, largest": errors.get((against_truth.AFTER_FIT, Statistic.MAX), NAN),
        f"{method}: ambiguous": float(sum(status is Status.AMBIGUOUS for status in result.scans.status)),
        f"{method}: scale, ppm": float(scales.max(initial=0.0)),
    }


def rows(found: Found) -> list[Row]:
    """Return the rows of the numbers that the paper states; it states no error."""
    section = text("section {number}", number="2")
    why, none = reason("papers.stitch-placed"), reason("papers.stitch-no-error")
    made = [_row(section, "", text("scans"), SCANS, found.values(BRIDGE, "scans"), Rule.NEAR, why)]
    made.append(
        _row(section, "", text("points per pair"), POINTS, found.values(BRIDGE, "points per pair"), Rule.NEAR, why)
    )
    for method in (SIX, SEVEN, OURS):
        published = NAN if method == OURS else SCANS
        because = reason("papers.beside") if method == OURS else why
        values = found.values(BRIDGE, f"{method}: placed")
        made.append(_row(section, method, text("scans in one frame"), published, values, Rule.NEAR, because))
        for quantity, figure, unit in (
            (text("station positions, rms"), "position, rms", "mm"),
            (text("station positions, largest"), "position, largest", "mm"),
            (text("largest error of a scale"), "scale, ppm", "ppm"),
        ):
            values = found.values(BRIDGE, f"{method}: {figure}")
            made.append(_row(section, method, quantity, NAN, values, Rule.AT_MOST, none, unit))
    ambiguous = found.values(BRIDGE, f"{OURS}: ambiguous")
    why = reason("papers.stitch-ambiguous")
    made.append(_row(section, OURS, text("scans called ambiguous"), NAN, ambiguous, Rule.AT_MOST, why))
    view, figure_8 = reason("papers.stitch-field-of-view"), text("figure {number}", number="8")
    stations = found.values(BRIDGE, "stations")
    made.append(_row(text("figure {number}", number="3"), SIX, text("stations"), STATIONS, stations, Rule.NEAR, view))
    merged = found.values(BRIDGE, "merged points")
    made.append(_row(figure_8, SIX, text("points of the merged cloud"), NAN, merged, Rule.NEAR, none))
    return made


def _row(
    place: Text, method: str, quantity: Text, number: float, values: tuple[float, ...], rule: Rule, why: Reason,
    unit: str = "",
) -> Row:  # fmt: skip
    return Row(
        paper=PAPER, place=place, data=BRIDGE, method=method, quantity=quantity, unit=unit, published=number,
        values=values, rule=rule, reason=why,
    )  # fmt: skip


def charts(found: Found) -> list[Chart]:
    """Return figure 8 in kind: the merged cloud in plan, in the frame of the first scan, of the first seed."""
    x, y = found.series(BRIDGE, "x"), found.series(BRIDGE, "y")
    if not x:
        return []
    title = text("figure {number} of paper {paper}", number="8", paper=PAPER)
    return [Chart(title=title, x=text("x, m"), y=text("y, m"), lines=((SIX, y),), plan=(x,))]
