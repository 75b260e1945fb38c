"""Round tubes in a row, straight or along an arch: meshes as designed, scans as built, key points in closed form.

A tube has an outer radius and a wall; its axis lies in the bridge's X-Z plane. At arc length s from the middle of the
row the axis is at ``axis(s)``, left is +Y, and up is square to both. A point of the tube is s, its distance rho from
the axis and the angle turn from left towards up. Ends are cut by planes that depart from the design's by a shift and by
two tilts. Key points are on the outer edge: P1..P4 at 45 degrees down left, down right, up right, up left, P5..P8 down,
right, up, left.
"""

from dataclasses import dataclass, field

import numpy as np

from processor.model import ArchDesign, ArchTruth, DesignPart, Scan, Scene, Truth

TURNS = np.radians([-45.0, -135.0, 135.0, 45.0, -90.0, 180.0, 90.0, 0.0])  # of P1..P8
FACETS = 192  # around a tube: within 0.04 mm of the circle of 250 mm
COLLAR = (700.0, 850.0, 16.0)  # from the start of a tube, and its height
GUSSET = ((-500.0, -260.0), (-8.0, 8.0), 160.0)  # along the tube from its middle, across, and its height above


@dataclass(frozen=True)
class Sizes:
    """Of all tubes of a row, mm; ``bend`` is the radius of the arch, inf of a straight row; ``gusset``: on top.

    A ``collar`` round each tube tells its ends from each other, and nothing of its turn.
    """

    radius: float = 250.0
    wall: float = 16.0
    length: float = 3000.0
    gap: float = 3.0
    parts: int = 3
    bend: float = np.inf
    gusset: bool = False
    collar: bool = False

    @property
    def starts(self):
        """Arc length at which each tube starts."""
        pitch = self.length + self.gap
        return pitch * np.arange(self.parts) - 0.5 * (pitch * self.parts - self.gap)


@dataclass(frozen=True)
class AsBuilt:
    """Of one tube: shift of its start and end (2,) outward, tilts (2, 2) of them, growth of the radius."""

    shift: np.ndarray = field(default_factory=lambda: np.zeros(2))
    tilt: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
    wider: float = 0.0


def drawn(rng, shift=2.0, tilt=2e-3, wider=0.3):
    return AsBuilt(shift * rng.standard_normal(2), tilt * rng.standard_normal((2, 2)), wider * rng.standard_normal())


def space(sizes, s, rho, turn):
    """Points (n, 3) of a row of tubes in the bridge's frame."""
    s, rho, turn = np.broadcast_arrays(s, rho, turn)
    y, z = rho * np.cos(turn), rho * np.sin(turn)
    if np.isinf(sizes.bend):
        return np.stack([s, y, 1000.0 + z], axis=-1)
    angle = s / sizes.bend
    out = sizes.bend + z
    return np.stack([out * np.sin(angle), y, out * np.cos(angle) - sizes.bend + 3000.0], axis=-1)


def end_at(sizes, part, end, rho, turn, built):
    """Arc length of a tube's end, 0 = start, at rho and turn."""
    sense = 1.0 if end else -1.0
    edge = sizes.starts[part] + end * sizes.length
    lever = built.tilt[end, 0] * np.cos(turn) + built.tilt[end, 1] * np.sin(turn)
    return edge + sense * (built.shift[end] + rho * lever)


def key_points(sizes, part, end, built=None):
    built = built or AsBuilt()
    rho = sizes.radius + built.wider
    return space(sizes, end_at(sizes, part, end, rho, TURNS, built), rho, TURNS)


def mesh(sizes, part, rings=60):
    """Vertices and facets of a tube as designed, closed; with the gusset as a body of its own."""
    along = sizes.starts[part] + sizes.length * np.linspace(0.0, 1.0, rings + 1 if np.isfinite(sizes.bend) else 2)
    turn = 2.0 * np.pi * np.arange(FACETS) / FACETS
    grids = [space(sizes, along[:, None], rho, turn[None]) for rho in (sizes.radius, sizes.radius - sizes.wall)]
    vertices, faces, count = np.vstack([g.reshape(-1, 3) for g in grids]), [], len(along)
    k = np.arange(FACETS)
    after = (k + 1) % FACETS

    def quads(a, b, c, d):
        return [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]

    for r in range(count - 1):
        o, i = r * FACETS, (count + r) * FACETS
        faces += quads(o + k, o + FACETS + k, o + FACETS + after, o + after)
        faces += quads(i + k, i + after, i + FACETS + after, i + FACETS + k)
    o, i, last = 0, count * FACETS, (count - 1) * FACETS
    faces += quads(o + k, o + after, i + after, i + k)
    faces += quads(o + last + k, i + last + k, i + last + after, o + last + after)
    faces = np.vstack(faces)
    # Facets look outward.
    corners = vertices[faces]
    if np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0.0:
        faces = faces[:, ::-1]
    if sizes.gusset:
        at, plates = _gusset_box(sizes, part)
        faces = np.vstack([faces, plates + len(vertices)])
        vertices = np.vstack([vertices, at])
    if sizes.collar:
        low, high, height = COLLAR
        s = sizes.starts[part] + np.array([low, low, high, high])
        rho = sizes.radius + np.array([-2.0, height, height, -2.0])
        at = space(sizes, s[:, None], rho[:, None], turn[None]).reshape(-1, 3)
        rings = np.vstack([t for r in range(3) for t in quads(*(FACETS * (r + i) + j for i, j in _corners(k, after)))])
        faces, vertices = np.vstack([faces, rings[:, ::-1] + len(vertices)]), np.vstack([vertices, at])
    return vertices, faces


def _corners(k, after):
    """Rows and columns of the corners of the facets between two rings."""
    return (0, k), (1, k), (1, after), (0, after)


def _gusset_box(sizes, part):
    (s0, s1), (y0, y1), height = GUSSET
    middle = sizes.starts[part] + 0.5 * sizes.length
    corners = [
        space(sizes, middle + s, np.hypot(sizes.radius + h, y), np.arctan2(sizes.radius + h, y))
        for s in (s0, s1) for y in (y0, y1) for h in (-4.0, height)
    ]  # fmt: skip
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (1, 5, 7, 3), (0, 2, 6, 4)]
    return np.array(corners), np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def scanned(sizes, part, built, rng, spacing=12.0, sigma=1.0):
    """Points (n, 3) of a tube as built, in the bridge's frame: outer wall, inner wall near the ends, and end faces."""
    clouds = []
    area = spacing**2
    for rho, reach in ((sizes.radius + built.wider, None), (sizes.radius + built.wider - sizes.wall, 500.0)):
        spans = [(-20.0, sizes.length + 20.0)] if reach is None else [(-20.0, reach), (-reach, 20.0)]
        for k, (low, high) in enumerate(spans):
            n = rng.poisson((high - low) * 2.0 * np.pi * rho / area)
            s, turn = rng.uniform(low, high, n), rng.uniform(-np.pi, np.pi, n)
            s = s + sizes.starts[part] + (sizes.length if reach is not None and k == 1 else 0.0)
            ends = [end_at(sizes, part, end, rho, turn, built) for end in (0, 1)]
            kept = (s > ends[0]) & (s < ends[1])
            out = 1.0 if reach is None else -1.0
            clouds.append(space(sizes, s[kept], rho + out * sigma * rng.standard_normal(kept.sum()), turn[kept]))
    for end in (0, 1):
        outer, inner = sizes.radius + built.wider, sizes.radius + built.wider - sizes.wall
        n = rng.poisson(np.pi * (outer**2 - inner**2) / area)
        rho, turn = np.sqrt(rng.uniform(inner**2, outer**2, n)), rng.uniform(-np.pi, np.pi, n)
        s = end_at(sizes, part, end, rho, turn, built) + sigma * rng.standard_normal(n)
        clouds.append(space(sizes, s, rho, turn))
    if sizes.gusset:
        (s0, s1), across, height = GUSSET
        middle = sizes.starts[part] + 0.5 * sizes.length
        for y in across:
            n = rng.poisson((s1 - s0) * height / area)
            s, h = rng.uniform(s0, s1, n) + middle, rng.uniform(0.0, height, n) + sizes.radius
            off = y + sigma * rng.standard_normal(n)
            clouds.append(space(sizes, s, np.hypot(h, off), np.arctan2(h, off)))
    if sizes.collar:
        low, high, height = COLLAR
        n = rng.poisson((high - low) * 2.0 * np.pi * sizes.radius / area)
        s, rho = rng.uniform(low, high, n), sizes.radius + height + sigma * rng.standard_normal(n)
        clouds.append(space(sizes, sizes.starts[part] + s, rho, rng.uniform(-np.pi, np.pi, n)))
        for at in (low, high):
            n = rng.poisson(2.0 * np.pi * sizes.radius * height / area)
            rho = sizes.radius + rng.uniform(0.0, height, n)
            s = sizes.starts[part] + at + sigma * rng.standard_normal(n)
            clouds.append(space(sizes, s, rho, rng.uniform(-np.pi, np.pi, n)))
    return np.vstack(clouds)


def design(sizes, ends=key_points):
    """The design of a row of tubes, as of design.json."""
    parts = tuple(DesignPart(f"tube{k + 1}", *mesh(sizes, k)) for k in range(sizes.parts))
    names = tuple(part.name for part in parts)
    joints = range(sizes.parts - 1)
    return ArchDesign(
        parts,
        joint_names=tuple(f"J{j + 1}" for j in joints),
        joint_left=names[:-1],
        joint_right=names[1:],
        joint_points=np.array([0.5 * (ends(sizes, j, 1) + ends(sizes, j + 1, 0)) for j in joints]),
    )


def random_pose(rng):
    """T_scan_bridge (4, 4) of any attitude."""
    q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = q * np.linalg.det(q), rng.uniform(-2000.0, 2000.0, 3)
    return T


def scene(sizes, seed, built=None, spacing=12.0, sigma=1.0, changed=None):
    """A scene of tubes as built, each scanned in a frame of its own, and the truth."""
    rng = np.random.default_rng(seed)
    built = built or [drawn(rng) for _ in range(sizes.parts)]
    of = design(sizes)
    scans, poses, in_scan, in_bridge = [], [], [], []
    for k, part in enumerate(of.parts):
        T = random_pose(rng)
        points = scanned(sizes, k, built[k], rng, spacing, sigma)
        points = points if changed is None else changed(k, points)
        scans.append(Scan(part.name, points @ T[:3, :3].T + T[:3, 3], component=part.name, sigma_mm=sigma))
        true = np.full((2, 8, 3), np.nan)
        for end in (0, 1):
            if 0 <= k - 1 + end < sizes.parts - 1:
                true[end] = key_points(sizes, k, end, built[k])
        in_bridge.append(true)
        in_scan.append(true @ T[:3, :3].T + T[:3, 3])
        back = np.eye(4)
        back[:3, :3], back[:3, 3] = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
        poses.append(back)
    truth = ArchTruth(
        names=tuple(part.name for part in of.parts),
        T_bridge_scan=np.array(poses),
        key_points_scan=np.array(in_scan),
        key_points_bridge=np.array(in_bridge),
        edges_bridge=np.full((sizes.parts, 2, 2, 3), np.nan),
    )
    made = Scene("tubes", "arch-bridge", scans=tuple(scans), arch=of)
    return made, Truth(arch=truth, spacing_mm=spacing, sigma_mm=sigma)
