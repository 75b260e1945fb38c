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
        raise InputError(closed_formats.advice(suffix), path=path)
    if suffix not in _FORMATS:
        raise InputError(f"expected a scan file ({', '.join(SUFFIXES)}), found {suffix or 'no suffix'}", path=path)
    if not path.is_file():
        raise InputError("expected a file, found a folder" if path.is_dir() else "no such file", path=path)
    if not path.stat().st_size:
        raise InputError("the file is empty; copy or export it again", path=path)
    module = _FORMATS[suffix]
    try:
        if getattr(module, "needs_sandbox", lambda _: False)(path):
            return sandbox.read(path, module.__name__.rpartition(".")[2])
        # numpy warns of signalling NaNs in damaged files; coordinates that are not finite are refused later.
        with np.errstate(invalid="ignore", over="ignore"):
            scans: list[RawScan] = module.read(path)
        return scans
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", path=path) from error
    except MemoryError:
        raise InputError("needs more memory than is available; split the scan or thin it out", path=path) from None


def is_closed(path: Path) -> bool:
    """Whether a path has the suffix of a closed format, which only its maker's software reads."""
    return path.suffix.lower() in closed_formats.FORMATS
