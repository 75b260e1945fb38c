"""[tolerance] of project.toml: a standard, limits of the project, limits of single components, or any of these."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from processor.limits import limit_bounds, measurands, project_limits, standards
from processor.model import DecisionRule, Floats, InputError, Limit, Tolerance, did_you_mean
from processor.model.inputs import Kind, Place, array, entry, number, read, tables, text
from processor.scan_folder.files import PROJECT

COMPONENTS = "component"
OF_DECISIONS = {"rule", "risk"}
AGREED = ", agreed by "
MOST_NAMES = 12  # components in a message
OF_COMPONENTS = (measurands.DEVIATION, measurands.DEVIATION_SHARE, measurands.DEFECT_DEPTH, measurands.DEFECT_AREA)


def read_tolerance(given: Any, place: Place) -> Tolerance | None:
    """Read the limits of a project; None without any. Raises InputError for a key or a number that makes no sense."""
    if isinstance(given, Mapping) and not given:
        return None
    standard = given.get("standard", "") if isinstance(given, Mapping) else ""
    try:
        base = standards.load(standard) if standard and isinstance(standard, str) else Tolerance()
        if isinstance(given, Mapping) and not set(given) - OF_DECISIONS:
            base = standards.default_for(None)
    except InputError as error:
        raise place.refused(str(error)) from None
    declared, choice = declared_limits(base.standard), project_limits.choice(base)
    others = project_limits.choice(Tolerance())
    elsewhere = [key for key in given if key in others and key not in choice] if isinstance(given, Mapping) else []
    if elsewhere:
        known = ", ".join(limit.key for limit in base.limits)
        raise place.refused(f"{standard} has no limit {elsewhere[0]!r}; it has {known}")
    limits = read(declared, given, place)
    of_components = {limited.name: _given(limited, choice) for limited in limits.component}
    values = _given(limits, choice)
    if limits.risk is not None and limits.rule != DecisionRule.RISK:
        raise place.refused(f'risk is of the decision rule "{DecisionRule.RISK}"; add rule = "{DecisionRule.RISK}"')
    base = dataclasses.replace(base, rule=limits.rule, risk=limits.risk)
    source = f"{PROJECT}{AGREED}{limits.agreed_by}" if limits.agreed_by else PROJECT
    tolerance = project_limits.override(base, values, source, limits.root_gap_mm, of_components)
    _check_share(place, tolerance)
    return tolerance


def _given(limits: Any, choice: Mapping[str, Limit]) -> dict[str, Floats]:
    values = {key: getattr(limits, key, None) for key in choice}
    return {key: np.atleast_1d(value) for key, value in values.items() if value is not None}


@functools.cache
def declared_limits(standard: str) -> Any:
    """Return the table [tolerance] with the limits that a project can set beside a standard, "" for none."""
    choice = project_limits.choice(standards.load(standard) if standard else Tolerance())
    of_one = {key: limit for key, limit in choice.items() if limit.measure in OF_COMPONENTS}
    component = _declared("Component", [("name", entry(text()))], of_one, [])
    about = "limits of single components, by a pattern of their names such as web*"
    first = [
        ("standard", entry(text(), "a standard of processor/limits", default="")),
        ("agreed_by", entry(text(), "who has agreed to the project's own limits, and when", default="")),
        ("root_gap_mm", entry(number(), "gap between two ends in the design", default=0.0)),
        ("rule", entry(text(*DecisionRule), "decision rule", default=None)),
        (
            "risk",
            entry(number(above=0, below=0.5), "largest probability of a wrong decision, of rule risk", default=None),
        ),
    ]
    return _declared("Limits", first, choice, [(COMPONENTS, entry(tables(component), about, default=()))])


def _declared(name: str, first: list[tuple[str, Any]], choice: Mapping[str, Limit], last: list[tuple[str, Any]]) -> Any:
    """Return the declaration of a table of limits. Its messages do not list those of every class of defects."""
    limits = [
        (key, entry(_limit(limit), f"{limit.what}{'' if limit.unit == 'mm' else f' ({limit.unit})'}", default=None))
        for key, limit in choice.items()
    ]
    of_classes = tuple(f"{name.replace('-', '_')}_" for name in measurands.DEFECT_CLASSES)
    ends = ("_depth_mm", "_area_mm2")
    fields = [(key, Any, field) for key, field in (*first, *limits, *last)]
    listed = [key for key, *_ in (*first, *last, *limits) if not (key.endswith(ends) and key.startswith(of_classes))]
    listed.append("CLASS_depth_mm and CLASS_area_mm2 of a class of defects")
    return dataclasses.make_dataclass(name, fields, namespace={"LISTED": listed}, frozen=True)


def _limit(limit: Limit) -> Kind:
    """Return what states a limit: its greatest value, its least one, or both, as the standard's own row has it."""
    if limit_bounds.at_least(limit):
        return Kind("a share above 0, at most 1", _share, number(above=0, most=1).schema)
    if limit_bounds.two_sided(limit):
        return Kind(array(2).expected, _least_and_greatest, array(2).schema)
    none_allowed = limit.measure in (measurands.DEFECT_DEPTH, measurands.DEFECT_AREA)
    return number(least=0) if none_allowed else number(above=0)


def _share(value: Any, place: Place) -> float:
    least: float = number().convert(value, place)
    if not 0.0 < least <= 1.0:
        hint = f"; {least:g} % is {least / 100.0:g}" if 1.0 < least <= 100.0 else ""
        raise place.refused(f"expected a share above 0, at most 1, found {least:g}{hint}")
    return least


def _least_and_greatest(value: Any, place: Place) -> Floats:
    both: Floats = array(2).convert(value, place)
    if not both[0] < both[1]:
        raise place.refused(
            f"expected two numbers, least and greatest, found {both.tolist()}; the least is not below the greatest"
        )
    return both


TOLERANCE = Kind("a table", read_tolerance, {"$tolerance": ""})


def check_components(where: str, tolerance: Tolerance | None, names: Sequence[str]) -> None:
    """Raise InputError for limits of components that no name of the design fits; without names nothing is checked."""
    for limit in tolerance.limits if tolerance is not None and names else ():
        if not any(limit_bounds.names_component(limit, name) for name in names):
            assert limit.component is not None
            known = ", ".join(names[:MOST_NAMES]) + (", ..." if len(names) > MOST_NAMES else "")
            raise InputError(
                f"{where}: tolerance: no component {limit.component!r}{did_you_mean(limit.component, names)}; the "
                f"design has {known}"
            )


def _check_share(place: Place, tolerance: Tolerance) -> None:
    """Raise InputError for a share of points within a deviation that is not limited, of all or of a component."""
    limited = {limit.component for limit in tolerance.limits if limit.measure == measurands.DEVIATION}
    for limit in tolerance.limits:
        stated = limit.measure == measurands.DEVIATION_SHARE and math.isfinite(limit.low)
        if stated and not {limit.component, None} & limited:
            raise place.refused(
                "deviation_share is the share of points that keep deviation_mm; give that as well, "
                "e.g. deviation_mm = [-10.0, 10.0]"
            )
