"""Cells run in child processes of this machine, or on the workers of a Dask cluster."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from processor.jobs import process, runner
from processor.jobs.causes import Cause
from processor.jobs.child import Lost
from processor.jobs.exit_codes import WITH_RESULTS
from processor.jobs.process import Ended
from processor.results.file_names import RESULTS_JSON
from processor.store.making import beside
from processor.validation.cells import Cell, Origin, Outcome
from processor.writers import toml

# Runs cells and yields each with its outcome as it comes; closing the generator stops those under way.
Runner = Callable[[Sequence[Cell]], Generator[tuple[Cell, Outcome], None, None]]

TIMEOUT_S = 3600.0  # chosen: an hour: a cell that takes longer hangs
TAIL = 500  # characters of an error message


class _FailedError(Exception):
    """A command of a cell failed."""


def do(
    cell: Cell,
    stopped: Callable[[], bool] = process.never,
    *,
    threads: int = 1,
    scratch: str | None = None,
    timeout_s: float = TIMEOUT_S,
) -> Outcome:
    """Make the scene of a cell and run it, in child processes; the scene is deleted afterwards."""
    started = time.monotonic()
    peak_mb = 0.0

    def command(*words: str) -> Ended:
        nonlocal peak_mb
        ended = process.run(
            (*process.GUARDED, "0", *words),
            env=process.environment(threads),
            timeout_s=timeout_s - (time.monotonic() - started),
            stopped=stopped,
        )
        peak_mb = max(peak_mb, ended.max_rss_mb)
        if ended.cause is Cause.TIME:
            raise _FailedError(f"took longer than {timeout_s:g} s")
        return ended

    with beside(None if scratch is None else Path(scratch)) as made:
        failed, results = "", {}
        try:
            results = _results(cell.spec(), made, command)
        except _FailedError as error:
            failed = str(error)
        return Outcome(failed, results, time.monotonic() - started, peak_mb)


def _results(spec: dict[str, Any], folder: Path, command: Callable[..., Ended]) -> dict[str, Any]:
    """Return results.json of a cell made in a folder. Raises _FailedError if a command fails."""
    scene, results = _scene(spec, folder, command), folder / "results"
    options = ["--steps", ",".join(spec["steps"]), "--methods-from", os.getcwd()]
    options += ["--method", ",".join(spec["methods"])] if spec["methods"] else []
    if spec["params"]:
        (folder / "params.toml").write_text(toml.document(spec["params"]), "utf-8")
        options += ["--params", str(folder / "params.toml")]
    ran = command("processor", "run", str(scene), "-o", str(results), *options)
    if ran.cause is not Cause.EXIT or ran.code not in WITH_RESULTS:
        raise _FailedError(_reason("processor run", ran))
    try:
        content: dict[str, Any] = json.loads((results / RESULTS_JSON).read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise _FailedError(f"processor run: ended with code {ran.code} and without results ({error})") from error
    return content


def _scene(spec: dict[str, Any], folder: Path, command: Callable[..., Ended]) -> Path:
    """Make the scene of a cell in a folder: a scene file, or by a foreign generator a scan folder."""
    recipe, foreign = spec["recipe"], spec["origin"] == Origin.FOREIGN  # foreign: the script that makes the scene
    if spec["recipe_text"]:
        recipe = folder / f"{recipe}.{'py' if foreign else 'toml'}"
        recipe.write_text(spec["recipe_text"], "utf-8")
    scene = folder / ("scene" if foreign else "scene.h5")
    maker = (str(recipe), str(scene)) if foreign else ("designgen", "make", str(recipe), "-o", str(scene))
    settings = (word for setting in spec["settings"] for word in ("--set", setting))
    made = command(*maker, "--seed", str(spec["seed"]), *settings)
    if made.cause is not Cause.EXIT or made.code != 0:
        raise _FailedError(_reason(spec["recipe"] if foreign else "designgen make", made))
    return scene


def _reason(program: str, ended: Ended) -> str:
    if ended.cause is Cause.STOPPED:
        return f"{program}: stopped"
    if ended.cause is Cause.MEMORY:
        return f"{program}: out of memory"
    how = f"signal {ended.code} (out of memory?)" if ended.cause is Cause.SIGNAL else f"exit code {ended.code}"
    return f"{program}: {how}: {ended.last_line[:TAIL]}" if ended.last_line else f"{program}: {how}"


@contextmanager
def cell_runner(cluster: str | None, jobs: int, scratch: Path, say: Callable[[str], None]) -> Iterator[Runner]:
    """Give what runs cells: ``jobs`` at a time in folders below ``scratch``, or on a cluster, which shares no folder.

    Raises UsageError if there is no cluster at the address ``cluster``; InputError if it is lost on the way.
    """
    threads = max(1, (os.cpu_count() or 1) // jobs)
    run_cell = do if cluster else partial(do, threads=threads, scratch=str(scratch.absolute()))
    with runner.executor(cluster, jobs, say) as executor:

        def run(cells: Sequence[Cell]) -> Generator[tuple[Cell, Outcome], None, None]:
            with closing(executor.run(run_cell, cells)) as results:
                for cell, result in results:
                    if isinstance(result, Lost):
                        result = Outcome(failed=f"a worker could not run it ({result.error or result.loss.value})")
                    yield cell, result

        yield run
