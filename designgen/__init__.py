"""Makes designs of steel structures, and synthetic laser scans of them with their truth."""

from __future__ import annotations

import os
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from processor.version import __version__

if TYPE_CHECKING:
    from processor.model import Scene, Truth

__all__ = ["__version__", "make", "scan"]


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


def scan(
    model: Any,
    stations: int | str | PathLike[str] = 6,
    scanner: str = "phase",
    seed: int = 0,
    units: str = "",
    settings: Mapping[str, Any] | None = None,
) -> tuple[Scene, Truth]:
    """Scan a model from stations around it: a scene of a structure, with its truth.

    Hits lie on the model's surfaces, not on facets. Notes on the model are warnings of the logger "designgen".

    Parameters
    ----------
    model
        Path of a STEP, IFC, PLY, STL or OBJ file, or of a Python file, which is run and leaves a CadQuery object in
        ``result``; a CadQuery Workplane, Shape or Assembly; or vertices (v, 3) in mm and faces (f, 3) of a mesh.
    stations
        Number of stations, placed where each adds most to the surface that is seen; or a JSON file of their positions
        in mm in the model's frame: ``{"S1": {"position": [x, y, z]}, ...}``.
    scanner
        Class of scanner: phase, pulse, long-range or another of ``processor/model/scanners.toml``, or the path of a
        scanner.toml.
    seed
        Seed of all random numbers, from 0.
    units
        Unit of a file's numbers, in place of that in the file; "": that in the file, mm for a mesh.
    settings
        Further values of a recipe by ``"section.key"``, e.g. ``{"scan.step_mrad": 1.0}``.

    Returns
    -------
    scene : processor.model.Scene
        A scan of each station (n, 3) in its scanner's frame with its pose, and the model's mesh as the design; mm, rad.
    truth : processor.model.Truth
        True poses of the stations, and of every point its body, face, range error and incidence.

    Raises
    ------
    processor.model.InputError
        For a model that cannot be read, or has no surface.
    processor.model.UsageError
        For unknown settings, units or classes of scanner.

    Examples
    --------
    >>> corners = [[0, 0, 0], [900, 0, 0], [0, 900, 0], [0, 0, 900]]
    >>> sides = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
    >>> scene, truth = designgen.scan((corners, sides), stations=2, settings={"scan.step_mrad": 5.0})
    >>> [scan.station for scan in scene.scans]
    ['S1', 'S2']
    """
    from designgen.models import loading
    from designgen.scenes import make as scenes
    from designgen.scenes import model as models

    of_file = isinstance(model, str | os.PathLike)
    name = Path(model).stem if of_file else "model"
    recipe = models.recipe_of(str(model) if of_file else name, stations, scanner, units, settings or {})
    return scenes.make(name, recipe, seed, None if of_file else loading.load(model, units, name))
