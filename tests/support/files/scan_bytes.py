"""Scan files made byte by byte, and where the real ones are."""

import struct
from pathlib import Path

import numpy as np
import pytest

DATA = Path(__file__).resolve().parents[3] / "../shared/data"

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the real scans are not on this machine")


def put(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def ply_header(form, kind, more="", count=3):
    axes = "".join(f"property {kind} {axis}\n" for axis in "xyz")
    return f"ply\nformat {form} 1.0\ncomment c\nelement vertex {count}\n{axes}{more}end_header\n".encode()


def pcd_header(data, count=3, width=3, height=1):
    return (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {data}\n"
    ).encode()


# A quarter turn about z, then (10, 20, 30): as row vectors, so x maps to y in the first row.
POSE_ROWS = "0 1 0 0\n-1 0 0 0\n0 0 1 0\n10 20 30 1\n"

TURNED = "10 20 30\n0 1 0\n-1 0 0\n0 0 1\n" + POSE_ROWS


def las_bytes(raw, scale, offset):
    """LAS 1.2, point format 0, by the specification's table."""
    count = len(raw)
    low, high = np.min(raw, axis=0) * scale + offset, np.max(raw, axis=0) * scale + offset
    header = struct.pack(
        "<4sHH16sBB32s32sHHHIIBHI5I12d",
        b"LASF", 0, 0, bytes(16), 1, 2, b"", b"", 1, 2026, 227, 227, 0, 0, 20, count, count, 0, 0, 0, 0,
        *[scale] * 3, *offset, high[0], low[0], high[1], low[1], high[2], low[2],
    )  # fmt: skip
    rows = b"".join(struct.pack("<3iHBBbBH", *row, 100 + i, 0x11, 0, 0, 0, 0) for i, row in enumerate(raw))
    return header + rows


def las_with_keys(path, points, keys, scale):
    """Write a LAS file by another library, with the keys of a coordinate system: EPSG codes by their GeoTIFF keys."""
    import laspy
    from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct

    las = laspy.LasData(laspy.LasHeader(point_format=0, version="1.2"))
    las.header.scales = np.full(3, scale)
    las.x, las.y, las.z = points.T
    vlr = GeoKeyDirectoryVlr()
    vlr.geo_keys = [GeoKeyEntryStruct(key, 0, 1, value) for key, value in sorted(keys.items())]
    vlr.geo_keys_header.number_of_keys = len(vlr.geo_keys)
    las.header.vlrs.append(vlr)
    las.write(str(path))
    return path
