"""Distances between two clouds with a level of detection at every point (M3C2).

    python examples/compare_clouds.py

The clouds are made here: a plane with 1 mm of noise, and the same plane with a bulge of 10 mm.
"""

import numpy as np

import processor

SPACING_MM, NOISE_MM, BULGE_MM = 10.0, 1.0, 10.0


def plane(rng: np.random.Generator, bulge_mm: float) -> np.ndarray:
    """Points (n, 3) of a square of 2 m in mm, random along it, with noise across."""
    x, y = rng.uniform(-1000.0, 1000.0, (2, int((2000.0 / SPACING_MM) ** 2)))
    z = bulge_mm * np.exp(-(x**2 + y**2) / 300.0**2) + rng.normal(0.0, NOISE_MM, len(x))
    return np.column_stack([x, y, z])


def main() -> None:
    """Print how much of the surface moved, and the largest movement."""
    rng = np.random.default_rng(1)
    reference, compared = plane(rng, 0.0), plane(rng, BULGE_MM)

    # Distances are compared minus reference along the normal. The diameter of the cylinder is chosen so that it holds
    # 20 points or more; the normal's sphere is twice as wide.
    table = processor.m3c2(
        reference,
        compared,
        core=reference[::20],
        normal_diameter=160.0,
        projection_diameter=80.0,
        max_depth=50.0,
        registration_error=0.2,
    )
    answered = np.isfinite(table.lod95)
    significant = answered & (np.abs(table.distance) > table.lod95)
    largest = table.distance[answered][np.argmax(np.abs(table.distance[answered]))]
    print(f"core points          {answered.sum()} of {len(answered)} with an answer")
    print(f"level of detection   {np.median(table.lod95[answered]):.2f} mm (median)")
    print(f"moved                {100.0 * significant.sum() / answered.sum():.1f} % of the core points")
    print(f"largest movement     {largest:.2f} mm")


if __name__ == "__main__":
    main()
