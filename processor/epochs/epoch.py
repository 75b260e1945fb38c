"""The runs below a folder as epochs: found, read, and put into the order of their days."""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from processor import pipeline
from processor.model import InputError, Status, StepRun
from processor.results.file_names import RESULTS_H5

DAY = re.compile(r"(?<!\d)(\d{4})[-_.]?(\d{2})[-_.]?(\d{2})(?!\d)")
FOLDER = "name of the folder"


@dataclass(frozen=True, kw_only=True)
class Epoch:
    """One run: its folder below the root, its day and where that is from, its steps' results, and its facts."""

    folder: str
    day: datetime.date
    day_from: str
    runs: tuple[StepRun, ...]
    input: str
    input_sha256: str
    facts: Mapping[str, Any]

    def result(self, step: str) -> Any:
        """Return the result of a step; None where it was not run, or failed."""
        found = next((run.result for run in self.runs if run.step == step), None)
        return None if found is None or found.status is Status.FAILED else found


def read(root: Path) -> list[Epoch]:
    """Read every run below ``root``, in the order of their days; links are not followed.

    Raises InputError for fewer than two, for one without a day, for runs of one input, and of different kinds.
    """
    if not root.is_dir():
        raise InputError(f"{root}: expected a folder with folders of results, found no folder")
    below = [path.relative_to(root) for path in root.rglob(RESULTS_H5)]
    folders = sorted(root / path.parent for path in below if not any(part.startswith(".") for part in path.parts))
    if len(folders) < 2:
        raise InputError(
            f"{root}: expected two folders of results or more, of one structure, found {len(folders)}; "
            "put the folders that processor run writes below one folder"
        )
    epochs = sorted((_read(root, folder) for folder in folders), key=lambda one: (one.day, one.folder))
    _check_different(root, epochs)
    return epochs


def _read(root: Path, folder: Path) -> Epoch:
    runs, provenance = pipeline.read_runs(folder / RESULTS_H5)
    facts = provenance.get("epoch", {})
    facts = facts if isinstance(facts, dict) else {}
    name = folder.relative_to(root).as_posix()
    day, day_from = _day(root / name, name, facts)
    return Epoch(
        folder=name,
        day=day,
        day_from=day_from,
        runs=runs,
        input=str(provenance["input"]),
        input_sha256=str(provenance["input_sha256"]),
        facts=facts,
    )


def _day(folder: Path, name: str, facts: Mapping[str, Any]) -> tuple[datetime.date, str]:
    """Return the day of the scans, and where it is from: what the run states, else a date in the folder's name."""
    stated = str(facts.get("scanned", ""))
    for text, source in ((stated, str(facts.get("scanned_from", ""))), (name, FOLDER)):
        found = DAY.findall(text)
        for digits in reversed(found):  # the last that is a day: a number of eight digits may follow it
            with suppress(ValueError):
                return datetime.date(*map(int, digits)), source
        if text and source != FOLDER:
            raise InputError(
                f"{folder / RESULTS_H5}: expected a day such as 2026-11-20 as 'scanned' of [report], found {text!r}; "
                "correct project.toml and run processor report again"
            )
    raise InputError(
        f"{folder / RESULTS_H5}: has no day of the scans, neither by 'scanned' of [report] nor by the scan files, and "
        f"none is in the folder's name; state it and run processor report, or name the folder by the day"
    )


def _check_different(root: Path, epochs: Sequence[Epoch]) -> None:
    seen: dict[str, Epoch] = {}
    for epoch in epochs:
        other = seen.setdefault(epoch.input_sha256, epoch)
        if other is not epoch:
            raise InputError(
                f"{root}: {other.folder} and {epoch.folder} are runs of the same scans; take one of them out"
            )
        kinds = {str(one.facts["kind"]): one for one in (epochs[0], epoch) if "kind" in one.facts}
        if len(kinds) > 1:
            raise InputError(
                f"{root}: expected runs of one structure, found {' and '.join(kinds)} in "
                f"{' and '.join(one.folder for one in kinds.values())}; take the others out"
            )
