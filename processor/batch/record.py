"""The record of a job: a small file with hashes of what the results depend on, and figures for the summary.

The record of a job with results lies in their folder, so that one renaming puts both in place. Records of failed jobs
lie together in a folder of the batch's state.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from processor.language.messages import messages
from processor.model import Reason, Word
from processor.store.whole_output import replace_text

FORMAT, FORMAT_VERSION = "processor-batch-job", "1.0"


class JobStatus(Word):
    """How a job ended."""

    DONE = "done"
    IN_PART = "in-part"
    LIMIT_MISSED = "limit-missed"
    FAILED = "failed"  # without results


@dataclass(frozen=True)
class Record:
    """How a job ended. ``identity`` is the hash of all that it depends on; ``reason`` that of a failure.

    A failure that is not the input's has no identity, so that the job is tried again.
    """

    input: str
    identity: str
    status: JobStatus
    reason: Reason | None = None
    input_sha256: str = ""
    results_sha256: str = ""
    figures: dict[str, Any] = field(default_factory=dict)
    steps: dict[str, str] = field(default_factory=dict)  # status by step
    limits: dict[str, float] = field(default_factory=dict)  # by name, of those that ended it
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
        code, values = stored.pop("reason_code"), stored.pop("reason_values")
        names = {each.name for each in fields(Record)}
        stored = {name: value for name, value in stored.items() if name in names}
        stored |= {"status": JobStatus(stored["status"]), "reason": Reason(code, values) if code else None}
        return Record(**stored)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def as_object(record: Record) -> dict[str, Any]:
    """Return a record as an object for JSON, its reason as text and as code with values."""
    stored = {each.name: getattr(record, each.name) for each in fields(Record)}
    reason = record.reason
    if reason is None:
        return stored | {"reason": "", "reason_code": "", "reason_values": {}}
    return stored | {
        "reason": messages("en").text(reason),
        "reason_code": reason.code,
        "reason_values": dict(reason.values),
    }


def write(path: Path, record: Record) -> None:
    """Write a record. Raises InputError if it cannot be written."""
    content = {"format": FORMAT, "format_version": FORMAT_VERSION, **as_object(record)}
    text = json.dumps(content, indent=1, allow_nan=False)
    replace_text(path, text + "\n")


def sha256_of(path: Path) -> str:
    """Return the SHA-256 (hex) of a small file; empty if it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""
