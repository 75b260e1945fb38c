"""The software that made a night's figures: versions, the commit, and a digest of the sources."""

from __future__ import annotations

import hashlib
import os
import platform
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from processor.jobs import process
from processor.jobs.causes import Cause
from processor.jobs.software import source_digest, versions

PACKAGES = ("processor", "designgen")
LIBRARIES = ("numpy", "scipy", "numba", "h5py", "cadquery", "cadquery-ocp")
SOURCES = (".py", ".toml")
NOT_DIGESTED = ("report",)  # of processor: tables, figures and pages, which no figure of a night is read from
GIT_S = 10  # a repository on a network drive answers within seconds


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
    checkout = Path(__file__).parents[2]
    if not (checkout / ".git").exists():  # installed, perhaps below a checkout of something else
        return ""

    def git(*words: str) -> str:
        with tempfile.TemporaryFile() as output:
            command = ("git", "-C", str(checkout), *words)
            ended = process.run(command, env={**os.environ, "GIT_OPTIONAL_LOCKS": "0"}, stdout=output, timeout_s=GIT_S)
            if ended.cause is not Cause.EXIT or ended.code:
                raise OSError(ended.last_line)
            output.seek(0)
            return output.read().decode().strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--", "processor") else "")
    except OSError:
        return ""
