"""The command line of designgen, or of a foreign script, that makes a scene; processor does not import designgen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


def scene_command(
    recipe: str | Path, scene: Path, seed: int, settings: Sequence[str], foreign: bool = False
) -> tuple[str, ...]:
    """Return module or script, and its arguments, that make a ``scene`` file from a recipe: a name or a TOML file.

    The recipe of a ``foreign`` scene is the script that makes it. ``settings`` are texts ``section.key=value``.
    """
    maker = (str(recipe), str(scene)) if foreign else ("designgen", "make", str(recipe), "-o", str(scene))
    return (*maker, "--seed", str(seed), *(word for setting in settings for word in ("--set", setting)))
