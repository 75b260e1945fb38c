"""Scans of boxes made with numpy alone: rays against axis-aligned boxes, noise along the ray."""

import numpy as np
from scipy.spatial.transform import Rotation

from processor.model import Scan

ROOM = (np.array([-6000.0, -4000.0, 0.0]), np.array([7000.0, 5000.0, 3500.0]))  # seen from within
# A table, a cupboard, a pillar, a step: no two ends of the room look alike.
THINGS = (
    (np.array([-5000.0, -3500.0, 0.0]), np.array([-3800.0, -2000.0, 900.0])),
    (np.array([3500.0, 3900.0, 0.0]), np.array([5500.0, 5000.0, 2200.0])),
    (np.array([1000.0, -1500.0, 0.0]), np.array([1500.0, -1000.0, 3500.0])),
    (np.array([-1500.0, 2500.0, 0.0]), np.array([-300.0, 3400.0, 500.0])),
)


def pose(position, turn_deg, tilt_deg=0.0):
    """T_room_scanner (4, 4)."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zx", [turn_deg, tilt_deg], degrees=True).as_matrix()
    T[:3, 3] = position
    return T


def ranges(origin, rays, room, things):
    """Distance to the first face along each of rays (n, 3), by slabs."""
    with np.errstate(divide="ignore"):
        inverse = 1.0 / rays
    low, high = (room[0] - origin) * inverse, (room[1] - origin) * inverse
    nearest = np.maximum(low, high).min(axis=1)
    for box in things:
        low, high = (box[0] - origin) * inverse, (box[1] - origin) * inverse
        enter, leave = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
        hit = (enter < leave) & (enter > 0.0)
        nearest = np.where(hit, np.minimum(nearest, enter), nearest)
    return nearest


def scan(name, T, seed, *, step_mrad=17.0, sigma_mm=2.0, room=ROOM, things=THINGS, grid=True):
    """A panoramic scan in its scanner's frame, in rows and columns."""
    rng = np.random.default_rng(seed)
    columns = int(2.0 * np.pi / (1e-3 * step_mrad))
    height = np.arange(-1.0, 1.4, 1e-3 * step_mrad)
    turn = 2.0 * np.pi * (np.arange(columns) + 0.5) / columns
    e, a = (x.ravel() for x in np.meshgrid(height, turn, indexing="ij"))
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    r = ranges(T[:3, 3], rays @ T[:3, :3].T, room, things) + rng.normal(0.0, sigma_mm, len(rays))
    row, column = np.divmod(np.arange(len(rays)), columns)
    there = {"grid_row": row, "grid_column": column} if grid else {}
    return Scan(name, rays * r[:, None], sigma_mm=sigma_mm, **there)


def four(seed=0, **options):
    """Poses (4, 4, 4) of four stations in the room, and their scans."""
    T = np.stack(
        [
            pose([-3000.0, 1000.0, 1600.0], 20.0),
            pose([0.0, 500.0, 1700.0], 140.0),
            pose([3500.0, -2000.0, 1500.0], -75.0, 0.1),
            pose([3000.0, 2200.0, 1650.0], 255.0),
        ]
    )
    return T, tuple(scan(f"S{i + 1}", one, 100 * seed + i, **options) for i, one in enumerate(T))
