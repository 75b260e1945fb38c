"""The software that made a night's figures: versions, the commit, and a digest of the sources."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from processor.jobs.software import source_digest, versions

PACKAGES = ("processor", "designgen")
LIBRARIES = ("numpy", "scipy", "numba", "h5py", "cadquery", "cadquery-ocp")
SOURCES = (".py", ".toml")
NOT_DIGESTED = ("report",)  # of processor: tables, figures and pages, which no figure of a night is read from
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
    sources = source_digest(PACKAGES, SOURCES, NOT_DIGESTED)
    digest = hashlib.sha256(repr([*sorted(installed.items()), sources]).encode())
    return Software(digest.hexdigest()[:16], _commit(), installed)


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
