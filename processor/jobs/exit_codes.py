"""Exit codes of the commands."""

from __future__ import annotations

DONE, IN_PART, LIMIT_MISSED = 0, 1, 4
WITH_RESULTS = (DONE, IN_PART, LIMIT_MISSED)
