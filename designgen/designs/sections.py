"""Sections of prismatic parts: box, stiffened box, I; outlines in y (left) and z (up) about the middle, mm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.model import Floats, UsageError

NAMES = ("box", "stiffened-box", "i")


@dataclass(frozen=True)
class Params:
    """Sizes in mm; ``stiffeners`` are flat bars on the inside of the bottom and of the top plate of a stiffened box."""

    section: str = "box"
    width_mm: float = 500.0
    height_mm: float = 700.0
    flange_mm: float = 24.0
    web_mm: float = 16.0
    stiffeners: int = 2
    stiffener_height_mm: float = 120.0
    stiffener_mm: float = 14.0


@dataclass(frozen=True)
class Section:
    """Closed outlines (n, 2), material to the left of each; ``plates`` (k, 4) cover the end face: y0, y1, z0, z1.

    ``key_points`` (8, 2) are P1..P8, NaN of those that do not lie on steel.
    """

    outlines: tuple[Floats, ...]
    plates: Floats
    key_points: Floats
    width: float
    height: float


def make(params: Params) -> Section:
    """Return a section; UsageError for an unknown name or plates that do not fit."""
    b, h, t, w = 0.5 * params.width_mm, 0.5 * params.height_mm, params.flange_mm, params.web_mm
    if params.section not in NAMES:
        raise UsageError(f"assembly.section: expected one of {', '.join(NAMES)}, got {params.section!r}")
    if not (0.0 < 2.0 * w < b and 0.0 < 2.0 * t < h):
        raise UsageError("assembly.flange_mm, web_mm: expected plates above 0 and below a quarter of the section")
    corners = np.array([[b, -h], [-b, -h], [-b, h], [b, h], [0.0, -h], [-b, 0.0], [0.0, h], [b, 0.0]])
    if params.section == "i":
        key_points = corners.copy()
        key_points[[5, 7]] = np.nan
        plates = np.array([[-b, b, -h, t - h], [-b, b, h - t, h], [-0.5 * w, 0.5 * w, t - h, h - t]])
        right = [[b, -h], [b, t - h], [0.5 * w, t - h], [0.5 * w, h - t], [b, h - t], [b, h]]
        outline = np.array([*right, *([-y, z] for y, z in reversed(right))])
        return Section((outline,), plates, key_points, 2.0 * b, 2.0 * h)
    outer = np.array([[-b, -h], [b, -h], [b, h], [-b, h]])
    # Places y (n,) of the stiffeners
    at, half = np.empty(0), 0.5 * params.stiffener_mm
    if params.section == "stiffened-box":
        share = 2.0 * (np.arange(params.stiffeners) + 1.0) / (params.stiffeners + 1.0) - 1.0
        at = np.asarray((b - w) * share)
    depth = params.stiffener_height_mm
    inner = _hole(b - w, h - t, at, half, depth)
    box = [[-b, b, -h, t - h], [-b, b, h - t, h], [-b, w - b, t - h, h - t], [b - w, b, t - h, h - t]]
    for y in at:
        box += [[y - half, y + half, t - h, t - h + depth], [y - half, y + half, h - t - depth, h - t]]
    return Section((outer, inner), np.array(box), corners, 2.0 * b, 2.0 * h)


def _hole(b: float, h: float, at: Floats, half: float, depth: float) -> Floats:
    """Outline of the cavity, clockwise, around stiffeners at y (n,)."""
    top = [[-b, h]]
    for y in at:
        top += [[y - half, h], [y - half, h - depth], [y + half, h - depth], [y + half, h]]
    top.append([b, h])
    return np.array([*top, *([-y, -z] for y, z in top)])
