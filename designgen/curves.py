"""Arch curves in closed form, parametrised by arc length.

A curve lies in the XZ plane of the bridge, X = 0 at its start and Z = 0 at both ends; ``s`` is the arc length from
the start in mm. The tangent points along +X, the normal upward.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from processor.model import Floats, UsageError

NAMES = ("parabola", "catenary", "circle")


@dataclass(frozen=True)
class Curve:
    """A symmetric arch curve, mm. Its private functions take the arc length from the crown."""

    span: float
    rise: float
    length: float
    _position: Callable[[Floats], tuple[Floats, Floats]]  # x from midspan, z below the crown
    _angle: Callable[[Floats], Floats]  # slope, rad
    _curvature: Callable[[Floats], Floats]  # 1/mm, positive

    def frame(self, s: Floats) -> tuple[Floats, Floats, Floats]:
        """Return point, tangent and upward normal (n, 3 each) at arc lengths s (n,)."""
        from_crown = np.asarray(s, dtype=np.float64) - 0.5 * self.length
        x, drop = self._position(from_crown)
        angle = self._angle(from_crown)
        zero, cos, sin = np.zeros_like(x), np.cos(angle), np.sin(angle)
        point = np.stack([x + 0.5 * self.span, zero, self.rise - drop], axis=-1)
        return point, np.stack([cos, zero, sin], axis=-1), np.stack([-sin, zero, cos], axis=-1)

    def point(self, s: Floats, u: Floats, v: Floats) -> Floats:
        """Return points (n, 3) at arc lengths s, u to the left (+Y) and v along the upward normal."""
        r, _, normal = self.frame(s)
        points: Floats = r + np.asarray(v)[..., None] * normal
        points[..., 1] += u
        return points

    def curvature(self, s: Floats) -> Floats:
        """Return the curvature (n,) in 1/mm; the centre of curvature lies below."""
        return self._curvature(np.asarray(s, dtype=np.float64) - 0.5 * self.length)


def make(name: str, span: float, rise: float) -> Curve:
    """Return the curve of a name in NAMES with the span and rise in mm; UsageError for any other name."""
    if name == "parabola":
        return _parabola(span, rise)
    if name == "catenary":
        return _catenary(span, rise)
    if name == "circle":
        return _circle(span, rise)
    raise UsageError(f"bridge.curve: expected one of {', '.join(NAMES)}, got {name!r}")


def ring(radius: float) -> Curve:
    """Return a full circle from its lowest point, the normal outward; ``radius`` in mm."""
    return Curve(
        span=2.0 * radius,
        rise=2.0 * radius,
        length=2.0 * math.pi * radius,
        _position=lambda s: (radius * np.sin(s / radius), radius * (1.0 - np.cos(s / radius))),
        _angle=lambda s: -s / radius,
        _curvature=lambda s: np.full_like(s, 1.0 / radius),
    )


def _parabola(span: float, rise: float) -> Curve:
    from scipy.interpolate import CubicHermiteSpline  # loaded in a third of a second, which other scenes spare

    k = 4.0 * rise / span**2  # z below the crown = k x^2

    def arc(x: Floats) -> Floats:
        t = 2.0 * k * x
        result: Floats = (t * np.sqrt(1.0 + t * t) + np.arcsinh(t)) / (4.0 * k)
        return result

    # Newton's method at the knots: the arc length is convex on either side of the crown, so it converges from outside.
    # Between knots a cubic with the true slopes is within 1e-7 mm. The table extends beyond the ends, because parts
    # with length errors do.
    knots = np.linspace(-0.55, 0.55, max(64, int(span / 20.0))) * 2.0 * float(arc(np.array(0.5 * span)))
    x = np.array(knots)
    for _ in range(50):
        step = (arc(x) - knots) / np.sqrt(1.0 + (2.0 * k * x) ** 2)
        x = x - step
        if np.max(np.abs(step)) < 1e-10 * span:
            break
    x_of = CubicHermiteSpline(knots, x, 1.0 / np.sqrt(1.0 + (2.0 * k * x) ** 2))

    def position(s: Floats) -> tuple[Floats, Floats]:
        x = x_of(s)
        return x, k * x * x

    return Curve(
        span=span,
        rise=rise,
        length=2.0 * float(arc(np.array(0.5 * span))),
        _position=position,
        _angle=lambda s: np.arctan(-2.0 * k * x_of(s)),
        _curvature=lambda s: 2.0 * k / (1.0 + (2.0 * k * x_of(s)) ** 2) ** 1.5,
    )


def _catenary(span: float, rise: float) -> Curve:
    from scipy.optimize import brentq

    half = 0.5 * span
    # Solve a (cosh(half / a) - 1) = rise for q = half / a; the left side grows with q from 0.
    q = brentq(lambda q: half * (math.cosh(q) - 1.0) / q - rise, 1e-9, 50.0, xtol=1e-15, rtol=1e-15)
    a = half / q
    return Curve(
        span=span,
        rise=rise,
        length=2.0 * a * math.sinh(q),
        _position=lambda s: (a * np.arcsinh(s / a), np.sqrt(a * a + s * s) - a),
        _angle=lambda s: np.arctan(-s / a),
        _curvature=lambda s: a / (a * a + s * s),
    )


def _circle(span: float, rise: float) -> Curve:
    R = (0.25 * span**2 + rise**2) / (2.0 * rise)
    # With a rise above half the span the curve would overhang; the recipe's checks exclude it.
    return Curve(
        span=span,
        rise=rise,
        length=2.0 * R * math.asin(0.5 * span / R),
        _position=lambda s: (R * np.sin(s / R), R * (1.0 - np.cos(s / R))),
        _angle=lambda s: -s / R,
        _curvature=lambda s: np.full_like(s, 1.0 / R),
    )
