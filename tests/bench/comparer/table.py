"""The table of a comparison: a row for every run, what differs, and the exit code."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

from processor.store.json_values import json_ready
from tests.bench.comparer.differences import Comparison

SLOWER = 1.05  # of the sum of seconds
SHOWN = 12  # differences of a run that are printed; the file has all


def row(recipe: str, seed: str, found: Comparison, old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """Return a row of the table."""
    seconds = [float(one.get("seconds", math.nan)) for one in (old, new)]
    return {
        "recipe": recipe, "seed": seed, "equal": not found.differences,
        "worst": found.worst, "worst place": found.worst_place,
        "verdicts": [f"{one.place}: {one.text}" for one in found.differences if one.of_verdict],
        "differences": [dataclasses.asdict(one) for one in found.differences],
        "reference seconds": seconds[0], "seconds": seconds[1], "ratio": seconds[1] / seconds[0],
    }  # fmt: skip


def reported(rows: list[dict[str, Any]], facts: dict[str, Any], output: Path | None) -> int:
    """Print differences and the table, write the table; returns the exit code."""
    for row in rows:
        for one in row["differences"][:SHOWN]:
            print(f"{row['recipe']}/{row['seed']} {one['place']}: {one['text']}  (relative {one['relative']:.1e})")
        if len(row["differences"]) > SHOWN:
            print(f"{row['recipe']}/{row['seed']}: {len(row['differences']) - SHOWN} more differences")
    print(f"{'recipe':16s} seed  worst    differ  verdicts   s, then and now   ratio  worst at")
    for row in rows:
        verdicts = f"{len(row['verdicts'])} differ" if row["verdicts"] else "equal"
        print(
            f"{row['recipe']:16s} {row['seed']:5s} {row['worst']:.1e} {len(row['differences']):6d}  {verdicts:10s} "
            f"{row['reference seconds']:7.1f} {row['seconds']:7.1f} {row['ratio']:7.2f}  {row['worst place']}"
        )
    ratio = sum(row["seconds"] for row in rows) / sum(row["reference seconds"] for row in rows)
    equal = all(row["equal"] for row in rows)
    judged = "" if facts["time judged"] else " (a hint: other work counts; --time judges)"
    words = "equal" if equal else "DIFFERENT"
    print(f"reference {facts['reference']}: {words}; time {ratio:.3f} of the reference's{judged}")
    if output:
        output.parent.mkdir(parents=True, exist_ok=True)
        content = {**facts, "equal": equal, "ratio": ratio, "rows": rows}
        output.write_text(json.dumps(json_ready(content), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return 1 if not equal else 2 if facts["time judged"] and not ratio <= SLOWER else 0
