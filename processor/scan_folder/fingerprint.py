"""The files that an input consists of, and whether they stayed as they were."""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from processor.model import InputError

BLOCK = 1 << 20

Signature = dict[str, tuple[int, ...]]


def files_of(path: Path, without: Path | None = None) -> Iterator[tuple[str, Path, os.stat_result]]:
    """Names relative to ``path``, paths and ``lstat`` of a file, or of all below a folder, in the order of their bytes.

    Links are named and not followed; ``without``, a folder of results, is left out, and so is what vanishes meanwhile.
    """
    if not path.is_dir():
        yield "", path, path.stat()
        return
    for place, folders, names in os.walk(path):
        folders.sort(key=os.fsencode)
        here = Path(place)
        linked = [name for name in folders if (here / name).is_symlink()]
        folders[:] = [name for name in folders if name not in linked and here / name != without]
        for name in sorted([*names, *linked], key=os.fsencode):
            one = here / name
            try:
                yield str(one.relative_to(path)), one, one.lstat()
            except FileNotFoundError:
                continue


def signature(path: Path, without: Path | None = None) -> Signature:
    """Size, times of change and place on the disk of every file of an input, by name; nothing is read."""
    return {
        name: (found.st_mode, found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino)
        for name, _, found in files_of(path, without)
    }


def check_unchanged(path: Path, before: Signature, without: Path | None = None) -> None:
    """Raise InputError where a file that was there ``before`` is another one now, or gone; new files do not count."""
    now = signature(path, without)
    changed = sorted(name for name, was in before.items() if now.get(name) != was)
    if changed:
        raise InputError(
            f"{path / changed[0] if changed[0] else path}: changed while it was processed, so the results are not "
            "kept; run again when it is complete"
        )


def content_hash(path: Path, without: Path | None = None) -> str:
    """SHA-256 (hex) of the names and bytes of an input's files.

    Of a link within the input counts what it leads to as well; what cannot be read, or is no file, counts by its name.
    Raises InputError where there is no such input.
    """
    digest = hashlib.sha256()
    try:
        inside = path.resolve(strict=True)
        for name, one, found in files_of(path, without):
            digest.update(b"\0" + os.fsencode(name) + b"\0")
            if stat.S_ISLNK(found.st_mode):
                digest.update(b"link " + os.fsencode(os.readlink(one)) + b"\0")
                target = one.resolve()
                if not (target.is_relative_to(inside) and target.is_file()):
                    continue
            elif not stat.S_ISREG(found.st_mode):
                digest.update(b"no file")
                continue
            _feed(digest, one)
    except (FileNotFoundError, NotADirectoryError, RuntimeError):
        raise InputError(f"{path}: vanished while it was read") from None
    return digest.hexdigest()


def _feed(digest: hashlib._Hash, path: Path) -> None:
    """Feed the number of a file's bytes and these; no file's content can pass for the next one's name."""
    own, size = hashlib.sha256(), 0
    try:
        # A pipe put in the file's place meanwhile must not be waited for.
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
            while block := file.read(BLOCK):
                own.update(block)
                size += len(block)
    except PermissionError:
        digest.update(b"unreadable")
        return
    digest.update(size.to_bytes(8, "big") + own.digest())
