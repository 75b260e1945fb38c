"""Write the lists of docs/papers.md: ``python -m docs.scripts.make_papers OUT/papers.json``, of any files."""

from __future__ import annotations

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
        for row in rows:
            unit = f" {row['unit']}" if row["unit"] else ""
            worst = f" ({number(row['worst'])})" if seeds > 1 else ""
            cells = (
                row["place"], ", ".join(one for one in (row["data"], row["method"]) if one), row["quantity"],
                "" if row["published"] is None else number(row["published"]) + unit,
                "–" if row["median"] is None else number(row["median"]) + worst + unit,
                str(reasons.index(row["reason"]["text"]) + 1),
            )  # fmt: skip
            lines.append("| " + " | ".join(cells) + " |")
        lines += ["", *(f"{i}. {reason[:1].upper()}{reason[1:]}." for i, reason in enumerate(reasons, 1))]
    return lines


def number(value: float | None) -> str:
    """Write a number with three significant digits, a dash for none."""
    if value is None:
        return "–"
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


if __name__ == "__main__":
    main()
