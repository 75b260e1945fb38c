"""Clouds of a wavy surface, and M3C2 of them by brute force."""

import numpy as np


def wavy(count, seed, off=0.0, size=1000.0, sigma=2.0):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.0, size, (2, count))
    return np.column_stack([x, y, 60.0 * np.sin(x / 150.0) * np.cos(y / 110.0) + off + rng.normal(0.0, sigma, count)])


def brute(reference, compared, core, normals, diameter, depth, error):
    rows = []
    for place, normal in zip(core, normals, strict=True):
        found = []
        for cloud in (reference, compared):
            along = (cloud - place) @ normal
            away = np.linalg.norm(cloud - place - along[:, None] * normal, axis=1)
            found.append(along[(np.abs(along) <= depth) & (away <= diameter / 2)])
        (n1, s1), (n2, s2) = ((len(one), one.std() if len(one) else np.nan) for one in found)
        lod = 1.96 * (np.sqrt(s1**2 / n1 + s2**2 / n2) + error) if min(n1, n2) >= 4 else np.nan
        apart = found[1].mean() - found[0].mean() if min(n1, n2) else np.nan
        rows.append((apart, lod, n1, n2, s1, s2))
    return np.array(rows).T
