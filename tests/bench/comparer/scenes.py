"""Scenes of the references: recipes of designgen, and what is changed in them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyElement

from designgen import recipe_files
from designgen.scenes import make
from processor.model import Ceiling, Control, Scene, Truth
from processor.store import store

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SCENE, CLOUD = "scene.h5", "cloud.ply"
SEEN_MM, SURVEYED_MM = 0.7, 0.5  # of control points: target fits and total stations, one standard deviation
CONTROL_POINTS = 6
HANGER_MM = 400.0  # from the lowest node of a frame down to its ceiling


def recipes() -> dict[str, dict[str, Any]]:
    """All recipes of the references by name."""
    return tomllib.loads(Path(__file__).with_name("recipes.toml").read_text("utf-8"))


def write(name: str, seed: int, folder: str | Path) -> None:
    """Make a scene of a recipe and write it into a folder; of a pair its first cloud as well."""
    recipe = recipes()[name]
    content = recipe_files.overridden(recipe_files.load(recipe["recipe"])[1], recipe["set"])
    scene, truth = make.make(name, content, seed)
    for change in recipe.get("change", ()):
        scene, truth = CHANGES[change](scene, truth, seed)
    folder = Path(folder)
    folder.mkdir(parents=True)
    store.write_scene(folder / SCENE, scene, truth, {"recipe": name, "parameters": content, "seed": seed})
    if recipe.get("pair"):
        points = 1e-3 * (scene.scans[0].origin + scene.scans[0].points)
        rows = np.array([tuple(point) for point in points], [(axis, "f8") for axis in "xyz"])
        PlyData([PlyElement.describe(rows, "vertex")]).write(folder / CLOUD)


def without_design(scene: Scene, truth: Truth | None, seed: int) -> tuple[Scene, Truth | None]:
    """Return a space frame without its design, and no truth: its nodes have the design's names."""
    return replace(scene, frame=None), None


def with_control(scene: Scene, truth: Truth, seed: int) -> tuple[Scene, Truth]:
    """Return a scene with control points about its structure, each seen in every scan, in the order of stations."""
    draws = np.random.default_rng(seed)
    poses = truth.stations.T_project_station
    middle = poses[:, :3, 3].mean(axis=0)
    angles = 2.0 * np.pi * np.arange(CONTROL_POINTS) / CONTROL_POINTS
    offsets = np.column_stack((np.cos(angles), np.sin(angles), np.arange(CONTROL_POINTS) % 3))
    places = middle + offsets * (5000.0, 4000.0, 1500.0)
    point, scan = (rows.ravel() for rows in np.indices((CONTROL_POINTS, len(poses))))
    seen = np.einsum("mji,mj->mi", poses[scan, :3, :3], places[point] - poses[scan, :3, 3])
    control = Control(
        tuple(f"K{row + 1}" for row in range(CONTROL_POINTS)),
        positions=places + SURVEYED_MM * draws.standard_normal(places.shape),
        sd=np.full(CONTROL_POINTS, SURVEYED_MM),
        point=point,
        scan=scan,
        station=np.full_like(scan, -1),
        seen=seen + SEEN_MM * draws.standard_normal(seen.shape),
        seen_sd=np.full(len(seen), SEEN_MM),
    )
    return replace(scene, control=control), truth


def with_ceiling(scene: Scene, truth: Truth, seed: int) -> tuple[Scene, Truth]:
    """Return a space frame with a ceiling that hangs from it."""
    level = float(scene.frame.centres[:, 2].min()) - HANGER_MM
    return replace(scene, ceiling=Ceiling(level=level, clearance_mm=100.0, longest_mm=1.1 * HANGER_MM)), truth


CHANGES: dict[str, Callable[[Scene, Any, int], tuple[Scene, Any]]] = {
    one.__name__: one for one in (without_design, with_control, with_ceiling)
}
