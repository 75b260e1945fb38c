"""The lists of versions in .ci fit what pyproject.toml asks for."""

import re
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
EXTRAS = ("designgen", "test")
ASKED = [
    Requirement(line)
    for line in (
        *PROJECT["dependencies"],
        *(line for extra in EXTRAS for line in PROJECT["optional-dependencies"][extra]),
    )
]


def listed(name):
    """Requirements of a list, by name; of some there are several, for different versions of Python."""
    text = (ROOT / ".ci" / name).read_text("utf-8")
    lines = re.findall(r"^([a-z0-9][^\\#\n]*)", text, flags=re.MULTILINE | re.IGNORECASE)
    found = {}
    for line in lines:
        one = Requirement(line.strip())
        found.setdefault(canonicalize_name(one.name), []).append(one)
    return found, text


@pytest.mark.parametrize("name", ["locked.txt", "lowest.txt"])
def test_locked_list_has_every_dependency_in_an_allowed_version(name):
    found, text = listed(name)
    for asked in ASKED:
        if asked.marker is not None and name == "lowest.txt" and not asked.marker.evaluate({"python_version": "3.10"}):
            continue
        versions = [str(one.specifier).removeprefix("==") for one in found[canonicalize_name(asked.name)]]
        assert all(asked.specifier.contains(version) for version in versions), f"{asked}: {versions}; run make lock"
    assert "://" not in text
    assert "setuptools" in found


def test_every_locked_version_has_a_hash():
    found, text = listed("locked.txt")
    blocks = re.findall(r"^[a-z0-9][^\n]*(?:\n +--hash=[^\n]+)*", text, flags=re.MULTILINE | re.IGNORECASE)
    assert len(blocks) == sum(map(len, found.values())) > 100
    assert all("--hash=sha256:" in block for block in blocks)


def test_the_lowest_versions_are_those_that_the_project_names():
    """But where a package of the list cannot go with the lowest, it is the lowest that can."""
    found, _ = listed("lowest.txt")
    low = {
        canonicalize_name(asked.name): next(one.version for one in asked.specifier if one.operator == ">=")
        for asked in ASKED
    }
    same = [
        name
        for name, version in low.items()
        if name in found and str(found[name][0].specifier).removeprefix("==").startswith(version)
    ]
    assert len(same) >= len(low) - 3, sorted(set(low) - set(same))
