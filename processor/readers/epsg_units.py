"""Units of coordinate systems that a file names by its EPSG code alone, as ``epsg_units.toml`` has them."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from processor.plain_text import tomllib


def unit(axes: str, code: int) -> str:
    """Return the unit of a system's ``horizontal`` axes, or of a ``vertical`` one in feet; "" where it is not known."""
    return next((unit for unit, codes in _codes()[axes].items() if any(code in one for one in codes)), "")


@cache
def _codes() -> dict[str, dict[str, list[range]]]:
    def codes_of(one: str) -> range:
        span, _, step = one.partition("/")
        first, _, last = span.partition("-")
        return range(int(first), int(last or first) + 1, int(step or 1))

    tables = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))
    return {
        axes: {unit: [*map(codes_of, codes.split())] for unit, codes in table.items()} for axes, table in tables.items()
    }
