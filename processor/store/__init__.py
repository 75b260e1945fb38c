"""Scenes, truths and results in HDF5 files; points of a file piece by piece are in ``streaming``."""
