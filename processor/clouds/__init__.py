"""Clouds out of a run's results and its input."""
