"""Small motions of rigid bodies as unknowns of an adjustment: x = (turn, rad; translation, mm; range offset, mm).

The turn is about a centre of the body, which each adjustment chooses; the offset of the ranges is left out where no
rays are known. Derivatives J are by these unknowns in this order, covariances are theirs.
"""

from __future__ import annotations

import numpy as np

from processor.geometry import rigid
from processor.model import Floats


def distance_derivative(arm: Floats, normals: Floats, rays: Floats | None = None) -> Floats:
    """Return the derivative J (n, 6) of distances along unit normals (n, 3) by the motion of a body.

    ``arm`` (n, 3), mm, are the points less the centre of the turn. With unit ``rays`` (n, 3) from the scanner, J (n, 7)
    is by the range offset as well: n . (w x arm + t + d ray).
    """
    J = np.hstack([np.cross(arm, normals), normals])
    return J if rays is None else np.hstack([J, np.einsum("ni,ni->n", rays, normals)[:, None]])


def transform_about(x: Floats, centre: Floats) -> Floats:
    """Return T (4, 4) of a motion x (6,): a turn about ``centre`` (3,), then a translation."""
    R = rigid.rotation_from_vector(x[:3])
    return rigid.transform(R, centre - R @ centre + x[3:6])


def variances(J: Floats, covariance: Floats) -> Floats:
    """Return the variances (n,) of n quantities with derivatives J (n, u) by unknowns of a covariance (u, u)."""
    propagated: Floats = np.maximum(np.einsum("ni,ij,nj->n", J, covariance, J), 0.0)
    return propagated


def point_covariances(arm: Floats, covariance: Floats) -> Floats:
    """Return the covariances (n, 3, 3) of points of a body by that (6, 6) of its motion; ``arm`` (n, 3) as above."""
    J = rigid.motion(arm)
    propagated: Floats = J @ covariance @ np.swapaxes(J, 1, 2)
    return propagated
