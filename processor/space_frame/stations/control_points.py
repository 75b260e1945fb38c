"""Control points in the stations' adjustment: their equations, and which of them the others contradict."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from processor.adjustment.control_points import Sightings
from processor.adjustment.data_snooping import Snooped
from processor.geometry import rigid
from processor.geometry.linalg_small import cholesky, product, solve
from processor.model import Floats, Reason, reason
from processor.space_frame.stations.residual_kernels import STATION


def misfits(control: Sightings, x: Floats, places: Floats) -> Floats:
    """Return known less seen places (c, 3) by the stations' unknowns x (7 s,)."""
    offset = x[STATION - 1 :: STATION]
    shorter = (offset - offset.mean())[control.body, None] * _rays(control, places)
    arm = control.seen - shorter - places[control.body]
    off: Floats = control.known - replace(control, seen=arm).placed(moved(x, places))
    return off


def moved(x: Floats, places: Floats) -> Floats:
    """Return the poses T (s, 4, 4) of stations at places (s, 3), whose axes were the project's, by the unknowns x."""
    T = np.array([rigid.transform(np.eye(3), place) for place in places])
    return rigid.moved_about_own_origins(T, x.reshape(-1, STATION)[:, :6])


def derivative(control: Sightings, places: Floats) -> Floats:
    """Return the derivative J (3c, 7s) of corrected sightings by the stations' unknowns."""
    J = control.derivative(control.seen - places[control.body], len(places), _rays(control, places))
    offsets = J[:, STATION - 1 :: STATION]
    offsets -= offsets.mean(axis=1, keepdims=True)  # offsets count relative to their mean
    return J


def added(control: Sightings, H: Floats, g: Floats, x: Floats, places: Floats) -> tuple[Floats, Floats]:
    """Return the normal equations H (7s, 7s), g (7s,) at x with those of the sightings added."""
    if not len(control.point):
        return H, g
    J = derivative(control, places)
    weighted = np.ascontiguousarray(solve(cholesky(control.covariance), J).T)
    return H + product(weighted, J), g + product(weighted, misfits(control, x, places).reshape(-1, 1))[:, 0]


def doubts(control: Sightings, snooped: Snooped) -> Iterator[Reason]:
    """Yield what was left out, and what contradicts the others where it cannot be decided which one is wrong."""

    def name_of(number: int) -> str:
        return control.point_name[int(np.argmax(control.point == number))]

    for rejection in snooped.rejected:
        row, off = rejection.row, rejection.off_mm
        if row is None:
            yield reason("spheres.control-left-out", point=name_of(rejection.number), off=off)
        else:
            point, scan = control.point_name[row], control.body_name[row]
            yield reason("spheres.sighting-left-out", point=point, scan=scan, off=off)
    if snooped.contradiction is not None:
        name, off = name_of(snooped.contradiction), float(np.linalg.norm(snooped.off))
        if snooped.alone:
            yield reason("spheres.control-contradicts-stations", point=name, off=off)
        else:
            yield reason("spheres.control-contradicts", point=name, off=off)


def _rays(control: Sightings, places: Floats) -> Floats:
    ray = control.seen - places[control.body]
    unit: Floats = ray / np.maximum(np.linalg.norm(ray, axis=1), 1e-300)[:, None]
    return unit
