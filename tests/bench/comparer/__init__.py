"""Results of today's code held against stored ones: ``python -m tests.bench.comparer``."""
