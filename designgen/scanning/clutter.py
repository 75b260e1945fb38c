"""Objects that are scanned but are no part of the structure, and hide parts of it."""

from __future__ import annotations

import numpy as np

from designgen.scanning.surfaces import Builder
from processor.model import Floats

UP = np.array([0.0, 0.0, 1.0])
ABOVE_MM = 1_000.0  # length of a pole beyond the line of sight


def add_pole(
    builder: Builder,
    station: Floats,
    target: Floats,
    up: Floats,
    shares: tuple[float, float],
    rng: np.random.Generator,
    *,
    on_ground: bool,
) -> None:
    """Add a pole along ``up`` (3,) across the line from a station (3,) to a target (3,), between two fractions of it.

    A pole ``on_ground`` starts at z = 0; any other extends as far below the line as above it.
    """
    at = station + (target - station) * rng.uniform(*shares) + rng.uniform(-500.0, 500.0, 3)
    radius = rng.uniform(25.0, 60.0)
    below = max(float(at[2]), 0.0) if on_ground else ABOVE_MM
    add_bar(builder, "pole", at - below * up, up, radius, below + ABOVE_MM)


def add_below_roof(builder: Builder, low: Floats, high: Floats, count: int, rng: np.random.Generator) -> None:
    """Add lamps (balls without members), pipes below a roof's box, and poles on the ground, in rotation."""
    span = high - low
    for i in range(count):
        at = low + rng.uniform(0.05, 0.95, 3) * span
        if i % 3 == 0:
            at[2] = low[2] - rng.uniform(600.0, 1500.0)
            builder.sphere(-1, "lamp", at, rng.uniform(190.0, 260.0), [])
        elif i % 3 == 1:
            along = np.array([1.0, 0.0, 0.0]) if rng.random() < 0.5 else np.array([0.0, 1.0, 0.0])
            length, radius = rng.uniform(4_000.0, 10_000.0), rng.uniform(20.0, 80.0)
            at[2] = low[2] - rng.uniform(200.0, 600.0)
            add_bar(builder, "pipe", at - 0.5 * length * along, along, radius, length)
        else:
            radius, height = rng.uniform(25.0, 60.0), rng.uniform(1_500.0, 3_000.0)
            foot = np.array([at[0], at[1], 0.0])
            add_bar(builder, "pole", foot, UP, radius, height)


def add_bar(builder: Builder, name: str, start: Floats, along: Floats, radius: float, length: float) -> None:
    """Add a round bar with its ends."""
    builder.cone(-1, name, start, along, (radius, radius), length)
    for end in (start, start + length * along):
        builder.disc(-1, f"{name} end", end, along, radius)
