"""The exact surfaces of a space frame: balls with flats and holes, hexagonal sleeves, cones, tubes."""

from __future__ import annotations

import numpy as np

from designgen.designs import bolt_ball
from designgen.designs.space_frame import HEXAGON, Frame
from designgen.rigid import perpendicular
from designgen.scanning.surfaces import Builder
from processor.model import Floats

DOWN = np.array([0.0, 0.0, -1.0])


def add_frame(builder: Builder, frame: Frame) -> None:
    """Add the whole frame; the part of a ball is its row, members have none (-1)."""
    for node, centre in enumerate(frame.centres):
        _add_ball(builder, node, centre, frame.ball(node))
    for member in range(len(frame.members)):
        _add_member(builder, frame, member)


def _add_ball(builder: Builder, node: int, centre: Floats, ball: bolt_ball.Params) -> None:
    R, cuts = ball.radius_mm, [(unit, ball.flat_distance) for unit in ball.directions]
    if ball.process_hole:
        hole = bolt_ball.PROCESS_HOLE_RADIUS_MM
        rim = float(np.sqrt(R * R - hole * hole))
        cuts.append((DOWN, rim))
        floor = R - bolt_ball.PROCESS_HOLE_DEPTH_MM
        builder.cone(node, "process hole", centre + rim * DOWN, -DOWN, (hole, hole), rim - floor)
        builder.disc(node, "process hole floor", centre + floor * DOWN, DOWN, hole)
    builder.sphere(node, "ball", centre, R, cuts)
    for unit in ball.directions:
        builder.disc(node, "flat", centre + ball.flat_distance * unit, unit, ball.connection.flat_radius)


def _add_member(builder: Builder, frame: Frame, member: int) -> None:
    connection, (a, b) = frame.connection, frame.ends(member)
    length = float(np.linalg.norm(b - a))
    unit = (b - a) / length
    radius, corner_radius = 0.5 * connection.tube_diameter, connection.sleeve_corner_radius
    for end, (origin, out) in enumerate(((a, unit), (b, -unit))):
        flat, tip, _ = frame.stacks[member, end]
        if frame.has_sleeve(member, end):
            side = perpendicular(out)
            ring = corner_radius * (HEXAGON[:, :2] @ np.stack([side, np.cross(out, side)]))
            near, far = origin + flat * out + ring, origin + tip * out + ring
            for k in range(6):
                n = (k + 1) % 6
                builder.polygon(-1, "sleeve", np.array([near[k], near[n], far[n], far[k]]))
        builder.disc(-1, "cone end", origin + tip * out, out, connection.cone_radius)
        builder.cone(-1, "cone", origin + tip * out, out, (connection.cone_radius, radius), connection.cone_length)
    first, last = frame.stacks[member, :, 2]
    tube = length - (first + last)
    builder.cone(-1, "tube", a + first * unit, unit, (radius, radius), tube, (frame.bow(member), 0.0, tube))
