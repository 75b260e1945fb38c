"""Parts as measured, made by hand: points on their design, bottom edges, and ends that depart by stated amounts."""

import numpy as np

from processor.preassembly import topology
from processor.preassembly.ends import bottom_edges, joint_end
from processor.preassembly.ends.bottom_edges import EdgeDepartures
from processor.preassembly.ends.joint_frame import joint_frame
from processor.preassembly.ends.outer_faces import RegisteredPart
from processor.preassembly.parts.part_in_chain import Member


def registered(points, surface, outer, pose_variance=0.0):
    """A part whose points (n, 3) of one station lie where the design has them."""
    station, pose = np.zeros(len(points), np.int64), pose_variance * np.eye(6)
    return RegisteredPart(
        points=points, station=station, between_stations=0.0, pose=pose, surface=surface, outer=outer
    )  # fmt: skip


def edges(chainage, points, axes, departure, sd=0.0, by_pose=None):
    """Departures (n, 2) of a left and then a right bottom edge of as many points."""
    n = len(points)
    return EdgeDepartures(
        side=("left",) * (n // 2) + ("right",) * (n // 2), chainage=chainage, points=points, axes=axes,
        departure=departure, covariance=np.stack([sd**2 * np.eye(n)] * 2),
        by_pose=np.zeros((n, 2, 6)) if by_pose is None else by_pose, by_view=np.zeros((2, n, 1)),
        by_tilt=np.zeros((2, n, 1)), tails=np.ones((2, 2)),
    )  # fmt: skip


def frames(design):
    """T_bridge_joint (j, 4, 4) of a design's joints."""
    return np.array([joint_frame(points) for points in design.joint_points])


def members(design, departure, sd_mm, of_edges=None):
    """Members whose ends depart from the design by ``departure(part, end, joint)`` (8, 3), in the joint's axes.

    A tuple of reasons instead is an end that was not measured. ``of_edges`` are the edges of each part.
    """
    made = []
    for i, part in enumerate(design.parts):
        ends = []
        for e, (joint, _) in enumerate(topology.ends_of(design.joined, i)):
            by = None if joint is None else departure(i, e, joint)
            if isinstance(by, np.ndarray):
                by = joint_end.JointEnd(by, sd_mm**2 * np.eye(24), np.zeros((24, 6)))
            ends.append(joint_end.unknown(*by) if isinstance(by, tuple) else by)
        own = bottom_edges.NONE if of_edges is None else of_edges[i]
        made.append(Member(tuple(ends), own, part.vertices.mean(axis=0), np.zeros((6, 6))))
    return made
