"""LAS and LAZ 1.4 in metres, to 0.1 mm; scalar fields as extra bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from processor.model import InputError
from processor.writers.cloud import COLOURS, GRID, INTENSITY, METRES, STATION, Cloud

STEP_M = 0.0001  # 0.1 mm: below noise; int32 then reaches 214 km
FULL = 65535.0  # the greatest intensity
COLOUR_STEP = 257  # of 16 bits a step of 8 bits
FARTHEST_MM = 2.0**31 * STEP_M / METRES  # from the origin: steps are stored as int32
PLAIN, COLOURED = 6, 7  # point formats


def write(path: Path, cloud: Cloud) -> int:
    """Write a cloud in metres; return the number of points. The suffix decides on LAZ.

    Intensities are scaled to 16 bits unless they fit, the station is the point source. Raises InputError for points too
    far from the cloud's origin for 32 bits of 0.1 mm, about 200 km, OSError where the file cannot be written.
    """
    import laspy
    import lazrs

    try:
        return _write(laspy, path, cloud)
    except lazrs.LazrsError as error:
        raise OSError(0, f"LAZ: {error}") from error


def _write(laspy: Any, path: Path, cloud: Cloud) -> int:
    header = laspy.LasHeader(point_format=COLOURED if COLOURS[0] in cloud.fields else PLAIN, version="1.4")
    header.scales = np.full(3, STEP_M)
    header.offsets = np.floor(cloud.origin * METRES)
    header.creation_date = None  # a date would change the bytes from day to day
    further = [name for name in cloud.fields if name not in (INTENSITY, STATION, *GRID, *COLOURS)]
    if further:
        header.add_extra_dims([laspy.ExtraBytesParams(name, np.dtype(cloud.fields[name])) for name in further])
    shift = cloud.origin - header.offsets / METRES
    count = 0
    with laspy.open(str(path), mode="w", header=header) as file:
        for block in cloud.blocks():
            # Steps from the offset, without large coordinates in between.
            from_offset = block.points + shift
            if np.abs(from_offset).max(initial=0.0) > FARTHEST_MM:
                raise InputError(f"{cloud.name!r} is over 200 km large: LAS cannot hold it to 0.1 mm", path=path)
            record = laspy.ScaleAwarePointRecord.zeros(len(block.points), header=header)
            record.X, record.Y, record.Z = np.rint(from_offset * (METRES / STEP_M)).astype(np.int32).T
            _fill(record, block.fields, cloud.brightest)
            for name in further:
                record[name] = block.fields[name]
            file.write_points(record)
            count += len(block.points)
    return count


def _fill(record: Any, fields: Any, brightest: float) -> None:
    """Fill the standard dimensions."""
    if INTENSITY in fields:
        bright = fields[INTENSITY].astype(np.float64)
        if brightest > 0.0:
            bright = bright / brightest * FULL
        record.intensity = np.rint(np.clip(bright, 0.0, FULL)).astype(np.uint16)
    if STATION in fields:
        record.point_source_id = fields[STATION].astype(np.uint16)
    if COLOURS[0] in fields:
        for name in COLOURS:
            record[name] = fields[name].astype(np.uint16) * COLOUR_STEP
