"""The table [targets] of project.toml: the kinds of targets that the scans are searched for."""

from __future__ import annotations

from processor.model import InputError, TargetSearch
from processor.scan_folder.checked_toml import Table

NAN = float("nan")
KEYS = ("checkerboard_mm", "sphere_radius_mm")


def read_search(project: Table) -> TargetSearch | None:
    """Return what scans are searched for; None without the table. Raises InputError for an empty one."""
    if "targets" not in project.values:
        return None
    table = project.table("targets")
    table.only(KEYS)
    if not table.values:
        raise InputError(f"{table.where}: expected {' or '.join(map(repr, KEYS))}, found neither; give one or both")
    return TargetSearch(*(table.number(key, NAN, positive=key in table.values) for key in KEYS))
