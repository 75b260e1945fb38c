"""Checks steel structures from laser scans, on machines without a screen.

The functions below are the Python interface. Lengths are in mm, angles in rad, points are arrays (n, 3) of float.
Each is loaded when it is first used, so ``import processor`` is quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from processor import library_settings
from processor.version import __version__

if TYPE_CHECKING:
    from processor.api.arrays import CorePoints, Pose, SphereFit, fit_sphere, m3c2, register
    from processor.api.conversion import Converted, convert
    from processor.api.runs import Results, check, export, read, run

library_settings.leave_current_folder_out()

__all__ = [
    "Converted",
    "CorePoints",
    "Pose",
    "Results",
    "SphereFit",
    "__version__",
    "check",
    "convert",
    "export",
    "fit_sphere",
    "m3c2",
    "read",
    "register",
    "run",
]
_RUNS = ("Results", "check", "export", "read", "run")
_ARRAYS = ("CorePoints", "Pose", "SphereFit", "fit_sphere", "m3c2", "register")
_HOMES = {
    **dict.fromkeys(_RUNS, "processor.api.runs"),
    **dict.fromkeys(_ARRAYS, "processor.api.arrays"),
    **dict.fromkeys(("Converted", "convert"), "processor.api.conversion"),
}


def __getattr__(name: str) -> Any:
    """Load a function of the interface at its first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'processor' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    """Name what the interface has, for completion."""
    return list(__all__)
