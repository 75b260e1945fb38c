"""[tolerance] of project.toml: a standard, limits of the project, limits of single components, or any of these."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from processor.limits import limit_bounds, measurands, project_limits, standards
from processor.model import Floats, InputError, Limit, Tolerance, did_you_mean
from processor.scan_folder.checked_table import Table
from processor.scan_folder.files import PROJECT

COMPONENTS = "component"
MOST_NAMES = 12
KEYS = ("standard", "root_gap_mm", COMPONENTS)  # beside those of limits
OF_COMPONENTS = (measurands.DEVIATION, measurands.DEVIATION_SHARE, measurands.DEFECT_DEPTH, measurands.DEFECT_AREA)


def read_tolerance(project: Table) -> Tolerance | None:
    """Read the limits of a project; None without any. Raises InputError for a key or a number that makes no sense."""
    if not project.values.get("tolerance"):
        return None
    table = project.table("tolerance")
    standard = table.text("standard", "")
    try:
        base = standards.load(standard) if standard else Tolerance()
        choice = project_limits.choice(base)
    except InputError as error:
        raise InputError(f"{table.where}: {error}") from None
    elsewhere = [
        key for key in table.values if key not in (*KEYS, *choice) and key in project_limits.choice(Tolerance())
    ]
    if elsewhere:
        known = ", ".join(limit.key for limit in base.limits)
        raise InputError(f"{table.where}: {standard} has no limit {elsewhere[0]!r}; it has {known}")
    _only(table, (*KEYS, *choice))
    values = {key: _limit(table, choice[key]) for key in table.values if key in choice}
    of_components: dict[str, dict[str, Floats]] = {}
    of_one = {key: limit for key, limit in choice.items() if limit.measure in OF_COMPONENTS}
    for entry in table.tables(COMPONENTS):
        _only(entry, ("name", *of_one))
        of_components[entry.text("name")] = {key: _limit(entry, of_one[key]) for key in entry.values if key in of_one}
    tolerance = project_limits.override(base, values, PROJECT, table.number("root_gap_mm", 0.0), of_components)
    _check_share(table, tolerance)
    return tolerance


def _only(table: Table, known: tuple[str, ...]) -> None:
    """Raise InputError for an unknown key, with the keys that are most like it, else with those that are no class's."""
    unknown = next((key for key in table.values if key not in known), None)
    if unknown is None:
        return
    of_classes = tuple(f"{name.replace('-', '_')}_" for name in measurands.DEFECT_CLASSES)
    ends = ("_depth_mm", "_area_mm2")
    single = [key for key in known if not (key.endswith(ends) and key.startswith(of_classes))]
    raise InputError(
        f"{table.where}: unknown key {unknown!r}{did_you_mean(unknown, known)}; known are {', '.join(single)}, and "
        "CLASS_depth_mm and CLASS_area_mm2 of a class of defects"
    )


def _limit(table: Table, limit: Limit) -> Floats:
    """Read one limit: its greatest value, its least one, or both, as the standard's own row has it."""
    key = limit.key
    if limit_bounds.at_least(limit):
        least = table.number(key)
        if not 0.0 < least <= 1.0:
            hint = f"; {least:g} % is {least / 100.0:g}" if 1.0 < least <= 100.0 else ""
            raise InputError(f"{table.where}: expected a share above 0, at most 1, as {key!r}, found {least:g}{hint}")
        return np.array([least])
    if limit_bounds.two_sided(limit):
        both = table.array(key, 2)
        if not both[0] < both[1]:
            raise InputError(
                f"{table.where}: expected two numbers, least and greatest as {key!r}, found {both.tolist()}; "
                "the least is not below the greatest"
            )
        return both
    greatest = table.number(key)
    none_allowed = limit.measure in (measurands.DEFECT_DEPTH, measurands.DEFECT_AREA)
    if greatest < 0.0 or (greatest == 0.0 and not none_allowed):
        expected = "a number from 0" if none_allowed else "a number above 0"
        raise InputError(f"{table.where}: expected {expected} as {key!r}, found [{greatest}]")
    return np.array([greatest])


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


def _check_share(table: Table, tolerance: Tolerance) -> None:
    """Raise InputError for a share of points within a deviation that is not limited, of all or of a component."""
    limited = {limit.component for limit in tolerance.limits if limit.measure == measurands.DEVIATION}
    for limit in tolerance.limits:
        stated = limit.measure == measurands.DEVIATION_SHARE and math.isfinite(limit.low)
        if stated and not {limit.component, None} & limited:
            raise InputError(
                f"{table.where}: deviation_share is the share of points that keep deviation_mm; give that as well, "
                "e.g. deviation_mm = [-10.0, 10.0]"
            )
