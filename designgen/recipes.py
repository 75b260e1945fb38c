"""Recipes: TOML files that name a scene's kind, sizes and scan. The named ones lie beside this file in ``recipes/``."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from processor.model import InputError, UsageError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Recipe = dict[str, Any]


def named() -> dict[str, Recipe]:
    """All named recipes, by name."""
    folder = resources.files("designgen") / "recipes"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=lambda f: f.name)
    return {f.name[: -len(".toml")]: tomllib.loads(f.read_text("utf-8")) for f in files}


def load(name_or_path: str) -> tuple[str, Recipe]:
    """Load a recipe by name, or from a TOML file: its name and content.

    Raises UsageError for a name that does not exist, InputError for a file that cannot be read.
    """
    known = named()
    if name_or_path in known:
        return name_or_path, known[name_or_path]
    path = Path(name_or_path)
    if path.suffix != ".toml":
        raise UsageError(f"no recipe {name_or_path!r}; there are {', '.join(known)}, or give a .toml file")
    try:
        return path.stem, tomllib.loads(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: not a readable recipe: {error}") from error


def overridden(recipe: Mapping[str, Any], settings: Sequence[str]) -> Recipe:
    """Copy a recipe with ``section.key=value`` settings; values are read as TOML, bare words as text."""
    result = {key: dict(value) if isinstance(value, dict) else value for key, value in recipe.items()}
    for setting in settings:
        path, equals, text = setting.partition("=")
        if not equals:
            raise UsageError(f"--set {setting}: expected section.key=value")
        *sections, key = path.strip().split(".")
        table = result
        for section in sections:
            table = table.setdefault(section, {})
            if not isinstance(table, dict):
                raise UsageError(f"--set {setting}: {section} is not a section")
        try:
            table[key] = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            table[key] = text
    return result
