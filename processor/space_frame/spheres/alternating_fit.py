"""Spheres at known nodes: size, centre, radius and lowest point from the points about each node, and from the axes.

Gather the points about all nodes. Choose sizes and fit. Estimate from all spheres together the sleeves' radii, the
noise, the scatter of radii and the stations' shifts; then choose and fit again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from processor import tiles
from processor.limits import standards
from processor.model import Floats, Tolerance
from processor.space_frame import shared_sizes
from processor.space_frame.ball_catalogue import Catalogue
from processor.space_frame.members.records import Members, Nodes
from processor.space_frame.points.source import Source
from processor.space_frame.points.sphere_crops import Crops, CropsWithRays, gather, with_rays
from processor.space_frame.spheres import assessment, ball_fit, size_selection, sleeve_radii, stochastic_model
from processor.space_frame.spheres.ball_fit import CUT_SD, LEAST_COSINE, NodesToFit
from processor.space_frame.spheres.records import (
    AMBIGUOUS,
    Finished,
    Fits,
    Masks,
    Priors,
    Residuals,
    SizeChoice,
    Sizes,
    Spheres,
    StochasticModel,
)
from processor.space_frame.spheres.size_selection import NodesToChoose
from processor.space_frame.spheres.sleeve_radii import AXIS_MM, FLAT_MM, MemberEnds
from processor.space_frame.spheres.unnamed_view_errors import view_errors

NAN = float("nan")
MARGIN_MM = 26.0  # of a crop beyond the largest sphere: sleeves are measured there
LARGEST_FREE_MM = 150.0  # chosen: radius, above the bolt balls of catalogues
FREE_SIZES = np.arange(20.0, LARGEST_FREE_MM + 1.0, 5.0)  # where a fit of a free radius starts
MOST_MODEL_POINTS = 60.0  # points that the noise model is worth for one sphere, at most
ROUNDS = 3  # work: of noise, shifts of stations and fits in turn; two where there are no shifts
NODES = 200  # of a tile
VAGUE_MM = 50.0  # a node with a larger sd than this has no prior


@dataclass(frozen=True)
class RayFitParams:
    """Parameters of the fit, mm. ``sigma_mm`` starts the estimate of the noise."""

    sigma_mm: float = 2.0
    process_hole_mm: float = 15.0  # radius of the cap about the lowest point that the process hole may take
    least_cosine: float = LEAST_COSINE
    other_size_penalty: float = 9.0  # by which the energy of a size other than the nominal one is raised
    first_reach_mm: float = 12.0  # reach of the first steps
    threads: int = 0  # 0 = as many as there are


@dataclass(frozen=True)
class _Problem:
    """Input of all rounds."""

    crops: CropsWithRays
    ends: MemberEnds
    centre_weight: Floats  # (k, 3, 3)
    nominal: Floats  # (k,)
    catalogue: Catalogue
    params: RayFitParams

    @property
    def free(self) -> bool:
        """Whether radii are free."""
        return len(self.catalogue.radii) == 0


@dataclass(frozen=True)
class _Setting:
    """Estimates that one round of fits uses."""

    noise: Floats  # (3,)
    model_points: float  # that the noise model is worth
    sleeve_radii: Floats  # (m,) radii of sleeves
    radius_sd: float
    least_cosine: float
    station_sd: float
    shift: Floats  # (s, 3, 3) covariance of each station's shift

    def size_weight(self, free: bool) -> float:
        """Weight of a radius about its size, 1 / mm^2; 0 where radii are free."""
        return 0.0 if free else 1.0 / self.radius_sd**2


def fit_spheres(
    source: Source,
    nodes: Nodes,
    members: Members,
    catalogue: Catalogue,
    nominal_mm: Floats | None = None,
    station_covariance: Floats | None = None,
    params: RayFitParams | None = None,
    limits: Tolerance | None = None,
) -> Spheres:
    """Fit a sphere at every node; one pass over the source.

    Parameters
    ----------
    nominal_mm : (k,) nominal radii, NaN = none: a prior on the size alone
    station_covariance : (s, 3, 3) of each scanner's place as registered, mm^2; by default it is estimated from spheres
        that several stations saw
    limits : has the tolerance of a sphere's blank; by default that of the default standard
    """
    largest = float(catalogue.radii.max()) if len(catalogue.radii) else LARGEST_FREE_MM
    if nominal_mm is not None and np.isfinite(nominal_mm).any():
        largest = max(largest, float(np.nanmax(nominal_mm)))
    crops = gather(source, nodes.positions, largest + MARGIN_MM, params.threads if params else 0)
    return fit_crops(crops, source.scanners, nodes, members, catalogue, nominal_mm, station_covariance, params, limits)


def fit_crops(
    crops: Crops,
    scanners: Floats,
    nodes: Nodes,
    members: Members,
    catalogue: Catalogue,
    nominal_mm: Floats | None = None,
    station_covariance: Floats | None = None,
    params: RayFitParams | None = None,
    limits: Tolerance | None = None,
) -> Spheres:
    """Fit a sphere to each node's gathered points; see :func:`fit_spheres`."""
    params = params or RayFitParams()
    problem = _Problem(
        crops=with_rays(crops, np.array(nodes.positions), np.array(scanners, np.float64), params.threads),
        ends=sleeve_radii.member_ends(nodes, members),
        centre_weight=centre_weights(nodes.covariance),
        nominal=np.full(nodes.count, NAN) if nominal_mm is None else np.asarray(nominal_mm, np.float64),
        catalogue=catalogue,
        params=params,
    )
    fits, setting, residuals = _rounds(problem, len(scanners), station_covariance)
    if catalogue.assumed:
        by_points = stochastic_model.without_prior(
            fits.states[:, 3], fits.covariance[:, 3, 3], fits.sizes, setting.radius_sd
        )
        shared = shared_sizes.estimated(*by_points, catalogue, problem.nominal)
        if shared is not None:
            del residuals
            catalogue = shared
            problem = replace(problem, catalogue=shared)
            fits, setting, residuals = _rounds(problem, len(scanners), station_covariance)
    scanners_known = bool(np.any(problem.crops.ranges > 0.0))
    priors = Priors(problem.centre_weight, fits.sizes, np.full(len(fits.sizes), setting.size_weight(problem.free)))
    offset = (0.0, np.inf)
    if len(catalogue.radii) and not catalogue.estimated:
        sure = fits.clear
        offset = stochastic_model.radius_offset(
            fits.states[sure, 3], fits.covariance[sure, 3, 3], fits.sizes[sure], setting.radius_sd, catalogue.sd_mm
        )
    views = None
    if not scanners_known:
        views = view_errors(problem.crops, residuals.weights, fits, priors, nodes.positions, offset[0])
    context = assessment.FitContext(
        catalogue=catalogue,
        scanners_known=scanners_known,
        views=views,
        noise=setting.noise,
        radius_sd=setting.radius_sd,
        station_sd=setting.station_sd if station_covariance is None else NAN,
        radius_offset=offset,
        limits=standards.default_for(limits),
    )
    return assessment.assess(fits, nodes, problem.nominal, context)


def _rounds(problem: _Problem, scanners: int, station_covariance: Floats | None) -> tuple[Fits, _Setting, Residuals]:
    """Alternate fits and the estimates from all of them; returns the last fits, their setting, residuals."""
    catalogue, ranges, known = problem.catalogue, problem.crops.ranges, station_covariance is not None
    setting = _Setting(
        noise=np.array([problem.params.sigma_mm**2, 0.0, 0.0]),
        model_points=10.0,
        sleeve_radii=sleeve_radii.from_tubes(problem.ends),
        radius_sd=catalogue.sd_mm,
        least_cosine=problem.params.least_cosine,
        station_sd=0.0,
        shift=np.array(station_covariance, np.float64) if known else np.zeros((scanners, 3, 3)),
    )
    fits: Fits | None = None
    for iteration in range(ROUNDS):
        fits, residuals = _fit(problem, setting, fits)
        if iteration == ROUNDS - 1 or (iteration == 1 and setting.station_sd == 0.0):
            return fits, setting, residuals
        estimate = _estimated(problem, setting, fits, residuals)
        del residuals  # those of many points take more memory than the fits
        if known:
            estimate = replace(estimate, station_sd=0.0, shift=setting.shift)
        noisier = typical_variance(estimate.noise, ranges) > 2.0 * typical_variance(setting.noise, ranges)
        # sleeves larger or beams wider than guessed, or shifted stations, may have led to a wrong size
        spoilt = bool((estimate.sleeve_radii > setting.sleeve_radii + AXIS_MM).any())
        spoilt = spoilt or estimate.least_cosine > setting.least_cosine
        if noisier or spoilt or estimate.station_sd > 1.2 * setting.station_sd:
            fits = None
        setting = estimate
    raise AssertionError("the last round returns")


def _estimated(problem: _Problem, setting: _Setting, fits: Fits, residuals: Residuals) -> _Setting:
    """Estimate the next round's setting from all spheres of one round."""
    crops, catalogue, threads = problem.crops, problem.catalogue, problem.params.threads
    errors, cosines, weights = residuals
    radii = sleeve_radii.estimated(problem.ends, crops.start, crops.points, fits.states, threads)
    noise, count = stochastic_model.noise_model(errors, cosines, crops.ranges, weights, setting.noise)
    limb = stochastic_model.limb_cosine(errors, cosines, crops.ranges, weights, noise, setting.least_cosine)
    sure, radius_sd, size_weight = fits.clear, setting.radius_sd, setting.size_weight(problem.free)
    if not problem.free:
        radius_sd = stochastic_model.radius_scatter(
            fits.states[sure, 3], fits.covariance[sure, 3, 3], fits.sizes[sure], setting.radius_sd, catalogue.sd_mm
        )
    # once the fits allow for shifts, their residuals no longer show them
    station_sd = setting.station_sd
    if not station_sd:
        priors = Priors(problem.centre_weight, fits.sizes, np.full(len(fits.sizes), size_weight))
        station_sd = stochastic_model.shift_sd(crops, weights, fits.states, sure, noise, priors, threads)
    return _Setting(
        noise=noise,
        model_points=min(count, MOST_MODEL_POINTS),
        sleeve_radii=radii,
        radius_sd=radius_sd,
        least_cosine=limb,
        station_sd=station_sd,
        shift=np.tile(station_sd**2 * np.eye(3), (len(setting.shift), 1, 1)),
    )


def _fit(problem: _Problem, setting: _Setting, before: Fits | None) -> tuple[Fits, Residuals]:
    """One round: choose sizes, except where ``before`` has final ones, and fit."""
    params, ends = problem.params, problem.ends
    sigma = float(np.sqrt(typical_variance(setting.noise, problem.crops.ranges)))
    tube = np.where(np.isfinite(ends.tube_radii), ends.tube_radii, 1.5 * setting.sleeve_radii)
    masks = Masks(
        start=ends.start,
        axis_points=ends.points,
        axes=ends.directions,
        keep_off=setting.sleeve_radii + FLAT_MM + AXIS_MM + 0.5 * sigma,
        tube_off=tube + 2.0 + 2.0 * sigma,
        hole=params.process_hole_mm,
        least_cosine=setting.least_cosine,
    )
    model = StochasticModel(setting.noise, setting.shift)
    size_weight = setting.size_weight(problem.free)
    sizes = Sizes(
        sizes=FREE_SIZES if problem.free else np.array(problem.catalogue.radii),
        weight=size_weight,
        nominal=problem.nominal,
        other_size_penalty=params.other_size_penalty,
        free=problem.free,
        centre_weight=problem.centre_weight,
    )
    undecided = np.ones(len(problem.nominal), bool) if before is None else ~before.final_size
    to_choose = NodesToChoose(
        crops=problem.crops, masks=masks, model=model, sizes=sizes, vote_half_width=2.5 * sigma + 1.0,
        first_reach_mm=params.first_reach_mm, wanted=undecided, threads=params.threads,
    )  # fmt: skip
    choice = _choose(to_choose)
    if before is not None:
        earlier = SizeChoice(before.states, before.sizes, before.energy, before.second, before.second_energy)
        for new, old in zip(choice, earlier, strict=True):
            new[~undecided] = old[~undecided]
    keep_nominal(choice, problem.nominal)
    priors = Priors(problem.centre_weight, choice.sizes, np.full(len(choice.sizes), size_weight))
    final = _fit_final(
        NodesToFit(
            crops=problem.crops,
            masks=masks,
            model=model,
            model_points=setting.model_points,
            priors=priors,
            states=choice.states,
            first_reach_mm=CUT_SD * sigma,
            threads=params.threads,
        )
    )
    fits = Fits(
        states=final.states,
        covariance=final.covariances,
        bound=final.bounds,
        sizes=choice.sizes,
        energy=choice.energy,
        second=choice.second,
        second_energy=choice.second_energy,
        numbers=final.numbers,
    )
    return fits, final.residuals


def keep_nominal(choice: SizeChoice, nominal: Floats) -> None:
    """Take the nominal size (k,) where it is the runner-up and is not ruled out, in place."""
    rows = (choice.second == nominal) & (choice.second_energy < choice.energy + AMBIGUOUS)
    choice.second[rows] = choice.sizes[rows]
    choice.sizes[rows] = choice.states[rows, 3] = nominal[rows]


def typical_variance(noise: Floats, ranges: Floats) -> float:
    """Variance of a range at normal incidence and the median range, mm^2."""
    known = ranges[ranges > 0.0]
    return float(noise[0] + noise[1] * (float(np.median(known)) ** 2 if len(known) else 0.0))


def centre_weights(covariance: Floats) -> Floats:
    """Inverse covariances (k, 3, 3) of nodes; 0 where a node's position is unknown or vague."""
    weights = np.zeros_like(covariance)
    known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    known[known] &= np.linalg.eigvalsh(covariance[known]).max(axis=1) < VAGUE_MM**2
    weights[known] = np.linalg.inv(covariance[known])
    return weights


# --- tiles of nodes, each with the points about them -----------------------------------------------------------------


def _choose(nodes: NodesToChoose) -> SizeChoice:
    """Choose the size of each node's sphere; see :func:`processor.space_frame.spheres.size_selection.choose`."""
    parts = tiles.mapped(size_selection.choose, [nodes.of_nodes(rows) for rows in _ranges(len(nodes.wanted))])
    return SizeChoice(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _fit_final(nodes: NodesToFit) -> Finished:
    """Fit every node whose state is finite; see :func:`processor.space_frame.spheres.ball_fit.fit_final`."""
    start, ranges = nodes.crops.start, _ranges(len(nodes.states))
    # The residuals of many points take more memory than all else: those of a tile are copied and forgotten.
    residuals = Residuals(*(np.empty(len(nodes.crops.points)) for _ in Residuals._fields))
    of_nodes = list[tuple[Floats, ...]]()
    parts = tiles.mapped(ball_fit.fit_final, [nodes.of_nodes(rows) for rows in ranges])
    for rows, part in zip(ranges, parts, strict=True):
        for column, values in zip(residuals, part.residuals, strict=True):
            column[start[rows.start] : start[rows.stop]] = values
        of_nodes.append(part[:-1])
    states, covariances, bounds, numbers = (np.concatenate(columns) for columns in zip(*of_nodes, strict=True))
    return Finished(states, covariances, bounds, numbers, residuals)


def _ranges(count: int) -> list[slice]:
    """Return the rows of the nodes of each tile; one of none where there are none."""
    return tiles.ranges(count, NODES) or [slice(0, 0)]
