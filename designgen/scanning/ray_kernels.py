"""Compiled kernels of the ray caster: intersections of rays with shapes, in float64.

Every kernel works on one strip of columns on its own, so that results do not depend on the number of threads. Rays
start at the scanner's origin. Lengths are in mm, in the scanner's frame. The numbers ``n`` of a shape are those of
:class:`designgen.scanning.surfaces.Builder`; the position ``n[0:3]`` is a centre, a start or the first corner.
"""
# Numba infers the types of the arguments: the kernels have no annotations.

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from designgen.scanning.surfaces import CONE, DISC, SPHERE, TRIANGLE
from processor.model import Floats, Ints, Labels, Shorts

MISS = -1
SLACK = 1e-9  # relative, so that two triangles with a common edge leave no gap
# Offsets of a shape's numbers: of discs and cones the axis (unit vector), and of cones what follows.
AXIS, R_START, R_END, LENGTH, BOW, BOW_OFFSET, BOW_SPAN = 3, 6, 7, 8, 9, 12, 13
RADIUS = 3  # of a sphere
R_OUTER, R_INNER = 6, 7  # of a disc
FEW_ROWS = 12  # testing so many rays costs no more than finding those that may meet a triangle


class Shapes(NamedTuple):
    """The shapes of a scene in the scanner's frame, a row each; see :class:`designgen.scanning.surfaces.Surfaces`."""

    kind: npt.NDArray[np.int8]
    numbers: Floats
    cuts: Floats
    cut_start: Ints


class Pieces(NamedTuple):
    """Bounding spheres in the scanner's frame, mm; a long shape has several."""

    shape: Labels  # (k,)
    centre: Floats  # (k, 3)
    radius: Floats  # (k,)


class Strip(NamedTuple):
    """Adjacent columns of the grid, the columns cast beside them, and the windows of pieces that they meet."""

    windows: Labels  # (b, 5): piece, first and last column, first and last row
    first: int  # column
    width: int
    side: int  # columns cast on either side


class Rays(NamedTuple):
    """The rays of a strip."""

    jitter: Shorts  # (width + 2 side, rows, 2) rotation of each ray to the left and upward, rad
    largest_jitter: float  # bound of the rotations, rad
    min_range: float  # mm; a nearer shape hides the ones behind it
    max_range: float  # mm


class Beam(NamedTuple):
    """A beam whose radius at a range is ``exit_radius + half_divergence range``."""

    exit_radius: float  # mm
    half_divergence: float  # rad


@njit(cache=True, nogil=True)
def hit(kind, n, cuts, c0, c1, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return the least range at which the ray d from the origin meets a shape from either side; infinite if none."""
    if kind == SPHERE:
        d2 = dx * dx + dy * dy + dz * dz
        b = (n[0] * dx + n[1] * dy + n[2] * dz) / d2
        # About the foot of the perpendicular, to avoid a difference of large squares.
        fx, fy, fz = n[0] - b * dx, n[1] - b * dy, n[2] - b * dz
        inside = n[RADIUS] * n[RADIUS] - (fx * fx + fy * fy + fz * fz)
        if inside < 0.0:
            return np.inf
        root = np.sqrt(inside / d2)
        for sign in range(2):
            t = b - root if sign == 0 else b + root
            if t <= 0.0:
                continue
            ux, uy, uz = t * dx - n[0], t * dy - n[1], t * dz - n[2]
            cut_off = False
            for c in range(c0, c1):
                if cuts[c, 0] * ux + cuts[c, 1] * uy + cuts[c, 2] * uz > cuts[c, 3]:
                    cut_off = True
                    break
            if not cut_off:
                return t
        return np.inf
    if kind == CONE:
        return hit_cone(n, dx, dy, dz)
    if kind == DISC:
        slope = n[AXIS] * dx + n[AXIS + 1] * dy + n[AXIS + 2] * dz
        if slope == 0.0:
            return np.inf
        t = (n[AXIS] * n[0] + n[AXIS + 1] * n[1] + n[AXIS + 2] * n[2]) / slope
        ux, uy, uz = t * dx - n[0], t * dy - n[1], t * dz - n[2]
        r2 = ux * ux + uy * uy + uz * uz
        return t if t > 0.0 and n[R_INNER] * n[R_INNER] <= r2 <= n[R_OUTER] * n[R_OUTER] else np.inf
    e1x, e1y, e1z = n[3] - n[0], n[4] - n[1], n[5] - n[2]
    e2x, e2y, e2z = n[6] - n[0], n[7] - n[1], n[8] - n[2]
    px, py, pz = dy * e2z - dz * e2y, dz * e2x - dx * e2z, dx * e2y - dy * e2x
    det = e1x * px + e1y * py + e1z * pz
    if det == 0.0:
        return np.inf
    u = -(n[0] * px + n[1] * py + n[2] * pz) / det
    if u < -SLACK or u > 1.0 + SLACK:
        return np.inf
    qx, qy, qz = -(n[1] * e1z - n[2] * e1y), -(n[2] * e1x - n[0] * e1z), -(n[0] * e1y - n[1] * e1x)
    v = (dx * qx + dy * qy + dz * qz) / det
    if v < -SLACK or u + v > 1.0 + SLACK:
        return np.inf
    t = (e2x * qx + e2y * qy + e2z * qz) / det
    return t if t > 0.0 else np.inf


@njit(cache=True, nogil=True)
def cone_at(n, ux, uy, uz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return a bowed cone's equation at u, a position from its start, mm, and its derivative along d.

    The result is the height along the axis, the squared distance from it less the squared radius, and the derivative of
    this difference.
    """
    ax, ay, az = n[AXIS], n[AXIS + 1], n[AXIS + 2]
    bx, by, bz = n[BOW], n[BOW + 1], n[BOW + 2]
    z, rate = ux * ax + uy * ay + uz * az, dx * ax + dy * ay + dz * az
    q = (n[BOW_OFFSET] + z) / n[BOW_SPAN]
    move, change = 4.0 * q * (1.0 - q), 4.0 * (1.0 - 2.0 * q) * rate / n[BOW_SPAN]
    ux, uy, uz = ux - z * ax - move * bx, uy - z * ay - move * by, uz - z * az - move * bz
    vx, vy, vz = dx - rate * ax - change * bx, dy - rate * ay - change * by, dz - rate * az - change * bz
    taper = (n[R_END] - n[R_START]) / n[LENGTH]
    r = n[R_START] + taper * z
    return z, ux * ux + uy * uy + uz * uz - r * r, 2.0 * (ux * vx + uy * vy + uz * vz - r * taper * rate)


@njit(cache=True, nogil=True)
def hit_cone(n, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return the least range of a cone: solve for the straight cone displaced by the bow, then Newton on the bowed."""
    ax, ay, az = n[AXIS], n[AXIS + 1], n[AXIS + 2]
    bx, by, bz = n[BOW], n[BOW + 1], n[BOW + 2]
    r_start, length = n[R_START], n[LENGTH]
    rate = dx * ax + dy * ay + dz * az
    taper = (n[R_END] - r_start) / length
    bowed = bx != 0.0 or by != 0.0 or bz != 0.0
    ox, oy, oz = -n[0], -n[1], -n[2]
    z0 = ox * ax + oy * ay + oz * az
    # The quadratic equation is set up about the range nearest to the axis, where it has no large terms.
    wx, wy, wz = dx - rate * ax, dy - rate * ay, dz - rate * az
    px, py, pz = ox - z0 * ax, oy - z0 * ay, oz - z0 * az
    w2 = wx * wx + wy * wy + wz * wz
    near = -(px * wx + py * wy + pz * wz) / w2 if w2 > 1e-18 else 0.0
    if rate != 0.0:  # a ray nearly along the axis is nearest to it far away
        enter, leave = -z0 / rate, (length - z0) / rate
        near = min(max(near, min(enter, leave)), max(enter, leave))
    if bowed:
        q = (n[BOW_OFFSET] + min(max(z0 + near * rate, 0.0), length)) / n[BOW_SPAN]
        move = 4.0 * q * (1.0 - q)
        px, py, pz = px - move * bx, py - move * by, pz - move * bz
    fx, fy, fz = px + near * wx, py + near * wy, pz + near * wz
    r = r_start + taper * (z0 + near * rate)
    a = w2 - taper * taper * rate * rate
    b = fx * wx + fy * wy + fz * wz - r * taper * rate
    c = fx * fx + fy * fy + fz * fz - r * r
    inside = b * b - a * c
    if inside < 0.0:
        return np.inf
    # Both roots without cancellation; a is negative for a ray steeper than the cone, 0 along its side.
    large = -b - np.sqrt(inside) if b > 0.0 else -b + np.sqrt(inside)
    root = c / large if large != 0.0 else (0.0 if a != 0.0 else np.inf)
    other_root = large / a if a != 0.0 else np.inf
    for sign in range(2):
        t = near + (min(root, other_root) if sign == 0 else max(root, other_root))
        if not np.isfinite(t):
            continue
        z = z0 + t * rate
        if bowed:
            for _ in range(8):
                z, value, slope = cone_at(n, t * dx - n[0], t * dy - n[1], t * dz - n[2], dx, dy, dz)
                if slope == 0.0:
                    break
                step = value / slope
                t -= step
                if abs(step) < 1e-9 * abs(t):
                    break
            z, value, slope = cone_at(n, t * dx - n[0], t * dy - n[1], t * dz - n[2], dx, dy, dz)
            if abs(value) > 1e-5 * r_start:  # Newton did not converge for this grazing ray
                continue
        if t > 0.0 and 0.0 <= z <= length and r_start + taper * z > 0.0:
            return t
    return np.inf


@njit(cache=True, nogil=True)
def direction(ca, sa, level, rise, da, de):  # type: ignore[no-untyped-def]
    """Return the direction of a ray rotated by da to the left and de upward, both rad.

    ``ca``, ``sa``, ``level`` and ``rise`` are cosine and sine of azimuth and elevation. The result is of first order in
    the encoders' noise: a unit vector to 1e-10.
    """
    flat = level - de * rise
    return flat * ca - da * sa, flat * sa + da * ca, rise + de * level


@njit(cache=True, nogil=True)
def elevations(grid, rows):  # type: ignore[no-untyped-def]
    """Return cosine and sine (rows,) of the elevations of a grid's rows."""
    cosine, sine = np.empty(rows), np.empty(rows)
    for i in range(rows):
        cosine[i], sine[i] = np.cos(grid.lowest + grid.step * i), np.sin(grid.lowest + grid.step * i)
    return cosine, sine


@njit(cache=True, nogil=True)
def cast(shapes, pieces, strip, grid, rays, beam, beside):  # type: ignore[no-untyped-def]
    """Return shape and range of the nearest hit of each ray of a strip and beside it, (width + 2 side, rows) each.

    ``grid`` is a :class:`designgen.scanning.raycast.Grid`. Beside the strip only the next ``beside`` (rows,) columns
    are cast. No hit: -1 and infinite. The third result is the range at which the beam may touch a shape so thin that
    the grid's rays may all miss it; infinite where there is none. Hits nearer than the least range are among them.
    """
    windows, first, width, side = strip  # in local variables, as the inner loops are faster with them
    kind, numbers, cuts, cut_start = shapes
    owner, centres, radii = pieces
    jitter, largest_jitter, _, max_range = rays
    rows = jitter.shape[1]
    best = np.full((width + 2 * side, rows), np.inf)
    thin = np.full((width + 2 * side, rows), np.inf)
    shape = np.full((width + 2 * side, rows), MISS, np.int32)
    used = min(width, grid.columns - first)
    level, rise = elevations(grid, rows)
    for b in range(len(windows)):
        k = windows[b, 0]
        i, radius = owner[k], radii[k]
        cx, cy, cz, r2 = centres[k, 0], centres[k, 1], centres[k, 2], 1.000001 * radius * radius
        c2 = cx * cx + cy * cy + cz * cz
        # Thinner than 1.5 times the distance between rays of the grid there.
        slim = thickness(kind[i], numbers[i]) < 1.5 * grid.step * (np.sqrt(c2) + radius)
        wide = kind[i] == TRIANGLE and windows[b, 4] - windows[b, 3] >= FEW_ROWS
        if wide:
            planes = edge_planes(numbers[i])
        for column in range(max(windows[b, 1], first - side), min(windows[b, 2], first + used - 1 + side) + 1):
            j = column - first + side
            outside = max(first - column, column - first - used + 1)
            azimuth = 2.0 * np.pi * column / grid.columns
            ca, sa = np.cos(azimuth), np.sin(azimuth)
            low, high = windows[b, 3], windows[b, 4]
            if wide:
                low, high = rows_within(planes, ca, sa, largest_jitter, grid, low, high)
            for row in range(low, high + 1):
                if outside > beside[row]:
                    continue
                dx, dy, dz = direction(ca, sa, level[row], rise[row], jitter[j, row, 0], jitter[j, row, 1])
                along = dx * cx + dy * cy + dz * cz
                if along + radius < 0.0 or along - radius > best[j, row]:
                    continue
                if slim:
                    near = radius + beam.exit_radius + beam.half_divergence * along
                    if c2 - along * along <= near * near and along < thin[j, row]:
                        thin[j, row] = along
                if c2 - along * along > r2 + 1e-9 * c2:
                    continue
                t = hit(kind[i], numbers[i], cuts, cut_start[i], cut_start[i + 1], dx, dy, dz)
                if t <= max_range and (t < best[j, row] or (t == best[j, row] and i < shape[j, row])):
                    best[j, row], shape[j, row] = t, i
    return shape, best, thin


@njit(cache=True, nogil=True)
def edge_planes(n):  # type: ignore[no-untyped-def]
    """Return inward unit normals (3, 3) of the planes through the origin and a triangle's edges; 0 for one end on."""
    planes = np.zeros((3, 3))
    for k in range(3):
        a, b, c = 3 * k, 3 * ((k + 1) % 3), 3 * ((k + 2) % 3)
        x = n[a + 1] * n[b + 2] - n[a + 2] * n[b + 1]
        y = n[a + 2] * n[b] - n[a] * n[b + 2]
        z = n[a] * n[b + 1] - n[a + 1] * n[b]
        size = np.sqrt(x * x + y * y + z * z)
        if size > 0.0:
            if x * n[c] + y * n[c + 1] + z * n[c + 2] < 0.0:
                size = -size
            planes[k, 0], planes[k, 1], planes[k, 2] = x / size, y / size, z / size
    return planes


@njit(cache=True, nogil=True)
def rows_within(planes, ca, sa, slack, grid, low, high):  # type: ignore[no-untyped-def]
    """Return first and last of the rows ``low`` to ``high`` of a column that are at most ``slack`` beyond each plane.

    ``ca`` and ``sa`` are the cosine and sine of the column's azimuth. If there is none, the first is above the last.
    """
    lowest, step = grid.lowest, grid.step
    bottom, top = lowest + step * low, lowest + step * high
    for k in range(3):
        across, up = planes[k, 0] * ca + planes[k, 1] * sa, planes[k, 2]
        size = np.sqrt(across * across + up * up)
        if size <= slack:
            continue
        # The elevations e with across cos e + up sin e >= -slack form one interval.
        middle, half = np.arctan2(up, across), np.arccos(-slack / size)
        a, z = np.inf, -np.inf
        for wrap in range(-1, 2):
            first = max(bottom, middle - half + 2.0 * np.pi * wrap)
            last = min(top, middle + half + 2.0 * np.pi * wrap)
            if first <= last:
                a, z = min(a, first), max(z, last)
        if a > z:
            return 1, 0
        bottom, top = a, z
    return max(low, int(np.floor((bottom - lowest) / step))), min(high, int(np.ceil((top - lowest) / step)))


@njit(cache=True, nogil=True)
def hide(shape, best, least):  # type: ignore[no-untyped-def]
    """Turn hits below the ``least`` range, mm, into misses: a shape too near hides the shapes behind it."""
    for j in range(best.shape[0]):
        for k in range(best.shape[1]):
            if best[j, k] < least:
                best[j, k], shape[j, k] = np.inf, MISS


@njit(cache=True, nogil=True)
def thickness(kind, n):  # type: ignore[no-untyped-def]
    """Return the diameter of a ball or bar, which may fall between two rays; infinite for faces."""
    if kind == SPHERE:
        return 2.0 * n[RADIUS]
    return 2.0 * max(n[R_START], n[R_END]) if kind == CONE else np.inf


@njit(cache=True, nogil=True)
def cast_around(shapes, pieces, strip, grid, rays, number, angle, offsets):  # type: ignore[no-untyped-def]
    """Return shape and range (m, k) of sub-rays about m rays of a strip.

    ``number`` (width + 2 side, rows) is a ray's row in the result, -1 for none. The sub-rays' directions differ from
    the ray's by ``angle`` (m,) times ``offsets`` (k, 2).
    """
    windows, first, width, side = strip  # in local variables, as the inner loops are faster with them
    kind, numbers, cuts, cut_start = shapes
    owner, centres, radii = pieces
    jitter, largest_jitter, _, max_range = rays
    count, m = len(angle), len(offsets)
    best = np.full((count, m), np.inf)
    shape = np.full((count, m), MISS, np.int32)
    farthest = np.full(count, np.inf)  # range of each ray's sub-rays
    widest = np.sqrt((offsets[:, 0] ** 2 + offsets[:, 1] ** 2).max())
    broadest = widest * angle.max() if count else 0.0
    rows = number.shape[1]
    level, rise = elevations(grid, rows)
    for b in range(len(windows)):
        k = windows[b, 0]
        i = owner[k]
        cx, cy, cz, r = centres[k, 0], centres[k, 1], centres[k, 2], radii[k]
        c2 = cx * cx + cy * cy + cz * cz
        wide = kind[i] == TRIANGLE and windows[b, 4] - windows[b, 3] >= FEW_ROWS
        if wide:
            planes = edge_planes(numbers[i])
        for column in range(max(windows[b, 1], first), min(windows[b, 2], first + width - 1) + 1):
            j = column - first + side
            azimuth = 2.0 * np.pi * column / grid.columns
            ca, sa = np.cos(azimuth), np.sin(azimuth)
            low, high = windows[b, 3], windows[b, 4]
            if wide:
                low, high = rows_within(planes, ca, sa, largest_jitter + broadest, grid, low, high)
            for row in range(low, high + 1):
                ray = number[j, row]
                if ray < 0:
                    continue
                dx, dy, dz = direction(ca, sa, level[row], rise[row], jitter[j, row, 0], jitter[j, row, 1])
                along = dx * cx + dy * cy + dz * cz
                # The beam's edge may touch what its middle misses.
                near = r + widest * angle[ray] * abs(along) + 1e-6 * r
                if along + r < 0.0 or along - r > farthest[ray] or c2 - along * along > near * near + 1e-9 * c2:
                    continue
                changed = False
                for o in range(m):
                    da = jitter[j, row, 0] + angle[ray] * offsets[o, 0]
                    de = jitter[j, row, 1] + angle[ray] * offsets[o, 1]
                    dx, dy, dz = direction(ca, sa, level[row], rise[row], da, de)
                    t = hit(kind[i], numbers[i], cuts, cut_start[i], cut_start[i + 1], dx, dy, dz)
                    if t <= max_range and (t < best[ray, o] or (t == best[ray, o] and i < shape[ray, o])):
                        best[ray, o], shape[ray, o] = t, i
                        changed = True
                if changed:
                    farthest[ray] = best[ray].max()
    return shape, best


@njit(cache=True, nogil=True)
def covered(windows, first, width, side, used, rows, beside):  # type: ignore[no-untyped-def]
    """Return numbers (width + 2 side, rows) of the rays of a strip in windows (b, 5), -1 for others, and their count.

    Beside the strip only the next ``beside`` (rows,) columns count.
    """
    number = np.full((width + 2 * side, rows), -1, np.int32)
    for b in range(len(windows)):
        for column in range(max(windows[b, 1], first - side), min(windows[b, 2], first + used - 1 + side) + 1):
            number[column - first + side, windows[b, 3] : windows[b, 4] + 1] = 0
    count = 0
    for j in range(width + 2 * side):
        outside = max(side - j, j - side - used + 1)
        for row in range(rows):
            if number[j, row] == 0:
                number[j, row] = count if outside <= beside[row] else -1
                count += outside <= beside[row]
    return number, count


@njit(cache=True, nogil=True)
def directions(R, strip, grid, rays, number, angle, offsets):  # type: ignore[no-untyped-def]
    """Return the directions (m k, 3) of the sub-rays of :func:`cast_around`, rotated by R (3, 3)."""
    _, first, _, side = strip
    jitter, k = rays.jitter, len(offsets)
    result = np.empty((len(angle) * k, 3))
    level, rise = elevations(grid, number.shape[1])
    for j in range(number.shape[0]):
        azimuth = 2.0 * np.pi * (first + j - side) / grid.columns
        ca, sa = np.cos(azimuth), np.sin(azimuth)
        for row in range(number.shape[1]):
            ray = number[j, row]
            if ray < 0:
                continue
            for o in range(k):
                da = jitter[j, row, 0] + angle[ray] * offsets[o, 0]
                de = jitter[j, row, 1] + angle[ray] * offsets[o, 1]
                x, y, z = direction(ca, sa, level[row], rise[row], da, de)
                for i in range(3):
                    result[ray * k + o, i] = R[i, 0] * x + R[i, 1] * y + R[i, 2] * z
    return result


@njit(cache=True, nogil=True)
def meet(corners, owner, place, rays, facet, max_range, shape, best):  # type: ignore[no-untyped-def]
    """Replace shape and range (n,) where the ``facet`` (n,) that a ray (n, 3) from ``place`` meets is nearer.

    ``corners`` (f, 3, 3) belong to the shapes ``owner`` (f,).
    """
    n, cuts = np.empty(9), np.empty((0, 4))
    for r in range(len(facet)):
        f = facet[r]
        if f < 0:
            continue
        for i in range(9):
            n[i] = corners[f, i // 3, i % 3] - place[i % 3]
        dx, dy, dz = rays[r, 0], rays[r, 1], rays[r, 2]
        t = hit(TRIANGLE, n, cuts, 0, 0, dx, dy, dz)
        if t == np.inf:
            t = pass_by(n, dx, dy, dz)
        if t <= max_range and (t < best[r] or (t == best[r] and owner[f] < shape[r])):
            best[r], shape[r] = t, owner[f]


@njit(cache=True, nogil=True)
def pass_by(n, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return the range at which the ray of a unit vector d is nearest to the edges of a triangle n (9,).

    It misses the triangle by the resolution of float32; on the plane, a grazing ray would be far from the triangle.
    """
    least, at = np.inf, np.inf
    for k in range(3):
        a, b = 3 * k, 3 * ((k + 1) % 3)
        ex, ey, ez = n[b] - n[a], n[b + 1] - n[a + 1], n[b + 2] - n[a + 2]
        along, range_ = ex * dx + ey * dy + ez * dz, n[a] * dx + n[a + 1] * dy + n[a + 2] * dz
        across = ex * ex + ey * ey + ez * ez - along * along
        share = along * range_ - (n[a] * ex + n[a + 1] * ey + n[a + 2] * ez)
        share = min(max(share / across, 0.0), 1.0) if across > 0.0 else 0.0
        t = range_ + share * along
        x, y, z = n[a] + share * ex - t * dx, n[a + 1] + share * ey - t * dy, n[a + 2] + share * ez - t * dz
        if x * x + y * y + z * z < least:
            least, at = x * x + y * y + z * z, t
    return at


@njit(cache=True, nogil=True)
def normals(kind, numbers, shape, points):  # type: ignore[no-untyped-def]
    """Return unit normals (n, 3), of either sign, at points (n, 3) on shapes (n,)."""
    result = np.empty((len(shape), 3))
    for k in range(len(shape)):
        n = numbers[shape[k]]
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        shape_kind = kind[shape[k]]
        if shape_kind == SPHERE:
            nx, ny, nz = x - n[0], y - n[1], z - n[2]
        elif shape_kind == CONE:
            # The gradient of the bowed cone's equation.
            ux, uy, uz = x - n[0], y - n[1], z - n[2]
            nx = cone_at(n, ux, uy, uz, 1.0, 0.0, 0.0)[2]
            ny = cone_at(n, ux, uy, uz, 0.0, 1.0, 0.0)[2]
            nz = cone_at(n, ux, uy, uz, 0.0, 0.0, 1.0)[2]
        elif shape_kind == DISC:
            nx, ny, nz = n[AXIS], n[AXIS + 1], n[AXIS + 2]
        else:
            ax, ay, az = n[3] - n[0], n[4] - n[1], n[5] - n[2]
            bx, by, bz = n[6] - n[0], n[7] - n[1], n[8] - n[2]
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        size = np.sqrt(nx * nx + ny * ny + nz * nz)
        result[k, 0], result[k, 1], result[k, 2] = nx / size, ny / size, nz / size
    return result
