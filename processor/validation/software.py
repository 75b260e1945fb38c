"""What made a night's figures: versions, the commit, and a digest of the sources themselves."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import subprocess
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("processor", "designgen")
LIBRARIES = ("numpy", "scipy", "numba", "h5py", "cadquery", "cadquery-ocp")
SOURCES = (".py", ".toml")
UNIMPORTANT = ("report", "validation")  # of processor: they move no figure
GIT_S = 10


@dataclass(frozen=True)
class Software:
    """``code`` is a digest of what figures depend on: sources, committed or not, and the libraries' versions.

    ``commit`` is git's, with + where files differ from it, empty where there is no git.
    """

    code: str
    commit: str
    versions: dict[str, str]


@cache
def present() -> Software:
    """Look at what is installed here."""
    versions = {"python": platform.python_version(), "machine": platform.machine()}
    for name in ("steel-scan-check", *LIBRARIES):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    digest = hashlib.sha256(repr(sorted(versions.items())).encode())
    for package in PACKAGES:
        for path in _sources(package):
            digest.update(path.name.encode())
            digest.update(path.read_bytes())
    return Software(digest.hexdigest()[:16], _commit(), versions)


def _sources(package: str) -> list[Path]:
    found = importlib.util.find_spec(package)
    if found is None or not found.submodule_search_locations:
        return []
    root = Path(found.submodule_search_locations[0])
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
