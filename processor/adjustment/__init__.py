"""Statistics of adjustment: tests, variance components, averages over models, and assumed errors of scanners."""
