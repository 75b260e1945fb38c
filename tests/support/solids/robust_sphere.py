"""Points on spheres, and the robust fit of a sphere in its readable form, in NumPy."""

from typing import NamedTuple

import numpy as np

TUKEY, WINDOW, STEEPEST, FREE_ITERATIONS = 4.685, 4.0, 0.3, 40


class Fit(NamedTuple):
    """State (4,) of x, y, z and radius, scale of the residuals, and points (n,) of weight > 0."""

    state: np.ndarray
    scale: float
    inliers: np.ndarray


def cap(rng, n, radius=45.0, share=0.45, view=(0.0, 0.0, 1.0)):
    """Directions evenly over the share of the sphere that faces ``view``, times the radius."""
    view = np.asarray(view) / np.linalg.norm(view)
    height, turn = rng.uniform(1.0 - 2.0 * share, 1.0, n), rng.uniform(0.0, 2.0 * np.pi, n)
    across = np.linalg.svd(view[None])[2][1:]
    ring = np.sqrt(1.0 - height**2)[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    return radius * (height[:, None] * view + ring @ across)


def linearised(points, state, scanner):
    """Residuals (n,), measured minus model, NaN where the ray misses the sphere, and the model's derivatives (n, 4)."""
    centre, radius = state[:3], state[3]
    if scanner is None:
        out = points - centre
        distance = np.linalg.norm(out, axis=1)
        return distance - radius, np.column_stack([out / distance[:, None], np.ones(len(points))])
    ray = points - scanner
    length = np.linalg.norm(ray, axis=1)
    ray = ray / length[:, None]
    along = np.einsum("ni,ni->n", ray, centre - scanner)
    off = centre - scanner - along[:, None] * ray
    under = radius**2 - np.sum(off**2, axis=1)
    met = under > (STEEPEST * radius) ** 2
    root = np.sqrt(np.where(met, under, radius**2))
    J = np.column_stack([ray + off / root[:, None], -radius / root])
    return np.where(met, length - (along - root), np.nan), J


def fit(points, state, scale, radius_free, scanner):
    """Gauss-Newton with Tukey's biweight; the scale is that of residuals within 4 scales, at most the first."""
    state, largest = state.copy(), scale
    free = 4 if radius_free else 3
    for iteration in range(200):
        residual, J = linearised(points, state, scanner)
        if iteration < FREE_ITERATIONS:
            size = np.abs(residual)
            scale = min(largest, 1.4826 * np.median(size[size <= WINDOW * scale]))
        with np.errstate(invalid="ignore"):
            weight = np.nan_to_num(np.maximum(1.0 - (residual / (TUKEY * scale)) ** 2, 0.0) ** 2)
        N = (J * weight[:, None]).T @ J
        step = np.linalg.solve(N[:free, :free], ((J * weight[:, None]).T @ np.nan_to_num(residual))[:free])
        state[:free] += step
        if np.linalg.norm(step) < 1e-10 * state[3]:
            break
    residual = linearised(points, state, scanner)[0]
    return Fit(state, scale, np.abs(residual) < TUKEY * scale)
