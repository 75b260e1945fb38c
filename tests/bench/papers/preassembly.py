"""Paper 000: three methods of preassembly on three bridges as designed, and two of them on bridges with open joints.

Tables 2 and 3 are of bridges without errors: what a method finds there is its own error. D1 to D3 are sampled twice, on
a net whose edges carry points, as a meshed model has them, and at random. Tables 4 to 7 are of real parts; ours have
the corners of the paper's tables 4 and 5 at their joints.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from processor import diagnostics
from processor.evaluation import evaluate
from processor.evaluation import preassembly as against_truth
from processor.language.messages import Text, text
from processor.model import Floats, Reason, Scene, Statistic, StepRun, reason
from processor.pipeline import Execution
from processor.preassembly import step
from processor.preassembly.baselines import methods as paper_methods
from processor.preassembly.result import Result
from processor.report.charts.line_chart import Chart
from processor.store import store
from tests.bench.papers import parameters
from tests.bench.papers.data_sets import DataSet, Found, Measured
from tests.bench.papers.rows import Row, Rule, is_smaller

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PAPER = "000"
METHODS = ("corner", "line", "design-aided")  # W1, W2, W3
BRIDGES = ("D1", "D2", "D3")
SPACING_MM, COARSE_MM = 10.0, 20.0  # the coarse one shows how errors grow with it
NO_NOISE_MM = 0.001  # a scene states a noise above 0
SIDES = {"east": 4, "west": 5}  # the table of each
CORNERS = 4
AXES = ("dx", "dy", "dz")
PUBLISHED_DIFFERENCE_MM = 1.0  # "at most" between line and design-aided, figures 19 to 21
TRUE = against_truth.TRUE_SPLICING
NO_COARSE_POSE = "preassemble.no-coarse-pose"
NAN = float("nan")


def published() -> dict[str, Any]:
    """Return the paper's numbers."""
    content: dict[str, Any] = tomllib.loads(
        resources.files("tests.bench.papers").joinpath("paper_000.toml").read_text("utf-8")
    )
    return content


def data_sets(seed: int) -> list[DataSet]:
    """Return the data sets of one seed."""
    found = []
    for bridge in BRIDGES:
        for name, spacing, net in _clouds(bridge):
            settings = (f"scan.sigma_mm={NO_NOISE_MM}", f"scan.spacing_mm={spacing}", f"scan.net={str(net).lower()}")
            found.append(DataSet(PAPER, name, f"arch-{bridge.lower()}", settings, seed))
    for side, table in SIDES.items():
        gaps = np.array(published()[f"table_{table}"])[:CORNERS].reshape(CORNERS, -1, 3).swapaxes(0, 1).ravel()
        listed = ", ".join(f"{gap:.2f}" for gap in gaps)
        opened = (f"asbuilt.gap_table_mm=[{listed}]", "asbuilt.corner_mm=0.0")
        found.append(DataSet(PAPER, side, f"arch-{side}-sampled", opened, seed))
    return found


def _clouds(bridge: str) -> list[tuple[str, float, bool]]:
    """Name, spacing and whether on a net, of the clouds of a bridge."""
    clouds = [(f"{bridge}, net", SPACING_MM, True), (f"{bridge}, {SPACING_MM:g} mm", SPACING_MM, False)]
    return [*clouds, (f"{bridge}, {COARSE_MM:g} mm", COARSE_MM, False)] if bridge == BRIDGES[0] else clouds


def measure(path: Path, data_set: DataSet) -> Measured:
    """Assemble a bridge by the paper's methods, and by ours."""
    scene = store.read_scene(path)
    assert scene.arch is not None
    params = step.Params(seed=data_set.seed)
    scans = [own[0] for own in step.scans_in_order(scene, scene.arch)]
    parts = paper_methods.extract(scans, scene.arch, params)
    figures: dict[str, float] = {}
    gaps: dict[str, Floats] = {}
    results: dict[str, Result] = {}
    series: dict[str, list[Any]] = {}
    for method in METHODS:
        with diagnostics.at(method):
            result = paper_methods.assemble(parts, scene.arch, replace(params, method=method))
        gaps[method], results[method] = result.joints.gaps, result
        figures |= _figures(method, result)
        for k, axis in enumerate(AXES):
            figures[f"{method}: mean {axis}"] = float(np.abs(result.joints.gaps[:, :, k]).mean())
        series[f"{method}: gaps"] = result.joints.gaps.tolist()
        series[f"{method}: linear"] = result.linear.assembled.deviation.tolist()
    difference = gaps["design-aided"] - gaps["line"]
    figures["difference, largest"] = float(np.abs(difference).max())
    for k, axis in enumerate(AXES):
        figures[f"difference, largest {axis}"] = float(np.abs(difference[:, :, k]).max())
        series[f"difference {axis}"] = difference[:, :, k].ravel().tolist()
    series["chainage"] = (result.linear.chainage / 1000.0).tolist()
    del parts
    if _has_ours(data_set.name):
        results["adjustment"] = ours = step.run(scene, params)
        figures |= _figures("adjustment", ours)
        series["adjustment: linear"] = ours.linear.assembled.deviation.tolist()
    figures |= _true_splicing(results, path, scene)
    return Measured(data_set, figures, series)


def _has_ours(name: str) -> bool:
    """Whether ours runs beside the paper's methods: not on every bridge and sampling, as it takes half of the time."""
    return name in SIDES or name == f"{BRIDGES[0]}, {SPACING_MM:g} mm"


def _true_splicing(results: Mapping[str, Result], path: Path, scene: Scene) -> dict[str, float]:
    """Return the mean gap of the true key points at the poses of each method; the truth is read once."""
    runs = tuple(StepRun(step.NAME, method, "{}", result) for method, result in results.items())
    report = evaluate.evaluate(path, Execution(scene, runs, {}))
    first = next(iter(results))  # its metrics do not name it, as it would be the answer of a run
    return {
        f"{metric.method or first}: true splicing, mean": metric.value
        for metric in report.metrics
        if metric.quantity == TRUE and metric.statistic is Statistic.MEAN
    }


def _figures(method: str, result: Result) -> dict[str, float]:
    """Return the errors that a method states, and its coarse poses."""
    without = sum(cause.code == NO_COARSE_POSE for causes in result.components.reasons for cause in causes)
    return {
        f"{method}: splicing, mean": result.splicing.mean,
        f"{method}: splicing, max": result.splicing.max,
        f"{method}: linear, mean": result.linear.assembled.error.mean,
        f"{method}: linear, max": result.linear.assembled.error.max,
        f"{method}: coarse poses": float(len(result.joints.name) - without),
    }


# --- rows ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Of:
    """Where a row stands and what it is of."""

    place: Text
    data: str
    method: str
    unit: str = "mm"

    def row(self, quantity: Text, number: float, values: tuple[float, ...], rule: Rule, why: Reason) -> Row:
        """Return the row."""
        return Row(
            paper=PAPER, place=self.place, data=self.data, method=self.method, quantity=quantity, unit=self.unit,
            published=number, values=values, rule=rule, reason=why,
        )  # fmt: skip


def rows(found: Found) -> list[Row]:
    """Return the rows of tables 1 to 7 and figures 18 to 21, then ours."""
    numbers = published()
    made = parameters.rows(PAPER, found.seeds)
    for bridge in range(len(BRIDGES)):
        made += _of_bridge(found, bridge, numbers)
    for side in SIDES:
        made += _of_side(found, side, numbers)
    return made


def _of_bridge(found: Found, bridge: int, numbers: dict[str, Any]) -> list[Row]:
    """Rows of tables 2 and 3 of one bridge: on a net, then at random, then ours."""
    made = []
    table_2, table_3 = text("table {number}", number="2"), text("table {number}", number="3")
    for name, spacing, net in _clouds(BRIDGES[bridge]):
        why = reason("papers.bridge-net") if net else reason("papers.bridge-random", spacing=spacing)
        for row, method in enumerate(METHODS):
            for place, quantity, key, own in (
                (table_2, text("splicing error, mean"), "splicing_mean", "splicing, mean"),
                (table_2, text("splicing error, max"), "splicing_max", "splicing, max"),
                (table_3, text("linear error, mean"), "linear_mean", "linear, mean"),
                (table_3, text("linear error, max"), "linear_max", "linear, max"),
            ):
                # The linear error of corner and line is that of the attitude of the first part: of no use as a limit.
                rule = Rule.NEAR if place is table_3 and method != "design-aided" else Rule.AT_MOST
                because = reason("papers.bridge-attitude") if rule is Rule.NEAR else why
                of = _Of(place, name, method)
                number = float(numbers[key][row][bridge])
                made.append(of.row(quantity, number, found.values(name, f"{method}: {own}"), rule, because))
            values = found.values(name, f"{method}: true splicing, mean")
            quantity = text("splicing error of the true key points, mean")
            made.append(
                _Of(table_2, name, method).row(quantity, NAN, values, Rule.AT_MOST, reason("papers.bridge-true"))
            )
        made += _orders(found, name, why, net)
        if not _has_ours(name):
            continue
        beside = _Of(table_2, name, "adjustment")
        for quantity, own in (
            (text("splicing error, mean"), "splicing, mean"),
            (text("linear error, mean"), "linear, mean"),
        ):
            values = found.values(name, f"adjustment: {own}")
            made.append(beside.row(quantity, NAN, values, Rule.AT_MOST, reason("papers.beside")))
    return made


def _orders(found: Found, name: str, why: Reason, net: bool) -> list[Row]:
    """Rows of the paper's statements on the order of the methods; ``net``: the points of the data set are on one."""

    def smaller(method: str, than: str, figure: str) -> tuple[float, ...]:
        return is_smaller(found.values(name, f"{method}: {figure}"), found.values(name, f"{than}: {figure}"))

    place, statement = text("table {number}", number="2"), text("splicing error smaller than by the other method")
    table_3, of_line = text("table {number}", number="3"), text("linear error smaller than by the other method")
    attitude = reason("papers.bridge-attitude")
    corners = reason("papers.bridge-net-corners") if net else why
    poses = found.values(name, "line: coarse poses")
    by_histograms, symmetric = text("joints whose coarse pose is from histograms"), reason("papers.bridge-histograms")
    figure_1 = _Of(text("figure {number}", number="1"), name, "line", "")
    return (
        [
            _Of(place, name, f"{one}, {other}", "").row(
                statement,
                1.0,
                smaller(one, other, "splicing, mean"),
                Rule.HOLDS,
                corners if other == "corner" else why,
            )
            for one, other in (("line", "corner"), ("line", "design-aided"), ("design-aided", "corner"))
        ]
        + [
            _Of(table_3, name, f"{one}, {other}", "").row(
                of_line, 1.0, smaller(one, other, "linear, mean"), Rule.HOLDS, because
            )
            for one, other, because in (("design-aided", "line", why), ("line", "corner", attitude))
        ]
        + [figure_1.row(by_histograms, 4.0, poses, Rule.NEAR, symmetric)]
    )


def _of_side(found: Found, side: str, numbers: dict[str, Any]) -> list[Row]:
    """Rows of tables 4 to 7 and figures 18 to 21 of one bridge of real parts."""
    made = []
    table = SIDES[side]
    why = reason("papers.bridge-open-joints")
    for number, method in ((table, "line"), (table + 2, "design-aided")):
        gaps = np.abs(np.array(numbers[f"table_{number}"]))
        of = _Of(text("table {number}", number=str(number)), side, method)
        for quantity, value, own in (
            (text("splicing error, mean"), float(gaps.mean()), "splicing, mean"),
            (text("splicing error, max"), float(gaps.max()), "splicing, max"),
        ):
            made.append(of.row(quantity, value, found.values(side, f"{method}: {own}"), Rule.NEAR, why))
        for k, axis in enumerate(AXES):
            quantity, values = text("mean of {axis}", axis=axis), found.values(side, f"{method}: mean {axis}")
            made.append(of.row(quantity, float(gaps[:, k::3].mean()), values, Rule.NEAR, why))
    for k, method in enumerate(("line", "design-aided")):
        of = _Of(text("figure {number}", number="18"), side, method)
        for i, (quantity, own) in enumerate(
            ((text("linear error, mean"), "linear, mean"), (text("linear error, max"), "linear, max"))
        ):
            values = found.values(side, f"{method}: {own}")
            made.append(
                of.row(quantity, numbers["figure_18"][k][i], values, Rule.NEAR, reason("papers.bridge-real-parts"))
            )
    smaller = is_smaller(found.values(side, "design-aided: linear, mean"), found.values(side, "line: linear, mean"))
    of = _Of(text("figure {number}", number="18"), side, "design-aided, line", "")
    statement = text("linear error smaller than by the other method")
    made.append(of.row(statement, 1.0, smaller, Rule.HOLDS, reason("papers.bridge-real-parts")))
    between = np.array(numbers[f"table_{table + 2}"]) - np.array(numbers[f"table_{table}"])
    left, before = beyond_rigid(between)
    why = reason("papers.bridge-picked-anew", rms=before, left=left)
    for k, axis in enumerate(AXES):
        of = _Of(text("figure {number}", number=str(19 + k)), side, "line, design-aided")
        quantity = text("largest difference of two methods, {axis}", axis=axis)
        value = float(np.abs(between[:, k::3]).max())
        made.append(of.row(quantity, value, found.values(side, f"difference, largest {axis}"), Rule.AT_MOST, why))
    return made


def beyond_rigid(between: Floats) -> tuple[float, float]:
    """Rms, mm, of differences (8, 3 j) of two methods' gaps that no rigid motion of the parts explains, and of all.

    Two methods that measure the same key points differ by rigid motions of the parts alone. Over a section of any size
    these change dx linearly to the left and upward, dy upward, and dz to the left: seven unknowns per joint.
    """
    left = np.array([1.0, -1.0, -1.0, 1.0, 0.0, -1.0, 0.0, 1.0])
    up = np.array([-1.0, -1.0, 1.0, 1.0, -1.0, 0.0, 1.0, 0.0])
    one = np.ones(8)
    square, dof = 0.0, 0
    for column, values in enumerate(between.T):
        A = np.stack([(one, left, up), (one, up), (one, left)][column % 3], axis=1)
        square += float(((values - A @ np.linalg.lstsq(A, values, rcond=None)[0]) ** 2).sum())
        dof += 8 - A.shape[1]
    return float(np.sqrt(square / dof)), float(np.sqrt(np.mean(between**2)))


# --- charts -------------------------------------------------------------------------------------------------------


def charts(found: Found) -> list[Chart]:
    """Return figures 18 to 21 in kind, of the first seed."""
    made = []
    for side in SIDES:
        lines = tuple(
            (method, found.series(side, f"{method}: linear")) for method in ("line", "design-aided", "adjustment")
        )
        if all(values for _, values in lines):
            made.append(
                Chart(
                    title=text("figure {number} of paper {paper}, {data}", number="18", paper=PAPER, data=side),
                    x=text("chainage, m"),
                    y=text("linear error, mm"),
                    lines=lines,
                    places=tuple(found.series(side, "chainage")),
                    logarithmic=True,
                )
            )
        for k, axis in enumerate(AXES):
            values = found.series(side, f"difference {axis}")
            if values:
                title = text("figure {number} of paper {paper}, {data}", number=str(19 + k), paper=PAPER, data=side)
                made.append(
                    Chart(
                        title=title,
                        x=text("point pair, joint by joint"),
                        y=text("difference, mm"),
                        lines=((axis, values),),
                    )
                )
    return made
