"""Scenes written as scan folders."""

METRES = 0.001  # of a millimetre
FORMATS = ("ply", "las", "laz", "e57", "ptx", "pcd", "xyz")
