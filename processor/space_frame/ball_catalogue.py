"""Catalogues of the radii in which spheres are made: data of the package, the user's list, or none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources

import numpy as np

from processor.model import Checked, Floats, UsageError, column
from processor.plain_text import tomllib

DEFAULT = "plausible"
ESTIMATED, DESIGNED = "estimated", "design"


@dataclass(frozen=True)
class Catalogue(Checked):
    """Radii (m,) of spheres in mm, ascending, and the standard deviation of a manufactured radius about its size.

    Without radii in the catalogue a sphere's radius is free.
    """

    radii: Floats = column("m")
    sd_mm: float = 0.4
    name: str = ""
    verified: bool = False  # the sizes were compared with a published catalogue, or are the design's own

    @property
    def assumed(self) -> bool:
        """Whether nobody stated the sizes: those of the package stand for an unknown catalogue."""
        return self.name == DEFAULT

    @property
    def estimated(self) -> bool:
        """Whether the sizes are estimates from the balls."""
        return self.name == ESTIMATED

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.sd_mm > 0.0 or not (self.radii > 0.0).all() or not np.isfinite(self.radii).all():
            raise UsageError("catalogue of balls: expected radii and a standard deviation above 0 mm")
        if (np.diff(self.radii) <= 0.0).any():
            raise UsageError("catalogue of balls: expected each radius once, in ascending order")


def load(name: str = DEFAULT) -> Catalogue:
    """Load a catalogue of the package by name. Raises UsageError for an unknown name, with those available."""
    known = tomllib.loads((resources.files("processor.space_frame") / "catalogues.toml").read_text("utf-8"))
    if name not in known:
        raise UsageError(f"catalogue of balls: expected one of {', '.join(known)}, got {name!r}")
    entry = known[name]
    return Catalogue(np.array(entry["radii_mm"], np.float64), entry["sd_mm"], name, entry["verified"])


def of_radii(radii_mm: Sequence[float], sd_mm: float = 0.4, name: str = "given") -> Catalogue:
    """Make a catalogue of the user's list, in any order; an empty list leaves the radius free."""
    return Catalogue(np.unique(np.array(radii_mm, np.float64)), sd_mm, name, False)
