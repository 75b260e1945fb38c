"""The software that made a night's figures: versions, the commit, and a digest of the sources."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import subprocess
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from processor.jobs.software import versions

PACKAGES = ("processor", "designgen")
LIBRARIES = ("numpy", "scipy", "numba", "h5py", "cadquery", "cadquery-ocp")
SOURCES = (".py", ".toml")
UNIMPORTANT = ("report", "validation")  # of processor: no figure depends on them
GIT_S = 10


@dataclass(frozen=True)
class Software:
    """``code`` is a digest of what figures depend on: sources, committed or not, and the libraries' versions.

    ``commit`` is git's, with + if files differ from it, empty without git.
    """

    code: str
    commit: str
    versions: dict[str, str]


@cache
def present() -> Software:
    """Return the software installed here."""
    machine = {"python": platform.python_version(), "machine": platform.machine()}
    installed = machine | versions(("steel-scan-check", *LIBRARIES))
    digest = hashlib.sha256(repr(sorted(installed.items())).encode())
    for package in PACKAGES:
        for path in _sources(package):
            digest.update(path.name.encode())
            digest.update(path.read_bytes())
    return Software(digest.hexdigest()[:16], _commit(), installed)


def _sources(package: str) -> list[Path]:
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        return []
    root = Path(spec.submodule_search_locations[0])
    return sorted(
        path
        for path in root.rglob("*")
        if path.suffix in SOURCES and path.relative_to(root).parts[0] not in UNIMPORTANT
    )


def _commit() -> str:
    folder = Path(__file__).parent
    env = {**os.environ, "GIT_OPTIONAL_LOCKS": "0"}

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=folder, env=env, capture_output=True, text=True, check=True, timeout=GIT_S
        ).stdout

    try:
        if not git("ls-files", __file__):  # installed below a checkout of something else
            return ""
        return git("rev-parse", "HEAD").strip() + ("+" if git("status", "--porcelain", "--", "..").strip() else "")
    except (OSError, subprocess.SubprocessError):
        return ""
