"""The exact surfaces of a scene for rays: spheres with caps cut off, cones, discs and triangles.

Curved faces whose intersection with a ray has no closed form are patches. Rays meet the net of a patch, and
:func:`designgen.scanning.raycast.refine_hits` moves the hit to the patch's own surface.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from designgen.designs.parametric_face import Patch, Trimmed, within_triangle
from designgen.low_discrepancy import in_square
from designgen.scanning.facets import Facets
from processor.model import Floats, Ints, Labels

SPHERE, CONE, DISC, TRIANGLE = range(4)  # kinds of surfaces
NUMBERS = 14  # of a shape: see Builder
MANY = 20_000  # triangles of a scene from which a tree is used; hits differ at the edges of facets, by 0.01 mm
FLAT_MM = 1e-7  # a face this close to a plane is plane, and its net is exact
FLAT_SAMPLES = 1000  # least number of points of a face at which this is tested


@dataclass(frozen=True)
class Surfaces:
    """All shapes of a scene, a row each, in the scene's frame, mm.

    The cuts of shape i are the rows ``cut_start[i]`` to ``cut_start[i + 1]`` of ``cuts``: unit normal and distance of
    planes beyond which a sphere is cut off, from its centre. A long shape has several bounding spheres (``piece_*``).
    """

    kind: npt.NDArray[np.int8]  # (m,)
    numbers: Floats  # (m, NUMBERS)
    surface: Labels  # (m,) number of the smooth surface
    label: Labels  # (m,) row of surface_names
    part: Labels  # (m,) row of part_names, -1 = none
    patch: Labels  # (m,) row of patches, -1 = none or a plane one, whose net is exact
    albedo: Floats  # (m,) reflectance as a multiple of the scan's
    corner_pq: Floats  # (m, 3, 2) parameters of the corners of a patch's triangles
    cuts: Floats  # (c, 4)
    cut_start: Ints  # (m + 1,)
    piece_shape: Labels  # (k,)
    piece_centre: Floats  # (k, 3)
    piece_radius: Floats  # (k,)
    patches: tuple[Patch | Trimmed, ...]
    surface_names: tuple[str, ...]

    @cached_property
    def facets(self) -> Facets | None:
        """All triangles; None for few, of which the windows on the grid are faster."""
        triangles = self.kind == TRIANGLE
        if triangles.sum() < MANY:
            return None
        return Facets.of(self.numbers[triangles, :9].reshape(-1, 3, 3))


@dataclass
class Builder:
    """Collects shapes. Every method takes the part (row, -1 = none) and the name of the surface.

    The numbers of a shape are: sphere: centre, radius; cone: start, axis, radii at start and end, length, bow vector,
    offset and span of the bow; disc: centre, normal, outer and inner radius; triangle: three corners.
    """

    _kind: list[int] = field(default_factory=list)
    _numbers: list[Floats] = field(default_factory=list)
    _surface: list[int] = field(default_factory=list)
    _part: list[int] = field(default_factory=list)
    _cuts: list[Floats] = field(default_factory=list)
    _pieces: list[tuple[int, Floats, float]] = field(default_factory=list)
    _labels: list[str] = field(default_factory=list)
    _albedo: list[float] = field(default_factory=list)
    _nets: list[tuple[Patch | Trimmed, int, Hashable]] = field(default_factory=list)

    def sphere(
        self,
        part: int,
        name: str,
        centre: Floats,
        radius: float,
        cuts: Sequence[tuple[Floats, float]],
        albedo: float = 1.0,
    ) -> None:
        """Add a sphere without the caps beyond planes, each given by unit normal and distance from the centre."""
        self._add(SPHERE, part, self._name(name), [*centre, radius], [(centre, radius)], albedo)
        self._cuts[-1] = np.array([[*normal, distance] for normal, distance in cuts]).reshape(-1, 4)

    def cone(
        self,
        part: int,
        name: str,
        start: Floats,
        axis: Floats,
        radii: tuple[float, float],
        length: float,
        bow: tuple[Floats, float, float] | None = None,
    ) -> None:
        """Add a cone or cylinder without ends: ``radii`` at ``start`` and at ``length`` along the unit ``axis``.

        ``bow`` (vector (3,), offset, span) displaces the section at z by 4 q (1 - q) vector, q = (offset + z) / span.
        """
        vector, begin, span = bow or (np.zeros(3), 0.0, 1.0)
        widest = max(radii)
        pieces = max(1, int(np.ceil(length / (4.0 * widest))))
        at = (np.arange(pieces) + 0.5) * length / pieces
        q = (begin + at) / span
        centres = start + at[:, None] * axis + (4.0 * q * (1.0 - q))[:, None] * vector
        # Within a piece the axis deviates from its middle by the slope of the bow, at most 4 |bow| / span.
        half = 0.5 * length / pieces
        radius = float(np.hypot(half, widest + 4.0 * np.linalg.norm(vector) / span * half))
        numbers = [*start, *axis, *radii, length, *vector, begin, span]
        self._add(CONE, part, self._name(name), numbers, [(c, radius) for c in centres])

    def disc(self, part: int, name: str, centre: Floats, normal: Floats, outer: float, inner: float = 0.0) -> None:
        """Add a disc or plane ring."""
        self._add(DISC, part, self._name(name), [*centre, *normal, outer, inner], [(centre, outer)])

    def polygon(self, part: int, name: str, corners: Floats, albedo: float = 1.0) -> None:
        """Add a convex plane polygon with corners (n, 3) that reflects ``albedo`` times as much as the scan states."""
        surface = self._name(name)
        for i in range(1, len(corners) - 1):
            triangle = corners[[0, i, i + 1]]
            middle = triangle.mean(axis=0)
            reach = float(np.linalg.norm(triangle - middle, axis=1).max())
            self._add(TRIANGLE, part, surface, triangle.ravel().tolist(), [(middle, reach)], albedo)

    def patch(self, part: int, patch: Patch | Trimmed, smooth: Hashable = None) -> None:
        """Add a patch. Patches of the same part and ``smooth`` are pieces of one smooth surface; None: of one name."""
        self._nets.append((patch, part, patch.name if smooth is None else smooth))

    def _name(self, name: str) -> int:
        self._labels.append(name)
        return len(self._labels) - 1

    def _add(
        self,
        kind: int,
        part: int,
        surface: int,
        numbers: Sequence[float],
        pieces: Sequence[tuple[Floats, float]],
        albedo: float = 1.0,
    ) -> None:
        self._albedo.append(albedo)
        row = np.zeros(NUMBERS)
        row[: len(numbers)] = numbers
        self._pieces += [(len(self._kind), centre, radius) for centre, radius in pieces]
        self._kind.append(kind)
        self._numbers.append(row)
        self._surface.append(surface)
        self._part.append(part)
        self._cuts.append(np.empty((0, 4)))

    def to_surfaces(self) -> Surfaces:
        """Return all shapes."""
        count = len(self._kind)
        names: dict[str, int] = {}
        for name in self._labels:
            names.setdefault(name, len(names))
        blocks: list[dict[str, Any]] = [
            {
                "kind": np.array(self._kind, np.int8),
                "numbers": np.array(self._numbers).reshape(-1, NUMBERS),
                "surface": np.array(self._surface, np.int32),
                "label": np.array([names[self._labels[row]] for row in self._surface], np.int32),
                "part": np.array(self._part, np.int32),
                "patch": np.full(count, -1, np.int32),
                "albedo": np.array(self._albedo, np.float64),
                "corner_pq": np.zeros((count, 3, 2)),
                "piece_shape": np.array([shape for shape, _, _ in self._pieces], np.int32),
                "piece_centre": np.array([centre for _, centre, _ in self._pieces]).reshape(-1, 3),
                "piece_radius": np.array([radius for _, _, radius in self._pieces]),
            }
        ]
        numbered: dict[tuple[int, Hashable], int] = {}
        for number, (patch, part, smooth) in enumerate(self._nets):
            surface = numbered.setdefault((part, smooth), len(self._labels) + len(numbered))
            label = names.setdefault(patch.name, len(names))
            blocks.append(_net_shapes(patch, number, part, surface, label, count))
            count += len(blocks[-1]["kind"])
        ends = np.cumsum([0, *(len(c) for c in self._cuts), *[0] * (count - len(self._kind))])
        return Surfaces(
            **{key: np.concatenate([block[key] for block in blocks]) for key in blocks[0]},
            cuts=np.concatenate([np.empty((0, 4)), *self._cuts]),
            cut_start=ends.astype(np.int64),
            patches=tuple(patch for patch, _, _ in self._nets),
            surface_names=tuple(names),
        )


def _net_shapes(patch: Patch | Trimmed, number: int, part: int, surface: int, label: int, first: int) -> dict[str, Any]:
    """Return the triangles of a patch's net, from row ``first`` of all shapes, as columns of Surfaces."""
    if isinstance(patch, Trimmed):
        corners, pq, flat = patch.corners, patch.pq, patch.at is None
    else:
        knots, faces = patch.net()
        corners, pq = patch.at(knots[:, 0], knots[:, 1])[faces], knots[faces]
        flat = _is_flat(patch, pq, corners)
    count, centre = len(corners), corners.mean(axis=1)
    numbers = np.zeros((count, NUMBERS))
    numbers[:, :9] = corners.reshape(-1, 9)
    return {
        "kind": np.full(count, TRIANGLE, np.int8),
        "numbers": numbers,
        "surface": np.full(count, surface, np.int32),
        "label": np.full(count, label, np.int32),
        "part": np.full(count, part, np.int32),
        "patch": np.full(count, -1 if flat else number, np.int32),
        "albedo": np.ones(count),
        "corner_pq": pq,
        "piece_shape": np.arange(first, first + count, dtype=np.int32),
        "piece_centre": centre,
        "piece_radius": np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1),
    }


def _is_flat(patch: Patch, pq: Floats, corners: Floats) -> bool:
    """Return whether a face is plane, at the corners (f, 3, 3) of its net and within its triangles pq (f, 3, 2)."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1)
    if not len(size) or not size.max() > 0.0:
        return False
    largest = np.argmax(size)
    unit = normal[largest] / size[largest]

    def plane(points: Floats) -> bool:
        return bool((np.abs((points - corners[largest, 0]) @ unit) <= FLAT_MM).all())

    if not plane(corners.reshape(-1, 3)):
        return False
    count = max(6, -(-FLAT_SAMPLES // len(pq)))
    shares = np.stack(within_triangle(*in_square(np.arange(count)).T), axis=1)
    samples = (pq[:, :1] + np.einsum("nk,fkc->fnc", shares, pq[:, 1:] - pq[:, :1])).reshape(-1, 2)
    return plane(patch.at(samples[:, 0], samples[:, 1]))
