"""The unit of length of the coordinate system that a LAS file names, by GeoTIFF keys or as WKT."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import processor.readers.epsg_units as epsg_units
from processor.model import Reason, reason

UNIT = "m"
# Keys of GeoTIFF 1.1.
MODEL_KEY, SYSTEM_KEY, LINEAR_UNIT_KEY, UNIT_SIZE_KEY, OTHER_UNIT_KEY = 1024, 3072, 3076, 3077, 4052
VERTICAL_SYSTEM_KEY, VERTICAL_UNIT_KEY = 4096, 4099  # of heights, as above
GEOGRAPHIC, USER_DEFINED = 2, 32767  # values of MODEL_KEY, and of any key
# Codes of units of length in the EPSG register.
EPSG_UNITS = {9001: "m", 9002: "ft", 9003: "us-ft", 9036: "km", 1025: "mm", 1033: "cm"}
# The international foot and that of the US survey (NIST SP 811, appendix B).
SIZES_M = {"m": 1.0, "ft": 0.3048, "us-ft": 1200.0 / 3937.0, "km": 1e3, "dm": 0.1, "cm": 0.01, "mm": 1e-3}
# Of a size as written. The two feet differ by 6e-7 m, and the foot of Clarke from them by more.
SIZE_TOLERANCE_M = 1e-7
GEOGRAPHIC_WKT = r"\s*((COMPD_?CS|COMPOUNDCRS)\[[^\[]*,\s*)?(GEOGC|GEOGRAPHICC|GEODC|GEODETICC)"
PLANE_WKT = "PROJC|PROJECTEDC|LOCAL_?C|ENGC|ENGINEERINGC"


def unit(vlrs: Sequence[Any], fits_degrees: bool) -> tuple[str, Reason | None]:
    """Return the unit of length of a coordinate system in records of LAS, or "" and why it cannot be used.

    A system in degrees is ignored, as a mistake of the writer, if the coordinates exceed those of degrees (not
    ``fits_degrees``). Without a system the unit is metres.
    """
    doubles = next((list(vlr.doubles) for vlr in vlrs if hasattr(vlr, "doubles")), [])
    units, heights = list[str | Reason](), ""
    for vlr in vlrs:
        keys = {key.id: key.value_offset for key in getattr(vlr, "geo_keys", ())}
        plane, *vertical = re.split("VERT_?CS|VERTCRS|VERTICALCRS", str(getattr(vlr, "string", "")))
        if fits_degrees and (keys.get(MODEL_KEY) == GEOGRAPHIC or re.match(GEOGRAPHIC_WKT, plane)):
            return "", reason("units.file-in-degrees")
        units += [*_units_of_keys(keys, doubles), *_units_of_wkt(plane)]
        of_wkt = _last_unit(vertical[0]) if vertical else ""
        heights = heights or EPSG_UNITS.get(keys.get(VERTICAL_UNIT_KEY, 0), "")
        heights = heights or epsg_units.unit("vertical", keys.get(VERTICAL_SYSTEM_KEY, 0))
        heights = heights or (of_wkt if isinstance(of_wkt, str) else "")
    horizontal = next((one for one in units if isinstance(one, str)), "")
    if units and not horizontal:
        return "", next(one for one in units if isinstance(one, Reason))
    horizontal = horizontal or UNIT
    if heights and heights != horizontal:
        return "", reason("units.file-in-two", horizontal=horizontal, vertical=heights)
    return horizontal, None


def _units_of_keys(keys: Mapping[int, int], doubles: Sequence[float]) -> Iterator[str | Reason]:
    """Yield the unit that GeoTIFF keys state: by its own code, by its size, or by the code of the system."""
    code, system = keys.get(LINEAR_UNIT_KEY, 0), keys.get(SYSTEM_KEY, 0)
    if code in EPSG_UNITS:
        yield EPSG_UNITS[code]
    elif code == USER_DEFINED and keys.get(UNIT_SIZE_KEY, -1) in range(len(doubles)):
        yield _unit_of_size("", doubles[keys[UNIT_SIZE_KEY]])
    elif code:
        yield reason("units.file-code-unknown", code=code)
    elif system not in (0, USER_DEFINED):
        yield epsg_units.unit("horizontal", system) or reason("units.file-code-unknown", code=system)
    elif keys.get(OTHER_UNIT_KEY) in EPSG_UNITS:
        yield EPSG_UNITS[keys[OTHER_UNIT_KEY]]


def _units_of_wkt(plane: str) -> Iterator[str | Reason]:
    """Yield the unit of a projected or local system in WKT: of its axes, else by the code of the system."""
    if not re.search(PLANE_WKT, plane):
        return
    last = _last_unit(plane)
    codes = re.findall(r'(?:AUTHORITY|ID)\["EPSG",\s*"?(\d+)', plane)
    if last or not codes:
        yield last or reason("units.file-unit-missing")
    else:
        yield epsg_units.unit("horizontal", int(codes[-1])) or reason("units.file-code-unknown", code=int(codes[-1]))


def _last_unit(wkt: str) -> str | Reason:
    """Return the last unit of length of a coordinate system in WKT, that of its axes; "" without one."""
    units = re.findall(r'(?<![A-Z])(?:LENGTH)?UNIT\["([^"]*)",\s*([0-9.eE+-]+)', wkt)
    lengths = [
        (name, float(size)) for name, size in units if not 0.017 < float(size) < 0.018
    ]  # a degree is 0.01745 rad
    return _unit_of_size(*lengths[-1]) if lengths else ""


def _unit_of_size(name: str, size_m: float) -> str | Reason:
    """Return the unit of a size in metres; the name decides between feet where the size is rounded."""
    if "US" in name.upper() and abs(size_m - SIZES_M["us-ft"]) < 1e-6:
        return "us-ft"
    near = [one for one, size in SIZES_M.items() if abs(size_m - size) <= SIZE_TOLERANCE_M]
    return near[0] if near else reason("units.file-size-unknown", name=name, size_m=size_m)
