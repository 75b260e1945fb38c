"""Inputs of a batch that must fail, each in its own way, and small ones that are done."""

import numpy as np

from processor.store import store
from tests.support.files.damaged_files import good_files
from tests.support.files.scan_bytes import ply_header
from tests.support.scenes.impossible_scenes import impossible_scenes
from tests.support.scenes.store_scenes import a_scene

# What a process does instead of its work: see failing_job. One waits for the limit of time.
PLANTS = ("segfault", "memory", "panic", "exit 3", "segfault", "memory elsewhere", "panic", "hang", "segfault")


def sphere(place, number):
    """Write a scan of a sphere, which the processor does in little time."""
    place.mkdir(parents=True)
    unit = np.random.default_rng(number).normal(size=(300, 3))
    np.savetxt(place / "scan.xyz", 0.05 * unit / np.linalg.norm(unit, axis=1)[:, None] + 1.0, fmt="%.6f")
    (place / "real").touch()


def _planted(plant):
    def write(place, number):
        sphere(place, number)
        (place / "real").unlink()
        (place / "plant").write_text(plant)

    return write


def _scan(name, content):
    def write(place, _):
        place.mkdir(parents=True)
        (place / name).write_bytes(content)
        (place / "real").touch()

    return write


def _beside(name, text):
    def write(place, number):
        sphere(place, number)
        (place / name).write_text(text)

    return write


def _scene(scene, truth=None, change=bytes):
    def write(place, _):
        place.mkdir(parents=True)
        store.write_scene(place / "scene.h5", scene, truth, {})
        (place / "scene.h5").write_bytes(change((place / "scene.h5").read_bytes()))

    return write


def _flipped(content):
    changed = bytearray(content)
    changed[len(content) // 2] ^= 8
    return bytes(changed)


def ways():
    """Return functions of a folder and a number that each write one bad input."""
    formats, impossible = good_files(), [scene for _, scene, _ in impossible_scenes()]
    cut = {name: content[: len(content) // 2] for name, content in (formats[one][0] for one in ("e57", "las", "laz"))}
    return [
        *(_planted(plant) for plant in PLANTS),
        *(_scan(name, content) for name, content in cut.items()),
        _scan("a.ply", ply_header("binary_little_endian", "double", count=1_000) + bytes(600)),
        _scan("a.xyz", b"hello world and more\n" * 10),
        _scan("a.xyz", b"1 2 3\n" * 30 + b"1 2 3 1 2 3\n"),
        _scan("a.pcd", b"hello\n" * 10),
        _scan("a.fls", b"closed"),
        _beside("project.toml", "name = \n"),
        _beside("project.toml", '[[scan]]\nfile = "../../etc/passwd.xyz"\n'),
        _beside("project.toml", '[[scan]]\nfile = "none.ply"\n'),
        _beside("design.json", "[" * 100_000),
        _scene(*a_scene(), lambda content: content[:-100]),
        _scene(*a_scene(), _flipped),
        *(_scene(impossible[k]) for k in (0, 40, 90)),
    ]
