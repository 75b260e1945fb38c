"""Scenes, truths and results in HDF5 files: the public names of the package.

Functions of whole files are in :mod:`processor.store.store`, points of a file piece by piece in
:mod:`processor.store.streaming`.
"""

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
