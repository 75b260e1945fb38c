"""Versions of installed software, which results depend on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version

from processor.model import InputError


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Return the versions of distribution packages by name; those not installed are left out."""
    installed = {}
    for name in packages:
        with suppress(PackageNotFoundError):
            installed[name] = version(name)
    return installed


def check_same(here: Mapping[str, str], expected: Mapping[str, str]) -> None:
    """Raise InputError if the versions on this worker differ from those of the machine that submitted the job."""
    different = sorted(name for name in {*here, *expected} if here.get(name) != expected.get(name))
    if different:
        pairs = ", ".join(f"{name} {here.get(name, 'none')}, not {expected.get(name, 'none')}" for name in different)
        raise InputError(f"a worker has other software: {pairs}; install the same everywhere")
