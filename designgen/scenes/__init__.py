"""Scenes of the kinds of recipes, with their truth."""

from processor.model import reason

MADE_IN_MM = (reason("units.made-in-mm"),)  # why every scene is in mm
