"""Exit codes of the commands."""

from __future__ import annotations

from collections.abc import Iterable

from processor.model import Verdict

DONE, IN_PART, WRONG_USAGE, BAD_INPUT, LIMIT_MISSED, VERDICT, GOT_WORSE = range(
    7
)  # scripts of users read them; 2 is also click's
ENDED_BY_LIMIT = BAD_INPUT  # of time or memory
WITH_RESULTS = (DONE, IN_PART, LIMIT_MISSED, VERDICT)
FAIL_ON = {
    "fail": frozenset({Verdict.FAIL}),
    "indeterminate": frozenset({Verdict.FAIL, Verdict.INDETERMINATE}),
}


def is_refused(verdicts: Iterable[Verdict], fail_on: str | None) -> bool:
    """Return whether any verdict is at least as severe as ``--fail-on``; False without that option."""
    return fail_on is not None and not FAIL_ON[fail_on].isdisjoint(verdicts)
