"""Bodies of STEP and IFC files: triangle meshes in mm, refined until they keep a deviation from the CAD surface."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from processor.model import Floats, InputError, Ints

TESSELLATION_MM = 0.05
COARSE_SHARE = 1e-3  # of a body's size: where meshing starts
COARSER = 10.0  # a mesh than the next
LARGEST_MM = 1e9
NO_UNIT = "says no unit of length that is known; name it with --units"
UNITS_MM = {
    "millimetre": 1.0, "mm": 1.0, "centimetre": 10.0, "cm": 10.0, "decimetre": 100.0, "metre": 1000.0, "m": 1000.0,
    "kilometre": 1e6, "micrometre": 1e-3, "inch": 25.4, "in": 25.4, "foot": 304.8, "ft": 304.8, "yard": 914.4,
}  # fmt: skip


@dataclass(frozen=True)
class Body:
    """A solid of a CAD file, or a surface without a volume: vertices (v, 3) in mm and triangles (f, 3).

    ``closed`` says whether the mesh has no open edge; ``deviation_mm`` how far it may be from the body, by the kernel's
    own figure; ``volume_mm3`` is NaN for a surface.
    """

    name: str
    solid: bool
    closed: bool
    vertices: Floats
    faces: Ints
    volume_mm3: float
    area_mm2: float
    deviation_mm: float

    @property
    def size_mm(self) -> Floats:
        """Sizes (3,) of the box around it."""
        found: Floats = np.ptp(self.vertices, axis=0)
        return found


@dataclass(frozen=True)
class CadFile:
    """The unit of a file's numbers and its size, the unit that the file says ("" if none), its bodies, what was lost.

    ``unit`` and ``unit_said`` differ where another unit was asked for.
    """

    unit: str
    unit_mm: float
    unit_said: str
    bodies: tuple[Body, ...]
    problems: tuple[str, ...]


# --- from process to process -----------------------------------------------------------------------------------------


# --- the text --------------------------------------------------------------------------------------------------------


# --- units and meshes ------------------------------------------------------------------------------------------------


def unit_name(path: str, said: str, size_mm: float) -> tuple[str, list[str]]:
    """Name a unit by its size, which is what counts, and say where the file's own name for it is another.

    Raises InputError for a size that is none.
    """
    if not 0.0 < size_mm < float("inf"):
        raise InputError(f"{path}: says a unit of length of {size_mm:.10g} mm; name it with --units")
    said = said.strip().lower()
    fitting = [name for name, size in UNITS_MM.items() if abs(size / size_mm - 1.0) < 1e-6]
    if said in UNITS_MM and said not in fitting:
        return f"{size_mm:.10g} mm", [f"the file calls {size_mm:.10g} mm {said}; name the unit with --units if wrong"]
    if fitting:
        return (said if said in fitting else fitting[0]), []
    return (said if re.fullmatch(r"[\w. -]{1,40}", said) else f"{size_mm:.10g} mm"), []


def finest_mm(path: str, name: str, size_mm: float, most: int, triangles: Callable[[float], int]) -> float:
    """Return the deviation of the last mesh made by ``triangles``: the aimed at, or what keeps near ``most`` triangles.

    ``triangles`` makes the mesh of a deviation in mm and counts it. The number of a doubly curved body goes with one
    over the deviation, that of any other slower, so that a coarse mesh tells before much time and memory are taken.
    Raises InputError for a body that is too large to be one.
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
    """Tell whether the triangles along every edge run one way as often as the other, so that they hold a volume."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    low, high = edges.min(axis=1), edges.max(axis=1)
    _, which = np.unique(low * (int(high.max(initial=0)) + 1) + high, return_inverse=True)
    balance = np.bincount(which.reshape(-1), weights=np.where(edges[:, 0] == low, 1.0, -1.0))
    return bool(len(faces)) and not balance.any()
