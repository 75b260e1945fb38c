"""The table [ceiling] of project.toml: a level or a surface below a space frame, and what is to be kept from it."""

from __future__ import annotations

from pathlib import Path

from processor.model import Ceiling, InputError
from processor.scan_folder.checked_table import Table, existing_file_in
from processor.scan_folder.design import read_surface
from processor.scan_folder.units import MM_PER_UNIT

NAN = float("nan")
KEYS = ("level", "surface", "clearance_mm", "hanger_longest_mm")


def read_ceiling(folder: Path, project: Table, unit: str, surface_unit: str) -> Ceiling | None:
    """Return the ceiling of a project, mm; None without one.

    ``unit`` is that of the level, ``surface_unit`` that of a mesh that states none. Raises InputError for a table that
    has neither level nor surface, or both.
    """
    if "ceiling" not in project.values:
        return None
    table = project.table("ceiling")
    table.only(KEYS)
    given = [key for key in ("level", "surface") if key in table.values]
    if len(given) != 1:
        raise InputError(
            f"{table.where}: expected 'level', a height, or 'surface', a mesh or CAD file, found "
            f"{' and '.join(given) or 'neither'}; give one of them"
        )
    clearance, longest = table.number("clearance_mm", 0.0), table.number("hanger_longest_mm", NAN)
    if clearance < 0.0 or longest <= clearance:
        raise InputError(
            f"{table.where}: expected 'clearance_mm' of 0 or more and 'hanger_longest_mm' above it, found "
            f"{clearance:g} and {longest:g}; correct them"
        )
    if given == ["level"]:
        level = table.number("level") * MM_PER_UNIT[unit]
        return Ceiling(level=level, clearance_mm=clearance, longest_mm=longest)
    path = existing_file_in(folder, table.text("surface"), f"{table.where}: surface")
    vertices, faces = read_surface(path, surface_unit)[:2]
    return Ceiling(vertices=vertices, faces=faces, clearance_mm=clearance, longest_mm=longest)
