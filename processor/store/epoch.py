"""What identifies a run as one epoch of a structure: day, scanner, temperature and design; the results keep it."""

from __future__ import annotations

import math
from typing import Any

from processor.model import Scene
from processor.store import store

REPORT, FILES = "[report] scanned", "scan files"  # where the day is from


def facts(scene: Scene) -> dict[str, Any]:
    """Return what distinguishes runs of the same structure; what is not known is left out.

    ``scanned`` is the day as the project's title block has it, else the first day that the scan files state, and
    ``scanned_from`` says which. ``design`` is the hash of the design's geometry.
    """
    block = scene.title_block
    given = {} if block is None else dict(zip(block.keys, block.values, strict=True))
    found: dict[str, Any] = {name: given[name] for name in ("scanner", "serial") if name in given}
    if "scanned" in given:
        found |= {"scanned": given["scanned"], "scanned_from": REPORT}
    elif scene.scanned:
        found |= {"scanned": scene.scanned[0], "scanned_from": FILES}
    if math.isfinite(scene.temperature_C):
        found["temperature_C"] = scene.temperature_C
    if design := store.design_hash(scene):
        found["design"] = design
    return found | {"name": scene.name, "kind": scene.kind}
