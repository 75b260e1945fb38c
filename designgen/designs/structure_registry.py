"""The types of whole structures, by ``structure.type`` of a recipe."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import Any

from designgen.designs import defect_specimens, stadium_roof, truss_bridge
from designgen.designs.boxes_and_tubes import Component
from designgen.recipe_params import filled
from processor.model import UsageError

TYPES: dict[Any, ModuleType] = {
    "stadium-roof": stadium_roof,
    "truss-bridge": truss_bridge,
    "plate-row": defect_specimens,
}


def params(recipe: Mapping[str, Any]) -> Any:
    """Return the Params of the recipe's type of structure; UsageError for an unknown type or key."""
    section = recipe.get("structure", {})
    if not isinstance(section, Mapping):
        raise UsageError(f"structure: expected a section, got {section!r}")
    kind = section.get("type")
    if kind not in TYPES:
        raise UsageError(f"structure.type: expected one of {', '.join(TYPES)}, got {kind!r}")
    sizes = {key: value for key, value in section.items() if key != "type"}
    return filled(TYPES[kind].Params, {"structure": sizes}, "structure")


def design(recipe: Mapping[str, Any]) -> tuple[Component, ...]:
    """Return the components of a structure's recipe as designed; UsageError for an unknown type or key."""
    sizes = params(recipe)
    components: tuple[Component, ...] = TYPES[recipe["structure"]["type"]].build(sizes)
    return components
