"""Epochs of step ``inspect``: the characteristics of each component.

The place and the sign of a greatest departure, such as sweep, may differ between epochs, so that absolute values are
compared. Where the departures along the axis are known, they are compared place by place too, from the
chord over what all epochs have in common.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from processor.epochs.quantity_series import Kind, Series, strongest
from processor.inspection.result import AxisDepartures, InspectedComponent, Quantity, Result
from processor.language.messages import Message, label, text
from processor.model import Floats, Reason, Status

BY_DESIGN = True  # holes and bodies are numbered, and faces and lines to measure along chosen, by the design
WITH_SIGN = (Quantity.SWEEP, Quantity.CAMBER)  # greatest departures, of which the interval is that of the size
OF_MEMBERS = (Quantity.DIAMETER, Quantity.BOW)


def series(results: Sequence[Result | None]) -> Iterator[Series]:
    """Yield each characteristic's actual size; its deviation where the nominal size is not known."""
    tables = [{} if one is None else {part.name: part for part in one.components} for one in results]
    for name in dict.fromkeys(name for table in tables for name in table):
        parts = [table.get(name) for table in tables]
        known = [part for part in parts if part is not None]
        # A member of a frame has the name of its balls
        kind = (
            Kind.MEMBER
            if any(quantity in OF_MEMBERS for part in known for quantity in part.characteristics.quantity)
            else Kind.PART
        )
        for key in dict.fromkeys(key for part in known for key in part.characteristics.id):
            yield _characteristic(name, kind, key, parts)
        yield from _along_axis(name, kind, parts)


def remarks(_: Sequence[Result | None]) -> Iterator[Reason]:
    """Say nothing: sizes of a part have nothing in common but the scanner."""
    yield from ()


def _characteristic(name: str, kind: Kind, key: str, parts: Sequence[InspectedComponent | None]) -> Series:
    values = np.array([_value(part, key) for part in parts]).reshape(-1, 4)
    actual = np.where(np.isfinite(values[:, 0]).any(), values[:, 0], values[:, 1])
    of = next(part.characteristics for part in parts if part is not None and key in part.characteristics.id)
    row = of.id.index(key)
    quantity: Message = label(key)
    if of.quantity[row] in WITH_SIGN:
        actual, quantity = np.abs(actual), text("size of {quantity}", quantity=quantity)
    length = kind is Kind.MEMBER and of.quantity[row] is Quantity.LENGTH
    return Series(
        component=name, kind=kind, quantity=quantity, value=actual, ci95=values[:, 2], unit=of.unit[row],
        doubtful=values[:, 3] > 0.0, between=tuple(name.split("-")) if length else (),
    )  # fmt: skip


def _value(part: InspectedComponent | None, key: str) -> tuple[float, float, float, float]:
    """Return actual size, deviation, half-width, and 1 where they are doubtful."""
    if part is None or key not in part.characteristics.id:
        return np.nan, np.nan, np.nan, 0.0
    table, row = part.characteristics, part.characteristics.id.index(key)
    doubtful = float(part.status is not Status.OK)
    return float(table.actual[row]), float(table.deviation[row]), float(table.ci95[row]), doubtful


def _along_axis(name: str, kind: Kind, parts: Sequence[InspectedComponent | None]) -> Iterator[Series]:
    """Yield the departures of the axis to the side and upward at the place where they changed most."""
    axes = {e: part.axis for e, part in enumerate(parts) if part is not None and len(part.axis.chainage) > 2}
    if len(axes) < 2:
        return
    start = max(float(axis.chainage[0]) for axis in axes.values())
    end = min(float(axis.chainage[-1]) for axis in axes.values())
    chainage = next(iter(axes.values())).chainage
    places = chainage[(chainage > start) & (chainage < end)]
    if not len(places):
        return
    doubtful = np.array([part is not None and part.status is not Status.OK for part in parts], np.bool_)
    for column, quantity in (("sideways", Quantity.SWEEP), ("up", Quantity.CAMBER)):
        value, half = np.full((2, len(parts), len(places)), np.nan)
        for e, axis in axes.items():
            value[e], half[e] = _off_the_chord(axis, column, np.array([start, *places, end]))
        known = list(axes)
        k = strongest(value[known], half[known])
        yield Series(
            component=name, kind=kind, value=value[:, k], ci95=half[:, k], doubtful=doubtful,
            quantity=text("{quantity} at {chainage:.0f} mm", quantity=label(str(quantity)), chainage=float(places[k])),
            chosen_from=len(places),
        )  # fmt: skip


def _off_the_chord(axis: AxisDepartures, column: str, places: Floats) -> tuple[Floats, Floats]:
    """Departures at places but the first and the last from the line through these two, and their half-widths.

    Half-widths are added up, as departures of one part have errors in common.
    """
    off, half = (np.interp(places, axis.chainage, getattr(axis, name)) for name in (column, f"{column}_ci95"))
    share = (places - places[0]) / (places[-1] - places[0])
    departure = off - (1.0 - share) * off[0] - share * off[-1]
    added = half + (1.0 - share) * half[0] + share * half[-1]
    return departure[1:-1], added[1:-1]
