"""What is kept of a job: one small file, written whole or not at all.

Of a job with results it lies among them, so that both come to be there by one renaming; of one that failed, beside
those of the other jobs that did. It says what the results were made from, by hashes, and the figures for the summary.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from processor.model import InputError

FORMAT, FORMAT_VERSION = "processor-batch-job", "1.0"
RECORD, RESULTS = "job.json", "results.json"
WITH_RESULTS = ("done", "in-part", "limit-missed")
FAILED = "failed"


@dataclass(frozen=True)
class Record:
    """A job as it ended. ``status`` is done | in-part | limit-missed | failed; ``identity`` what it was made from."""

    input: str
    identity: str
    status: str
    reason: str = ""
    input_sha256: str = ""
    results_sha256: str = ""
    figures: dict[str, Any] = field(default_factory=dict)
    limits: dict[str, float] = field(default_factory=dict)  # that ended it, by name
    lasting: bool = True  # False: nothing of the input; it may go well the next time
    kept: bool = False  # from an earlier run of the batch
    seconds: float = 0.0
    peak_mb: float = 0.0


def identity(input_sha256: str, parameters: Mapping[str, Any], software: Mapping[str, str]) -> str:
    """SHA-256 (hex) of all that a result depends on."""
    made_from = {"input": input_sha256, "parameters": parameters, "software": software}
    return hashlib.sha256(json.dumps(made_from, sort_keys=True).encode()).hexdigest()


def read(path: Path) -> Record | None:
    """Read a record; None where there is none that can be read."""
    try:
        found = json.loads(path.read_text("utf-8"))
        if (found.pop("format"), found.pop("format_version")) != (FORMAT, FORMAT_VERSION):
            return None
        names = {one.name for one in fields(Record)}
        return Record(**{name: value for name, value in found.items() if name in names})
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def write(path: Path, record: Record) -> None:
    """Write a record. Raises InputError where that cannot be done."""
    text = json.dumps({"format": FORMAT, "format_version": FORMAT_VERSION, **asdict(record)}, indent=1, allow_nan=False)
    write_text(path, text + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a file that is there whole, or as it was before. Raises InputError where it cannot be written."""
    temporary = ""
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name[:100]}-", suffix=".tmp", dir=path.parent)
        with open(handle, "w", encoding="utf-8", newline="") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
        sync(path.parent)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        if temporary:
            with suppress(OSError):
                os.unlink(temporary)


def sync(folder: Path) -> None:
    """Wait until what a folder holds is known to the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sha256_of(path: Path) -> str:
    """SHA-256 (hex) of a small file; empty where it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""
