"""Curves from the history: errors and coverage against noise, density and distance, and detection by size.

A curve is of scenes of one recipe that differ in one setting alone. Its values are those of all nights by the same
software; a fixed seed counts once.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from processor.evaluation.defects import FOUND_BY_AREA, FOUND_BY_DEPTH
from processor.language.messages import Message, Text, label, text
from processor.model import Statistic, Word
from processor.report import templates
from processor.report.charts import line_chart
from processor.report.charts.line_chart import Chart
from processor.validation.history import Row

FORMAT, FORMAT_VERSION = "processor-validation-curves", "1.0"
NOMINAL = 95.0
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
AXIS_OF = {key: axis for axis, keys in KEYS.items() for key in keys}
SIZES = {Axis.DEPTH: FOUND_BY_DEPTH, Axis.DIAMETER: FOUND_BY_AREA}


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


@dataclass(frozen=True, order=True)
class _Of:
    """What the values at the places of one curve have in common."""

    origin: str
    recipe: str
    key: str
    others: tuple[str, ...]
    step: str
    method: str
    quantity: str


def _of(row: Row, recipe: str, key: str, others: tuple[str, ...], quantity: str) -> _Of:
    return _Of(
        origin=row.origin,
        recipe=recipe,
        key=key,
        others=others,
        step=row.name[0],
        method=row.name[1],
        quantity=quantity,
    )


def of_history(
    rows: Sequence[Row], nights: Collection[str], cases: Mapping[str, tuple[str, tuple[str, ...]]]
) -> list[Curve]:
    """Return the curves of the rows of ``nights``; ``cases`` are recipe and settings of each case."""
    last: dict[tuple[str, int, tuple[str, str, str]], Row] = {}
    for row in rows:
        if row.night in nights and row.statistic:
            last[row.case, row.seed, row.name] = row
    latest = list(last.values())
    return [*_against_settings(latest, cases), *_detection(latest, cases)]


def _against_settings(rows: Iterable[Row], cases: Mapping[str, tuple[str, tuple[str, ...]]]) -> list[Curve]:
    found: dict[_Of, dict[str, dict[float, list[Row]]]] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for row in rows:
        recipe, settings = cases.get(row.case, ("", ()))
        for setting in settings:
            key, place = _numeric(setting)
            if key.rpartition(".")[2] in AXIS_OF and math.isfinite(place):
                others = tuple(sorted(other for other in settings if other != setting))
                of = _of(row, recipe, key, others, row.quantity)
                found[of][row.statistic][place].append(row)
    made = []
    for of, by_statistic in sorted(found.items(), key=lambda item: item[0]):
        statistic = next((str(one) for one in ERRORS if str(one) in by_statistic), "")
        if statistic and next(iter(by_statistic[statistic].values()))[0].unit in LENGTHS_AND_ANGLES:
            made += _curve(CurveKind.ERROR, of, statistic, by_statistic[statistic])
        if Statistic.COVERAGE in by_statistic:
            numbers = by_statistic.get(Statistic.NUMBER, {})
            made += _curve(CurveKind.COVERAGE, of, Statistic.COVERAGE, by_statistic[Statistic.COVERAGE], numbers)
    return made


def _curve(
    shown: CurveKind,
    of: _Of,
    statistic: str,
    rows: Mapping[float, list[Row]],
    numbers: Mapping[float, list[Row]] | None = None,
) -> list[Curve]:
    """Return a curve with two places or more, else none."""
    points = []
    for place in sorted(rows):
        value, scenes, items = _pooled(rows[place], None if numbers is None else numbers.get(place, []))
        if math.isfinite(value):
            points.append((place, value, scenes, items))
    if len(points) < 2:
        return []
    places, values, counts, items_of = zip(*points, strict=True)
    unit = next(iter(rows.values()))[0].unit
    return [
        Curve(
            shown=shown, axis=AXIS_OF[of.key.rpartition(".")[2]], statistic=str(statistic), unit=unit, places=places,
            values=values, scenes=counts, items=items_of if numbers is not None else (), **asdict(of),
        )
    ]  # fmt: skip


def _pooled(rows: Sequence[Row], numbers: Sequence[Row] | None) -> tuple[float, int, int]:
    """Return the median over scenes, or the share of all items together, with the numbers of scenes and of items."""
    known = [row for row in rows if math.isfinite(row.value)]
    if numbers is None:
        return (float(np.median([row.value for row in known])) if known else math.nan), len(known), 0
    number_of = {(row.case, row.seed): row.value for row in numbers}
    pairs = [(row.value, number_of.get((row.case, row.seed), 0.0)) for row in known]
    items = sum(number for _, number in pairs)
    share = sum(value * number for value, number in pairs) / items if items else math.nan
    return share, sum(number > 0.0 for _, number in pairs), int(items)


def _detection(rows: Sequence[Row], cases: Mapping[str, tuple[str, tuple[str, ...]]]) -> list[Curve]:
    """Return the share of defects that were found by their size, of each recipe and method."""
    made = []
    for axis, sizes in SIZES.items():
        shares: dict[_Of, dict[float, list[Row]]] = defaultdict(lambda: defaultdict(list))
        numbers: dict[_Of, dict[float, list[Row]]] = defaultdict(lambda: defaultdict(list))
        for row in rows:
            if row.quantity in sizes:
                low, high = sizes[row.quantity]
                recipe = cases.get(row.case, ("", ()))[0]
                of = _of(row, recipe, str(axis), (), str(axis))
                if row.statistic == Statistic.SHARE:
                    shares[of][math.sqrt(low * high)].append(row)
                elif row.statistic == Statistic.NUMBER:
                    numbers[of][math.sqrt(low * high)].append(row)
        for of, at in sorted(shares.items(), key=lambda item: item[0]):
            points = [(place, *_pooled(at[place], numbers[of][place])) for place in sorted(at)]
            points = [point for point in points if math.isfinite(point[1])]
            if points:
                places, values, scenes, items = zip(*points, strict=True)
                made.append(
                    Curve(
                        shown=CurveKind.DETECTION, axis=axis, statistic=str(Statistic.SHARE), unit="%",
                        places=places, values=values, scenes=scenes, items=items, **asdict(of),
                    )
                )  # fmt: skip
    return made


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
    drawn: list[dict[str, Message | str]] = [
        {"title": chart.title, "image": line_chart.data_uri(line_chart.png(chart))} for chart in charts(curves)
    ]
    template = templates.environment("validation", lang).get_template("curves.html")
    page: str = template.render(lang=lang, night=night, charts=drawn)
    return page + "\n"
