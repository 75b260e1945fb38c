"""Statistics that several steps share: tests, variances, averages over hypotheses, and assumed errors of scanners."""
