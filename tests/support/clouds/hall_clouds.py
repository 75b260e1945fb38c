"""Scans of a hall of nearly equal bays, made with numpy alone: columns, beams and walls repeat, a few things do not."""

import numpy as np

from processor.model import Scan
from tests.support.clouds import stitch_clouds

BAYS, BAY, WIDTH, HEIGHT = 9, 6000.0, 14000.0, 7000.0
SCANS, CRATES, BRACKETS = 7, 9, 12


def box(low, size):
    """A box (2, 3) by its least corner and its size."""
    return np.array(low, float), np.array(low, float) + np.array(size, float)


def frames():
    """Columns, cross beams, purlins and braces."""
    boxes = []
    for i in range(BAYS + 1):
        x = BAY * i - 200.0
        boxes += [box((x, y, 0.0), (400.0, 350.0, HEIGHT)) for y in (300.0, WIDTH - 650.0)]
        boxes.append(box((x, 0.0, HEIGHT - 900.0), (400.0, WIDTH, 500.0)))
        boxes += [box((x - 300.0, y, 4200.0), (1000.0, 500.0, 250.0)) for y in (650.0, WIDTH - 1150.0)]
    boxes += [box((0.0, y, HEIGHT - 400.0), (BAY * BAYS, 160.0, 200.0)) for y in (2800.0, 7000.0, 11000.0)]
    boxes += [box((0.0, y, 4450.0), (BAY * BAYS, 300.0, 400.0)) for y in (750.0, WIDTH - 1050.0)]  # crane rails
    return boxes


def things(rng):
    """Crates on the floor and brackets at the walls, at random places."""
    boxes = []
    for _ in range(CRATES):
        size = rng.uniform((600.0, 600.0, 400.0), (1600.0, 1400.0, 1500.0))
        at = (
            rng.uniform(0.5, BAYS - 0.8) * BAY,
            rng.choice([rng.uniform(1200.0, 3500.0), rng.uniform(9000.0, 11500.0)]),
        )
        boxes.append(box((*at, 0.0), size))
    for _ in range(BRACKETS):
        side = rng.choice([0.0, WIDTH - 400.0])
        boxes.append(
            box((rng.uniform(0.3, BAYS - 0.3) * BAY, side, rng.uniform(1500.0, 3800.0)), (250.0, 400.0, 300.0))
        )
    return boxes


def hall(seed, step_mrad):
    """True poses (k, 4, 4) and scans without a scanner's grid, from stations along the hall's middle."""
    rng = np.random.default_rng(seed)
    room, boxes = (np.zeros(3), np.array([BAY * BAYS, WIDTH, HEIGHT])), frames() + things(rng)
    x = BAY * (0.5 + (BAYS - 1.0) * np.arange(SCANS) / (SCANS - 1)) + rng.uniform(-1500.0, 1500.0, SCANS)
    made, T = [], []
    for i in range(SCANS):
        at = [x[i], rng.uniform(4500.0, 9000.0), rng.uniform(1500.0, 1800.0)]
        T.append(stitch_clouds.pose(at, rng.uniform(0.0, 360.0), rng.uniform(-1.0, 1.0)))
        scan = stitch_clouds.scan(
            f"S{i + 1}", T[-1], int(rng.integers(1 << 31)), step_mrad=step_mrad, sigma_mm=2.0, room=room, things=boxes,
            grid=False,
        )  # fmt: skip
        made.append(Scan(scan.name, scan.points))
    return np.stack(T), tuple(made)
