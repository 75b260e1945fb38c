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
