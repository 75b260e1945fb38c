"""A straight box built otherwise than designed, in closed form, seen by stations with errors of their own."""

from typing import NamedTuple

import numpy as np

from processor.geometry import rigid
from tests.support.clouds import plate_clouds

SIZE = np.array([3000.0, 400.0, 300.0])
STATIONS = np.array(
    [[-5000.0, -4000.0, 2500.0], [5000.0, -4000.0, -2500.0], [5000.0, 4500.0, 2500.0], [-5000.0, 4500.0, -2500.0]]
)


class Built(NamedTuple):
    """How the box is built: longer, wider and bowed sideways and up in mm; twisted and skewed in rad."""

    longer: float = 0.0
    wider: float = 0.0
    bow: float = 0.0
    camber: float = 0.0
    twist: float = 0.0
    skew: float = 0.0  # of the end face, about the upright axis


def moved(points, built):
    """Where points (n, 3) of the box as designed really are; the middle of the box is the origin."""
    x, y, _ = (points / (0.5 * SIZE)).T
    bend = np.cos(0.5 * np.pi * x)
    angle = 0.5 * built.twist * x
    off = np.stack([0.5 * built.longer * x, 0.5 * built.wider * y, 0.0 * x], axis=1)
    off[:, 0] += built.skew * points[:, 1] * 0.5 * (1.0 + x)
    off[:, 1] += built.bow * bend - angle * points[:, 2]
    off[:, 2] += built.camber * bend + angle * points[:, 1]
    return points + off


def beam(built, seed, sigma=1.0, registration=0.3, count=60_000, T=None):
    """A scene of the box from four stations; T (4, 4) moves what was built, not the design."""

    def real(points):
        return rigid.apply(np.eye(4) if T is None else T, moved(points, built))

    return plate_clouds.seen(SIZE, real, STATIONS, True, count, seed, sigma, registration)
