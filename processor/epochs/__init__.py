"""Several runs of one structure over time: what changed beyond its interval."""
