"""How a recipe's scene is scanned: by rays from stations, or by sampling its surfaces."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from designgen.recipe_params import filled
from designgen.scanning import sampler, scanner, surroundings
from processor.model import UsageError


@dataclass(frozen=True)
class ByRays:
    """A scan by rays of a device; spacing and noise differ from point to point."""

    spacing_mm: ClassVar[float] = float("nan")
    sigma_mm: ClassVar[float] = float("nan")
    params: scanner.Params
    device: scanner.Scanner
    surroundings: surroundings.Params | None = None


Scanning = sampler.Params | ByRays

# Keys of [scan] that only some kinds of scene use.
KEYS_BY_KIND = {
    "inner_depth_mm": ("arch-bridge",),
    "net": ("arch-bridge",),
    "member_reach_mm": ("space-frame",),
    "distance_mm": ("arch-bridge", "assembly", "structure"),
    "height_mm": ("space-frame", "structure", "room"),
    "field_of_view_deg": ("structure",),
    "elevation_deg": ("structure",),
    "registered": ("structure", "room"),
    "repeated": ("structure",),
    "scans_at_first": ("structure",),
    "merged": ("space-frame", "structure", "room"),
    "origin_mm": ("space-frame", "structure", "room"),
}
# Keys that a type of structure does not use: a stadium is scanned from inside.
WINDOW_KEYS = ("field_of_view_deg", "elevation_deg")  # a truss bridge alone is scanned through a window
UNUSED_KEYS_BY_TYPE = {"stadium-roof": ("distance_mm", *WINDOW_KEYS), "plate-row": WINDOW_KEYS}


def scan_settings_of(recipe: Mapping[str, Any]) -> Scanning:
    """Read the sections ``scan`` and ``scanner`` of a recipe. Raises UsageError that names the key at fault."""
    table = recipe.get("scan", {})
    mode = table.get("mode", sampler.MODE) if isinstance(table, Mapping) else sampler.MODE
    if mode not in (sampler.MODE, scanner.MODE):
        raise UsageError(f"scan.mode: expected {sampler.MODE} or {scanner.MODE}, got {mode!r}")
    if mode == sampler.MODE:
        for section in ("scanner", "surroundings"):
            if section in recipe:
                raise UsageError(f"{section}: only with scan.mode = {scanner.MODE!r}, which scans by rays")
        sampling = filled(sampler.Params, recipe, "scan")
        _check_used(recipe, sampler.Params)
        return sampling
    params = filled(scanner.Params, recipe, "scan")
    _check_used(recipe, scanner.Params)
    changes = recipe.get("scanner", {})
    if not isinstance(changes, Mapping):
        raise UsageError(f"scanner: expected a section, got {changes!r}")
    numbers = {**scanner.preset(params.scanner), **changes}
    about = filled(surroundings.Params, recipe, "surroundings") if "surroundings" in recipe else None
    return ByRays(params, filled(scanner.Scanner, {"scanner": numbers}, "scanner"), about)


def _check_used(recipe: Mapping[str, Any], params: type) -> None:
    """Raise UsageError for a key of ``scan`` that the recipe's kind of scene does not use."""
    kind, section = recipe.get("kind"), recipe.get("structure")
    unused = {key for key, kinds in KEYS_BY_KIND.items() if kind not in kinds}
    if kind == "structure" and isinstance(section, Mapping) and section.get("type") in UNUSED_KEYS_BY_TYPE:
        kind = section["type"]
        unused.update(UNUSED_KEYS_BY_TYPE[kind])
    if "model" in recipe:
        unused.update(WINDOW_KEYS)
    for key in recipe.get("scan", {}):
        if key in unused:
            there = ", ".join(f.name for f in dataclasses.fields(params) if f.name not in unused)
            raise UsageError(f"scan.{key}: not used for kind {kind}; there are {there}")
