"""Compiled Gauss-Newton fit of one sphere: centre and radius by robust residuals along the ray, with priors.

Each station may be shifted as a whole by an unknown vector of known covariance (from its registration). The shift is
estimated with the sphere and so enters the sphere's covariance. Coordinates are relative to the node, so that the
prior of the centre has mean 0.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from processor.geometry.linalg_small import inverse_of
from processor.inner_kernels import inner_ieee
from processor.model import Floats, Labels

LEAST_COSINE = 0.15
MISSED, VISIBLE, MASKED = 0, 1, 2  # what a ray meets
FULL_SD, CUT_SD = 3.0, 4.5  # residuals up to the first have weight 1, beyond the second weight 0


class Observations(NamedTuple):
    """Points of one sphere, sorted by station; see :class:`~processor.space_frame.spheres.records.CropsWithRays`."""

    points: Floats
    rays: Floats
    ranges: Floats
    station: Labels


class SphereMask(NamedTuple):
    """Mask of one sphere; see :class:`~processor.space_frame.spheres.records.Masks`."""

    axis_points: Floats
    axes: Floats
    keep_off: Floats
    hole: float
    least_cosine: float


class Prior(NamedTuple):
    """Inverse covariance (3, 3) of the centre about 0, and radius with its weight (1 / variance)."""

    centre_weight: Floats
    radius: float
    radius_weight: float


class Unknowns(NamedTuple):
    """State (x, y, z, r), shift (g, 3) of each station in turn, and the gains (g, 3, 8) that eliminate the shifts."""

    state: Floats
    shifts: Floats
    gains: Floats


class NormalEquations(NamedTuple):
    """Matrix H (4, 4) and gradient g (4,) of the state."""

    H: Floats
    g: Floats


# --- residuals and the choice of points ------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def residual(px, py, pz, ux, uy, uz, cx, cy, cz, r):  # type: ignore[no-untyped-def]
    """Residual of a point p to a sphere (c, r), the cosine of its incidence, and the residual's derivatives by c and r.

    Along the unit ray u from the scanner, positive where the point lies behind the surface that the ray meets first.
    All numbers are 0 where the ray misses the sphere. With u = 0 the ray is unknown: the distance from the centre less
    the radius, positive outside the sphere, with cosine 1.
    """
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
    """Weight of a residual of t sd: 1 up to FULL_SD, then a biweight that is 0 from CUT_SD."""
    t = abs(t)
    if t <= FULL_SD:
        return 1.0
    if t >= CUT_SD:
        return 0.0
    q = (t - FULL_SD) / (CUT_SD - FULL_SD)
    return (1.0 - q * q) ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def variance(noise, distance, cosine):  # type: ignore[no-untyped-def]
    """Variance of a range: constant, signal (R^2 / cosine) and footprint (tangent^2) parts, mm^2."""
    c2 = cosine * cosine
    return noise[0] + noise[1] * distance * distance / cosine + noise[2] * (1.0 - c2) / c2


@njit(cache=True, nogil=True, error_model="numpy")
def select(points, rays, mask, state, gate, surface):  # type: ignore[no-untyped-def]
    """Mark points in ``surface`` (n,) by where their rays meet the model, and count those on visible surface.

    VISIBLE: the ray meets the sphere's own visible surface. MASKED: it meets masked surface, that is flats and
    sleeves (``keep_off`` from each member's axis) or the process hole about the lowest point. MISSED: it misses the
    model or its incidence is below ``least_cosine``. The noisy point itself is not used. ``gate`` (mm) only saves work:
    it is far beyond the noise.
    """
    cx, cy, cz, r = state[0], state[1], state[2], state[3]
    total = 0
    for i in range(len(points)):
        surface[i] = MISSED
        e, cosine, jx, jy, jz, _ = residual(
            points[i, 0], points[i, 1], points[i, 2], rays[i, 0], rays[i, 1], rays[i, 2], cx, cy, cz, r
        )
        if cosine < mask.least_cosine or abs(e) > gate:
            continue
        if rays[i, 0] == 0.0 and rays[i, 1] == 0.0 and rays[i, 2] == 0.0:
            qx, qy, qz = -r * jx, -r * jy, -r * jz
        else:
            qx = points[i, 0] - e * rays[i, 0] - cx
            qy = points[i, 1] - e * rays[i, 1] - cy
            qz = points[i, 2] - e * rays[i, 2] - cz
        masked = qz < 0.0 and qx * qx + qy * qy < mask.hole * mask.hole
        for m in range(len(mask.axes)):
            if masked:
                break
            dx, dy, dz = mask.axes[m, 0], mask.axes[m, 1], mask.axes[m, 2]
            sx = qx + cx - mask.axis_points[m, 0]
            sy = qy + cy - mask.axis_points[m, 1]
            sz = qz + cz - mask.axis_points[m, 2]
            along = sx * dx + sy * dy + sz * dz
            across2 = sx * sx + sy * sy + sz * sz - along * along
            masked = along > 0.0 and across2 < mask.keep_off[m] * mask.keep_off[m]
        surface[i] = MASKED if masked else VISIBLE
        total += not masked
    return total


# --- normal equations and their solution -----------------------------------------------------------------------------


@inner_ieee
def _add_shifted(A, b, T, shift, normal, gain):  # type: ignore[no-untyped-def]
    """Add one station's information A (4, 4) and gradient b (4,), its unknown shift of covariance T eliminated.

    ``gain`` (3, 8) is filled so that the shift's own step is -(gain[:, :4] . step of the state + gain[:, 4]), and the
    shift's covariance given the state is gain[:, 5:].
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
            normal.H[i, j] += A[i, j]
            for k in range(3):
                normal.H[i, j] -= A[i, k] * gain[k, j]
        normal.g[i] += b[i]
        for k in range(3):
            normal.g[i] -= A[i, k] * gain[k, 4]
    return True


@inner_ieee
def _start_from(prior, state, normal):  # type: ignore[no-untyped-def]
    """Set the normal equations to those of the prior alone."""
    H, g = normal.H, normal.g
    for i in range(4):
        g[i] = 0.0
        for j in range(4):
            H[i, j] = 0.0
    for i in range(3):
        for j in range(3):
            H[i, j] = prior.centre_weight[i, j]
            g[i] += prior.centre_weight[i, j] * state[j]
    H[3, 3] = prior.radius_weight
    g[3] = prior.radius_weight * (state[3] - prior.radius)


@njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(observations, surface, model, stretch, whole, prior, unknowns, normal):  # type: ignore[no-untyped-def]
    """Fill the normal equations at the unknowns; returns the number of points of weight above 0.

    ``stretch`` widens the robust cut; ``whole`` gives all these points their full weight.
    """
    points, rays, ranges, station = observations
    state, shifts, gains = unknowns
    H, g = normal.H, normal.g
    _start_from(prior, state, normal)
    A, b, J = np.zeros((4, 4)), np.zeros(4), np.empty(4)
    n = len(points)
    used, segment, inside = 0, 0, 0
    for i in range(n):
        if surface[i] == VISIBLE:
            cx = state[0] + shifts[segment, 0]
            cy = state[1] + shifts[segment, 1]
            cz = state[2] + shifts[segment, 2]
            e, cosine, J[0], J[1], J[2], J[3] = residual(
                points[i, 0], points[i, 1], points[i, 2], rays[i, 0], rays[i, 1], rays[i, 2], cx, cy, cz, state[3]
            )
            if cosine > 0.02:
                v = variance(model.noise, ranges[i], max(cosine, 0.1))
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
            eliminated = False
            if inside > 0 and s >= 0 and s < len(model.shift_covariance) and model.shift_covariance[s, 0, 0] > 0.0:
                eliminated = _add_shifted(A, b, model.shift_covariance[s], shifts[segment], normal, gains[segment])
            if not eliminated:
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
def solve(observations, surface, model, stretch, prior, unknowns, tolerance, steps, covariance):  # type: ignore[no-untyped-def]
    """Move state and shifts by at most ``steps`` Gauss-Newton steps; returns the number of points used, or -1.

    Iteration stops after a step below ``tolerance`` mm. ``covariance`` (4, 4) is the inverse of the information at the
    last but one state. -1: the sphere is not determined.
    """
    state, shifts, gains = unknowns
    normal = NormalEquations(np.empty((4, 4)), np.empty(4))
    used = 0
    for _ in range(steps):
        # a variable for False: numba compiles a kernel anew for every literal
        used = normal_equations(observations, surface, model, stretch, steps < 0, prior, unknowns, normal)
        if not inverse_of(normal.H, covariance):
            return -1
        step = np.zeros(4)
        size = 0.0
        for i in range(4):
            for j in range(4):
                step[i] -= covariance[i, j] * normal.g[j]
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
        if size < tolerance:
            break
    return used
