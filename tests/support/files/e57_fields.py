"""Columns of E57 files, by the library's own buffers."""

import numpy as np
from pye57 import libe57


def e57_field(path, name, scan=0):
    """Return a column of a scan, also one of an extension."""
    image = libe57.ImageFile(str(path), "r")
    points = image.root()["data3D"][scan]["points"]
    values = np.empty(points.childCount())
    buffers = libe57.VectorSourceDestBuffer()
    buffers.append(libe57.SourceDestBuffer(image, name, values, len(values), True, True))
    reader = points.reader(buffers)
    reader.read()
    reader.close()
    image.close()
    return values
