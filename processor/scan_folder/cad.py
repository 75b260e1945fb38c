"""STEP and IFC designs as meshes, made by ``designgen import`` in a process of its own: no CAD kernel is loaded here.

What was made once is kept for the next time, under the hash of the file's bytes, in the user's cache folder.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from processor.jobs import process
from processor.model import Floats, InputError, Ints
from processor.version import __version__

SUFFIXES = (".step", ".stp", ".ifc")
LIMIT_S = 900.0  # designgen has a limit of its own, with a better message, below this one
NO_UNIT = "no unit of length"
SAID = "import.json"


def read(path: Path, unit: str) -> tuple[Floats, Ints]:
    """Vertices (v, 3) in mm and triangles (f, 3) of all bodies of a CAD file, one after another.

    ``unit`` is that of a file that names none. Raises InputError without designgen, and for a file that it cannot take
    whole.
    """
    from processor.scan_folder.meshes import read_mesh

    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    key = hashlib.sha256(b"\0".join((content, path.suffix.lower().encode(), unit.encode(), __version__.encode())))
    with _cache() as cache:
        meshes = cache / key.hexdigest()
        if not (meshes / SAID).is_file():
            _import(path, content, unit, cache, meshes)
        bodies = [read_mesh(meshes / one) for one in _names(meshes, path)]
    counts = np.cumsum([0, *(len(vertices) for vertices, _ in bodies)])
    faces = [faces + first for (_, faces), first in zip(bodies, counts.tolist(), strict=False)]
    return np.concatenate([vertices for vertices, _ in bodies]), np.concatenate(faces)


def _names(meshes: Path, path: Path) -> list[str]:
    try:
        said = json.loads((meshes / SAID).read_text("utf-8"))
        names = [str(body["mesh"]) for body in said["bodies"]]
        problems = [str(problem) for problem in said["problems"]]
    except (OSError, ValueError, KeyError, TypeError):
        shutil.rmtree(meshes, ignore_errors=True)
        raise InputError(f"{meshes}: is damaged, and removed; run again") from None
    if problems:
        more = f", and {len(problems) - 1} more" if len(problems) > 1 else ""
        raise InputError(f"{path}: not all of it could be turned into meshes ({problems[0]}{more}); export it again")
    if not names or any(Path(name).name != name for name in names):
        raise InputError(f"{path}: no body of it could be turned into a mesh; export it with solids or surfaces")
    return names


@contextmanager
def _cache() -> Iterator[Path]:
    """Give the folder of what was made before; one that is gone afterwards where the user can have none."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    place = Path(home, "steel-scan-check", "cad")
    if place.is_absolute():
        with suppress(OSError):
            place.mkdir(parents=True, exist_ok=True)
            if os.access(place, os.W_OK):
                yield place
                return
    with tempfile.TemporaryDirectory() as temporary:
        yield Path(temporary)


def _designgen(path: Path) -> list[str]:
    """Return the command of designgen: of this installation, or another one on the search path."""
    if importlib.util.find_spec("designgen") and importlib.util.find_spec("cadquery"):
        return [sys.executable, "-m", "designgen"]
    found = shutil.which("designgen")
    if found:
        return [found]
    raise InputError(
        f"{path}: to be turned into a mesh it needs designgen with its CAD kernel: "
        "pip install 'steel-scan-check[designgen]'"
    )


def _import(path: Path, content: bytes, unit: str, cache: Path, meshes: Path) -> None:
    """Make the meshes; they come to be at ``meshes`` whole."""
    command = _designgen(path)
    try:
        making = Path(tempfile.mkdtemp(prefix=".making-", dir=cache))
    except OSError as error:
        raise InputError(f"{cache}: cannot be written ({error.strerror or error})") from error
    try:
        # A copy of the bytes that were hashed, under a name that no program takes for an option.
        source = making / f"design{path.suffix.lower()}"
        source.write_bytes(content)
        failure = _run(command, source, making / "meshes", "")
        if failure and NO_UNIT in failure:
            failure = _run(command, source, making / "meshes", unit)
        if failure:
            raise InputError(f"{path}: {failure.replace(f'{source}: ', '')}")
        with suppress(OSError):  # another process was faster
            os.replace(making / "meshes", meshes)
        if not meshes.is_dir():
            raise InputError(f"{path}: designgen import left no meshes")
    except OSError as error:
        raise InputError(f"{cache}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(making, ignore_errors=True)


def _run(command: list[str], source: Path, out: Path, unit: str) -> str:
    """Run designgen import; what it says where there are no meshes in the end."""
    units = ["--units", unit] if unit else []
    ended = process.run([*command, "import", str(source), "-o", str(out), *units], own_group=False, timeout_s=LIMIT_S)
    if ended.cause is process.Cause.TIME:
        return f"designgen import did not end within {LIMIT_S:g} s"
    if (out / SAID).is_file():
        return ""
    code = -ended.code if ended.cause is process.Cause.SIGNAL else ended.code
    return ended.last_line.removeprefix("error: ") or f"designgen import ended with exit code {code}"
