"""Networks of scans with picked common points."""

import numpy as np

from processor.model import Picks, Scan, Scene
from tests.support.clouds.stitch_clouds import pose


def network(seed, noise, scale=1.0, count=5, points=6):
    """Scans with picks between neighbours and from the first to the last: a loop."""
    rng = np.random.default_rng(seed)
    T = [pose([8000.0 * i, 500.0 * i, 1500.0], 50.0 * i, 2.0 * i) for i in range(count)]
    scans = tuple(Scan(f"S{i + 1}", rng.normal(0.0, 5000.0, (200, 3))) for i in range(count))
    rows = []
    for a, b in [*((i, i + 1) for i in range(count - 1)), (0, count - 1)]:
        world = rng.uniform([0, -8e3, 0], [3e4, 8e3, 8e3], (points, 3))
        for k, x in enumerate(world):
            local = [np.linalg.inv(T[s]) @ [*x, 1.0] for s in (a, b)]
            rows.append((f"S{a + 1}", f"S{b + 1}", f"P{k}", *(p[:3] + rng.normal(0, noise, 3) for p in local)))
    names_a, names_b, names, in_a, in_b = zip(*rows, strict=True)
    picks = Picks(names_a, names_b, names, np.array(in_a), scale * np.array(in_b))
    return np.array(T), Scene("network", "structure", scans, picks=picks)
