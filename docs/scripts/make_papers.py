"""Write the lists of docs/papers.md: ``python -m docs.scripts.make_papers OUT/papers.json``, of any files."""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[1] / "papers.md"
MARK = "<!-- below: written by docs/scripts/make_papers.py from papers.json -->"


def main() -> None:
    """Replace what stands below the mark."""
    contents = [json.loads(Path(path).read_text("utf-8")) for path in sys.argv[1:]]
    lines = [line for content in contents for line in (*tables(content), "")]
    above = PAGE.read_text("utf-8").partition(MARK)[0]
    PAGE.write_text(above + MARK + "\n\n" + "\n".join(lines[:-1]) + "\n", "utf-8")


def tables(content: dict[str, Any]) -> list[str]:
    """Return the lines of what was not reproduced or not made, with the reasons; papers.html of the command has all."""
    seeds = content["seeds"]
    papers = list(dict.fromkeys(row["paper"] for row in content["rows"]))
    lines = [f"Papers {', '.join(papers)}: {content['line']}."]
    lines = [f"{lines[0]} Ours is the median (worst) over the seeds."] if seeds > 1 else lines
    for paper in papers:
        rows = [row for row in content["rows"] if row["paper"] == paper and row["reproduced"] in ("no", "not made")]
        reasons = list(dict.fromkeys(row["reason"]["text"] for row in rows))
        if not rows:
            continue
        lines += ["", f"### Paper {paper}", "", "| place | of | figure | published | ours | reason |"]
        lines += ["|---|---|---|---|---|---|"]
        groups = itertools.groupby(rows, lambda row: (row["place"], row["data"], row["method"], row["reason"]["text"]))
        for (place, data, method, reason), alike in groups:
            few = list(alike)
            cells = (
                place, ", ".join(one for one in (data, method) if one), "; ".join(row["quantity"] for row in few),
                "; ".join(published(row) for row in few), "; ".join(ours(row, seeds) for row in few),
                str(reasons.index(reason) + 1),
            )  # fmt: skip
            lines.append("| " + " | ".join(cells) + " |")
        lines += ["", *(f"{i}. {reason[:1].upper()}{reason[1:]}." for i, reason in enumerate(reasons, 1))]
    return lines


def published(row: dict[str, Any]) -> str:
    """Write the published value with its unit."""
    return "" if row["published"] is None else number(row["published"]) + unit_of(row)


def ours(row: dict[str, Any], seeds: int) -> str:
    """Write the median with its unit, and of several seeds the worst."""
    worst = f" ({number(row['worst'])})" if seeds > 1 else ""
    return "–" if row["median"] is None else number(row["median"]) + worst + unit_of(row)


def unit_of(row: dict[str, Any]) -> str:
    """Write a unit after its number."""
    return f" {row['unit']}" if row["unit"] else ""


def number(value: float | None) -> str:
    """Write a number with three significant digits, a dash for none."""
    if value is None:
        return "–"
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


if __name__ == "__main__":
    main()
