"""Compiled residuals of points on balls, and which points count for a ball.

A point p seen along the unit ray u, with w = c - p, a = u.w and root = sqrt(r^2 - |w|^2 + a^2), has the residual
"measured range minus the range at which the ray meets the sphere" e = root - a; the cosine of incidence on the model is
root / r. Nothing in it grows with the range. Where the scanner is unknown (u = 0) the residual is the distance from
the surface, outside positive, with cosine 1: noise along an unknown ray biases that one.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
from numba import njit

LEAST_COSINE = 0.15
WHOLE, NOTHING = 3.0, 4.5  # in sd: residuals up to the first count whole, beyond the second not at all


@njit(cache=True, nogil=True, error_model="numpy")
def residual(px, py, pz, ux, uy, uz, cx, cy, cz, r):  # type: ignore[no-untyped-def]
    """Residual, cosine of incidence on the model (0 = missed), and the residual's derivatives by centre and radius."""
    wx, wy, wz = cx - px, cy - py, cz - pz
    if ux == 0.0 and uy == 0.0 and uz == 0.0:
        d = np.sqrt(wx * wx + wy * wy + wz * wz)
        if d < 1e-9:
            return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        return d - r, 1.0, wx / d, wy / d, wz / d, -1.0
    a = ux * wx + uy * wy + uz * wz
    vx, vy, vz = wx - a * ux, wy - a * uy, wz - a * uz
    under = r * r - (vx * vx + vy * vy + vz * vz)
    if under <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    root = np.sqrt(under)
    return root - a, root / r, -ux - vx / root, -uy - vy / root, -uz - vz / root, r / root


@njit(cache=True, nogil=True, error_model="numpy")
def weight(t):  # type: ignore[no-untyped-def]
    """Weight of a residual of t sd: it redescends, and is all but fully efficient for normal noise."""
    t = abs(t)
    if t <= WHOLE:
        return 1.0
    if t >= NOTHING:
        return 0.0
    q = (t - WHOLE) / (NOTHING - WHOLE)
    return (1.0 - q * q) ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def variance(noise, distance, cosine):  # type: ignore[no-untyped-def]
    """Variance of a range: constant, signal (R^2 / cosine) and footprint (tangent^2) parts, mm^2."""
    c2 = cosine * cosine
    return noise[0] + noise[1] * distance * distance / cosine + noise[2] * (1.0 - c2) / c2


@njit(cache=True, nogil=True, error_model="numpy")
def select(  # type: ignore[no-untyped-def]
    points, rays, axis_points, axes, keep_off, hole, state, least_cosine, gate, chosen
):
    """Mark by 1 the points whose rays meet the model where the ball's own surface is to be seen; returns their number.

    By 2 those that are kept off, by 0 those that miss the model or come in too slantwise.

    The choice looks at where the ray meets the model and never at the noisy point: it keeps off the flats and sleeves
    (``keep_off`` from each member's axis), the process hole about the lowest point, and grazing incidence. ``gate``
    only spares work: it is far beyond the noise.
    """
    cx, cy, cz, r = state[0], state[1], state[2], state[3]
    total = 0
    for i in range(len(points)):
        chosen[i] = 0
        e, cosine, jx, jy, jz, _ = residual(
            points[i, 0], points[i, 1], points[i, 2], rays[i, 0], rays[i, 1], rays[i, 2], cx, cy, cz, r
        )
        if cosine < least_cosine or abs(e) > gate:
            continue
        if rays[i, 0] == 0.0 and rays[i, 1] == 0.0 and rays[i, 2] == 0.0:
            qx, qy, qz = -r * jx, -r * jy, -r * jz
        else:
            qx = points[i, 0] - e * rays[i, 0] - cx
            qy = points[i, 1] - e * rays[i, 1] - cy
            qz = points[i, 2] - e * rays[i, 2] - cz
        masked = qz < 0.0 and qx * qx + qy * qy < hole * hole
        for m in range(len(axes)):
            if masked:
                break
            dx, dy, dz = axes[m, 0], axes[m, 1], axes[m, 2]
            sx = qx + cx - axis_points[m, 0]
            sy = qy + cy - axis_points[m, 1]
            sz = qz + cz - axis_points[m, 2]
            along = sx * dx + sy * dy + sz * dz
            masked = along > 0.0 and sx * sx + sy * sy + sz * sz - along * along < keep_off[m] * keep_off[m]
        chosen[i] = 2 if masked else 1
        total += not masked
    return total
