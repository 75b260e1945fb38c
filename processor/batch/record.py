"""The record of a job: one small file with hashes of what the results were made from, and figures for the summary.

The record of a job with results lies among them, so that one renaming puts both in place. Records of failed jobs lie
together in a folder of the batch's state.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from processor.store.store import replacing

FORMAT, FORMAT_VERSION = "processor-batch-job", "1.0"
RECORD, RESULTS = "job.json", "results.json"
WITH_RESULTS = ("done", "in-part", "limit-missed")
FAILED = "failed"


@dataclass(frozen=True)
class Record:
    """How a job ended. ``status``: done | in-part | limit-missed | failed; ``identity``: hash of what it depends on."""

    input: str
    identity: str
    status: str
    reason: str = ""
    input_sha256: str = ""
    results_sha256: str = ""
    figures: dict[str, Any] = field(default_factory=dict)
    limits: dict[str, float] = field(default_factory=dict)  # by name, of those that ended it
    lasting: bool = True  # False: the failure is not the input's, and the job is tried again
    kept: bool = False  # from an earlier run of the batch
    seconds: float = 0.0
    peak_mb: float = 0.0


def identity(input_sha256: str, parameters: Mapping[str, Any], software: Mapping[str, str]) -> str:
    """Return the SHA-256 (hex) of all that a result depends on."""
    parts = {"input": input_sha256, "parameters": parameters, "software": software}
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def read(path: Path) -> Record | None:
    """Read a record; None if there is none that can be read."""
    try:
        stored = json.loads(path.read_text("utf-8"))
        if (stored.pop("format"), stored.pop("format_version")) != (FORMAT, FORMAT_VERSION):
            return None
        names = {each.name for each in fields(Record)}
        return Record(**{name: value for name, value in stored.items() if name in names})
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def write(path: Path, record: Record) -> None:
    """Write a record. Raises InputError if it cannot be written."""
    text = json.dumps({"format": FORMAT, "format_version": FORMAT_VERSION, **asdict(record)}, indent=1, allow_nan=False)
    write_text(path, text + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a file whole, or leave it as it was. Raises InputError if it cannot be written."""
    with replacing(path) as temporary:
        temporary.write_text(text, "utf-8", newline="")


def sha256_of(path: Path) -> str:
    """Return the SHA-256 (hex) of a small file; empty if it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""
