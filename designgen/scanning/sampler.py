"""Points sampled from exact surfaces with isotropic noise, as papers do: no station, no occlusion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from designgen.designs import arch_part, bolt_ball, space_frame
from designgen.designs.arch_part import Face
from designgen.scanning.surfaces import Bools, Patch
from processor.model import SOURCES, Codes, Floats, Labels, UsageError

MODE = "surface"
OUTLIER = SOURCES.index("outlier")


@dataclass(frozen=True)
class Params:
    """How a scene is scanned (mm). ``spacing_mm`` d means one point in d^2 on average."""

    mode: str = MODE
    spacing_mm: float = 10.0
    sigma_mm: float = 1.0  # of each coordinate
    outlier_share: float = 0.0  # of all points, anywhere in the part's box and a tenth around it
    inner_depth_mm: float = 1000.0  # how far into an open end the inner faces are seen
    member_reach_mm: float = 0.0  # frames: members are sampled this far from each ball; 0 = all along

    def __post_init__(self) -> None:
        _expect(0.05 <= self.spacing_mm <= 1000.0, "spacing_mm", self.spacing_mm, "0.05 to 1000")
        _expect(0.0 <= self.sigma_mm <= 1000.0, "sigma_mm", self.sigma_mm, "0 to 1000")
        _expect(0.0 <= self.outlier_share < 1.0, "outlier_share", self.outlier_share, "0 to less than 1")
        _expect(self.inner_depth_mm > 0.0, "inner_depth_mm", self.inner_depth_mm, "a length above 0")
        _expect(self.member_reach_mm >= 0.0, "member_reach_mm", self.member_reach_mm, "0 or a length")


def _expect(fits: bool, key: str, came: object, expected: str) -> None:
    if not fits:
        raise UsageError(f"scan.{key}: expected {expected}, got {came!r}")


def spacing_mm(params: object) -> float:
    """Return the spacing of a sampled scene; NaN for another, which has it point by point."""
    return params.spacing_mm if isinstance(params, Params) else float("nan")


def sigma_mm(params: object) -> float:
    """Return the noise of a sampled scene; NaN for another, which has it point by point."""
    return params.sigma_mm if isinstance(params, Params) else float("nan")


@dataclass(frozen=True)
class Cloud:
    """Points (n, 3), the part each belongs to (-1 = none) and its source (a row of SOURCES)."""

    points: Floats
    part: Labels
    source: Codes


def scan_part(part: arch_part.ArchPart, number: int, params: Params, rng: np.random.Generator) -> Cloud:
    """Scan one arch part in the bridge's frame; its points are labelled with its number."""
    faces = arch_part.faces(part, params.inner_depth_mm)
    points = np.vstack([_on_face(face, params.spacing_mm, rng) for face in faces])
    return _with_errors(points, np.full(len(points), number), params, rng)


def scan_frame(frame: space_frame.Frame, params: Params, rng: np.random.Generator) -> Cloud:
    """Scan a whole frame; points of a ball are labelled with its node, those of members with -1."""
    clouds, labels = [], []
    for node, centre in enumerate(frame.centres):
        ball = frame.ball(node)
        count = rng.poisson(4.0 * np.pi * ball.radius_mm**2 / params.spacing_mm**2)
        unit = _unit_vectors(count, rng)
        unit = unit[bolt_ball.exposed(ball, unit)]
        clouds.append(centre + ball.radius_mm * unit)
        labels.append(np.full(len(unit), node))
    for member in range(len(frame.members)):
        members = _member(frame, member, params, rng)
        clouds.append(members)
        labels.append(np.full(len(members), -1))
    return _with_errors(np.vstack(clouds), np.concatenate(labels), params, rng)


def scan_patches(
    patches: Sequence[tuple[int, Patch]],
    params: Params,
    rng: np.random.Generator,
    hidden: Callable[[int, Floats, Floats], Bools] | None = None,
) -> Cloud:
    """Scan faces with their parts' numbers: uniform by the area of their nets, on the faces themselves.

    ``hidden`` says of a face's row and numbers p, q (n,) on it which places another body covers: they are left out.
    """
    clouds, labels = [], []
    for row, (part, patch) in enumerate(patches):
        knots, triangles = patch.net()
        a, b, c = (patch.at(knots[:, 0], knots[:, 1])[triangles[:, i]] for i in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        if not area.sum() > 0.0:  # all of it is missing
            continue
        count = rng.poisson(area.sum() / params.spacing_mm**2)
        chosen = triangles[rng.choice(len(area), count, p=area / area.sum())]
        u, v = rng.random(count), rng.random(count)
        over = u + v > 1.0
        u, v = np.where(over, 1.0 - u, u), np.where(over, 1.0 - v, v)
        pq = knots[chosen[:, 0]] + u[:, None] * (knots[chosen[:, 1]] - knots[chosen[:, 0]])
        pq += v[:, None] * (knots[chosen[:, 2]] - knots[chosen[:, 0]])
        if hidden is not None:
            pq = pq[~hidden(row, pq[:, 0], pq[:, 1])]
        clouds.append(patch.at(pq[:, 0], pq[:, 1]))
        labels.append(np.full(len(pq), part))
    return _with_errors(np.vstack(clouds), np.concatenate(labels), params, rng)


def _on_face(face: Face, spacing_mm: float, rng: np.random.Generator) -> Floats:
    """Points (n, 3) on a face, uniform by area: proposals in (p, q), kept in proportion to the area element."""
    p, q = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, 201), np.linspace(0, 1, 5), indexing="ij"))
    highest = 1.001 * float(face.element(p, q).max())
    count = rng.poisson(highest / spacing_mm**2)
    p, q = rng.uniform(size=count), rng.uniform(size=count)
    kept = (rng.uniform(size=count) * highest < face.element(p, q)) & face.kept(p, q)
    return face.at(p[kept], q[kept])


def _unit_vectors(count: int, rng: np.random.Generator) -> Floats:
    z = rng.uniform(-1.0, 1.0, count)
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    rho = np.sqrt(1.0 - z * z)
    return np.stack([rho * np.cos(angle), rho * np.sin(angle), z], axis=1)


def _member(frame: space_frame.Frame, member: int, params: Params, rng: np.random.Generator) -> Floats:
    """Sleeves, cones and tube of a member, as surfaces of revolution (the sleeve hexagonal) about its axis."""
    joined, (a, b) = frame.connection, frame.ends(member)
    length = float(np.linalg.norm(b - a))
    unit = (b - a) / length
    side = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit))])
    side /= np.linalg.norm(side)
    basis = np.stack([side, np.cross(unit, side), unit])
    reach = params.member_reach_mm or length
    tube = 0.5 * joined.tube_diameter
    ends = [
        frame.ball(int(node)).flat_distance + joined.sleeve_length + joined.cone_length
        for node in frame.members[member]
    ]

    def bowed(cloud: Floats) -> Floats:
        q = (cloud[:, 2] - ends[0]) / (length - sum(ends))
        moved: Floats = cloud @ basis + np.outer(4.0 * q * (1.0 - q), frame.bow(member))
        return moved

    found = []
    for end, (origin, sign) in enumerate(((a, 1.0), (b, -1.0))):
        tip = ends[end] - joined.cone_length
        axial = basis * np.array([[1.0], [1.0], [sign]])
        near = [_cone(joined.sleeve_corner_radius + 3.0, tube, tip, ends[end], params.spacing_mm, rng)]
        if frame.has_sleeve(member, end):
            near.append(_prism(joined.sleeve_corner_radius, tip - joined.sleeve_length, tip, params.spacing_mm, rng))
        found += [origin + cloud @ axial for cloud in near]
        if ends[end] < reach < 0.5 * length:
            low, high = (ends[0], reach) if end == 0 else (length - reach, length - ends[1])
            found.append(a + bowed(_cone(tube, tube, low, high, params.spacing_mm, rng)))
    if reach >= 0.5 * length:
        found.append(a + bowed(_cone(tube, tube, ends[0], length - ends[1], params.spacing_mm, rng)))
    return np.vstack(found)


def _cone(r0: float, r1: float, z0: float, z1: float, spacing_mm: float, rng: np.random.Generator) -> Floats:
    """Points on a cone or cylinder about z, uniform by area."""
    slant = np.hypot(z1 - z0, r1 - r0)
    count = rng.poisson(np.pi * (r0 + r1) * slant / spacing_mm**2)
    t = rng.uniform(size=count)
    if r0 != r1:  # the share of the area up to t is that of r^2
        t = (np.sqrt(r0 * r0 + t * (r1 * r1 - r0 * r0)) - r0) / (r1 - r0)
    r, angle = r0 + t * (r1 - r0), rng.uniform(0.0, 2.0 * np.pi, count)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z0 + t * (z1 - z0)], axis=1)


def _prism(corner_radius: float, z0: float, z1: float, spacing_mm: float, rng: np.random.Generator) -> Floats:
    """Points on the six sides of a hexagonal prism about z (a hexagon's side is its corner radius)."""
    count = rng.poisson(6.0 * corner_radius * (z1 - z0) / spacing_mm**2)
    side, q = rng.integers(0, 6, count), rng.uniform(-0.5, 0.5, count) * corner_radius
    apothem = corner_radius * np.sqrt(0.75)
    angle = (side + 0.5) * np.pi / 3.0
    x = apothem * np.cos(angle) - q * np.sin(angle)
    y = apothem * np.sin(angle) + q * np.cos(angle)
    return np.stack([x, y, rng.uniform(z0, z1, count)], axis=1)


def _with_errors(points: Floats, part: Labels, params: Params, rng: np.random.Generator) -> Cloud:
    """Add noise to every coordinate, and outliers after the points."""
    low, high = points.min(axis=0), points.max(axis=0)
    if params.sigma_mm > 0.0:
        points = points + params.sigma_mm * rng.standard_normal(points.shape)
    source = np.zeros(len(points), np.uint8)
    if params.outlier_share > 0.0:
        count = round(len(points) * params.outlier_share / (1.0 - params.outlier_share))
        margin = 0.1 * (high - low)
        points = np.vstack([points, rng.uniform(low - margin, high + margin, (count, 3))])
        part = np.concatenate([part, np.full(count, -1)])
        source = np.concatenate([source, np.full(count, OUTLIER)])
    return Cloud(points, part.astype(np.int32), source.astype(np.uint8))
