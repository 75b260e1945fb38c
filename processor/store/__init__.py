"""Scenes, truths and results in HDF5 files: the public names of the package.

Functions of whole files are in :mod:`processor.store.store`, points of a file piece by piece in
:mod:`processor.store.streaming`. Each is loaded when it is first used: the process that looks at the structure of files
needs none of them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from processor.store.store import (
        copy_truth,
        damage,
        problems,
        read_provenance,
        read_results,
        read_scene,
        read_truth,
        scene_hash,
        write_results,
        write_scene,
        write_truth,
    )
    from processor.store.streaming import StoredPoints, points_of

__all__ = [
    "StoredPoints",
    "copy_truth",
    "damage",
    "points_of",
    "problems",
    "read_provenance",
    "read_results",
    "read_scene",
    "read_truth",
    "scene_hash",
    "write_results",
    "write_scene",
    "write_truth",
]

_STORE, _STREAMING = "processor.store.store", "processor.store.streaming"


def __getattr__(name: str) -> Any:
    """Load a function of the package at its first use."""
    if name not in __all__:
        raise AttributeError(f"module 'processor.store' has no attribute {name!r}")
    return getattr(importlib.import_module(_STREAMING if name in ("StoredPoints", "points_of") else _STORE), name)
