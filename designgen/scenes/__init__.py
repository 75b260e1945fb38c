"""Scenes of the kinds of recipes, with their truth."""

MADE_IN_MM = "made in millimetres"  # the reason for the unit of every scene
