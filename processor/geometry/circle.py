"""The circle through points in a plane, by least squares in closed form."""

from __future__ import annotations

import numpy as np

from processor.model import Floats


def algebraic(points: Floats) -> tuple[Floats, float] | None:
    """Return centre (2,) and radius of the circle nearest to points (n, 2); None where they lie on a line.

    The squares of the distances from the circle's power are least (Kasa 1976, IEEE Transactions on Instrumentation and
    Measurement 25): exact for points on a circle.
    """
    unknown, _, rank, _ = np.linalg.lstsq(
        np.column_stack([2.0 * points, np.ones(len(points))]), np.einsum("ki,ki->k", points, points), rcond=None
    )
    square = float(unknown[2] + unknown[:2] @ unknown[:2])
    return (unknown[:2], float(np.sqrt(square))) if rank == 3 and square > 0.0 else None
