"""Balls at known nodes: size, centre, radius and lowest point from the points about each node, with the axes fused.

Method ``ray`` of the spheres. Its steps: gather the points about all nodes; vote for sizes and fit those in question;
learn from all balls together how large sleeves are, how noise grows and how radii scatter; choose and fit again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from processor.geometry.parallel import over_ranges
from processor.limits import standards
from processor.model import Floats, Tolerance
from processor.space_frame.catalogue import Catalogue
from processor.space_frame.members.records import Nodes, Tubes
from processor.space_frame.points.source import Source
from processor.space_frame.points.sphere_crops import Crops, gather
from processor.space_frame.spheres import noise_model, occlusion, quality
from processor.space_frame.spheres.final_fit import finish
from processor.space_frame.spheres.gauss_newton import LEAST_COSINE
from processor.space_frame.spheres.occlusion import AXIS_MM, FLAT_MM, Ends
from processor.space_frame.spheres.records import Balls, Fits
from processor.space_frame.spheres.size_selection import choose
from processor.space_frame.spheres.station_scatter import shift_sd

NAN = float("nan")
MARGIN_MM = 26.0  # of a crop beyond the largest ball: sleeves are measured there
LARGEST_FREE_MM = 150.0
FREE_SIZES = np.arange(20.0, LARGEST_FREE_MM + 1.0, 5.0)  # where a fit of a free radius starts
MOST_BELIEVED = 60.0  # points that the noise model is worth for one ball
ROUNDS = 3
VAGUE_MM = 50.0  # a node with a larger sd than this has no prior


@dataclass(frozen=True)
class Params:
    """Parameters of the fit, mm. ``sigma_mm`` starts the estimate of the noise, which the balls then say themselves."""

    sigma_mm: float = 2.0
    process_hole_mm: float = 15.0  # radius of the cap about the lowest point that is not the ball's
    least_cosine: float = LEAST_COSINE
    surprise: float = 9.0  # by which the energy of a size other than the expected one is raised
    catch_mm: float = 12.0  # how far off a point may be and still draw the first steps
    threads: int = 0  # as many as there are


@dataclass(frozen=True)
class _Rays:
    """Return unit rays (n, 3), 0 where the scanner is unknown, and ranges (n,) of gathered points."""

    directions: Floats
    ranges: Floats


def find_balls(
    source: Source,
    nodes: Nodes,
    tubes: Tubes,
    catalogue: Catalogue,
    expected_mm: Floats | None = None,
    station_covariance: Floats | None = None,
    params: Params | None = None,
    limits: Tolerance | None = None,
) -> Balls:
    """Fit a ball at every node; one pass over the source.

    ``expected_mm`` (k,) are nominal radii, NaN = none: a prior on the size alone. ``station_covariance`` (s, 3, 3) is
    that of each scanner's place as registered, mm^2; left out, it is estimated from balls that several stations saw.
    ``limits`` hold the tolerance of a ball's blank; left out, it is the default standard's.
    """
    largest = float(catalogue.radii.max()) if len(catalogue.radii) else LARGEST_FREE_MM
    if expected_mm is not None and np.isfinite(expected_mm).any():
        largest = max(largest, float(np.nanmax(expected_mm)))
    threads = params.threads if params else 0
    crops = gather(source, nodes.positions, largest + MARGIN_MM, threads)
    return fit_crops(crops, source.scanners, nodes, tubes, catalogue, expected_mm, station_covariance, params, limits)


def fit_crops(
    crops: Crops,
    scanners: Floats,
    nodes: Nodes,
    tubes: Tubes,
    catalogue: Catalogue,
    expected_mm: Floats | None = None,
    station_covariance: Floats | None = None,
    params: Params | None = None,
    limits: Tolerance | None = None,
) -> Balls:
    """Fit a ball to each node's gathered points; see :func:`find_balls`."""
    params = params or Params()
    k = nodes.count
    expected = np.full(k, NAN) if expected_mm is None else np.asarray(expected_mm, np.float64)
    rays = _aimed(crops, np.array(nodes.positions), np.array(scanners, np.float64), params.threads)
    ranges = rays.ranges
    found = occlusion.ends(nodes, tubes)
    weights = centre_weights(nodes.covariance)
    noise = np.array([params.sigma_mm**2, 0.0, 0.0])
    setting = _Setting(noise, 10.0, occlusion.first_guess(found), catalogue.sd_mm, params.least_cosine, 0.0)
    shift = np.zeros((len(scanners), 3, 3)) if station_covariance is None else np.array(station_covariance, np.float64)
    fits: Fits | None = None
    for turn in range(ROUNDS):
        fits, errors, cosines, on = _fit(crops, rays, found, weights, setting, catalogue, expected, shift, params, fits)
        if turn == ROUNDS - 1 or (turn == 1 and setting.station_sd == 0.0):
            break
        learnt = _learnt(crops, rays, found, weights, setting, catalogue, params, fits, (errors, cosines, on))
        if station_covariance is None:
            shift = np.tile(learnt.station_sd**2 * np.eye(3), (len(scanners), 1, 1))
        else:
            learnt = replace(learnt, station_sd=0.0)
        noisier = typical_variance(learnt.noise, ranges) > 2.0 * typical_variance(setting.noise, ranges)
        # sleeves larger than guessed, or stations that moved, may have spoilt any choice of a size
        spoilt = bool((learnt.corner > setting.corner + AXIS_MM).any())
        if noisier or spoilt or learnt.station_sd > 1.2 * setting.station_sd:
            fits = None
        setting = learnt
    assert fits is not None
    offset = (0.0, np.inf)
    if len(catalogue.radii):
        sure = fits.clear
        offset = noise_model.radius_offset(
            fits.states[sure, 3], fits.covariance[sure, 3, 3], fits.sizes[sure], setting.radius_sd, catalogue.sd_mm
        )
    stations = setting.station_sd if station_covariance is None else NAN
    return quality.judged(
        fits,
        nodes,
        expected,
        catalogue,
        bool(np.any(ranges > 0.0)),
        setting.noise,
        setting.radius_sd,
        stations,
        offset,
        standards.default_for(limits),
    )


def _learnt(
    crops: Crops,
    rays: _Rays,
    found: Ends,
    weights: Floats,
    setting: _Setting,
    catalogue: Catalogue,
    params: Params,
    fits: Fits,
    left: tuple[Floats, Floats, Floats],
) -> _Setting:
    """Learn from one round, over all balls, what the next one holds; ``left``: residuals, cosines, weights (n,)."""
    errors, cosines, on = left
    corner = occlusion.measured(found, crops.start, crops.points, fits.states[:, :3], fits.states[:, 3], params.threads)
    noise, count = noise_model.noise_model(errors, cosines, rays.ranges, on, setting.noise)
    limb = noise_model.limb_cosine(errors, cosines, rays.ranges, on, noise, setting.least_cosine)
    sure, radius_sd, size_weight = fits.clear, setting.radius_sd, 0.0
    if len(catalogue.radii):
        size_weight = 1.0 / setting.radius_sd**2
        radius_sd = noise_model.radius_scatter(
            fits.states[sure, 3], fits.covariance[sure, 3, 3], fits.sizes[sure], setting.radius_sd, catalogue.sd_mm
        )
    # once stations are known to move, their residuals no longer say by how much
    station_sd = setting.station_sd or shift_sd(
        crops.start, crops.points, rays.directions, rays.ranges, crops.station, on, fits.states, sure, noise, weights,
        fits.sizes, size_weight, params.threads,
    )  # fmt: skip
    return _Setting(noise, min(count, MOST_BELIEVED), corner, radius_sd, limb, station_sd)


@dataclass(frozen=True)
class _Setting:
    """What is held of the scan in one round: noise (3,), the points it is worth, sleeves (m,), and the rest."""

    noise: Floats
    believed: float
    corner: Floats
    radius_sd: float
    least_cosine: float
    station_sd: float


def _fit(
    crops: Crops,
    rays: _Rays,
    found: Ends,
    weights: Floats,
    setting: _Setting,
    catalogue: Catalogue,
    expected: Floats,
    shift: Floats,
    params: Params,
    before: Fits | None,
) -> tuple[Fits, Floats, Floats, Floats]:
    """One round: choose sizes, except where ``before`` leaves no doubt of them, and fit."""
    free = len(catalogue.radii) == 0
    noise = setting.noise
    sigma = float(np.sqrt(typical_variance(noise, rays.ranges)))
    keep_off = setting.corner + FLAT_MM + AXIS_MM + 0.5 * sigma
    tube_off = np.where(np.isfinite(found.tube_radii), found.tube_radii, 1.5 * setting.corner) + 2.0 + 2.0 * sigma
    size_weight = 0.0 if free else 1.0 / setting.radius_sd**2
    near = (crops.start, crops.points, rays.directions, rays.ranges, crops.station)
    axes = (found.start, found.points, found.directions, keep_off)
    limits = (params.process_hole_mm, setting.least_cosine)
    doubtful = np.ones(len(weights), bool) if before is None else ~before.beyond_doubt
    chosen = choose(
        near, (*axes, tube_off), limits, noise, weights, FREE_SIZES if free else np.array(catalogue.radii),
        size_weight, expected, params.surprise, free, 2.5 * sigma + 1.0, params.catch_mm, shift, doubtful,
        params.threads,
    )  # fmt: skip
    if before is not None:
        kept = (before.states, before.sizes, before.energy, before.second, before.second_energy)
        for new, old in zip(chosen, kept, strict=True):
            new[~doubtful] = old[~doubtful]
    states, sizes, energy, second, second_energy = chosen
    states, covariance, bound, numbers, errors, cosines, on = finish(
        near,
        axes,
        limits,
        noise,
        setting.believed,
        weights,
        sizes,
        np.full(len(states), size_weight),
        states,
        4.5 * sigma,
        shift,
    )
    return Fits(states, covariance, bound, sizes, energy, second, second_energy, numbers), errors, cosines, on


def typical_variance(noise: Floats, ranges: Floats) -> float:
    """Variance of a range seen square on at the median range, mm^2."""
    known = ranges[ranges > 0.0]
    return float(noise[0] + noise[1] * (float(np.median(known)) ** 2 if len(known) else 0.0))


def centre_weights(covariance: Floats) -> Floats:
    """Inverse covariances (k, 3, 3) of nodes; 0 where a node's position says nothing."""
    weights = np.zeros_like(covariance)
    known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    known[known] &= np.linalg.eigvalsh(covariance[known]).max(axis=1) < VAGUE_MM**2
    weights[known] = np.linalg.inv(covariance[known])
    return weights


def _aimed(crops: Crops, nodes: Floats, scanners: Floats, threads: int) -> _Rays:
    """Rays of the gathered points from the scanners (s, 3) that saw them."""
    directions, ranges = np.zeros((len(crops.points), 3)), np.zeros(len(crops.points))
    over_ranges(
        lambda a, b: _aim(a, b, crops.start, crops.points, crops.station, nodes, scanners, directions, ranges),
        len(nodes),
        threads,
    )
    return _Rays(directions, ranges)


@njit(cache=True, nogil=True, error_model="numpy")
def _aim(begin, end, start, points, station, nodes, scanners, directions, ranges):  # type: ignore[no-untyped-def]
    """Fill unit rays (n, 3), 0 where the scanner is unknown, and ranges (n,)."""
    for k in range(begin, end):
        for i in range(start[k], start[k + 1]):
            s = station[i]
            if s < 0 or s >= len(scanners):
                continue
            x = points[i, 0] + (nodes[k, 0] - scanners[s, 0])
            y = points[i, 1] + (nodes[k, 1] - scanners[s, 1])
            z = points[i, 2] + (nodes[k, 2] - scanners[s, 2])
            d = np.sqrt(x * x + y * y + z * z)
            if d > 0.0:
                directions[i, 0], directions[i, 1], directions[i, 2] = x / d, y / d, z / d
                ranges[i] = d
