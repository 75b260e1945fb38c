"""Paper 003: nine scans from six stations chained by three picked points per pair, with six and seven parameters."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from processor.evaluation import evaluate
from processor.language.messages import Text, text
from processor.model import Reason, Scene, StepRun, reason
from processor.papers.charts import Chart
from processor.papers.data_sets import DataSet, Found, Measured
from processor.papers.rows import Row, Rule
from processor.pipeline import Execution
from processor.stitching import step
from processor.stitching.params import Params
from processor.stitching.result import Result
from processor.store import store

PAPER = "003"
BRIDGE = "truss bridge"
SCANS, STATIONS, POINTS = 9.0, 6.0, 3.0
SIX, SEVEN, OURS = "three-point, six", "three-point, seven", "automatic"
NAN = float("nan")


def data_sets(seed: int) -> list[DataSet]:
    """Return the data set of one seed."""
    return [DataSet(PAPER, BRIDGE, "truss-bridge-picks", (), seed)]


def measure(path: Path, data_set: DataSet) -> Measured:
    """Stitch the scans with six and seven parameters by picks, and by ours without any."""
    scene = store.read_scene(path)
    params = Params(method="three-point", seed=data_set.seed)
    figures = {"scans": float(len(scene.scans))}
    if scene.picks is not None:
        pairs = set(zip(scene.picks.scan_a, scene.picks.scan_b, strict=True))
        figures["points per pair"] = len(scene.picks.scan_a) / len(pairs)
    figures |= _figures(SIX, step.run(scene, params), path, scene)
    figures |= _figures(SEVEN, step.run(scene, replace(params, scale="free")), path, scene)
    figures |= _figures(OURS, step.run(replace(scene, picks=None), Params(seed=data_set.seed)), path, scene)
    return Measured(data_set, figures)


def _figures(method: str, result: Result, path: Path, scene: Scene) -> dict[str, float]:
    """Return how many scans were placed, the errors of their positions by the truth, and the scales' errors."""
    report = evaluate.evaluate(path, Execution(scene, (StepRun(step.NAME, method, "{}", result),), {}))
    errors = {metric.name: metric.value for metric in report.metrics}
    placed = result.scans.placed
    scales = 1e6 * np.abs(result.scans.scale[placed] - 1.0)
    return {
        f"{method}: placed": float(placed.sum()),
        f"{method}: position, rms": errors.get("station positions after datum fit, rms", NAN),
        f"{method}: position, largest": errors.get("station positions after datum fit, max", NAN),
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
    view = reason("papers.stitch-field-of-view")
    made.append(_row(text("figure {number}", number="3"), "", text("stations"), STATIONS, (), Rule.NONE, view))
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
    """Return no charts: the paper's figures are pictures of clouds."""
    return []
