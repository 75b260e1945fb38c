"""Exit codes of the commands."""

from __future__ import annotations

from collections.abc import Iterable

from processor.model import Verdict

DONE, IN_PART, BAD_INPUT, LIMIT_MISSED, VERDICT = 0, 1, 3, 4, 5
ENDED_BY_LIMIT = BAD_INPUT  # of time or memory
WITH_RESULTS = (DONE, IN_PART, LIMIT_MISSED, VERDICT)
FAIL_ON = {
    "fail": frozenset({Verdict.FAIL}),
    "indeterminate": frozenset({Verdict.FAIL, Verdict.INDETERMINATE}),
}


def is_refused(verdicts: Iterable[Verdict], fail_on: str | None) -> bool:
    """Return whether one of the verdicts is as bad as ``--fail-on`` names, or worse; never without that option."""
    return fail_on is not None and not FAIL_ON[fail_on].isdisjoint(verdicts)
