"""STEP and IFC designs as meshes, converted by ``designgen import`` in a separate process.

No CAD kernel is loaded here. Meshes are cached in the user's cache folder under the hash of the file's bytes,
with a hash of their own: those that have changed are made again.
"""

from __future__ import annotations

import grp
import hashlib
import importlib.util
import json
import os
import pwd
import re
import shutil
import stat
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from processor.jobs import process
from processor.jobs.causes import Cause
from processor.meshes.mesh_files import read_whole
from processor.model import DesignBodies, Floats, InputError, Ints
from processor.scan_folder.files import CAD_SUFFIXES as SUFFIXES
from processor.store.making import beside
from processor.version import __version__

__all__ = ["SUFFIXES", "read"]

LIMIT_S = 900.0  # designgen has a lower limit, with a better message
RECORD, CHECKSUM = "import.json", "sha256"
SOURCE = "design"  # stem of the copy that is imported, by which bodies without names are numbered
UNNAMED = rf"{SOURCE}-\d+"


def read(path: Path, unit: str) -> tuple[Floats, Ints, DesignBodies, str]:
    """Return vertices (v, 3) in mm and triangles (f, 3) of all bodies of a CAD file, the bodies, and its unit.

    ``unit`` is that of a file that states none, for which the one returned is "". Raises InputError without designgen,
    and for a file that cannot be converted completely.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", path=path) from None
    key = hashlib.sha256(b"\0".join((content, path.suffix.lower().encode(), unit.encode(), __version__.encode())))
    with _cache() as cache:
        meshes = cache / key.hexdigest()
        if not _is_whole(meshes):
            shutil.rmtree(meshes, ignore_errors=True)
            _import(path, content, unit, cache, meshes)
        record, stated = _record(meshes, path)
        bodies = [read_whole(meshes / mesh) for _, mesh in record]
    counts = np.cumsum([0, *(len(vertices) for vertices, _ in bodies)])
    faces = [faces + first for (_, faces), first in zip(bodies, counts.tolist(), strict=False)]
    named = _named([name for name, _ in record], [len(triangles) for _, triangles in bodies])
    return np.concatenate([vertices for vertices, _ in bodies]), np.concatenate(faces), named, stated


def _is_whole(meshes: Path) -> bool:
    """Whether an import is there and has the bytes that it was made with."""
    with suppress(OSError):
        return (meshes / CHECKSUM).read_text("ascii") == _sha256(meshes)
    return False


def _sha256(meshes: Path) -> str:
    """Return the hash of the names and bytes of an import's files."""
    digest = hashlib.sha256()
    for file in sorted(meshes.iterdir()):
        if file.name != CHECKSUM:
            content = file.read_bytes()
            digest.update(f"{file.name}\0{len(content)}\0".encode("utf-8", "surrogateescape") + content)
    return digest.hexdigest()


def _named(names: list[str], facets: list[int]) -> DesignBodies:
    """Return bodies of so many facets under unique names: "web", "web (2)", and "body 3" where the file has no name."""
    unnamed = [not name or re.fullmatch(UNNAMED, name) is not None for name in names]
    said = [f"body {k + 1}" if none else name for k, (name, none) in enumerate(zip(names, unnamed, strict=True))]
    count = Counter(said)
    taken, result = set(said), list[str]()
    before = Counter[str]()
    for name in said:
        before[name] += 1
        free = name
        while free in taken and before[name] > 1:
            free = f"{name} ({before[name]})"
            before[name] += free in taken
        taken.add(free)
        result.append(free)
    return DesignBodies(
        names=tuple(result),
        of_facet=np.repeat(np.arange(len(names)), facets),
        shared=sum(number for number in count.values() if number > 1),
        unnamed=sum(unnamed),
    )


def _record(meshes: Path, path: Path) -> tuple[list[tuple[str, str]], str]:
    """Return name and mesh of each body of an import, and the unit that the file states."""
    try:
        record = json.loads((meshes / RECORD).read_text("utf-8"))
        names = [(str(body.get("name", "")), str(body["mesh"])) for body in record["bodies"]]
        problems = [str(problem) for problem in record["problems"]]
        stated = str(record.get("unit_stated") or "")
    except (OSError, ValueError, KeyError, TypeError):
        shutil.rmtree(meshes, ignore_errors=True)
        raise InputError("was damaged and has been removed; run again", path=meshes) from None
    if problems:
        more = f", and {len(problems) - 1} more" if len(problems) > 1 else ""
        raise InputError(f"cannot be converted to meshes completely ({problems[0]}{more}); export it again", path=path)
    if not names or any(Path(mesh).name != mesh for _, mesh in names):
        raise InputError("expected solids or surfaces, found none; export it with them", path=path)
    return names, stated


@contextmanager
def _cache() -> Iterator[Path]:
    """Yield the cache folder, or a temporary one where the user's cannot be written, or others can write to it."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    place = Path(home, "steel-scan-check", "cad")
    if place.is_absolute():
        with suppress(OSError):
            place.mkdir(parents=True, exist_ok=True, mode=0o700)
            place = place.resolve()  # a link in it may be changed meanwhile
            if os.access(place, os.W_OK) and _is_private(place):
                yield place
                return
    with beside() as temporary:
        yield temporary


def _is_private(place: Path) -> bool:
    """Whether nobody else can put meshes into a folder, or another folder in its place (root can)."""
    me = os.geteuid()
    for folder in (place, *place.parents):
        found = folder.stat()
        if found.st_uid not in ((me,) if folder == place else (me, 0)):
            return False
        sticky = folder != place and found.st_mode & stat.S_ISVTX  # only its owner renames what lies in it
        writable = found.st_mode & stat.S_IWOTH or (found.st_mode & stat.S_IWGRP and not _own_group(found.st_gid, me))
        if writable and not sticky:
            return False
    return True


def _own_group(number: int, user: int) -> bool:
    """Whether a group is that of one user alone: of the same name and without further members, or root's."""
    with suppress(KeyError):
        group, name = grp.getgrgid(number), pwd.getpwuid(user).pw_name
        return number == 0 or (group.gr_name == name and set(group.gr_mem) <= {name})
    return False


def _designgen(path: Path) -> list[str]:
    """Return the command of designgen: of this installation, or else the one on the search path."""
    if importlib.util.find_spec("designgen") and importlib.util.find_spec("cadquery"):
        return [*process.GUARDED, "0", "designgen"]
    program = shutil.which("designgen")
    if program and os.path.isabs(program):  # not one of the current folder
        return [program]
    raise InputError(
        "a CAD file needs designgen with its CAD kernel: pip install 'steel-scan-check[designgen]'", path=path
    )


def _import(path: Path, content: bytes, unit: str, cache: Path, meshes: Path) -> None:
    """Make the meshes in a temporary folder and rename it to ``meshes``, so that they are complete there."""
    command = _designgen(path)
    try:
        with beside(cache) as making:
            # A copy of the hashed bytes, under a name that cannot be mistaken for an option.
            source = making / f"{SOURCE}{path.suffix.lower()}"
            source.write_bytes(content)
            _run(command, source, making / "meshes", unit, path)
            (making / "meshes" / CHECKSUM).write_text(_sha256(making / "meshes"), "ascii")
            with suppress(OSError):  # another process has made them meanwhile
                os.replace(making / "meshes", meshes)
            if not meshes.is_dir():
                raise InputError("expected meshes from designgen import, found none; run again", path=path)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror or error})", path=cache) from error


def _run(command: list[str], source: Path, out: Path, unit: str, path: Path) -> None:
    """Run designgen import on ``source``, a copy of ``path``. Raises InputError if it made no meshes."""
    arguments = ["import", str(source), "-o", str(out), "--default-units", unit, f"--named={path}"]
    ended = process.run([*command, *arguments], own_group=False, timeout_s=LIMIT_S)
    if ended.cause is Cause.TIME:
        raise InputError(f"designgen import did not end within {LIMIT_S:g} s", path=path)
    if (out / RECORD).is_file():
        return
    if ended.error:  # names the file already
        raise InputError(ended.error)
    code = -ended.code if ended.cause is Cause.SIGNAL else ended.code
    raise InputError(ended.last_line or f"designgen import ended with exit code {code}", path=path)
