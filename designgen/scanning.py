"""How a recipe's scene is scanned: by rays of a device from stations, or sampled from its surfaces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from designgen import sampler, scanner
from designgen.reading import filled
from processor.model import UsageError


@dataclass(frozen=True)
class ByRays:
    """Scans by rays of a device."""

    params: scanner.Params
    device: scanner.Scanner


Scanning = sampler.Params | ByRays


def read(recipe: Mapping[str, Any]) -> Scanning:
    """Read the sections ``scan`` and ``scanner``. Raises UsageError that names the key for what cannot be."""
    table = recipe.get("scan", {})
    mode = table.get("mode", sampler.MODE) if isinstance(table, Mapping) else sampler.MODE
    if mode not in (sampler.MODE, scanner.MODE):
        raise UsageError(f"scan.mode: expected {sampler.MODE} or {scanner.MODE}, got {mode!r}")
    if mode == sampler.MODE:
        if "scanner" in recipe:
            raise UsageError(f"scanner: there is a scanner only with scan.mode = {scanner.MODE!r}")
        return filled(sampler.Params, recipe, "scan")
    params = filled(scanner.Params, recipe, "scan")
    own = recipe.get("scanner", {})
    if not isinstance(own, Mapping):
        raise UsageError(f"scanner: expected a section, got {own!r}")
    return ByRays(params, filled(scanner.Scanner, {"scanner": {**scanner.preset(params.scanner), **own}}, "scanner"))
