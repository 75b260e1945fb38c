"""Scans of a hall of nearly equal bays, made with numpy alone: columns, beams and walls repeat, a few things do not."""

import numpy as np

from processor.model import Scan
from tests.support.clouds import stitch_clouds

BAY, WIDTH, HEIGHT = 6000.0, 14000.0, 7000.0


def box(low, size):
    """A box (2, 3) by its least corner and its size."""
    return np.array(low, float), np.array(low, float) + np.array(size, float)


def frames(bays):
    """Columns, cross beams, purlins and braces of a hall of ``bays``."""
    boxes = []
    for i in range(bays + 1):
        x = BAY * i - 200.0
        boxes += [box((x, y, 0.0), (400.0, 350.0, HEIGHT)) for y in (300.0, WIDTH - 650.0)]
        boxes.append(box((x, 0.0, HEIGHT - 900.0), (400.0, WIDTH, 500.0)))
        boxes += [box((x - 300.0, y, 4200.0), (1000.0, 500.0, 250.0)) for y in (650.0, WIDTH - 1150.0)]
    boxes += [box((0.0, y, HEIGHT - 400.0), (BAY * bays, 160.0, 200.0)) for y in (2800.0, 7000.0, 11000.0)]
    boxes += [box((0.0, y, 4450.0), (BAY * bays, 300.0, 400.0)) for y in (750.0, WIDTH - 1050.0)]  # crane rails
    return boxes


def things(rng, bays, crates, brackets):
    """Crates on the floor and brackets at the walls, at random places."""
    boxes = []
    for _ in range(crates):
        size = rng.uniform((600.0, 600.0, 400.0), (1600.0, 1400.0, 1500.0))
        at = (
            rng.uniform(0.5, bays - 0.8) * BAY,
            rng.choice([rng.uniform(1200.0, 3500.0), rng.uniform(9000.0, 11500.0)]),
        )
        boxes.append(box((*at, 0.0), size))
    for _ in range(brackets):
        side = rng.choice([0.0, WIDTH - 400.0])
        boxes.append(
            box((rng.uniform(0.3, bays - 0.3) * BAY, side, rng.uniform(1500.0, 3800.0)), (250.0, 400.0, 300.0))
        )
    return boxes


def hall(
    seed, *, bays=9, scans=7, crates=9, brackets=12, reach_mm=np.inf, open_ends=False, step_mrad=15.0, sigma_mm=2.0
):
    """True poses (k, 4, 4) and scans without a scanner's grid, from stations along the hall's middle."""
    rng = np.random.default_rng(seed)
    room = (np.array([0.0, 0.0, 0.0]), np.array([BAY * bays, WIDTH, HEIGHT]))
    if open_ends:
        room[0][0], room[1][0] = -1e6, 1e6
    boxes = frames(bays) + things(rng, bays, crates, brackets)
    x = BAY * (0.5 + (bays - 1.0) * np.arange(scans) / max(scans - 1, 1)) + rng.uniform(-1500.0, 1500.0, scans)
    made, T = [], []
    for i in range(scans):
        at = [x[i], rng.uniform(4500.0, 9000.0), rng.uniform(1500.0, 1800.0)]
        T.append(stitch_clouds.pose(at, rng.uniform(0.0, 360.0), rng.uniform(-1.0, 1.0)))
        scan = stitch_clouds.scan(
            f"S{i + 1}", T[-1], int(rng.integers(1 << 31)), step_mrad=step_mrad, sigma_mm=sigma_mm, room=room,
            things=boxes, grid=False,
        )  # fmt: skip
        made.append(Scan(scan.name, scan.points[np.linalg.norm(scan.points, axis=1) < reach_mm]))
    return np.stack(T), tuple(made)
