"""Make the scene of a recipe and its truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from threadpoolctl import threadpool_limits

from designgen.models.model import Model
from designgen.recipe_params import filled
from designgen.scanning import processing
from designgen.scanning.scan_settings import Scanning, scan_settings_of
from designgen.scenes import arch_bridge, assembly, model, space_frame, structure, target_room
from processor.model import Scene, Truth, UsageError, reason

Maker = Callable[[str, Mapping[str, Any], Scanning, int], tuple[Scene, Truth]]
MAKERS: dict[str, tuple[str, Maker]] = {
    "arch-bridge": ("bridge", arch_bridge.make),
    "space-frame": ("frame", space_frame.make),
    "structure": ("structure", structure.make),
    "ring": ("ring", arch_bridge.make_ring),
    "assembly": ("assembly", assembly.make),
    "room": ("room", target_room.make),
}
EXTRA = {"structure": {"picks"}, "assembly": {"bolts"}}  # sections of one kind only


def make(
    name: str, recipe: Mapping[str, Any], seed: int | None = None, of_model: Model | None = None
) -> tuple[Scene, Truth]:
    """Make the scene of a recipe and its truth; ``seed`` replaces that of the recipe, ``of_model`` its model's file.

    The result depends on the recipe and seed, not on time, host or number of threads. Raises UsageError that names the
    key for an unknown kind or key, a wrong type or an impossible size.
    """
    kind = recipe.get("kind")
    if kind not in MAKERS:
        raise UsageError(f"recipe {name}: kind: expected one of {', '.join(MAKERS)}, got {kind!r}")
    section, maker = MAKERS[kind]
    of_part = False
    if kind == "structure" and "model" in recipe:
        section, maker = "model", partial(model.make, model=of_model)
        of_part = isinstance(recipe["model"], Mapping) and bool(recipe["model"].get("part"))
    keys = {"about", "kind", "seed", "scan", "scanner", "surroundings", "processing", "asbuilt", section} | EXTRA.get(
        kind, set()
    )
    keys |= {"bridge"} if of_part else set()
    if unknown := sorted(set(recipe) - keys):
        raise UsageError(f"recipe {name}: unknown key {unknown[0]!r}; there are {', '.join(sorted(keys))}")
    used = recipe.get("seed", 0) if seed is None else seed
    if not isinstance(used, int) or isinstance(used, bool) or used < 0:
        raise UsageError(f"recipe {name}: seed: expected a whole number from 0, got {used!r}")
    # The number of BLAS threads changes the order of its sums, and with it the last bits.
    with threadpool_limits(1, user_api="blas"):
        scanning = scan_settings_of(recipe)
        made, truth = maker(name, recipe, scanning, used)
        made = replace(made, units="mm", units_reason=(reason("units.made-in-mm"),))
        truth = replace(truth, spacing_mm=scanning.spacing_mm, sigma_mm=scanning.sigma_mm)
        if "processing" not in recipe:
            return made, truth
        return processing.process(made, truth, filled(processing.Params, recipe, "processing"), used)
