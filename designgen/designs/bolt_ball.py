"""Bolt ball: a sphere with a milled flat and a threaded hole for each member, and a process hole at its lowest point.

The sizes are plausible and follow the pattern of catalogues, but not a standard.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from processor.model import Floats, UsageError

if TYPE_CHECKING:
    import cadquery as cq

ABOUT = "bolt ball: sphere with milled flats, threaded holes and a process hole"
CONE_EDGE_MM = 3.0  # by which the wide end of a cone is larger than the sleeve's corners
PROCESS_HOLE_RADIUS_MM, PROCESS_HOLE_DEPTH_MM = 10.0, 35.0  # chosen: M20, at the lowest point


@dataclass(frozen=True)
class Connection:
    """How a tube is joined to a ball, mm: bolt, hexagonal sleeve and cone."""

    tube_diameter: float
    bolt: float
    across_flats: float
    sleeve_length: float
    cone_length: float

    @property
    def sleeve_corner_radius(self) -> float:
        """Radius of the sleeve's corners."""
        return self.across_flats / math.sqrt(3.0)

    @property
    def flat_radius(self) -> float:
        """Radius of the flat milled for the sleeve."""
        return self.sleeve_corner_radius + 1.0

    @property
    def cone_radius(self) -> float:
        """Radius of the cone's wide end, next to the sleeve."""
        return self.sleeve_corner_radius + CONE_EDGE_MM

    def scaled(self, factor: float) -> Connection:
        """Return the connection with all its sizes times ``factor``."""
        return Connection(**{key: factor * size for key, size in dataclasses.asdict(self).items()})


# By diameters of tubes that are usual in China; bolts, sleeves and cones are chosen, growing with the tube.
CONNECTIONS = (
    Connection(60.0, 20.0, 34.0, 35.0, 50.0),
    Connection(75.5, 24.0, 41.0, 40.0, 60.0),
    Connection(88.5, 27.0, 46.0, 45.0, 70.0),
    Connection(114.0, 33.0, 55.0, 50.0, 80.0),
    Connection(140.0, 39.0, 65.0, 60.0, 100.0),
)


def connection(tube_diameter: float) -> Connection:
    """Return the connection of a tube; UsageError for a diameter without one."""
    for candidate in CONNECTIONS:
        if candidate.tube_diameter == tube_diameter:
            return candidate
    diameters = ", ".join(f"{c.tube_diameter:g}" for c in CONNECTIONS)
    raise UsageError(f"frame.tube_diameter_mm: expected one of {diameters}, got {tube_diameter:g}")


@dataclass(frozen=True)
class Params:
    """A ball of radius ``radius_mm`` and the unit directions (m, 3) of its members."""

    radius_mm: float
    directions: Floats
    connection: Connection
    process_hole: bool = True

    def __post_init__(self) -> None:
        if not self.radius_mm > self.connection.flat_radius:
            raise UsageError(
                f"frame.radii_mm: expected more than the flat's radius {self.connection.flat_radius:.1f}, "
                f"got {self.radius_mm:g}"
            )
        least = least_radius(self.directions, self.connection)
        if self.radius_mm < least:
            raise UsageError(
                f"frame.radii_mm: expected at least {least:.1f} so that sleeves do not meet, got {self.radius_mm:g}"
            )

    @property
    def flat_distance(self) -> float:
        """Distance of a flat from the centre."""
        return math.sqrt(self.radius_mm**2 - self.connection.flat_radius**2)


def least_radius(directions: Floats, connection: Connection) -> float:
    """Return the least radius of a ball whose sleeves along directions (m, 3) do not touch: rc / sin(angle / 2)."""
    if len(directions) < 2:
        return 0.0
    cosines = directions @ directions.T - 2.0 * np.eye(len(directions))
    angle = math.acos(min(1.0, max(-1.0, float(cosines.max()))))
    return connection.sleeve_corner_radius / math.sin(0.5 * angle)


def build(params: Params, bolted: Sequence[bool] = ()) -> cq.Shape:
    """Return the CadQuery solid, centred at the origin; flats that are not ``bolted`` have no bore. Empty: all are."""
    import cadquery as cq

    R, bolt = params.radius_mm, params.connection.bolt
    ball: cq.Shape = cq.Solid.makeSphere(R, cq.Vector(0, 0, 0), cq.Vector(0, 0, 1), -90, 90, 360)
    for direction, bored in zip(params.directions, bolted or [True] * len(params.directions), strict=True):
        out = cq.Vector(*direction)
        flat = cq.Solid.makeCylinder(2.0 * R, R, out * params.flat_distance, out)
        ball = ball.cut(flat)
        if bored:
            ball = ball.cut(cq.Solid.makeCylinder(0.5 * bolt, 0.8 * R, out * (0.3 * R), out))
    if params.process_hole:
        hole = cq.Solid.makeCylinder(
            PROCESS_HOLE_RADIUS_MM, PROCESS_HOLE_DEPTH_MM, cq.Vector(0, 0, -R), cq.Vector(0, 0, 1)
        )
        ball = ball.cut(hole)
    return ball


def exposed(params: Params, directions: Floats) -> np.ndarray:
    """Mark the unit directions (n, 3) in which the sphere is not cut by a flat or the process hole."""
    result = np.ones(len(directions), bool)
    for flat in params.directions:
        result &= params.radius_mm * (directions @ flat) < params.flat_distance
    if params.process_hole:
        off_axis = params.radius_mm * np.hypot(directions[:, 0], directions[:, 1])
        result &= (off_axis > PROCESS_HOLE_RADIUS_MM) | (directions[:, 2] > 0.0)
    return result
