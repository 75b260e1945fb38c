"""Scenes and solids that tests need are made once: later workers and runs read them from the disk.

A thing is kept under a key of all that made it: the sources of the module of its function and of all modules that
those import, the TOML files beside them, the arguments, the versions of the libraries. So a change of any of them makes
it anew.
"""

import fcntl
import hashlib
import importlib.metadata
import pickle
import platform
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from tests.support.structure import ROOT, imports

FOLDER = ROOT / ".pytest_cache" / "made"
LIBRARIES = ("numpy", "scipy", "numba", "cadquery", "cadquery-ocp", "trimesh", "open3d", "h5py")
KEPT_DAYS = 7.0  # without use: longer than a pause of work, and the folder does not grow for ever

T = TypeVar("T")


def made(function: Callable[..., T], *arguments: Any) -> T:
    """Return a copy of what a function of a module makes of arguments; they differ where their ``repr`` does.

    Keep it in a module whose imports are those of what is made: one that imports ``processor`` makes anew after every
    change of that package.
    """
    path = FOLDER / f"{function.__qualname__}-{_key(function, repr(arguments))}.pickle"
    if not path.exists():
        FOLDER.mkdir(parents=True, exist_ok=True)
        with path.with_suffix(".lock").open("a") as lock:  # other workers wait for the one that makes it
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not path.exists():
                _discard_old()
                part = path.with_suffix(".part")
                part.write_bytes(pickle.dumps(function(*arguments), protocol=5))
                part.replace(path)
    path.touch()
    result: T = pickle.loads(path.read_bytes())
    return result


def _key(function: Callable[..., Any], arguments: str) -> str:
    text = "\n".join((_sources(function.__module__), function.__qualname__, arguments, platform.python_version()))
    return hashlib.sha256(text.encode()).hexdigest()[:24]


@cache
def _sources(module: str) -> str:
    """Return a digest of the sources of a module and of all of this project that it imports, and of the libraries."""
    digest = hashlib.sha256("".join(f"{name} {_version(name)} " for name in LIBRARIES).encode())
    files = _files(module)
    for path in sorted(files | {data for source in files for data in source.parent.glob("*.toml")}):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _files(module: str) -> set[Path]:
    waiting, known = [module], set()
    while waiting:
        path = _file(waiting.pop())
        if path is not None and path not in known:
            known.add(path)
            waiting += imports(path)
    return known


def _file(module: str) -> Path | None:
    place = ROOT.joinpath(*module.split("."))
    for path in (place.with_suffix(".py"), place / "__init__.py"):
        if path.exists():
            return path
    return None


def _version(library: str) -> str:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return "none"


def _discard_old() -> None:
    oldest = time.time() - KEPT_DAYS * 86_400.0
    for path in FOLDER.glob("*.*"):
        try:
            if path.stat().st_mtime < oldest:
                path.unlink()
        except FileNotFoundError:  # another worker was here
            continue
