"""Bodies of STEP and IFC files: triangle meshes in mm, refined to a deviation from the CAD surface."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from designgen.cad.face_surfaces import Forms
from processor.model import Floats, InputError, Ints

TESSELLATION_MM = 0.05  # deviation aimed at
EDGE_SHARE = 0.1  # of it at edges, where the forms of faces are known: a scanned point departs by that at most
ANGLE_RAD = 0.1  # largest angle between adjacent facets of a curved face
COARSE_SHARE = 1e-3  # deviation of the first mesh as a fraction of the body's size
COARSER = 10.0  # largest ratio of the deviations of a mesh and the next
LARGEST_MM = 1e9  # 1000 km: a unit is wrong; as large as a record allows a coordinate to be
NO_UNIT = "states no known unit of length; name it with --units"
UNITS_MM = {
    "millimetre": 1.0, "mm": 1.0, "centimetre": 10.0, "cm": 10.0, "decimetre": 100.0, "metre": 1000.0, "m": 1000.0,
    "kilometre": 1e6, "micrometre": 1e-3, "inch": 25.4, "in": 25.4, "foot": 304.8, "ft": 304.8, "yard": 914.4,
    "dm": 100.0, "km": 1e6, "us-ft": 1_200_000.0 / 3937.0,
}  # fmt: skip


@dataclass(frozen=True)
class Body:
    """A solid of a CAD file, or a surface without a volume: vertices (v, 3) in mm and triangles (f, 3).

    ``closed``: the mesh has no open edge. ``deviation_mm`` is the kernel's figure of the largest distance between mesh
    and body. ``volume_mm3`` is NaN for a surface. ``forms`` are the surfaces of its faces, where they were asked for.
    """

    name: str
    solid: bool
    closed: bool
    vertices: Floats
    faces: Ints
    volume_mm3: float
    area_mm2: float
    deviation_mm: float
    forms: Forms | None = None

    @property
    def size_mm(self) -> Floats:
        """Sizes (3,) of the axis-aligned bounding box, mm."""
        sizes: Floats = np.ptp(self.vertices, axis=0)
        return sizes


@dataclass(frozen=True)
class CadFile:
    """The bodies of a CAD file, and as ``problems`` what could not be read.

    ``unit`` and its size ``unit_mm`` are those of the file's numbers; ``unit_stated`` is that in the file, ""
    for none. The two differ where another unit was requested.
    """

    unit: str
    unit_mm: float
    unit_stated: str
    bodies: tuple[Body, ...]
    problems: tuple[str, ...]


def unit_name(path: str, given: str, size_mm: float) -> tuple[str, list[str]]:
    """Return the name of a unit by its size, and a problem where the name ``given`` in the file contradicts the size.

    Raises InputError for a size that is not positive and finite.
    """
    if not 0.0 < size_mm < float("inf"):
        raise InputError(f"{path}: states a unit of length of {size_mm:.10g} mm; name it with --units")
    given = given.strip().lower()
    fitting = [name for name, size in UNITS_MM.items() if abs(size / size_mm - 1.0) < 1e-6]
    if given in UNITS_MM and given not in fitting:
        return f"{size_mm:.10g} mm", [f"the file calls {size_mm:.10g} mm {given}; name the unit with --units if wrong"]
    if fitting:
        return (given if given in fitting else fitting[0]), []
    return (given if re.fullmatch(r"[\w. -]{1,40}", given) else f"{size_mm:.10g} mm"), []


def finest_mm(path: str, name: str, size_mm: float, most: int, triangles: Callable[[float], int]) -> float:
    """Refine a mesh to TESSELLATION_MM, or to about ``most`` triangles; return the deviation of the last mesh, mm.

    ``triangles`` makes the mesh of a deviation in mm and returns the number of its triangles. That number is inversely
    proportional to the deviation on doubly curved bodies and grows more slowly on others. So a coarse mesh predicts the
    time and memory of a finer one. Raises InputError for a body too large to be real.
    """
    if not size_mm < LARGEST_MM:
        raise InputError(f"{path}: {name!r} is {size_mm:.3g} mm large; is its unit right? name it with --units")
    deviation = max(TESSELLATION_MM, COARSE_SHARE * size_mm)
    while True:
        count = triangles(deviation)
        finer = max(TESSELLATION_MM, deviation / COARSER, deviation * count / most)
        if finer > 0.9 * deviation:
            return deviation
        deviation = finer


def is_closed(faces: Ints) -> bool:
    """Return whether every edge is used equally often in both directions, so that the triangles enclose a volume."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    low, high = edges.min(axis=1), edges.max(axis=1)
    _, which = np.unique(low * (int(high.max(initial=0)) + 1) + high, return_inverse=True)
    balance = np.bincount(which.reshape(-1), weights=np.where(edges[:, 0] == low, 1.0, -1.0))
    return bool(len(faces)) and not balance.any()
