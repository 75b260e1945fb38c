"""Meshes and CAD solids."""
