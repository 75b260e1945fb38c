"""Stitching of scans: overlaps found by the structure itself, pairs, and the adjustment of the whole network."""
