"""A part as a beam: how its weight bends it between its supports, and a difference of temperature across it.

Timoshenko's beam of variable section on two or more supports, overhangs included. Weight, stiffness and shear area are
those of the design's cross-sections. A part whose mesh has its outer faces alone, or is modelled as solid, has thin
walls of one thickness along its outline: bending by weight depends on the ratio of stiffness to weight, in which the
thickness cancels. Forces are in N, lengths in mm.

Displacements are zero at the supports: that is how the part without load would lie there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from processor.adjustment.thermal import EXPANSION_PER_K
from processor.geometry import mesh_distance
from processor.model import Bools, DesignPart, Floats, Steel
from processor.preassembly.parts.mesh_sections import Sections, sections
from processor.registration import principal

CELLS = 200  # along a part: 4 cm of 8 m, while stiffness changes over metres
LOCAL = 5  # cells whose median is taken, so that a diaphragm or a lug is not taken for the section
GRAVITY = 9.80665  # m/s^2 (ISO 80000-3)
LATERAL = 2.6  # E / G at Poisson's ratio of 0.3 (EN 1993-1-1, 3.2.6)
SLENDER = 2.0  # length by depth, below which a part is no beam; its sag is below 0.01 mm
CLOSED = 1e-3  # of the outline's length by which it may be open: rounding of corners
# Square of the radius of gyration of the area by that of the outline. Thin walls: 1, flanges three times as thick as
# the web of a deep girder: 1.5; a solid box: 0.5.
OF_PLATES = (0.7, 2.0)
MOST_OPEN = 0.2  # of the cells without a section of plates: those cut by oblique ends
# Relative standard deviation of a computed sag: stiffeners and diaphragms, which weigh some 10 % and stiffen less,
# plates as delivered, and the beam's kinematics; of an outline also that plates are of several thicknesses.
BY_PLATES, BY_OUTLINE = 0.15, 0.3


class Beam(NamedTuple):
    """A part along its axis in n cells: see :func:`beam`.

    ``axes`` (3, 3) are unit row vectors along and across, ``nodes`` (n + 1,) the cells' bounds along from ``origin``
    (3,). ``weight`` (n,) in N/mm, ``centroid`` (n, 2), ``bending`` (n, 2, 2) in 1/(N mm^2), the inverse of E times the
    second moment, ``shear`` (n, 2, 2) in 1/N, ``depth`` (n, 2) across. ``plates``: the mesh has the plates.
    """

    origin: Floats
    axes: Floats
    nodes: Floats
    weight: Floats
    centroid: Floats
    bending: Floats
    shear: Floats
    depth: Floats
    plates: bool

    @property
    def length(self) -> float:
        """Length along the axis."""
        return float(self.nodes[-1] - self.nodes[0])

    @property
    def step(self) -> float:
        """Length of a cell."""
        return self.length / len(self.weight)

    @property
    def relative_sd(self) -> float:
        """Relative standard deviation of a computed sag."""
        return BY_PLATES if self.plates else BY_OUTLINE


class Deflection(NamedTuple):
    """Displacements (n + 1, 2) across and turns (n + 1, 2) of the sections at a beam's nodes, mm and rad."""

    across: Floats
    turn: Floats

    def through(self, beam: Beam, supports: Sequence[float]) -> Deflection:
        """Return it after a small motion that leaves its first and last support at rest."""
        first, last = min(supports), max(supports)
        ends = _at(np.array([first, last]), beam.nodes, self.across)
        slope = (ends[1] - ends[0]) / (last - first)
        return Deflection(self.across - ends[0] - (beam.nodes - first)[:, None] * slope, self.turn - slope)

    def scaled(self, factor: float) -> Deflection:
        """Return it times a factor."""
        return Deflection(factor * self.across, factor * self.turn)

    def plus(self, other: Deflection, factor: float = 1.0) -> Deflection:
        """Return the sum of it and another one times a factor."""
        return Deflection(self.across + factor * other.across, self.turn + factor * other.turn)

    def displacement(self, beam: Beam, points: Floats) -> Floats:
        """Displacements (k, 3) of points (k, 3) of the part: sections stay plane."""
        local = (points - beam.origin) @ beam.axes.T
        along = local[:, 0]
        middles = 0.5 * (beam.nodes[1:] + beam.nodes[:-1])
        above = local[:, 1:] - _at(along, middles, beam.centroid)
        by_turn = -np.einsum("ki,ki->k", above, _at(along, beam.nodes, self.turn))
        moved: Floats = np.column_stack([by_turn, _at(along, beam.nodes, self.across)]) @ beam.axes
        return moved


def beam(part: DesignPart, start: Floats | None, steel: Steel) -> Beam | None:
    """Return a part as a beam whose axis leads away from ``start`` (3,); None where it is none."""
    axes = principal.of_mesh(part.vertices, part.faces)
    rows = axes.axes.T.copy()
    if start is not None and (axes.centre - start) @ rows[0] < 0.0:
        rows[0] *= -1.0
    # Of a nearly square section they may be turned by up to 45 degrees, where its depth is not that between its faces.
    side = principal.along_faces(axes.axes, mesh_distance.of_mesh(part.vertices, part.faces))[:, 1]
    rows[1] = side - (side @ rows[0]) * rows[0]
    rows[1] /= np.linalg.norm(rows[1])
    rows[2] = np.cross(rows[0], rows[1])
    along = part.vertices @ rows[0]
    origin = axes.centre + (along.min() - axes.centre @ rows[0]) * rows[0]
    nodes = np.linspace(0.0, float(np.ptp(along)), CELLS + 1)
    cut = sections(part.vertices, part.faces, origin, rows, 0.5 * (nodes[1:] + nodes[:-1]))
    crossed = cut.length > 0.0
    if crossed.mean() < 1.0 - MOST_OPEN:
        return None
    of_plates = _of_plates(cut)
    plates = bool(of_plates.mean() >= 1.0 - MOST_OPEN)
    known = of_plates if plates else crossed
    area, centroid, moment = (
        (cut.area, cut.centroid, cut.second_moment) if plates else (cut.length, cut.line_centroid, cut.line_moment)
    )
    sense = np.sign(np.median(area))  # of a mesh whose facets all look inward both are negative
    area, moment = (_smooth(sense * values, known) for values in (area, moment))
    depth = _smooth(cut.extent, known)
    if len(area) * (nodes[1] - nodes[0]) < SLENDER * np.median(depth.max(axis=1)):
        return None
    bending = np.linalg.inv(moment).astype(np.float64) / steel.E_MPa
    shear_area = area[:, None, None] * _smooth(cut.direction / np.where(crossed, cut.length, 1.0)[:, None, None], known)
    shear = LATERAL * np.linalg.inv(shear_area).astype(np.float64) / steel.E_MPa
    return Beam(
        origin=origin,
        axes=rows,
        nodes=nodes,
        weight=1e-9 * steel.density_kg_m3 * GRAVITY * area,
        centroid=_smooth(centroid, known),
        bending=bending,
        shear=shear,
        depth=depth,
        plates=plates,
    )


def sag(beam: Beam, gravity: Floats, supports: Sequence[float]) -> tuple[Deflection, tuple[float, ...]] | None:
    """Bend a beam by its weight on supports at distances along its axis.

    ``gravity`` (3,) is its direction; only what acts across the axis bends. Supports push and do not pull: those that
    the part lifts off from are left out, and the others returned as those that carry. None where fewer than two do.
    """
    across = beam.axes[1:] @ gravity
    load = float(np.linalg.norm(across))
    down = across / load if load > 0.0 else np.array([1.0, 0.0])
    weight = load * np.concatenate([[0.0], np.cumsum(beam.weight) * beam.step])
    own = _bent(beam, _integral(weight, beam.step), down)
    carrying = sorted(supports)
    while len(carrying) >= 2:
        pushed = [_bent(beam, -np.maximum(beam.nodes - s, 0.0), down) for s in carrying]
        values = np.array([_at(np.array(carrying), beam.nodes, one.across) @ down for one in (own, *pushed)])
        moments = (weight[-1], float(np.diff(weight) @ (0.5 * (beam.nodes[1:] + beam.nodes[:-1]))))
        # Unknown are height and slope of the beam's start, and the supports' forces.
        count = len(carrying)
        A = np.zeros((count + 2, count + 2))
        A[:count] = np.column_stack([np.ones(count), carrying, values[1:].T])
        A[count, 2:], A[count + 1, 2:] = 1.0, carrying
        size = np.abs(A).max(axis=0)
        right = np.array([*-values[0], *moments])
        scale = np.abs(A / size).max(axis=1)
        solution = np.linalg.solve(A / size / scale[:, None], right / scale) / size
        forces = solution[2:]
        if (forces >= 0.0).all():
            for force, one in zip(forces.tolist(), pushed, strict=True):
                own = own.plus(one, force)
            return own.through(beam, carrying), tuple(carrying)
        carrying.pop(int(np.argmin(forces)))
    return None


def by_gradient(beam: Beam, axis: int, supports: Sequence[float]) -> Deflection:
    """Bend a beam by one kelvin between its faces across an axis, 0 or 1: a curvature along its whole length."""
    turn = np.zeros((len(beam.nodes), 2))
    turn[1:, axis] = np.cumsum(EXPANSION_PER_K / beam.depth[:, axis]) * beam.step
    return Deflection(_integral(turn, beam.step), turn).through(beam, supports)


def _bent(beam: Beam, moment: Floats, down: Floats) -> Deflection:
    """Bend by moments (n + 1,) at the nodes that act in a direction (2,), from rest at the start."""
    curvature = (0.5 * (moment[1:] + moment[:-1]))[:, None] * (beam.bending @ down)
    turn = np.vstack([np.zeros((1, 2)), np.cumsum(curvature, axis=0) * beam.step])
    by_shear = np.vstack([np.zeros((1, 2)), np.cumsum(-np.diff(moment)[:, None] * (beam.shear @ down), axis=0)])
    return Deflection(_integral(turn, beam.step) + by_shear, turn)


def _integral(values: Floats, step: float) -> Floats:
    """Integrate values at equal steps from the first one, by trapezes."""
    integral: Floats = np.zeros_like(values)
    integral[1:] = np.cumsum(0.5 * step * (values[1:] + values[:-1]), axis=0)
    return integral


def _of_plates(cut: Sections) -> Bools:
    """Mark the sections (n,) that are closed and have the proportions of plates."""
    found = (cut.open < CLOSED * cut.length) & (cut.area != 0.0)
    gyration = [
        np.einsum("nii->n", moment) / np.where(found, size, 1.0)
        for moment, size in ((cut.second_moment, cut.area), (cut.line_moment, cut.length))
    ]
    ratio = gyration[0] / np.where(gyration[1] > 0.0, gyration[1], 1.0)
    marked: Bools = found & (ratio > OF_PLATES[0]) & (ratio < OF_PLATES[1])
    return marked


def _smooth(values: Floats, known: Bools) -> Floats:
    """Interpolate values (n, ...) where they are not known, and take the median of each LOCAL neighbours."""
    rows = np.arange(len(values), dtype=np.float64)
    flat = values.reshape(len(values), -1)
    filled = _at(rows, rows[known], flat[known])
    smooth: Floats = median_filter(filled, size=(LOCAL, 1), mode="nearest").reshape(values.shape)
    return smooth


def _at(places: Floats, nodes: Floats, values: Floats) -> Floats:
    """Interpolate columns of values (n, m) at places (k,)."""
    found: Floats = np.stack([np.interp(places, nodes, column) for column in values.T], axis=1)
    return found
