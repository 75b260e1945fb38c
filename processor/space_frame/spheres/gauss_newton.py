"""Compiled Gauss-Newton solution of one ball: centre and radius by robust residuals along the ray, with priors.

Each station may have moved as a whole by an unknown shift of known covariance (its registration): it is estimated with
the ball and so enters the ball's covariance.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from processor.geometry.linalg_small import inverse_of


@njit(cache=True, nogil=True, error_model="numpy")
def _add_station(A, b, T, shift, H, g, gain):  # type: ignore[no-untyped-def]
    """Add one station's information A (4, 4) and gradient b (4,) to the ball's, its unknown shift eliminated.

    ``gain`` (3, 8) is left so that the shift's own step is -(gain[:, :4] . step of the ball + gain[:, 4]), and that the
    shift's covariance, were the ball known, is gain[:, 5:].
    """
    W, S = np.empty((3, 3)), np.empty((3, 3))
    if not inverse_of(T, W):
        return False
    for i in range(3):
        for j in range(3):
            S[i, j] = A[i, j] + W[i, j]
    M = np.empty((3, 3))
    if not inverse_of(S, M):
        return False
    for i in range(3):
        for k in range(3):
            gain[i, 5 + k] = M[i, k]
    for i in range(3):
        for k in range(5):
            total = 0.0
            for j in range(3):
                total += M[i, j] * (
                    A[j, k] if k < 4 else b[j] + W[j, 0] * shift[0] + W[j, 1] * shift[1] + W[j, 2] * shift[2]
                )
            gain[i, k] = total
    for i in range(4):
        for j in range(4):
            H[i, j] += A[i, j]
            for k in range(3):
                H[i, j] -= A[i, k] * gain[k, j]
        g[i] += b[i]
        for k in range(3):
            g[i] -= A[i, k] * gain[k, 4]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(  # type: ignore[no-untyped-def]
    points, rays, ranges, station, chosen, noise, stretch, whole, centre, centre_weight, radius, radius_weight,
    shift_covariance, state, shifts, gains, H, g,
):  # fmt: skip
    """Fill H (4, 4) and gradient g (4,) at ``state``; returns the number of points of weight above 0.

    ``stretch`` widens the robust cut; ``whole`` gives all these points their full weight. Points are sorted by station.
    """
    for i in range(4):
        g[i] = 0.0
        for j in range(4):
            H[i, j] = 0.0
    for i in range(3):
        for j in range(3):
            H[i, j] = centre_weight[i, j]
            g[i] += centre_weight[i, j] * (state[j] - centre[j])
    H[3, 3] = radius_weight
    g[3] = radius_weight * (state[3] - radius)
    A, b, J = np.zeros((4, 4)), np.zeros(4), np.empty(4)
    n = len(points)
    used, segment, inside = 0, 0, 0
    for i in range(n):
        if chosen[i] == 1:
            cx = state[0] + shifts[segment, 0]
            cy = state[1] + shifts[segment, 1]
            cz = state[2] + shifts[segment, 2]
            e, cosine, J[0], J[1], J[2], J[3] = residual(
                points[i, 0], points[i, 1], points[i, 2], rays[i, 0], rays[i, 1], rays[i, 2], cx, cy, cz, state[3]
            )
            if cosine > 0.02:
                v = variance(noise, ranges[i], max(cosine, 0.1))
                w = weight(e / (stretch * np.sqrt(v)))
                if w > 0.0:
                    used += 1
                    inside += 1
                    w = (1.0 if whole else w) / v
                    for p in range(4):
                        b[p] += w * J[p] * e
                        for q in range(p + 1):
                            A[p, q] += w * J[p] * J[q]
        if i + 1 == n or station[i + 1] != station[i]:
            for p in range(4):
                for q in range(p):
                    A[q, p] = A[p, q]
            s = station[i]
            moved = False
            if inside > 0 and s >= 0 and s < len(shift_covariance) and shift_covariance[s, 0, 0] > 0.0:
                moved = _add_station(A, b, shift_covariance[s], shifts[segment], H, g, gains[segment])
            if not moved:
                for p in range(4):
                    g[p] += b[p]
                    for q in range(4):
                        H[p, q] += A[p, q]
                for p in range(3):
                    for q in range(8):
                        gains[segment, p, q] = 0.0
            for p in range(4):
                b[p] = 0.0
                for q in range(4):
                    A[p, q] = 0.0
            segment += 1
            inside = 0
    return used


@njit(cache=True, nogil=True, error_model="numpy")
def solve(  # type: ignore[no-untyped-def]
    points, rays, ranges, station, chosen, noise, stretch, centre, centre_weight, radius, radius_weight,
    shift_covariance, settled, state, shifts, gains, steps, covariance,
):  # fmt: skip
    """Move ``state`` (x, y, z, r) and ``shifts`` by at most ``steps`` Gauss-Newton steps; returns points used, or -1.

    A step below ``settled`` mm is the last. ``covariance`` (4, 4) is the inverse of the information at the last but one
    state. -1: nothing determines the ball.
    """
    H, g = np.empty((4, 4)), np.empty(4)
    used = 0
    for _ in range(steps):
        used = normal_equations(
            points, rays, ranges, station, chosen, noise, stretch, steps < 0, centre, centre_weight,
            radius, radius_weight,
            shift_covariance, state, shifts, gains, H, g,
        )  # fmt: skip
        if not inverse_of(H, covariance):
            return -1
        step = np.zeros(4)
        size = 0.0
        for i in range(4):
            for j in range(4):
                step[i] -= covariance[i, j] * g[j]
            size = max(size, abs(step[i]))
        scale = 1.0 if size <= 0.2 * state[3] else 0.2 * state[3] / size
        for i in range(4):
            state[i] += scale * step[i]
        if not (state[3] > 1.0 and state[3] < 2000.0):
            return -1
        for k in range(len(shifts)):
            for i in range(3):
                move = gains[k, i, 4]
                for j in range(4):
                    move += gains[k, i, j] * scale * step[j]
                shifts[k, i] -= move
        if size < settled:
            break
    return used


# --- Compiled residuals of points on balls, and which points count for a ball.


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
