"""Software that results depend on: versions of libraries, and digests of sources."""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from processor.model import InputError


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Return the versions of distribution packages by name; those not installed are left out."""
    installed = {}
    for name in packages:
        with suppress(PackageNotFoundError):
            installed[name] = version(name)
    return installed


def source_digest(packages: Iterable[str], suffixes: Collection[str], left_out: Collection[str] = ()) -> str:
    """Return the SHA-256 (hex) of the files of packages with the suffixes; ``left_out`` are folders of packages."""
    digest = hashlib.sha256()
    for package in packages:
        spec = importlib.util.find_spec(package)
        for place in (spec.submodule_search_locations or []) if spec else []:
            root = Path(place)
            for path in sorted(path for path in root.rglob("*") if path.suffix in suffixes):
                relative = path.relative_to(root)
                if relative.parts[0] not in left_out:
                    digest.update(f"{package}/{relative}\0".encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


class OtherSoftwareError(InputError):
    """A worker has other versions than the machine that submitted the job; the first argument lists them."""

    def __str__(self) -> str:
        """Return the message."""
        return f"a worker has other software: {self.args[0]}; install the same everywhere"


def check_same(here: Mapping[str, str], expected: Mapping[str, str]) -> None:
    """Compare the versions on this worker with those of the machine that submitted the job.

    Raises OtherSoftwareError if they differ.
    """
    different = sorted(name for name in {*here, *expected} if here.get(name) != expected.get(name))
    if different:
        pairs = ", ".join(f"{name} {here.get(name, 'none')}, not {expected.get(name, 'none')}" for name in different)
        raise OtherSoftwareError(pairs)
