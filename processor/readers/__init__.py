"""Readers of scan files: one module per format, chosen by the suffix of the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from processor.model import InputError
from processor.readers import closed_formats, e57, las, pcd, ply, ptx, sandbox, text
from processor.readers.raw_scan import RawScan

__all__ = ["ARCHIVES", "SUFFIXES", "RawScan", "is_closed", "read"]

_FORMATS = {suffix: module for module in (e57, las, pcd, ply, ptx, text) for suffix in module.SUFFIXES}

SUFFIXES = tuple(sorted(_FORMATS))
ARCHIVES = closed_formats.ARCHIVES


def read(path: Path) -> list[RawScan]:
    """Read the scans of a file, in the file's own unit.

    Raises InputError for a file that is missing, damaged, empty or of an unsupported format.
    """
    suffix = path.suffix.lower()
    if is_closed(path):
        raise InputError(f"{path}: {closed_formats.advice(suffix)}")
    if suffix not in _FORMATS:
        raise InputError(f"{path}: expected a scan file ({', '.join(SUFFIXES)}), found {suffix or 'no suffix'}")
    if not path.is_file():
        raise InputError(f"{path}: {'expected a file, found a folder' if path.is_dir() else 'no such file'}")
    if not path.stat().st_size:
        raise InputError(f"{path}: the file is empty; copy or export it again")
    module = _FORMATS[suffix]
    try:
        if getattr(module, "needs_sandbox", lambda _: False)(path):
            return sandbox.read(path, module.__name__.rpartition(".")[2])
        # numpy warns of signalling NaNs in damaged files; coordinates that are not finite are refused later.
        with np.errstate(invalid="ignore", over="ignore"):
            scans: list[RawScan] = module.read(path)
        return scans
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except MemoryError:
        raise InputError(f"{path}: needs more memory than is available; split the scan or thin it out") from None


def is_closed(path: Path) -> bool:
    """Whether a path has the suffix of a closed format, which only its maker's software reads."""
    return path.suffix.lower() in closed_formats.FORMATS
