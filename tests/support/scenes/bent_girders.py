"""Straight box girders in a row, scanned as they lie on trestles, bent as finite elements say; NumPy alone.

Nothing of the processor but its records is used. A part has two plates of one thickness and two of another, open ends
and a pad that distinguishes its ends. Its scan's frame is levelled, z up. Lengths in mm, forces in N.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from processor.model import ArchDesign, DesignPart, PartSupports, Scan, Scene

E_MPA, WEIGHT, EXPANSION = 210_000.0, 7850e-9 * 9.80665, 12e-6
ELEMENTS = 60
SIDES = ("bottom", "right", "top", "left")


class Girder(NamedTuple):
    """A box of a length and a section: plates of bottom and top, and of the webs."""

    length: float = 16_000.0
    width: float = 900.0
    height: float = 1_000.0
    flange: float = 20.0
    web: float = 16.0

    @property
    def area(self):
        return 2.0 * (self.width * self.flange + (self.height - 2.0 * self.flange) * self.web)

    def inertia(self, level):
        """Second moments of area for bending up, or sideways."""
        b, h, f, w = self.width, self.height, self.flange, self.web
        if level:
            return (b * h**3 - (b - 2.0 * w) * (h - 2.0 * f) ** 3) / 12.0
        return (h * b**3 - (h - 2.0 * f) * (b - 2.0 * w) ** 3) / 12.0


def finite_elements(nodes, stiffness, load, curvature, supports):
    """Deflections and slopes at nodes (n,) of a beam on supports that push along the negative direction of a load.

    ``stiffness`` E I, ``load`` per length, and the ``curvature`` of the beam without restraint. Elements of Hermite's
    cubics. A support that would pull is left out. Returns them and the supports that carry.
    """
    n = len(nodes)
    K, f = np.zeros((2 * n, 2 * n)), np.zeros(2 * n)
    for e, size in enumerate(np.diff(nodes)):
        a, b, c = 6.0 * size, 4.0 * size**2, 2.0 * size**2
        of_bending = np.array([[12.0, a, -12.0, a], [a, b, -a, c], [-12.0, -a, 12.0, -a], [a, c, -a, b]])
        rows = slice(2 * e, 2 * e + 4)
        K[rows, rows] += stiffness / size**3 * of_bending
        f[rows] += load * size / 2.0 * np.array([1.0, size / 6.0, 1.0, -size / 6.0])
        f[rows] += stiffness * curvature * np.array([0.0, -1.0, 0.0, 1.0])
    carrying = list(supports)
    while True:
        held = [2 * int(np.argmin(np.abs(nodes - s))) for s in carrying]
        free = np.setdiff1d(np.arange(2 * n), held)
        u = np.zeros(2 * n)
        u[free] = np.linalg.solve(K[np.ix_(free, free)], f[free])
        pull = (K @ u - f)[held]
        if len(carrying) == 2 or (pull <= 0.0).all():
            return u[::2], u[1::2], carrying
        carrying.pop(int(np.argmax(pull)))


def key_points(girder, x):
    """P1..P8 at x."""
    b, h = 0.5 * girder.width, girder.height
    corners = np.array([[x, b, 0.0], [x, -b, 0.0], [x, -b, h], [x, b, h]])
    return np.vstack([corners, 0.5 * (corners + np.roll(corners, -1, axis=0))])


def _pad(girder, start):
    """Corner and size of a pad on the top plate."""
    return np.array([start + 0.3 * girder.length, 0.1 * girder.width, girder.height]), np.array([200.0, 150.0, 20.0])


def _plane(points, corner, u, v):
    p = points.reshape(-1, 2)
    return np.asarray(corner, float) + p[:, :1] * np.asarray(u, float) + p[:, 1:] * np.asarray(v, float)


def _faces(girder, start):
    """Faces that a scanner sees, as corner and two sides: outer faces, the inner ones near the ends, rings, the pad."""
    g, end = girder, start + girder.length
    b, found = 0.5 * g.width, []
    for inset_v, inset_h, low, high in ((0.0, 0.0, start, end), (g.flange, g.web, start, start + 600.0),
                                        (g.flange, g.web, end - 600.0, end)):  # fmt: skip
        wide, tall, along = 2.0 * (b - inset_h), g.height - 2.0 * inset_v, (high - low, 0.0, 0.0)
        found += [((low, -b + inset_h, z), along, (0.0, wide, 0.0)) for z in (inset_v, g.height - inset_v)]
        found += [((low, y, inset_v), along, (0.0, 0.0, tall)) for y in (-b + inset_h, b - inset_h)]
    for x in (start, end):
        found += [((x, -b, z), (0.0, 2.0 * b, 0.0), (0.0, 0.0, g.flange)) for z in (0.0, g.height - g.flange)]
        inner = g.height - 2.0 * g.flange
        found += [((x, y, g.flange), (0.0, g.web, 0.0), (0.0, 0.0, inner)) for y in (-b, b - g.web)]
    (x, y, z), (dx, dy, dz) = _pad(g, start)
    found.append(((x, y, z + dz), (dx, 0.0, 0.0), (0.0, dy, 0.0)))
    return found


def sampled(girder, start, spacing, rng):
    """Random points (n, 3) on a girder."""
    points = []
    for corner, u, v in _faces(girder, start):
        count = max(int(np.linalg.norm(u) * np.linalg.norm(v) / spacing**2), 20)
        points.append(_plane(rng.uniform(size=(count, 2)), corner, u, v))
    return np.vstack(points)


def mesh(girder, start, plates=True):
    """Vertices and outward triangles of a girder with its plates, or of its outer faces alone, and of the pad."""
    outer = np.array([[-0.5, 0.0], [0.5, 0.0], [0.5, 1.0], [-0.5, 1.0]]) * [girder.width, girder.height]
    inner = outer * [1.0 - 2.0 * girder.web / girder.width, 1.0 - 2.0 * girder.flange / girder.height]
    inner[:, 1] += girder.flange
    ends = (start, start + girder.length)
    vertices = [np.array([[x, *p] for p in ring]) for x in ends for ring in (outer, inner)]
    quads = []
    for k in range(4):
        j = (k + 1) % 4
        quads += [(k, j, 8 + j, 8 + k)]
        quads += (
            [(4 + k, 12 + k, 12 + j, 4 + j), (k, 4 + k, 4 + j, j), (8 + k, 8 + j, 12 + j, 12 + k)] if plates else []
        )
    corner, size = _pad(girder, start)
    box = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    vertices.append(corner + box * size)
    quads += [tuple(16 + i for i in q) for q in
              ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))]  # fmt: skip
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return np.vstack(vertices), np.array(triangles)


def design(girder, count=3, plates=True):
    """The design of girders end to end."""
    parts, b = [], 0.5 * girder.width
    for i in range(count):
        x = np.linspace(i * girder.length, (i + 1) * girder.length, 41)
        edges = [np.column_stack([x, np.full(41, y), np.zeros(41)]) for y in (b, -b)]
        parts.append(DesignPart(f"g{i + 1}", *mesh(girder, i * girder.length, plates), *edges))
    names = tuple(part.name for part in parts)
    joints = np.array([key_points(girder, (i + 1) * girder.length) for i in range(count - 1)])
    return ArchDesign(tuple(parts), tuple(f"J{i + 1}" for i in range(count - 1)), names[:-1], names[1:], joints)


class Lying(NamedTuple):
    """How a part is scanned: turned by quarters about its axis, supports along it, difference of temperature up and
    sideways of the scan's frame in K; of the supports those that carry, () for all."""

    quarters: int
    supports: tuple[float, ...]
    gradient: tuple[float, float]
    heading: float
    carrying: tuple[float, ...] = ()


def drawn(girder, rng, supports=2, gradient=10.0):
    """Draw how a part lies, on two or three trestles."""
    low, high = rng.uniform(0.0, 1.0 / 3.0, 2)
    places = np.linspace(low, 1.0 - high, supports) * girder.length
    size, angle = rng.uniform(0.0, gradient), rng.uniform(0.0, 2.0 * np.pi)
    uneven = (size * np.cos(angle), size * np.sin(angle))
    return Lying(int(rng.integers(4)), tuple(places), uneven, rng.uniform(0.0, 2.0 * np.pi))


def bent(girder, start, points, lying, weight=1.0):
    """Displace points (n, 3) of a part in the frame of the design by its weight and the difference of temperature."""
    nodes = np.union1d(np.linspace(0.0, girder.length, ELEMENTS + 1), lying.supports)
    Q = _quarters(lying.quarters)  # from the design to the scan, but for the heading
    up, side = Q[2], Q[1]  # of the scan, in the design
    local = points - np.array([start, 0.0, 0.5 * girder.height])
    moved = points.copy()
    for axis, load, uneven in (
        (-up, WEIGHT * girder.area * weight, -lying.gradient[0]),
        (side, 0.0, lying.gradient[1]),
    ):
        level = abs(axis[2]) > 0.5
        depth = girder.height if level else girder.width
        held = lying.carrying or lying.supports
        held = held if load else (held[0], held[-1])
        across, slope, _ = finite_elements(nodes, E_MPA * girder.inertia(level), load, EXPANSION * uneven / depth, held)
        # Of a part that lifts off an outer support: where it lies as a whole is no bend
        first, last = np.interp((lying.supports[0], lying.supports[-1]), nodes, across)
        tilt = (last - first) / (lying.supports[-1] - lying.supports[0])
        across, slope = across - first - tilt * (nodes - lying.supports[0]), slope - tilt
        moved += np.outer(np.interp(local[:, 0], nodes, across), axis)
        moved[:, 0] -= (local @ axis) * np.interp(local[:, 0], nodes, slope)
    return moved


def _quarters(k):
    c, s = np.round(np.cos(0.5 * np.pi * k)), np.round(np.sin(0.5 * np.pi * k))
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def scene(girder, every, seed, stated=True, spacing=20.0, sigma=1.0, plates=True, weight=1.0):
    """A scene of parts that lie as in ``every``, and the truth: T_bridge_scan and key points (2, 8, 3) in each scan.

    The truth is of the parts without bend, as they would lie on their supports.
    """
    rng = np.random.default_rng(seed)
    scans, poses, true, names, places = [], [], [], [], []
    for i, lying in enumerate(every):
        start = i * girder.length
        c, s = np.cos(lying.heading), np.sin(lying.heading)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ _quarters(lying.quarters)
        t = rng.uniform(-5000.0, 5000.0, 3) - R @ np.array([start, 0.0, 0.0])
        points = bent(girder, start, sampled(girder, start, spacing, rng), lying, weight)
        points += rng.normal(0.0, sigma, points.shape)
        scans.append(Scan(f"scan{i + 1}", points @ R.T + t, component=f"g{i + 1}"))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R.T, -R.T @ t
        poses.append(T)
        true.append([key_points(girder, x) @ R.T + t for x in (start, start + girder.length)])
        names += [f"g{i + 1}"] * len(lying.supports)
        places += [R @ np.array([start + x, 0.0, 0.0]) + t for x in lying.supports]
    supports = PartSupports(tuple(names), np.array(places), np.full(len(names), np.nan)) if stated else None
    arch = design(girder, len(every), plates)
    return Scene("girders", "arch-bridge", tuple(scans), arch=arch, part_supports=supports), poses, np.array(true)


def raw(girder, scan, T_bridge_scan, trestles, rng, lower=0.0, unseen=(0.0, 0.0)):
    """Add to a girder's scan the floor, and trestles along it of which the last one ends ``lower`` than its underside.

    Floor and underside are not seen between two places along it.
    """
    up = T_bridge_scan[:3, 2]
    axes = np.stack([[1.0, 0.0, 0.0], np.cross(up, [1.0, 0.0, 0.0]), up])
    part = (scan.points @ T_bridge_scan[:3, :3].T + T_bridge_scan[:3, 3]) @ axes.T
    corners = key_points(girder, 0.0) @ axes.T
    low, middle, half = corners[:, 2].min(), corners[:, 1].mean(), 0.5 * np.ptp(corners[:, 1])
    floor, start = low - 800.0, part[:, 0].min()
    size = np.array([girder.length, 2.0 * half]) + 2_000.0
    on_floor = rng.uniform(-1_000.0, size - 1_000.0, (int(size.prod() / 50.0**2), 2)) + np.array([start, middle - half])
    found = [np.column_stack([on_floor, np.full(len(on_floor), floor)]), part]
    found = [
        p[(np.abs(p[:, 0] - start - np.mean(unseen)) > 0.5 * np.ptp(unseen)) | (p[:, 2] > low + 20.0)] for p in found
    ]
    for k, at in enumerate(trestles):
        top = low - (lower if k == len(trestles) - 1 else 0.0)
        p = rng.uniform([-60.0, -1.1 * half, floor], [60.0, 1.1 * half, top], (4_000, 3))
        p[:, 0] = np.sign(p[:, 0]) * 60.0  # the two sides that are seen beneath the part
        found.append(p + np.array([start + at, middle, 0.0]))
    points = np.vstack(found) @ axes + rng.normal(0.0, 1.0, (sum(map(len, found)), 3))
    return dataclasses.replace(scan, points=(points - T_bridge_scan[:3, 3]) @ T_bridge_scan[:3, :3])
