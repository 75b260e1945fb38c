"""Values and tables as text of TOML."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from datetime import date, time
from typing import Any


def as_toml(value: Any) -> str:
    """Return a text, number, truth value, date, time, or list or table of these as TOML in one line."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")  # JSON has DEL as it is
    if isinstance(value, float) and not math.isfinite(value):
        return "nan" if math.isnan(value) else "inf" if value > 0.0 else "-inf"
    if isinstance(value, date | time):
        return value.isoformat()
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(as_toml, value))}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{as_toml(str(key))} = {as_toml(inner)}' for key, inner in value.items())}}}"
    return json.dumps(value)


def document(table: Mapping[str, Any], above: str = "") -> str:
    """Return a table as a TOML document: its values, then its tables."""
    values = [f"{as_toml(key)} = {as_toml(value)}" for key, value in table.items() if not isinstance(value, Mapping)]
    below = [
        f"[{above}{as_toml(key)}]\n{document(value, f'{above}{as_toml(key)}.')}"
        for key, value in table.items()
        if isinstance(value, Mapping)
    ]
    return "\n".join([*values, *below]) + "\n"
