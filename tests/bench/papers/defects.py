"""Paper 004: defects of plates by the one page of the paper that is available. It states no number of a result."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from processor import diagnostics
from processor.defects import step
from processor.defects.params import Params
from processor.defects.result import DefectClass, Result
from processor.evaluation import defects as against_truth
from processor.evaluation import evaluate
from processor.language.messages import Text, text
from processor.model import Reason, Scene, Statistic, StepRun, reason
from processor.pipeline import Execution
from processor.report.charts.line_chart import Chart
from processor.store import store
from tests.bench.papers.data_sets import DataSet, Found, Measured
from tests.bench.papers.rows import Row, Rule, median

PAPER = "004"
PLATES = "12 plates"
METHODS = ("paper", "default")
NAN = float("nan")
MISSED = frozenset(against_truth.missed_quantity(kind) for kind in DefectClass)
STAGES = ("density clusters", "descriptors", "sample consensus", "iterative closest point", "defect points")


def data_sets(seed: int) -> list[DataSet]:
    """Return the data set of one seed."""
    return [DataSet(PAPER, PLATES, "plates-defects", ("scan.step_mrad=1.0",), seed)]


def measure(path: Path, data_set: DataSet) -> Measured:
    """Find the defects of a scene by the paper's method and by ours."""
    scene = store.read_scene(path)
    figures: dict[str, float] = {}
    series: dict[str, list[float]] = {}
    for method in METHODS:
        with diagnostics.recording() as notes:
            result = step.run(scene, Params(method=method, seed=data_set.seed), {})
        diagnostics.replay(notes)
        figures |= _of_stages(notes)
        figures |= _figures(method, result, path, scene)
        curves = [curve for curve in result.defects.deflection if len(curve.along)]
        if curves:
            longest = max(curves, key=lambda curve: float(np.ptp(curve.along)))
            series[f"{method}: along"] = (longest.along - longest.along.min()).tolist()
            series[f"{method}: deflection"] = longest.displacement.tolist()
            deepest = np.abs(result.defects.depth_max[[len(one.along) > 0 for one in result.defects.deflection]])
            reached = np.array([float(np.ptp(one.displacement)) for one in curves])
            figures[f"{method}: deflection by depth"] = float(np.median(reached / np.maximum(deepest, 1e-9)))
    return Measured(data_set, figures, series)


def _figures(method: str, result: Result, path: Path, scene: Scene) -> dict[str, float]:
    report = evaluate.evaluate(path, Execution(scene, (StepRun(step.NAME, method, "{}", result),), {}))
    values = {(metric.quantity, metric.statistic): metric.value for metric in report.metrics}
    missed = [value for (quantity, _), value in values.items() if quantity in MISSED]
    return {
        f"{method}: missed": float(sum(missed)),
        f"{method}: true": float(len(missed)),
        f"{method}: false alarms": values.get((against_truth.FALSE_ALARMS, Statistic.COUNT), NAN),
        f"{method}: depth error": values.get((against_truth.DEPTH_ERROR, Statistic.MEDIAN), NAN),
        f"{method}: threshold": result.lod95,
        f"{method}: curves": float(sum(len(curve.along) > 0 for curve in result.defects.deflection)),
        f"{method}: clustered": _stated(result, "defects.paper-clusters", "points"),
        f"{method}: rms": _stated(result, "defects.paper-fit", "rms"),
    }


def _of_stages(notes: diagnostics.Notes) -> dict[str, float]:
    """Return the figures that the stages of the paper's method note; of several rounds of registration the last."""
    return {f"{stage}: {quantity}": value for stage, _, quantity, value in notes.rows if stage in STAGES}


def _stated(result: Result, code: str, value: str) -> float:
    """Return a value that a remark of the result states; NaN without the remark."""
    return next((float(one.values[value]) for one in result.reasons if one.code == code), NAN)


def rows(found: Found) -> list[Row]:
    """Return rows of ours alone: the page that is available states steps and equations, and no number of a result."""
    none, beside = reason("papers.defects-no-number"), reason("papers.beside")
    made = []
    for place, quantity, figure, unit in (
        (text("section {number}", number="1.2"), text("points after the density clusters"), "clustered", ""),
        (text("figure {number}", number="2"), text("rms after histograms, consensus and registration"), "rms", "mm"),
        (text("section {number}", number="1.3"), text("threshold of a defect"), "threshold", "mm"),
        (text("section {number}", number="1.4"), text("defects with a deflection curve by slopes"), "curves", ""),
    ):
        made.append(_row(place, "paper", quantity, found.values(PLATES, f"paper: {figure}"), none, unit))
    section = text("section {number}", number="1.3")
    fitted, trials = (median(found.values(PLATES, f"sample consensus: {name}")) for name in ("fitted", "trials"))
    alike = reason("papers.defects-alike", fitted=fitted, trials=trials)
    figure_2 = text("figure {number}", number="2")
    for place, quantity, figure, unit, why in (
        (figure_2, text("places of the scan with a descriptor"), "descriptors: source", "", none),
        (figure_2, text("radius of a descriptor"), "descriptors: radius_mm", "mm", none),
        (section, text("poses compared by Huber's function"), "sample consensus: fitted", "", alike),
        (section, text("sum of Huber's function, equation 5"), "sample consensus: huber_mm2", "mm2", alike),
        (section, text("rounds of registration, last gate"), "iterative closest point: rounds", "", none),
        (section, text("points beyond the threshold"), "defect points: beyond", "", none),
    ):
        made.append(_row(place, "paper", quantity, found.values(PLATES, figure), why, unit))
    section_4 = text("section {number}", number="1.4")
    for method in METHODS:
        curve = text("range of a deflection curve by depth of the defect, median")
        values = found.values(PLATES, f"{method}: deflection by depth")
        made.append(_row(section_4, method, curve, values, none if method == "paper" else beside, ""))
        for quantity, figure, unit in (
            (text("defects not found"), "missed", ""),
            (text("false alarms"), "false alarms", ""),
            (text("depth error, median"), "depth error", "mm"),
            (text("level of detection"), "threshold", "mm"),
        ):
            if method == "default" or figure != "threshold":
                made.append(_row(section, method, quantity, found.values(PLATES, f"{method}: {figure}"), beside, unit))
    return made


def _row(place: Text, method: str, quantity: Text, values: tuple[float, ...], why: Reason, unit: str) -> Row:
    return Row(
        paper=PAPER, place=place, data=PLATES, method=method, quantity=quantity, unit=unit, published=NAN,
        values=values, rule=Rule.AT_MOST, reason=why,
    )  # fmt: skip


def charts(found: Found) -> list[Chart]:
    """Return the longest deflection curve by slopes, of the first seed."""
    curve = found.series(PLATES, "paper: deflection")
    if not curve:
        return []
    return [
        Chart(
            title=text("deflection curve by slopes of paper {paper}", paper=PAPER),
            x=text("along, mm"),
            y=text("displacement, mm"),
            lines=(("paper", curve),),
            places=tuple(found.series(PLATES, "paper: along")),
        )
    ]
