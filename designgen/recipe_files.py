"""Recipes: TOML files with a scene's kind, sizes and scan. The named ones are in the folder ``recipes``."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any

from processor.model import InputError, UsageError, did_you_mean
from processor.plain_text import tomllib

Recipe = dict[str, Any]


def named() -> dict[str, Recipe]:
    """Return all named recipes, by name."""
    folder = resources.files("designgen") / "recipes"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=lambda f: f.name)
    return {f.name[: -len(".toml")]: tomllib.loads(f.read_text("utf-8")) for f in files}


def load(name_or_path: str | PathLike[str]) -> tuple[str, Recipe]:
    """Return name and content of a recipe, by its name or from a TOML file.

    Raises UsageError for an unknown name, InputError for a file that cannot be read.
    """
    recipes = named()
    name = str(name_or_path)
    if name in recipes:
        return name, recipes[name]
    path = Path(name)
    if path.suffix != ".toml":
        like = did_you_mean(name, recipes)
        raise UsageError(f"no recipe {name!r}{like}; there are {', '.join(recipes)}, or give a .toml file")
    try:
        content = tomllib.loads(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: not a readable recipe: {error}") from error
    return path.stem, with_files_in(content, path.parent)  # a recipe names files beside it


def with_files_in(recipe: Recipe, folder: str | PathLike[str]) -> Recipe:
    """Return a recipe whose relative paths of files begin with a folder."""
    model = recipe.get("model")
    if not isinstance(model, dict):
        return recipe
    paths = {key: model[key] for key in ("file", "stations") if isinstance(model.get(key), str) and model[key]}
    return {**recipe, "model": {**model, **{key: str(Path(folder, path)) for key, path in paths.items()}}}


def overridden(recipe: Mapping[str, Any], settings: Sequence[str] | Mapping[str, Any]) -> Recipe:
    """Return a copy of a recipe with settings: values by ``section.key``, or texts ``section.key=value``.

    The values of texts are read as TOML, or taken as text where they are not TOML. Raises UsageError for a text without
    a value, and for a section that is a value in the recipe.
    """
    if not isinstance(settings, Mapping | list | tuple) or not all(isinstance(setting, str) for setting in settings):
        raise UsageError(f'settings: expected a mapping by "section.key", got {settings!r}')
    pairs: Iterable[tuple[str, Any]]
    pairs = settings.items() if isinstance(settings, Mapping) else [_parsed(setting) for setting in settings]
    result = copy.deepcopy(dict(recipe))
    for path, value in pairs:
        *sections, key = path.split(".")
        table = result
        for section in sections:
            table = table.setdefault(section, {})
            if not isinstance(table, dict):
                raise UsageError(f"setting {path}: {section} is not a section")
        table[key] = _as_toml(value)
    return result


def _parsed(setting: str) -> tuple[str, Any]:
    path, equals, text = setting.partition("=")
    if not equals:
        raise UsageError(f"--set {setting}: expected section.key=value")
    try:
        return path.strip(), tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return path.strip(), text


def _as_toml(value: Any) -> Any:
    """Return a value with the types of TOML: lists for tuples and arrays, Python's numbers for NumPy's."""
    value = value.tolist() if hasattr(value, "tolist") else value
    return [_as_toml(item) for item in value] if isinstance(value, list | tuple) else value
