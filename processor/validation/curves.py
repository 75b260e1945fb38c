"""Curves from the history: errors and coverage against noise, density and distance, and detection by size.

A curve is of scenes of one recipe that differ in one setting alone. Its values are those of all nights by the same
software; a fixed seed counts once.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from processor.evaluation.defects import FOUND_BY_AREA, FOUND_BY_DEPTH
from processor.language.messages import Text, label, text
from processor.model import Statistic, Word
from processor.report import templates
from processor.report.charts import line_chart
from processor.report.charts.line_chart import Chart
from processor.validation.history import Figures, Row, by_quantity, of_items

FORMAT, FORMAT_VERSION = "processor-validation-curves", "1.0"
NOMINAL = 95.0  # % of intervals that hold the truth
MOST_LINES = 8  # of a chart
DECADE = 10.0  # ratio of the values of a chart above which its axis is logarithmic
ERRORS = (Statistic.RMS, Statistic.MEDIAN, Statistic.MEAN)  # the first that a quantity has is drawn
LENGTHS_AND_ANGLES = ("mm", "mrad")


class CurveKind(Word):
    """What a curve shows."""

    ERROR = "error"
    COVERAGE = "coverage"
    DETECTION = "detection"


class Axis(Word):
    """What a curve is drawn against."""

    NOISE = "noise"
    DENSITY = "density"
    DISTANCE = "distance"
    DEPTH = "depth"
    DIAMETER = "diameter"


# Settings by the last part of their keys: those of designgen and of foreign generators.
KEYS = {
    Axis.NOISE: ("sigma_mm", "noise_mm", "noise"),
    Axis.DENSITY: ("spacing_mm", "spacing", "step_mrad"),
    Axis.DISTANCE: ("distance_mm", "distance"),
}
SIZES = {Axis.DEPTH: FOUND_BY_DEPTH, Axis.DIAMETER: FOUND_BY_AREA}
AXIS_OF = {key: axis for axis, keys in KEYS.items() for key in keys} | {str(axis): axis for axis in SIZES}


@dataclass(frozen=True)
class Curve:
    """Values (n,) of a quantity at places (n,) of a setting, each of so many scenes, and of so many items if counted.

    ``key`` is the setting that differs, or the size of defects; ``others`` are the settings that are common.
    """

    shown: CurveKind
    origin: str
    recipe: str
    axis: Axis
    key: str
    others: tuple[str, ...]
    step: str
    method: str
    quantity: str
    statistic: str
    unit: str
    places: tuple[float, ...]
    values: tuple[float, ...]
    scenes: tuple[int, ...]
    items: tuple[int, ...] = ()


# What the values of one curve have in common: origin, recipe, key, others, step, method and quantity
_Common = tuple[str, str, str, tuple[str, ...], str, str, str]
_Places = dict[float, list[Figures]]  # scenes by the place on the axis


def of_history(
    rows: Sequence[Row], nights: Collection[str], cases: Mapping[str, tuple[str, tuple[str, ...]]]
) -> list[Curve]:
    """Return the curves of the rows of ``nights``; ``cases`` are recipe and settings of each case."""
    against: dict[_Common, _Places] = defaultdict(lambda: defaultdict(list))
    sizes: dict[_Common, _Places] = defaultdict(lambda: defaultdict(list))
    for (origin, step, method, quantity), scenes in by_quantity(rows, nights).items():
        for (case, _), figures in scenes.items():
            recipe, settings = cases.get(case, ("", ()))
            for setting in settings:
                key, place = _numeric(setting)
                if key.rpartition(".")[2] in AXIS_OF and math.isfinite(place):
                    others = tuple(sorted(other for other in settings if other != setting))
                    against[origin, recipe, key, others, step, method, quantity][place].append(figures)
            for axis, of_axis in SIZES.items():
                if quantity in of_axis:
                    place = math.sqrt(math.prod(of_axis[quantity]))
                    sizes[origin, recipe, str(axis), (), step, method, str(axis)][place].append(figures)
    made = []
    for common, by_place in sorted(against.items()):
        known = {statistic for figures in by_place.values() for one in figures for statistic in one}
        statistic = next((one for one in ERRORS if one in known), None)
        drawn = _curve(CurveKind.ERROR, common, statistic, by_place) if statistic is not None else []
        made += [curve for curve in drawn if curve.unit in LENGTHS_AND_ANGLES]
        made += _curve(CurveKind.COVERAGE, common, Statistic.COVERAGE, by_place)
    for common, by_place in sorted(sizes.items(), key=lambda item: (item[0][2], item[0])):
        made += _curve(CurveKind.DETECTION, common, Statistic.SHARE, by_place, least=1)
    return made


def _curve(shown: CurveKind, common: _Common, statistic: Statistic, by_place: _Places, least: int = 2) -> list[Curve]:
    """Return a curve with ``least`` places or more, else none."""
    points, units = [], [one[statistic].unit for figures in by_place.values() for one in figures if statistic in one]
    for place in sorted(by_place):
        value, scenes, items = _pooled(by_place[place], statistic, counted=shown is not CurveKind.ERROR)
        if math.isfinite(value):
            points.append((place, value, scenes, items))
    if len(points) < least:
        return []
    origin, recipe, key, others, step, method, quantity = common
    places, values, counts, items_of = zip(*points, strict=True)
    return [
        Curve(
            shown=shown, origin=origin, recipe=recipe, key=key, others=others, step=step, method=method,
            axis=AXIS_OF[key.rpartition(".")[2]], quantity=quantity, statistic=str(statistic), unit=units[0],
            places=places, values=values, scenes=counts, items=() if shown is CurveKind.ERROR else items_of,
        )
    ]  # fmt: skip


def _pooled(scenes: Sequence[Figures], statistic: Statistic, counted: bool) -> tuple[float, int, int]:
    """Return the median over scenes, or the share of all items together, with the numbers of scenes and of items."""
    if counted:
        share, pairs = of_items(scenes, statistic)
        return share, len(pairs), int(sum(number for _, number in pairs))
    values = [one[statistic].value for one in scenes if statistic in one and math.isfinite(one[statistic].value)]
    return (float(np.median(values)) if values else math.nan), len(values), 0


def _numeric(setting: str) -> tuple[str, float]:
    key, _, value = setting.partition("=")
    try:
        return key.strip(), float(value)
    except ValueError:
        return key.strip(), math.nan


# --- charts and page ------------------------------------------------------------------------------------------------


def charts(curves: Sequence[Curve]) -> list[Chart]:
    """Return a chart of the curves of one recipe, step and setting, and one a size of the detection of all recipes."""
    groups: dict[tuple[Any, ...], list[Curve]] = defaultdict(list)
    for curve in curves:
        of_all = curve.shown is CurveKind.DETECTION
        apart = ("", ()) if of_all else (curve.recipe, curve.others)
        groups[curve.shown, curve.step, apart, curve.key, curve.unit].append(curve)
    return [
        _chart(own[first : first + MOST_LINES]) for own in groups.values() for first in range(0, len(own), MOST_LINES)
    ]


def _chart(curves: Sequence[Curve]) -> Chart:
    first = curves[0]
    values = [value for curve in curves for value in curve.values if value > 0.0]
    places = [place for curve in curves for place in curve.places if place > 0.0]
    wide = first.shown is CurveKind.ERROR and values != [] and max(values) > DECADE * min(values)
    names = [_name(curve) for curve in curves]
    return Chart(
        title=_title(first),
        x=text("{key}, mm", key=first.axis) if first.shown is CurveKind.DETECTION else text("{key}", key=first.key),
        y=text("{shown}, {unit}", shown=first.shown, unit=first.unit),
        lines=tuple((name, list(curve.values)) for name, curve in zip(names, curves, strict=True)),
        over=tuple(list(curve.places) for curve in curves),
        logarithmic=wide,
        logarithmic_x=bool(places)
        and min(p for c in curves for p in c.places) > 0.0
        and max(places) > 4.0 * min(places),
        level=NOMINAL if first.shown is CurveKind.COVERAGE else math.nan,
    )


def _name(curve: Curve) -> str:
    if curve.shown is CurveKind.DETECTION:
        return f"{curve.recipe} ({curve.method}), {sum(curve.items)}"
    return (
        f"{curve.quantity}, {curve.statistic} ({curve.method})"
        if curve.shown is CurveKind.ERROR
        else (f"{curve.quantity} ({curve.method})")
    )


def _title(curve: Curve) -> Text:
    if curve.shown is CurveKind.DETECTION:
        return text("defects found by {key}: scenes and method, number of true defects", key=curve.axis)
    return text(
        "{step}, {recipe}: {shown} against {axis}",
        step=label(curve.step),
        recipe=" ".join([curve.recipe, *curve.others]),
        shown=curve.shown,
        axis=curve.axis,
    )


def as_object(curves: Sequence[Curve], night: str) -> dict[str, Any]:
    """Return what curves.json holds."""
    return {"format": FORMAT, "version": FORMAT_VERSION, "night": night, "curves": [asdict(curve) for curve in curves]}


def html(curves: Sequence[Curve], night: str, lang: str) -> str:
    """Return the page of the charts in a language."""
    drawn = [{"title": chart.title, "image": line_chart.png(chart)} for chart in charts(curves)]
    return templates.render("validation", "curves.html", lang, night=night, charts=drawn) + "\n"
