"""Makes designs of steel structures, and synthetic laser scans of them with their truth."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from processor.model import Scene, Truth

__version__ = "0.1.0"
__all__ = ["__version__", "make"]


def make(
    recipe: str | PathLike[str], seed: int | None = None, settings: Mapping[str, Any] | None = None
) -> tuple[Scene, Truth]:
    """Make the scene of a recipe and its truth.

    The same recipe, seed and settings give the same scene, whatever the time, host and number of threads.

    Parameters
    ----------
    recipe
        Name of a recipe (``designgen list`` shows them), or the path of a TOML file.
    seed
        Seed of all random numbers, from 0; None: that of the recipe.
    settings
        Values that replace those of the recipe, by ``"section.key"``, e.g. ``{"scan.sigma_mm": 2.0}``.

    Returns
    -------
    scene : processor.model.Scene
        Scans and design. Lengths are in mm, angles in rad. Points (n, 3) are in the frame of their scan, which is given
        by ``T_project_scan`` where it is known. Scans of an arch bridge's parts are in unknown frames.
    truth : processor.model.Truth
        True poses, dimensions and labels of the points. ``T_a_b`` maps coordinates in frame b to frame a.

    Raises
    ------
    processor.model.UsageError
        For an unknown recipe, section or key, a value of another type, and a size that cannot be built.
    processor.model.InputError
        For a TOML file that cannot be read.

    Examples
    --------
    >>> import designgen
    >>> scene, truth = designgen.make("arch-s1", seed=1, settings={"scan.sigma_mm": 2.0, "scan.spacing_mm": 50.0})
    >>> [scan.component for scan in scene.scans]
    ['foot1', 'rib1', 'rib2', 'rib3', 'foot2']
    >>> truth.arch.T_bridge_scan.shape
    (5, 4, 4)
    """
    # Imported here, so that the package itself loads at once.
    from designgen import recipe_files
    from designgen.scenes import make as scenes

    name, content = recipe_files.load(recipe)
    return scenes.make(name, recipe_files.overridden(content, settings or {}), seed)
