"""A folder of what the stages of steps found: clouds in PLY, and their numbers as a table.

Clouds of one stage in one frame are one file, whose column ``place`` numbers the places that ``clouds.csv`` names.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from processor.diagnostics import KeptCloud
from processor.model import Diagnostics
from processor.writers import ply
from processor.writers.cloud import Block, Cloud

CLOUDS, NUMBERS = "clouds.csv", "diagnostics.csv"
LONGEST = 80  # characters of a file's name


@dataclass(frozen=True)
class OfRun:
    """What the stages of one run of a step by a method found."""

    step: str
    method: str
    clouds: Sequence[KeptCloud]
    numbers: Diagnostics | None


def write(folder: Path, runs: Sequence[OfRun]) -> None:
    """Write clouds and numbers of runs into a new folder; coordinates are in mm, in the frame that clouds.csv names."""
    folder.mkdir(parents=True)
    listed = [["file", "place_number", "place", "points", "step", "method", "stage", "frame"]]
    numbers = [["step", "method", "stage", "place", "quantity", "value"]]
    used: set[str] = set()
    for run in runs:
        found: dict[tuple[str, str], list[KeptCloud]] = {}
        for cloud in run.clouds:
            found.setdefault((cloud.stage, cloud.frame), []).append(cloud)
        for (stage, frame), clouds in found.items():
            file = _name(f"{run.step}-{run.method}-{stage}-{frame}", used)
            comments = (f"{stage}, {run.step} ({run.method})", f"frame: {frame}; mm; place: see {CLOUDS}")
            ply.write(folder / file, _cloud(clouds, comments))
            rows = enumerate(clouds)
            listed += [
                [file, str(i), one.place, str(len(one.points)), run.step, run.method, stage, frame] for i, one in rows
            ]
        if (table := run.numbers) is not None:
            columns = zip(table.stage, table.place, table.quantity, table.value.tolist(), strict=True)
            numbers += [[run.step, run.method, *texts, f"{value:.9g}"] for *texts, value in columns]
    for name, rows_of in ((CLOUDS, listed), (NUMBERS, numbers)):
        text = io.StringIO(newline="")
        csv.writer(text, lineterminator="\n").writerows(rows_of)
        (folder / name).write_text(text.getvalue(), "utf-8")


def _name(text: str, used: set[str]) -> str:
    """Return a file name that is not used, of letters and digits that every system takes."""
    stem = re.sub(r"[^\w.]+", "-", text).strip("-.")[:LONGEST] or "cloud"
    name, number = f"{stem}.ply", 1
    while name.lower() in used:
        number += 1
        name = f"{stem}-{number}.ply"
    used.add(name.lower())
    return name


def _cloud(clouds: Sequence[KeptCloud], comments: tuple[str, ...]) -> Cloud:
    def blocks() -> Iterator[Block]:
        for number, cloud in enumerate(clouds):
            yield Block(cloud.points, {"place": np.full(len(cloud.points), number, np.int32)})

    plain = tuple(" ".join(text.split()) for text in comments)  # a name with a line break would end the comment
    points = sum(len(cloud.points) for cloud in clouds)
    return Cloud(plain[0], {"place": np.dtype(np.int32)}, blocks, count=points, comments=plain)
