"""E57 (ASTM E2807): several scans a file, each named and with the pose of its scanner, in whose frame points stay.

Points whose invalid state is set are no returns and are left out. SI metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from processor.model import Floats, InputError
from processor.readers.raw import RawScan, make, parsing

SUFFIXES = (".e57",)
UNIT = "m"
CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
LONGEST_NAME = 100
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")


def read(path: Path) -> list[RawScan]:
    """Read every scan of an E57 file."""
    import pye57

    with parsing(path, "E57"):
        file = pye57.E57(str(path))
        try:
            count = file.scan_count
            if not count:
                raise InputError(f"{path}: holds no scans")
            called = names(path.stem, [_own_name(file.get_header(i)) for i in range(count)])
            return [_read_scan(path, file, i, called) for i in range(count)]
        finally:
            file.close()


def names(stem: str, own: Sequence[str]) -> list[str]:
    """Return how the scans of a file are called, by the file's stem and their own names in it.

    A lone scan is named by the file, as in other formats. Of several each keeps its own name where that is plain text
    and no other's; the rest are numbered.
    """
    if len(own) == 1:
        return [stem]
    found = [
        name if _is_plain(name) and own.count(name) == 1 else f"{stem}-{number}" for number, name in enumerate(own, 1)
    ]
    return found if len(set(found)) == len(found) else [f"{stem}-{number}" for number in range(1, len(own) + 1)]


def _is_plain(name: str) -> bool:
    return bool(name.strip() == name and name.isprintable() and 0 < len(name) <= LONGEST_NAME and name[0] != ".") and (
        not set(name) & set("/\\")
    )


def _own_name(header: Any) -> str:
    try:
        return str(header.node["name"].value()) if header.node.isDefined("name") else ""
    except UnicodeDecodeError:
        return ""


def _read_scan(path: Path, file: Any, index: int, called: Sequence[str]) -> RawScan:
    name, count = called[index], len(called)
    header = file.get_header(index)
    declared = int(header.point_count)
    if declared > 8 * path.stat().st_size:  # less than a bit for a point
        raise InputError(f"{path}: scan {index + 1} declares {declared} points, more than the file can hold")
    fields = set(header.point_fields)
    cartesian = fields.issuperset(CARTESIAN)
    if not cartesian and not fields.issuperset(SPHERICAL):
        raise InputError(f"{path}: scan {name!r} has neither Cartesian nor spherical points ({', '.join(fields)})")
    state = "cartesianInvalidState" if cartesian else "sphericalInvalidState"
    wanted = [*(CARTESIAN if cartesian else SPHERICAL), *({state, "intensity"} & fields)]
    data, buffers = file.make_buffers(wanted, declared)
    found = header.points.reader(buffers).read() if declared else 0
    if found != declared:
        raise InputError(f"{path}: scan {name!r} declares {declared} points but holds {found}; copy it again")
    valid = data[state] == 0 if state in data else np.ones(declared, bool)
    if cartesian:
        xyz = np.stack([data[name][valid] for name in CARTESIAN], axis=1)
    else:
        xyz = cartesian_from_spherical(*(data[name][valid] for name in SPHERICAL))
    pose = _pose(path, name, header) if header.has_pose() else np.empty(0)
    # Writers give a lone or merged cloud an identity pose too, so it says nothing of where a scanner stood.
    posed = pose.size > 0 and (count > 1 or bool((pose != np.eye(4)).any()))
    return make(
        path,
        name,
        xyz,
        unit=UNIT,
        intensity=data["intensity"][valid] if "intensity" in data else (),
        position=np.zeros(3) if posed else (),
        T_project_scan=pose,
    )


def cartesian_from_spherical(distance: Floats, azimuth: Floats, elevation: Floats) -> Floats:
    """Points (n, 3) of ranges and angles (n,) in rad; the elevation is 0 at the horizon, as in ASTM E2807."""
    level = distance * np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)], axis=1)


def _pose(path: Path, name: str, header: Any) -> Floats:
    pose = np.eye(4)
    node = header.node["pose"]
    if node.isDefined("rotation"):
        w, x, y, z = (float(node["rotation"][key].value()) for key in "wxyz")
        length = float(np.sqrt(w * w + x * x + y * y + z * z))
        if not 0.99 < length < 1.01:
            raise InputError(f"{path}: the pose of scan {name!r} has a quaternion of length {length:g}, expected 1")
        w, x, y, z = w / length, x / length, y / length, z / length
        pose[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    if node.isDefined("translation"):
        pose[:3, 3] = [float(node["translation"][key].value()) for key in "xyz"]
    if not np.isfinite(pose).all():
        raise InputError(f"{path}: the pose of scan {name!r} holds numbers that are not finite")
    return pose
