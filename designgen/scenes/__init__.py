"""Scenes of the kinds of recipes, with their truth."""
