"""Noise of a scan's points across the faces that they lie on, by incidence and range, estimated from the scatter.

The noise of a range makes a point scatter across its face by the cosine of the incidence; a footprint that the face
lengthens, and directions, make it scatter the more the more oblique the ray is. Both grow with the range, as the signal
fades and the beam widens. Near and far scans of a face would be weighted alike without it.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from processor.model import Floats
from processor.robust_statistics import huber
from processor.stitching.planes.scan_planes import Cloud

LEAST_DOF = 10.0  # of a piece
FEWEST_PIECES = 10  # chosen: of fewer the law's unknowns would follow single pieces
RANGE_MM = 1e4  # unit of ranges in the model
LEAST_SHARE = 0.05**2  # least variance across a face seen at grazing incidence, of that of the range
LEAST_MM2 = 1e-8  # (1e-4 mm)^2: of scans without noise
ROUNDS = 8  # of reweighting
PIECES_SD = 0.3  # of the variances of pieces of one incidence and range, relative: faces differ in brightness
HUBER = 1.5  # standard deviations: 96 % efficient at the normal law


def variances(cloud: Cloud) -> Floats:
    """Return the variance (m,), mm^2, of a point of each cell across its face."""
    dof = cloud.planes.count - 3.0
    keep = dof >= LEAST_DOF
    v = cloud.planes.variance[keep, 0] * cloud.planes.count[keep] / dof[keep]
    if len(v) < FEWEST_PIECES or not cloud.has_position:
        one = max(float(np.median(v)) if len(v) else cloud.sigma_mm**2, LEAST_MM2)
        return np.full(len(cloud.mean), one)
    terms = _terms(cloud.planes.mean[keep], cloud.planes.normal[keep])
    share = _fitted(terms, v, dof[keep])
    model: Floats = _terms(cloud.mean, cloud.normal) @ share
    return np.maximum(model, LEAST_MM2)


def _terms(points: Floats, normals: Floats) -> Floats:
    """Return the terms (n, 4) of the variance at points (n, 3), the scanner at the origin, on faces of such normals.

    Noise across the face and noise along the ray, each constant and growing with the range.
    """
    R = np.maximum(np.linalg.norm(points, axis=1), 1e-9)
    c2 = (np.einsum("ni,ni->n", points, normals) / R) ** 2 + LEAST_SHARE
    r2 = (R / RANGE_MM) ** 2
    return np.stack([np.ones(len(R)), r2, c2, c2 * r2], axis=1)


def _fitted(terms: Floats, v: Floats, dof: Floats) -> Floats:
    """Fit shares (4,), none negative, of the terms to variances v (n,) of pieces.

    Relative misfits are weighted by Huber's function, since pieces that are not quite planar scatter by more than the
    noise; the median then sets the size.
    """
    v = np.maximum(v, 1e-12)
    sd = np.sqrt(2.0 / dof + PIECES_SD**2)
    model: Floats = np.full(len(v), float(np.median(v)))
    weight = np.ones(len(v))
    share = np.zeros(terms.shape[1])
    for _ in range(ROUNDS):
        row = np.sqrt(weight) / (sd * model)
        share = nnls(terms * row[:, None], v * row)[0]
        model = np.maximum(terms @ share, 1e-3 * float(np.median(v)))
        weight = huber((v / model - 1.0) / sd, HUBER)
    sized: Floats = share * float(np.median(v / model))
    return sized
