"""One run in a process of its own, within limits of time and memory."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from processor.cli.common import print_error_line
from processor.jobs import process
from processor.jobs.causes import Cause, signal_name
from processor.jobs.exit_codes import BAD_INPUT, ENDED_BY_LIMIT, WITH_RESULTS
from processor.jobs.process import Ended
from processor.model import InputError
from processor.results.file_names import RESULTS_H5

MORE = "raise --timeout-s or --memory-mb, or run fewer --steps"


def limited_run(
    input_: Path, output: Path, timeout_s: float | None, memory_mb: int | None, arguments: Sequence[str]
) -> int:
    """Run ``processor run`` with its arguments and print what a limit ended; returns the exit code.

    Steps that were done are kept in the folder OUTPUT.part, which is removed when the run comes to its end.
    """
    from processor.store.making import remove_leftovers

    part = output.with_name(f"{output.name}.part")
    _remove(part)
    command = (*process.GUARDED, str(memory_mb or 0), "processor", "run", *arguments, "--so-far", str(part.absolute()))
    try:
        ended = process.run(
            (*command, "--methods-from", str(Path.cwd()), "-o", str(output.absolute()), "--", str(input_.absolute())),
            log=Path("/dev/stderr"),
            stdout=1,
            timeout_s=timeout_s or float("inf"),
            memory_mb=memory_mb or float("inf"),
        )
    finally:
        remove_leftovers(output.absolute().parent)
    why = _why(ended, timeout_s, memory_mb)
    if why:
        print_error_line(f"error: {input_}: {why}; {_what_is_done(part, input_)}")
        return ENDED_BY_LIMIT
    if ended.code in WITH_RESULTS:
        _remove(part)
    return BAD_INPUT if ended.cause is Cause.OUTPUT else ended.code


def _remove(part: Path) -> None:
    """Remove the folder of an earlier run; one that holds anything else stays, and is an error of its own later."""
    (part / RESULTS_H5).unlink(missing_ok=True)
    with suppress(OSError):
        part.rmdir()


def _why(ended: Ended, timeout_s: float | None, memory_mb: int | None) -> str:
    if ended.cause is Cause.TIME:
        return f"expected the run to end within {timeout_s:g} s (--timeout-s), it did not"
    if ended.cause is Cause.MEMORY:
        if memory_mb is None:
            return "the run took more memory than it was given"
        return f"expected the run to take at most {memory_mb} MB (--memory-mb), it took more"
    if ended.cause is Cause.SIGNAL:
        return f"the run was ended by {signal_name(ended.code)}"
    return ""


def _what_is_done(part: Path, input_: Path) -> str:
    """Return which steps were done before the end, and where they are."""
    nothing = f"ended before the first step; nothing is kept; {MORE}"
    if not (part / RESULTS_H5).is_file():
        return nothing
    from processor import pipeline  # with all steps, in two seconds

    try:
        runs, provenance = pipeline.read_runs(part / RESULTS_H5)
    except InputError:
        return nothing
    done = [f"{run.step} ({run.method})" for run in runs]
    planned = [str(name) for name in provenance.get("planned", ())]
    left = ", ".join(planned[len(done) :])
    if not done:
        _remove(part)
        return f"no step was done of {left}; {MORE}"
    return f"done: {', '.join(done)}; not done: {left}; see what is done by processor report {part} {input_}"
