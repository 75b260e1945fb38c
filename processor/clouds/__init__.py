"""Clouds out of a run's results and its input."""

CONTENTS = ("registered", "merged", "assembled", "clean", "deviation")
FORMATS = ("e57", "las", "laz", "ply", "xyz")
