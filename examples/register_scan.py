"""Scan a model, register the scan to the model's mesh from a frame of its own, and write both for other programs.

    python examples/register_scan.py [OUTPUT]

The model is a bracket of two plates, made here. OUTPUT is a new folder; without it the files are written to a folder
for temporary files and removed.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import designgen
import processor

LONG_MM, WIDE_MM, HIGH_MM, THICK_MM = 1500.0, 600.0, 400.0, 20.0
# Corners of the bracket's section in x and z, and its triangles: an L of two plates.
SECTION = ((0, 0), (LONG_MM, 0), (LONG_MM, THICK_MM), (THICK_MM, THICK_MM), (THICK_MM, HIGH_MM), (0, HIGH_MM))
ENDS = ((0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5))


def bracket() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (12, 3) in mm and faces (20, 3), whose normals point outward."""
    vertices = np.array([(x, y, z) for y in (0.0, WIDE_MM) for x, z in SECTION])
    n = len(SECTION)
    faces = [*ENDS, *((c + n, b + n, a + n) for a, b, c in ENDS)]
    for a in range(n):
        b = (a + 1) % n
        faces += [(a, a + n, b + n), (a, b + n, b)]
    return vertices, np.array(faces)


def moved(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) moved by a transform (4, 4)."""
    return points @ T[:3, :3].T + T[:3, 3]


def main(output: Path) -> None:
    """Print the pose that is found, how far it is from the true one, and the files written."""
    vertices, faces = bracket()
    scene, _ = designgen.scan((vertices, faces), stations=2, settings={"scan.step_mrad": 4.0})

    # The poses of the stations are known here: T maps the coordinates of a scan to the frame of the model. What is
    # registered are the points of both stations in the frame of the first, each with the place of its scanner.
    first, second = scene.scans
    T = np.linalg.inv(first.pose) @ second.pose
    clouds = [first.origin + first.points, moved(T, second.origin + second.points)]
    places = [np.zeros_like(clouds[0]), np.tile(T[:3, 3], (len(clouds[1]), 1))]
    points = np.concatenate(clouds)
    pose = processor.register(points, vertices, faces, scanners=np.concatenate(places))
    off = np.linalg.norm(moved(pose.T_design_scan, points) - moved(first.pose, points), axis=1).max()
    print(f"status  {pose.status.value} {[one.code for one in pose.reasons]}")
    print(f"points  {len(points)}, at most {off:.2f} mm from their places by the true pose")

    # The scene is processed as a scan folder would be, and each registered scan written as a file.
    results = processor.run(scene, steps="deviation")
    written = processor.export(results, output / "registered", what="registered", format="ply")
    print(f"wrote   {', '.join(f'{name} ({count} points)' for name, count in written.files.items())}")

    # A folder of scans becomes one scene file, which is read at once afterwards.
    converted = processor.convert(output / "registered", output / "scene.h5")
    print(f"wrote   {converted.path.name}, read as {converted.units} ({converted.units_reason})")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as folder:
            main(Path(folder))
