"""Scenes written as scan folders."""

FORMATS = ("ply", "las", "laz", "e57", "ptx", "pcd", "xyz")
