"""Method ``paper``: to be filled."""

from __future__ import annotations

from typing import Any

from processor.defects.params import Params
from processor.defects.result import Result
from processor.model import Scene


def defects(scene: Scene, params: Params, earlier: dict[str, Any]) -> Result:
    """Find defects as in paper 004."""
    return Result("failed", params.method, "not there yet")
