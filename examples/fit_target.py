"""Fit a sphere to the points of one target.

    python examples/fit_target.py [SCAN]

SCAN is a scan file that holds the target's points and little else. The default is a ball of 75 mm.
"""

import sys
from pathlib import Path

import numpy as np

import processor

BALL = Path(__file__).resolve().parents[1] / "fixtures/formats/ball.e57"


def main(path: Path = BALL) -> None:
    """Print centre and radius with their standard deviations."""
    scene = processor.read(path)
    scan = scene.scans[0]
    points = scan.origin + scan.points  # (n, 3), mm, in the scan's frame

    # With the scanner's position residuals run along the rays, and the fit is free of the bias of an orthogonal one.
    scanner = scan.position if scan.position.size else None
    sphere = processor.fit_sphere(points, scanner=scanner)

    sd = np.sqrt(np.diag(sphere.covariance))  # of x, y, z and radius
    print(f"status  {sphere.status.value}")
    for axis, value, deviation in zip("xyz", sphere.centre, sd, strict=False):
        print(f"{axis}       {value:10.3f} mm, standard deviation {deviation:.3f} mm")
    print(f"radius  {sphere.radius:10.3f} mm, standard deviation {sd[3]:.3f} mm")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
