"""A small arch bridge made with numpy alone: circular soffit, box sections, five parts; for tests of the processor."""

from functools import cache

import numpy as np

from processor.model import ArchDesign, ArchTruth, DesignPart, Scan, Scene, Truth

RADIUS, HALF_ANGLE = 18_000.0, 0.75  # mm, rad: a span of 24.5 m
WIDTH, HEIGHT, PLATE = 900.0, 1100.0, 24.0
CUTS = (0.0, 0.19, 0.40, 0.60, 0.81, 1.0)
NAMES = ("foot1", "rib1", "rib2", "rib3", "foot2")
ARC = 2.0 * HALF_ANGLE * RADIUS


def position(s, u, v):
    """Points (n, 3) at arc length s, u to the left and v up from the soffit."""
    angle = np.asarray(s) / RADIUS - HALF_ANGLE
    out = RADIUS + np.asarray(v)
    x = RADIUS * np.sin(HALF_ANGLE) + out * np.sin(angle)
    z = out * np.cos(angle) - RADIUS * np.cos(HALF_ANGLE)
    return np.stack([x, np.broadcast_to(u, x.shape), z], axis=1)


def widening(s, part):
    """How much wider the feet get towards their base: 1 up to 0.4 of their length, 1.4 at the base."""
    t = {0: 1.0 - s / (CUTS[1] * ARC), 4: (s / ARC - CUTS[4]) / (1.0 - CUTS[4])}.get(part, 0.0 * s)
    return 1.0 + 0.4 * np.clip((t - 0.4) / 0.6, 0.0, 1.0)


def faces(part):
    """The faces of a part as (start, end, kind, function of two numbers in 0..1)."""
    start, end = CUTS[part] * ARC, CUTS[part + 1] * ARC

    def wall(side, inset, lo, hi):
        def point(p, q):
            s = lo + p * (hi - lo)
            w = widening(s, part)
            b, h = 0.5 * WIDTH * w - inset, HEIGHT * w
            if side in ("bottom", "top"):
                return position(s, (2.0 * q - 1.0) * b, inset if side == "bottom" else h - inset)
            return position(s, b if side == "left" else -b, inset + q * (h - 2.0 * inset))

        return point

    def ring(s, side):
        def point(p, q):
            s_ = np.full(p.shape, s)
            w = widening(s_, part)
            b, h = 0.5 * WIDTH * w, HEIGHT * w
            if side in ("bottom", "top"):
                return position(s_, (2.0 * q - 1.0) * b, PLATE * p if side == "bottom" else h - PLATE * p)
            return position(s_, (b - PLATE * p) * (1 if side == "left" else -1), PLATE + q * (h - 2.0 * PLATE))

        return point

    def base(s):
        def point(p, q):
            s_ = np.full(p.shape, s)
            w = widening(s_, part)
            return position(s_, (2.0 * q - 1.0) * 0.5 * WIDTH * w, p * HEIGHT * w)

        return point

    def pad(p, q):  # a mark on the top plate, off the centre
        at = start + 0.3 * (end - start)
        s = at + 200.0 * p
        return position(s, 100.0 + 200.0 * q, HEIGHT * widening(s, part) + 20.0)

    sides = ("bottom", "right", "top", "left")
    found = [(wall(side, 0.0, start, end), end - start, WIDTH) for side in sides]
    for s, opened, lo, hi in ((start, part != 0, start, start + 600.0), (end, part != 4, end - 600.0, end)):
        if opened:
            found += [(wall(side, PLATE, lo, hi), 600.0, WIDTH) for side in sides]
            found += [(ring(s, side), PLATE, WIDTH) for side in sides]
        else:
            found += [(base(s), HEIGHT * 1.4, WIDTH * 1.4)]
    return [*found, (pad, 200.0, 200.0)]


def mesh(part):
    """Vertices and triangles of all faces, 400 x 2 cells along and across each: within 2 microns of them."""
    vertices, triangles = [], []
    for point, _, _ in faces(part):
        p, q = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, 401), np.linspace(0, 1, 3), indexing="ij"))
        base = sum(len(v) for v in vertices)
        vertices.append(point(p, q))
        i = (np.arange(400)[:, None] * 3 + np.arange(2)).ravel() + base
        triangles += [np.stack([i, i + 3, i + 1], axis=1), np.stack([i + 1, i + 3, i + 4], axis=1)]
    return np.vstack(vertices), np.vstack(triangles)


def key_points(s):
    """P1..P8 of the joint at arc length s."""
    b, h = 0.5 * WIDTH, HEIGHT
    corners = position(np.full(4, s), np.array([b, -b, -b, b]), np.array([0.0, 0.0, h, h]))
    middles = [0.5 * (corners[i] + corners[j]) for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))]
    return np.vstack([corners, middles])


@cache
def design(count=5):
    """The design of the bridge's first parts; not to be changed."""
    parts = []
    for i, name in enumerate(NAMES[:count]):
        s = np.linspace(CUTS[i] * ARC, CUTS[i + 1] * ARC, 101)
        b = 0.5 * WIDTH * widening(s, i)
        vertices, triangles = mesh(i)
        parts.append(DesignPart(name, vertices, triangles, position(s, b, 0.0 * s), position(s, -b, 0.0 * s)))
    joints = np.array([key_points(c * ARC) for c in CUTS[1:count]])
    names = tuple(f"J{j}" for j in range(1, count))
    return ArchDesign(tuple(parts), names, NAMES[: count - 1], NAMES[1:count], joints)


def random_pose(rng):
    """A rigid T (4, 4): any proper rotation, up to some metres away."""
    Q, R = np.linalg.qr(rng.normal(size=(3, 3)))
    Q = Q @ np.diag(np.sign(np.diag(R)))
    T = np.eye(4)
    T[:3, :3] = Q * np.sign(np.linalg.det(Q))
    T[:3, 3] = rng.uniform(-5000.0, 5000.0, 3)
    return T


def scan_points(part, spacing_mm, sigma_mm, rng):
    """Points (n, 3) of a part in the bridge's frame, random on its faces."""
    clouds = []
    for point, length, width in faces(part):
        n = int(length * width / spacing_mm**2)
        clouds.append(point(rng.uniform(size=n), rng.uniform(size=n)))
    points = np.vstack(clouds)
    return points + sigma_mm * rng.normal(size=points.shape)


def bridge(spacing_mm=10.0, sigma_mm=1.0, seed=0, count=5):
    """A scene of the first parts in arbitrary poses, and its truth."""
    rng = np.random.default_rng(seed)
    scans, poses, key_scan, key_bridge, edges = [], [], [], [], []
    for i, name in enumerate(NAMES[:count]):
        T_scan_bridge = random_pose(rng)
        R, t = T_scan_bridge[:3, :3], T_scan_bridge[:3, 3]
        scans.append(Scan(name, scan_points(i, spacing_mm, sigma_mm, rng) @ R.T + t, component=name))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R.T, -R.T @ t
        ends = [key_points(CUTS[j] * ARC) if 0 < j < count else np.full((8, 3), np.nan) for j in (i, i + 1)]
        poses.append(T)
        key_bridge.append(ends)
        part = design(count).parts[i]
        edges.append([part.bottom_edge_left, part.bottom_edge_right])
        key_scan.append([end @ R.T + t for end in ends])
    scene = Scene("bridge", "arch-bridge", tuple(scans), arch=design(count))
    arch = ArchTruth(NAMES[:count], np.array(poses), np.array(key_scan), np.array(key_bridge), np.array(edges))
    return scene, Truth(arch=arch, spacing_mm=spacing_mm, sigma_mm=sigma_mm)
