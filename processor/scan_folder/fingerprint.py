"""The files of an input, their hash, and whether they changed during a run."""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from processor.model import InputError

BLOCK = 1 << 20  # bytes read at once: work, not result

Signature = dict[str, tuple[int, ...]]


def files_of(path: Path, without: Path | None = None) -> Iterator[tuple[str, Path, os.stat_result]]:
    """Yield names relative to ``path``, paths and ``lstat`` of a file or of all files below a folder, sorted by bytes.

    Links are not followed. The folder ``without`` (of results) is left out, and so are files deleted meanwhile.
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
            file = here / name
            try:
                yield str(file.relative_to(path)), file, file.lstat()
            except FileNotFoundError:
                continue


def signature(path: Path, without: Path | None = None) -> Signature:
    """Return mode, size, times of change and inode of every file of an input, by name, without reading them."""
    return {
        name: (status.st_mode, status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino)
        for name, _, status in files_of(path, without)
    }


def check_unchanged(path: Path, before: Signature, without: Path | None = None) -> None:
    """Raise InputError if a file of ``before`` has changed or was deleted; new files are ignored."""
    now = signature(path, without)
    changed = sorted(name for name, was in before.items() if now.get(name) != was)
    if changed:
        raise InputError(
            f"{path / changed[0] if changed[0] else path}: changed while it was processed, so the results are not "
            "kept; run again when it is complete"
        )


def content_hash(path: Path, without: Path | None = None) -> str:
    """Return the SHA-256 (hex) of the names and bytes of an input's files.

    Links count with the file they lead to if that is within the input; what cannot be read or is not a file counts by
    its name. Raises InputError without such an input.
    """
    digest = hashlib.sha256()
    try:
        inside = path.resolve(strict=True)
        for name, file, status in files_of(path, without):
            digest.update(b"\0" + os.fsencode(name) + b"\0")
            if stat.S_ISLNK(status.st_mode):
                digest.update(b"link " + os.fsencode(os.readlink(file)) + b"\0")
                target = file.resolve()
                if not (target.is_relative_to(inside) and target.is_file()):
                    continue
            elif not stat.S_ISREG(status.st_mode):
                digest.update(b"no file")
                continue
            _feed(digest, file)
    except (FileNotFoundError, NotADirectoryError, RuntimeError):
        raise InputError("was deleted while it was read; run again when it is complete", path=path) from None
    return digest.hexdigest()


def _feed(digest: hashlib._Hash, path: Path) -> None:
    """Add the size and the hash of a file's bytes, so that content cannot be mistaken for the next file's name."""
    content, size = hashlib.sha256(), 0
    try:
        # Not blocking: a pipe may have replaced the file meanwhile.
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
            while block := file.read(BLOCK):
                content.update(block)
                size += len(block)
    except PermissionError:
        digest.update(b"unreadable")
        return
    digest.update(size.to_bytes(8, "big") + content.digest())
