"""The exact surfaces of a scene as rays see them: spheres with parts cut off, cones, discs and triangles.

Curved faces without a closed form for rays are patches: a function of two numbers and a net of triangles on it. Rays
hit the net, and :func:`designgen.scanning.raycast.meet` moves the hit to the function's own surface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from processor.model import Floats, Ints, Labels

SPHERE, CONE, DISC, TRIANGLE = range(4)
NUMBERS = 14  # a shape's own: see Builder
FLAT_MM = 1e-7  # a face this near to a plane is one, and its net is the face itself
FLAT_SAMPLES = 1000  # of a face, at least
Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Patch:
    """A face: ``at(p, q)`` maps (n,) each in 0..1 to points (n, 3), mm; the net has its knots at ``p`` and ``q``.

    ``kept`` (len(p) - 1, len(q) - 1) marks the cells that exist; absent, all do. Patches of one part with one name are
    pieces of one smooth surface.
    """

    name: str
    at: Callable[[Floats, Floats], Floats]
    p: Floats
    q: Floats
    kept: Bools | None = None

    def net(self) -> tuple[Floats, Ints]:
        """Numbers (v, 2) of the knots and triangles (f, 3) of the cells that exist."""
        n = len(self.q)
        knots = np.stack(np.meshgrid(self.p, self.q, indexing="ij"), axis=-1).reshape(-1, 2)
        i, j = np.meshgrid(np.arange(len(self.p) - 1), np.arange(n - 1), indexing="ij")
        corner = (i * n + j)[np.ones(i.shape, bool) if self.kept is None else self.kept]
        quads = np.stack([corner, corner + n, corner + n + 1, corner + 1], axis=-1)
        return knots, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3).astype(np.int64)


@dataclass(frozen=True)
class Surfaces:
    """All shapes of a scene, a row each, in the scene's frame (mm).

    ``cuts`` of shape i are the rows ``cut_start[i]`` to ``cut_start[i + 1]``: unit normal and distance; what lies
    beyond them, seen from a sphere's centre, is cut off. A long shape has several bounding spheres (``piece_*``).
    """

    kind: npt.NDArray[np.int8]  # (m,)
    numbers: Floats  # (m, NUMBERS)
    surface: Labels  # (m,) row of surface_names; equal numbers of one smooth surface
    part: Labels  # (m,) row of part_names, -1 = none
    patch: Labels  # (m,) row of patches, -1 = none or a flat one, whose net is exact
    corner_pq: Floats  # (m, 3, 2) of a patch's triangles
    cuts: Floats  # (c, 4)
    cut_start: Ints  # (m + 1,)
    piece_shape: Labels  # (k,)
    piece_centre: Floats  # (k, 3)
    piece_radius: Floats  # (k,)
    patches: tuple[Patch, ...]
    surface_names: tuple[str, ...]
    surface_label: Labels  # (surfaces,) row of surface_names of each surface number


@dataclass
class Builder:
    """Collects shapes. Every ``add`` takes the part (row, -1 = none) and the surface's name."""

    _kind: list[int] = field(default_factory=list)
    _numbers: list[Floats] = field(default_factory=list)
    _surface: list[int] = field(default_factory=list)
    _part: list[int] = field(default_factory=list)
    _cuts: list[Floats] = field(default_factory=list)
    _pieces: list[tuple[int, Floats, float]] = field(default_factory=list)
    _labels: list[str] = field(default_factory=list)
    _nets: list[tuple[Patch, int]] = field(default_factory=list)

    def sphere(self, part: int, name: str, centre: Floats, radius: float, cuts: Sequence[tuple[Floats, float]]) -> None:
        """Add a sphere less the caps beyond planes of unit normal and distance from the centre."""
        table = np.array([[*normal, distance] for normal, distance in cuts]).reshape(-1, 4)
        self._add(SPHERE, part, self._name(name), [*centre, radius], [(centre, radius)], table)

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

        ``bow`` (vector (3,), from, span) moves the section at z sideways by 4 q (1 - q) vector, q = (from + z) / span.
        """
        vector, begin, span = bow or (np.zeros(3), 0.0, 1.0)
        widest = max(radii)
        pieces = max(1, int(np.ceil(length / (4.0 * widest))))
        at = (np.arange(pieces) + 0.5) * length / pieces
        q = (begin + at) / span
        centres = start + at[:, None] * axis + (4.0 * q * (1.0 - q))[:, None] * vector
        # Within a piece the axis strays from its middle by the bow's slope, 4 |bow| / span at most.
        half = 0.5 * length / pieces
        radius = float(np.hypot(half, widest + 4.0 * np.linalg.norm(vector) / span * half))
        numbers = [*start, *axis, *radii, length, *vector, begin, span]
        self._add(CONE, part, self._name(name), numbers, [(c, radius) for c in centres])

    def disc(self, part: int, name: str, centre: Floats, normal: Floats, outer: float, inner: float = 0.0) -> None:
        """Add a plane ring."""
        self._add(DISC, part, self._name(name), [*centre, *normal, outer, inner], [(centre, outer)])

    def polygon(self, part: int, name: str, corners: Floats) -> None:
        """Add a convex plane polygon of corners (n, 3)."""
        surface = self._name(name)
        for i in range(1, len(corners) - 1):
            triangle = corners[[0, i, i + 1]]
            middle = triangle.mean(axis=0)
            reach = float(np.linalg.norm(triangle - middle, axis=1).max())
            self._add(TRIANGLE, part, surface, triangle.ravel().tolist(), [(middle, reach)])

    def patch(self, part: int, patch: Patch) -> None:
        """Add a patch."""
        self._nets.append((patch, part))

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
        cuts: Floats | None = None,
    ) -> None:
        row = np.zeros(NUMBERS)
        row[: len(numbers)] = numbers
        self._pieces += [(len(self._kind), centre, radius) for centre, radius in pieces]
        self._kind.append(kind)
        self._numbers.append(row)
        self._surface.append(surface)
        self._part.append(part)
        self._cuts.append(np.empty((0, 4)) if cuts is None else cuts)

    def done(self) -> Surfaces:
        """Return all that was added."""
        plain = len(self._kind)
        kinds, numbers = [np.array(self._kind, np.int8)], [np.array(self._numbers).reshape(-1, NUMBERS)]
        surface, part = [np.array(self._surface, np.int32)], [np.array(self._part, np.int32)]
        patch, pq = [np.full(plain, -1, np.int32)], [np.zeros((plain, 3, 2))]
        owner = [np.array([p[0] for p in self._pieces], np.int32)]
        centres = [np.array([p[1] for p in self._pieces]).reshape(-1, 3)]
        radii = [np.array([p[2] for p in self._pieces])]
        count = plain
        known: dict[tuple[int, str], int] = {}
        for number, (one, of_part) in enumerate(self._nets):
            knots, faces = one.net()
            corners = one.at(knots[:, 0], knots[:, 1])[faces]
            rows = np.zeros((len(faces), NUMBERS))
            rows[:, :9] = corners.reshape(-1, 9)
            kinds.append(np.full(len(faces), TRIANGLE, np.int8))
            numbers.append(rows)
            if (of_part, one.name) not in known:  # patches of one name are pieces of one smooth surface of their part
                known[of_part, one.name] = self._name(one.name)
            surface.append(np.full(len(faces), known[of_part, one.name], np.int32))
            part.append(np.full(len(faces), of_part, np.int32))
            patch.append(np.full(len(faces), -1 if _is_flat(one, knots[faces], corners) else number, np.int32))
            pq.append(knots[faces])
            middle = corners.mean(axis=1)
            owner.append(np.arange(count, count + len(faces), dtype=np.int32))
            centres.append(middle)
            radii.append(np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1))
            count += len(faces)
        names = tuple(dict.fromkeys(self._labels))
        rows_of = {name: i for i, name in enumerate(names)}
        ends = np.cumsum([0, *(len(c) for c in self._cuts), *[0] * (count - plain)])
        return Surfaces(
            np.concatenate(kinds),
            np.concatenate(numbers),
            np.concatenate(surface),
            np.concatenate(part),
            np.concatenate(patch),
            np.concatenate(pq),
            np.concatenate([np.empty((0, 4)), *self._cuts]),
            ends.astype(np.int64),
            np.concatenate(owner),
            np.concatenate(centres),
            np.concatenate(radii),
            tuple(one for one, _ in self._nets),
            names,
            np.array([rows_of[label] for label in self._labels], np.int32),
        )


def _is_flat(patch: Patch, pq: Floats, corners: Floats) -> bool:
    """Say whether a face is plane: at the corners (f, 3, 3) of its net, and within its triangles, of pq (f, 3, 2)."""
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
    # Spread evenly over a triangle, and in step with nothing.
    number = np.arange(max(6, -(-FLAT_SAMPLES // len(pq))))
    shares = (0.5 + np.outer(number, [0.7548776662466927, 0.5698402909980532])) % 1.0
    over = shares.sum(axis=1) > 1.0
    shares[over] = 1.0 - shares[over]
    samples = (pq[:, :1] + np.einsum("nk,fkc->fnc", shares, pq[:, 1:] - pq[:, :1])).reshape(-1, 2)
    return plane(patch.at(samples[:, 0], samples[:, 1]))
