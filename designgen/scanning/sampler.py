"""Points sampled from exact surfaces with isotropic noise, as in the papers: no stations, no occlusion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from designgen.checks import expect_all
from designgen.designs import arch_part, bolt_ball, space_frame
from designgen.designs.arch_part import Face
from designgen.designs.parametric_face import Patch, within_triangle
from designgen.rigid import perpendicular
from processor.model import SOURCES, Bools, Codes, Floats, Labels

MODE = "surface"
OUTLIER = SOURCES.index("outlier")


@dataclass(frozen=True)
class Params:
    """How surfaces are sampled, mm: on average one point in an area of ``spacing_mm`` squared."""

    mode: str = MODE
    spacing_mm: float = 10.0
    sigma_mm: float = 1.0  # of each coordinate
    outlier_share: float = 0.0  # of all points; uniform in the part's box enlarged by a tenth
    inner_depth_mm: float = 1000.0  # depth from an open end to which inner faces are sampled
    member_reach_mm: float = 0.0  # frames: members are sampled to this distance from each ball; 0 = over their length
    net: bool = False  # arch parts: points on a net over each face, its edges included, instead of at random

    def __post_init__(self) -> None:
        expect_all(
            "scan",
            (0.05 <= self.spacing_mm <= 1000.0, "spacing_mm", self.spacing_mm, "0.05 to 1000"),
            (0.0 <= self.sigma_mm <= 1000.0, "sigma_mm", self.sigma_mm, "0 to 1000"),
            (0.0 <= self.outlier_share < 1.0, "outlier_share", self.outlier_share, "0 to less than 1"),
            (self.inner_depth_mm > 0.0, "inner_depth_mm", self.inner_depth_mm, "a length above 0"),
            (self.member_reach_mm >= 0.0, "member_reach_mm", self.member_reach_mm, "0 or a length"),
        )


@dataclass(frozen=True)
class Cloud:
    """Points (n, 3), mm, with the part of each (-1 = none) and its source (a row of SOURCES)."""

    points: Floats
    part: Labels
    source: Codes


def scan_part(part: arch_part.ArchPart, number: int, params: Params, rng: np.random.Generator) -> Cloud:
    """Sample one arch part in the bridge's frame; its points are labelled with its number."""
    faces = arch_part.faces(part, params.inner_depth_mm)
    on_face = _on_net if params.net else _on_face
    points = np.vstack([on_face(face, params.spacing_mm, rng) for face in faces])
    return _with_errors(points, np.full(len(points), number), params, rng)


def scan_frame(frame: space_frame.Frame, params: Params, rng: np.random.Generator) -> Cloud:
    """Sample a whole frame; points of a ball are labelled with its node, those of members with -1."""
    clouds, labels = [], []
    for node, centre in enumerate(frame.centres):
        ball = frame.ball(node)
        count = rng.poisson(4.0 * np.pi * ball.radius_mm**2 / params.spacing_mm**2)
        unit = _unit_vectors(count, rng)
        unit = unit[bolt_ball.exposed(ball, unit)]
        clouds.append(centre + ball.radius_mm * unit)
        labels.append(np.full(len(unit), node))
    for member in range(len(frame.members)):
        points = _on_member(frame, member, params, rng)
        clouds.append(points)
        labels.append(np.full(len(points), -1))
    return _with_errors(np.vstack(clouds), np.concatenate(labels), params, rng)


def scan_patches(
    patches: Sequence[tuple[int, Patch]],
    params: Params,
    rng: np.random.Generator,
    hidden: Callable[[int, Floats, Floats], Bools] | None = None,
) -> Cloud:
    """Sample faces with their parts' numbers: uniform by the area of their nets, on the faces themselves.

    ``hidden`` takes a face's row and parameters p, q (n,), and marks the places that another body covers. They get no
    points.
    """
    clouds, labels = [], []
    for row, (part, patch) in enumerate(patches):
        knots, triangles = patch.net()
        a, b, c = (patch.at(knots[:, 0], knots[:, 1])[triangles[:, i]] for i in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        if not area.sum() > 0.0:  # the whole face is missing
            continue
        count = rng.poisson(area.sum() / params.spacing_mm**2)
        corners = triangles[rng.choice(len(area), count, p=area / area.sum())]
        u, v = within_triangle(rng.random(count), rng.random(count))
        start, second, third = knots[corners.T]
        pq = start + u[:, None] * (second - start) + v[:, None] * (third - start)
        if hidden is not None:
            pq = pq[~hidden(row, pq[:, 0], pq[:, 1])]
        clouds.append(patch.at(pq[:, 0], pq[:, 1]))
        labels.append(np.full(len(pq), part))
    return _with_errors(np.vstack(clouds), np.concatenate(labels), params, rng)


def _on_face(face: Face, spacing_mm: float, rng: np.random.Generator) -> Floats:
    """Sample points (n, 3) on a face, uniform by area: proposals uniform in (p, q), accepted by the area element."""
    p, q = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, 201), np.linspace(0, 1, 5), indexing="ij"))
    highest = 1.001 * float(face.element(p, q).max())
    count = rng.poisson(highest / spacing_mm**2)
    p, q = rng.uniform(size=count), rng.uniform(size=count)
    accepted = (rng.uniform(size=count) * highest < face.element(p, q)) & face.present(p, q)
    return face.at(p[accepted], q[accepted])


def _on_net(face: Face, spacing_mm: float, _: np.random.Generator) -> Floats:
    """Return the points (n, 3) of a net over a face, as of a model that is meshed: its borders carry points."""
    edge = np.linspace(0.0, 1.0, 201)
    middle = np.full_like(edge, 0.5)
    length = [
        float(np.linalg.norm(np.diff(face.at(*line), axis=0), axis=1).sum())
        for line in ((edge, middle), (middle, edge))
    ]
    lines = [np.linspace(0.0, 1.0, max(2, 1 + round(one / spacing_mm))) for one in length]
    p, q = (grid.ravel() for grid in np.meshgrid(*lines, indexing="ij"))
    there = face.present(p, q)
    return face.at(p[there], q[there])


def _unit_vectors(count: int, rng: np.random.Generator) -> Floats:
    z = rng.uniform(-1.0, 1.0, count)
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    rho = np.sqrt(1.0 - z * z)
    return np.stack([rho * np.cos(angle), rho * np.sin(angle), z], axis=1)


def _on_member(frame: space_frame.Frame, member: int, params: Params, rng: np.random.Generator) -> Floats:
    """Sample a member's sleeves, cones and tube."""
    connection, (a, b) = frame.connection, frame.ends(member)
    length = float(np.linalg.norm(b - a))
    unit = (b - a) / length
    side = perpendicular(unit)
    basis = np.stack([side, np.cross(unit, side), unit])
    reach = params.member_reach_mm or length
    tube, (first, last) = 0.5 * connection.tube_diameter, frame.stacks[member, :, 2]

    def on_tube(low: float, high: float) -> Floats:
        cloud = _on_cone((tube, tube), (low, high), params.spacing_mm, rng)
        q = (cloud[:, 2] - first) / (length - (first + last))
        bowed: Floats = a + (cloud @ basis + np.outer(4.0 * q * (1.0 - q), frame.bow(member)))
        return bowed

    points = []
    for end, (origin, sign, start) in enumerate(((a, 1.0, first), (b, -1.0, last))):
        axial = basis * np.array([[1.0], [1.0], [sign]])
        tip = start - connection.cone_length
        near = [_on_cone((connection.cone_radius, tube), (tip, start), params.spacing_mm, rng)]
        if frame.has_sleeve(member, end):
            bounds = (tip - connection.sleeve_length, tip)
            near.append(_on_prism(connection.sleeve_corner_radius, bounds, params.spacing_mm, rng))
        points += [origin + cloud @ axial for cloud in near]
        if start < reach < 0.5 * length:
            points.append(on_tube(first, reach) if end == 0 else on_tube(length - reach, length - last))
    if reach >= 0.5 * length:
        points.append(on_tube(first, length - last))
    return np.vstack(points)


def _on_cone(radii: tuple[float, float], z: tuple[float, float], spacing_mm: float, rng: np.random.Generator) -> Floats:
    """Sample points (n, 3) on a cone or cylinder about z, uniform by area; radii at both ends z."""
    (r0, r1), (z0, z1) = radii, z
    slant = np.hypot(z1 - z0, r1 - r0)
    count = rng.poisson(np.pi * (r0 + r1) * slant / spacing_mm**2)
    t = rng.uniform(size=count)
    if r0 != r1:  # the area up to t is proportional to r^2 - r0^2
        t = (np.sqrt(r0 * r0 + t * (r1 * r1 - r0 * r0)) - r0) / (r1 - r0)
    r, angle = r0 + t * (r1 - r0), rng.uniform(0.0, 2.0 * np.pi, count)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z0 + t * (z1 - z0)], axis=1)


def _on_prism(corner_radius: float, z: tuple[float, float], spacing_mm: float, rng: np.random.Generator) -> Floats:
    """Sample points (n, 3) on the sides of a hexagonal prism about z (a side is as long as the corner radius)."""
    z0, z1 = z
    count = rng.poisson(6.0 * corner_radius * (z1 - z0) / spacing_mm**2)
    side, q = rng.integers(0, 6, count), rng.uniform(-0.5, 0.5, count) * corner_radius
    apothem = corner_radius * np.sqrt(0.75)
    angle = (side + 0.5) * np.pi / 3.0
    x = apothem * np.cos(angle) - q * np.sin(angle)
    y = apothem * np.sin(angle) + q * np.cos(angle)
    return np.stack([x, y, rng.uniform(z0, z1, count)], axis=1)


def _with_errors(points: Floats, part: Labels, params: Params, rng: np.random.Generator) -> Cloud:
    """Return the points with noise in every coordinate, followed by outliers."""
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
