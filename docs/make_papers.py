"""Write the tables of docs/papers.md from papers.json: ``python -m docs.make_papers OUT/papers.json``."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parent / "papers.md"
MARK = "<!-- below: written by docs/make_papers.py from papers.json -->"


def main() -> None:
    """Replace what stands below the mark."""
    content = json.loads(Path(sys.argv[1]).read_text("utf-8"))
    above = PAGE.read_text("utf-8").partition(MARK)[0]
    PAGE.write_text(above + MARK + "\n\n" + "\n".join(tables(content)) + "\n", "utf-8")


def tables(content: dict[str, Any]) -> list[str]:
    """Return the lines of the tables, and of the reasons below each, which their rows number."""
    seeds = content["seeds"]
    lines = [f"{content['line']}. Median and worst over {seeds} seeds." if seeds > 1 else f"{content['line']}."]
    for paper in dict.fromkeys(row["paper"] for row in content["rows"]):
        rows = [row for row in content["rows"] if row["paper"] == paper]
        reasons = list(dict.fromkeys(row["reason"]["text"] for row in rows))
        lines += ["", f"### Paper {paper}", ""]
        lines += ["| place | data set | method | figure | published | ours (worst) | reproduced | reason |"]
        lines += ["|---|---|---|---|---|---|---|---|"]
        for row in rows:
            unit = f" {row['unit']}" if row["unit"] else ""
            ours = f"{number(row['median'])} ({number(row['worst'])}){unit}"
            cells = (
                row["place"], row["data"], row["method"], row["quantity"], number(row["published"], "") + unit,
                ours if row["median"] is not None else "–", row["reproduced"] or "",
                str(reasons.index(row["reason"]["text"]) + 1),
            )  # fmt: skip
            lines.append("| " + " | ".join(cells) + " |")
        lines += ["", *(f"{i}. {reason[:1].upper()}{reason[1:]}." for i, reason in enumerate(reasons, 1))]
    return lines


def number(value: float | None, none: str = "–") -> str:
    """Write a number with three significant digits, or what stands for none."""
    if value is None:
        return none
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


if __name__ == "__main__":
    main()
