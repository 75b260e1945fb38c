"""The command ``processor papers``."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from processor.jobs import runner
from processor.jobs.child import Lost
from processor.language.messages import Text
from processor.model import UsageError
from processor.plain_text import printable
from processor.report import write_results
from processor.store.making import beside
from processor.store.whole_output import whole_folder
from tests.bench.papers import measuring, page
from tests.bench.papers.data_sets import DataSet, Found, Measured
from tests.bench.papers.measuring import PAPERS
from tests.bench.papers.rows import Row

FORMAT, FORMAT_VERSION = "processor-papers", "1.0"
MATRICES = ("T1", "T2")  # of paper 002
JSON, PAGE, STEPS = "papers.json", "papers.html", "steps"


@dataclass(frozen=True)
class Comparison:
    """What the command found."""

    line: Text
    rows: tuple[Row, ...]
    content: dict[str, Any]  # of papers.json
    failed: int  # data sets


def run(
    out: Path, only: Sequence[str], seeds: int, jobs: int, lang: str = "en", keep_steps: bool = False
) -> Comparison:
    """Measure the papers named, or all, and write papers.json and papers.html into the folder ``out``.

    With ``keep_steps`` its folder ``steps`` has what the stages of the papers' methods found in each data set.
    Raises UsageError for an unknown paper or a folder that holds anything but earlier results.
    """
    if unknown := [number for number in only if number not in PAPERS]:
        raise UsageError(f"--only: no paper {unknown[0]!r}; there are {', '.join(PAPERS)}")
    write_results.check_output(out, None, JSON, (JSON, PAGE, STEPS))
    papers = [number for number in PAPERS if not only or number in only]
    wanted = [one for number in papers for seed in range(seeds) for one in measuring.module_of(number).data_sets(seed)]
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    with beside(out.absolute().parent) as folder:
        scratch = str(folder)
        steps = Path(scratch, STEPS)
        measured = _measured(wanted, jobs, scratch, str(steps) if keep_steps else "")
        return _written(out, papers, measured, seeds, lang, steps)


def _written(
    out: Path, papers: Sequence[str], measured: Sequence[Measured], seeds: int, lang: str, steps: Path
) -> Comparison:
    """Make the rows and charts of papers of what was measured, and write them; ``steps`` is moved there if it is."""
    by_paper = {}
    for number in papers:
        module = measuring.module_of(number)
        own = [one for one in measured if one.data_set.paper == number]
        found = Found(own)
        by_paper[number] = (module.rows(found), module.charts(found), own)
    rows = tuple(row for of_paper, _, _ in by_paper.values() for row in of_paper)
    line = page.summary_line(rows, seeds)
    content = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "line": str(line),
        "seeds": seeds,
        "rows": [row.as_object() for row in rows],
        "data_sets": [_of_data_set(one) for one in measured],
    }
    with whole_folder(out, replaces=True) as making:
        (making / JSON).write_text(json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n", "utf-8")
        (making / PAGE).write_text(page.html(by_paper, line, lang), "utf-8")
        if steps.exists():
            shutil.move(steps, making / STEPS)
    return Comparison(line, rows, content, sum(bool(one.failed) for one in measured))


def _measured(wanted: Sequence[DataSet], jobs: int, scratch: str, steps: str) -> list[Measured]:
    """Measure data sets, ``jobs`` at a time, with a progress bar if standard error is a terminal."""
    do: Callable[..., Measured] = partial(measuring.make_and_measure, scratch=scratch, steps=steps)
    found = []
    with (
        runner.executor(None, jobs, lambda line: print(line, file=sys.stderr)) as executor,
        tqdm(total=len(wanted), unit="set", disable=not sys.stderr.isatty()) as bar,
        closing(executor.run(do, wanted)) as results,
    ):
        for data_set, result in results:
            one = Measured(data_set, failed=result.error) if isinstance(result, Lost) else result
            found.append(one)
            bar.update()
            if one.failed:
                with bar.external_write_mode(sys.stderr):
                    print(printable(f"{data_set.name} ({data_set.seed}): {one.failed}"), file=sys.stderr)
    return sorted(found, key=lambda one: wanted.index(one.data_set))


def _of_data_set(one: Measured) -> dict[str, Any]:
    return {
        "paper": one.data_set.paper,
        "name": one.data_set.name,
        "recipe": one.data_set.recipe,
        "settings": list(one.data_set.settings),
        "seed": one.data_set.seed,
        "seconds": round(one.seconds, 1),
        "failed": one.failed,
        "matrices": {name: one.series[name] for name in MATRICES if name in one.series},
    }
