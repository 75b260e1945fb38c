"""Rows of results of surfaces, made by hand: core points and defects, what a test does not name being neutral."""

import numpy as np

from processor.defects.result import Defects
from processor.deviation.result import CorePoints


def core_points(points, normals, distance, lod95):
    """Core points of nine points each, without scatter; ``lod95`` is of each, or one for all."""
    n = len(points)
    return CorePoints(
        points=points, normals=normals, distance=distance, lod95=np.broadcast_to(np.float64(lod95), n),
        n1=np.full(n, 9), n2=np.full(n, 9), std1=np.zeros(n), std2=np.zeros(n),
    )  # fmt: skip


def defects(**columns):
    """Defects with the columns given, at least those of classes, components and depths."""
    k = len(columns["depth_max"])
    zero, one = np.zeros(k), np.ones(k)
    neutral = {
        "id": np.arange(1, k + 1), "confidence": one, "otherwise": ("pit",) * k, "centre": np.zeros((k, 3)),
        "area_mm2": np.full(k, 1e4), "depth_ci95": one, "depth_mean": zero, "volume_mm3": zero, "volume_ci95": one,
        "axes": np.tile(np.eye(3), (k, 1, 1)), "extent": np.full((k, 2), 10.0), "edge_distance": zero,
        "curvature_per_m": zero, "lod95": np.full(k, 0.1), "z": one, "chance": zero, "doubtful": np.zeros(k, bool),
        "reasons": ((),) * k,
    }  # fmt: skip
    return Defects(**neutral | columns)
