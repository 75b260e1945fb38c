"""Epochs of step ``inspect``: the characteristics of each component.

The place and the sign of a greatest departure, such as sweep, may differ between epochs, so that absolute values are
compared. Where the departures along the axis are known, they are compared place by place too, from the
chord over what all epochs have in common.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from processor.epochs.quantity_series import Kind, Series, by_key, strongest
from processor.inspection import part_geometry
from processor.inspection.result import InspectedComponent, Quantity, Result
from processor.language.messages import Message, label, text
from processor.model import Reason, Status

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
        for (key, measured, unit), numbers in by_key(parts, _characteristics).items():
            actual, deviation, ci95, doubtful = numbers
            value = actual if np.isfinite(actual).any() else deviation
            quantity: Message = label(key)
            if measured in WITH_SIGN:
                value, quantity = np.abs(value), text("size of {quantity}", quantity=quantity)
            length = kind is Kind.MEMBER and measured is Quantity.LENGTH
            yield Series(
                component=name, kind=kind, quantity=quantity, value=value, ci95=ci95, unit=unit,
                doubtful=doubtful > 0.0, between=tuple(name.split("-")) if length else (),
            )  # fmt: skip
        yield from _along_axis(name, kind, parts)


def remarks(_: Sequence[Result | None]) -> Iterator[Reason]:
    """Say nothing: sizes of a part have nothing in common but the scanner."""
    yield from ()


def _characteristics(part: InspectedComponent) -> Iterator[tuple[Any, ...]]:
    """Yield id, quantity and unit of each characteristic, with actual size, deviation, half-width and doubt."""
    doubtful = part.status is not Status.OK
    for row in part.characteristics.items():
        yield (row["id"], row["quantity"], row["unit"]), row["actual"], row["deviation"], row["ci95"], doubtful


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
    chord = np.array([start, *places, end])
    off_the_chord = part_geometry.off_the_chord(chord)[1:-1]
    doubtful = np.array([part is not None and part.status is not Status.OK for part in parts], np.bool_)
    for column, quantity in (("sideways", Quantity.SWEEP), ("up", Quantity.CAMBER)):
        value, half = np.full((2, len(parts), len(places)), np.nan)
        for e, axis in axes.items():
            off, ci95 = (np.interp(chord, axis.chainage, getattr(axis, name)) for name in (column, f"{column}_ci95"))
            # Half-widths are added up, as departures of one part have errors in common.
            value[e], half[e] = off_the_chord @ off, np.abs(off_the_chord) @ ci95
        known = list(axes)
        k = strongest(value[known], half[known])
        yield Series(
            component=name, kind=kind, value=value[:, k], ci95=half[:, k], doubtful=doubtful,
            quantity=text("{quantity} at {chainage:.0f} mm", quantity=label(str(quantity)), chainage=float(places[k])),
            chosen_from=len(places),
        )  # fmt: skip
