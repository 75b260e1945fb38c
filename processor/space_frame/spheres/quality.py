"""What each fitted ball is worth: evidence, flag and every reason for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.special import chdtrc

from processor.limits import standards
from processor.model import NORMAL_95, Floats, Tolerance
from processor.space_frame.catalogue import Catalogue
from processor.space_frame.members.records import Nodes
from processor.space_frame.spheres.records import AMBIGUOUS, Balls, Fits

Bools = npt.NDArray[np.bool_]

AMBIGUOUS_DESIGN = "ambiguous which ball of the design this is, and these differ in size: none is called wrong"
CELLS = 200
LEAST_POINTS = 8
LARGEST_LOWEST_SD_MM = 0.8  # 3 mm off is then nearly four standard deviations
LARGEST_RADIUS_SD = 0.05
LARGEST_SCALE = 1.6
UNLIKELY = 1e-3  # probability below which ball and priors are said to disagree
LEAST_NEWS = 0.02  # share of a prior's variance that points must take away to be heard against it
SURE = 3.0  # standard deviations beyond which an offset of all radii is spoken of
UNLISTED = 6.0  # scatters of radii, off its size: a ball is of none in the catalogue
FEW = 30
FEW_MARGIN = 10.0  # more that the runner-up must lose by where points are few


def judged(
    fits: Fits,
    nodes: Nodes,
    expected: Floats,
    catalogue: Catalogue,
    rays: bool,
    noise: Floats,
    radius_sd: float,
    station_sd: float,
    offset: tuple[float, float],
    limits: Tolerance,
) -> Balls:
    """Give every node its numbers, evidence, flag and reason.

    ``offset`` is what radii lie off their sizes on the whole and its standard deviation, mm: it may come from an offset
    of all ranges or from the beam's width, so it stays in the radii, and in their covariances. Seen from below the
    surface stays where it is. ``limits`` hold the tolerance of a ball's blank: what is beyond it is of another size
    where the catalogue does not say so.
    """
    k = nodes.count
    fitted = np.asarray(fits.numbers[:, 7] > 0)
    state = fits.states.copy()
    degrees = fits.numbers[:, 5]
    # The scale is estimated: the variance of Student's t is wider than the normal one.
    wider = np.where(degrees > 4.0, degrees / np.maximum(degrees - 2.0, 1.0), 2.0)
    common = np.array([0.0, 0.0, 1.0, 1.0]) * offset[0]
    covariance = fits.covariance * wider[:, None, None] + np.outer(common, common)
    axes_known = np.asarray(np.isfinite(nodes.covariance).all(axis=(1, 2)))
    evidence, flags, reasons = [], [], []
    margin = fits.margin
    agreement = agreements(fits, nodes, radius_sd if len(catalogue.radii) else np.inf)
    for i in range(k):
        doubts: list[str] = []
        flag = "ok"
        if not fitted[i]:
            state[i, :3] = 0.0
            state[i, 3] = expected[i]
            covariance[i] = np.nan
            covariance[i, :3, :3] = nodes.covariance[i]
            if np.isfinite(expected[i]):
                covariance[i, 3, :], covariance[i, :, 3] = 0.0, 0.0
                covariance[i, 3, 3] = radius_sd**2
            evidence.append("axes")
            enough = axes_known[i] and nodes.axes[i] >= 2
            flags.append("low-confidence" if enough else "not-found")
            seen = f"known from {nodes.axes[i]} axes alone" if enough else "and no two axes that fix the node"
            source = "the radius is the design's" if np.isfinite(expected[i]) else "the radius is unknown"
            reasons.append(f"no ball seen, {seen}" + (f"; {source}" if enough else ""))
            continue
        has_prior = bool(axes_known[i]) and fits.numbers[i, 6] > 0.0
        evidence.append("fused" if has_prior else "ball")
        n = int(fits.numbers[i, 0])
        C = covariance[i]
        lowest_sd = float(np.sqrt(max(C[2, 2] + C[3, 3] - 2.0 * C[2, 3], 0.0)))
        if n < LEAST_POINTS:
            doubts.append(f"{n} points, fewer than {LEAST_POINTS}")
        if not lowest_sd <= LARGEST_LOWEST_SD_MM:
            doubts.append(f"ill-conditioned: sd of the lowest point {lowest_sd:.1f} mm")
        if not np.sqrt(C[3, 3]) <= LARGEST_RADIUS_SD * state[i, 3]:
            doubts.append(f"ill-conditioned: sd of the radius {np.sqrt(C[3, 3]):.1f} mm")
        if margin[i] < AMBIGUOUS + (FEW_MARGIN if n < FEW else 0.0):
            doubts.append(f"size ambiguous: {fits.second[i]:.0f} mm fits nearly as well ({margin[i]:.0f})")
        if fits.numbers[i, 4] > LARGEST_SCALE:
            doubts.append(f"not round: residuals {fits.numbers[i, 4]:.1f} times the noise of all balls")
        away, off = float(np.linalg.norm(state[i, :3])), float(state[i, 3] - fits.sizes[i])
        unlisted = not doubts and _unlisted(agreement[i] < UNLIKELY, off, radius_sd, catalogue)
        if unlisted and (said := beyond(state[i, 3], expected[i], NORMAL_95 * float(np.sqrt(C[3, 3])), limits)):
            flags.append("wrong-size")
            reasons.append(said)
            continue
        if agreement[i] < UNLIKELY:
            sized = f" and its radius off the size by {off:+.1f} mm" if len(catalogue.radii) else ""
            doubts.append(f"ball and axes disagree: centres {away:.1f} mm apart{sized}")
        if doubts:
            flag = "low-confidence"
        elif np.isfinite(expected[i]) and len(catalogue.radii) and fits.sizes[i] != expected[i]:
            flag = "wrong-size"
            doubts.append(f"size {fits.sizes[i]:g} mm instead of {expected[i]:g} mm")
        flags.append(flag)
        reasons.append("; ".join(doubts))
    centres = nodes.positions + state[:, :3]
    bound = fits.bound
    down = np.array([0.0, 0.0, 1.0, -1.0])
    lowest_sd = np.sqrt(np.einsum("i,kij,j->k", down, covariance, down))
    bound_lowest = np.sqrt(np.einsum("i,kij,j->k", down, bound, down))
    with np.errstate(invalid="ignore"):
        trace = np.sqrt(np.einsum("kii->k", bound[:, :3, :3]) / np.einsum("kii->k", covariance[:, :3, :3]))
        by_radius = np.sqrt(bound[:, 3, 3] / covariance[:, 3, 3])
    message = (
        "ranges from the known scanners"
        if rays
        else "orthogonal distances, for the scanners are unknown: the bias of range noise stands, from none to that of "
        "noise in all directions; the middle is taken off, the rest is in the intervals"
    )
    if station_sd > 0.0:
        message += f"; stations disagree by {station_sd:.1f} mm an axis (sd), which every covariance holds"
    if abs(offset[0]) > SURE * offset[1]:
        message += f"; radii lie {offset[0]:+.2f} mm off their sizes on the whole, as where all ranges err alike or "
        message += "the beam is wide: their intervals hold that"
    if len(catalogue.radii) and not catalogue.verified:
        message += f"; the catalogue of radii ({catalogue.name}) was not held against a published one"
    return Balls(
        centres=centres,
        radii=state[:, 3],
        lowest=centres - state[:, 3:] * np.array([0.0, 0.0, 1.0]),
        covariance=covariance,
        lowest_sd=lowest_sd,
        bound=bound,
        bound_lowest_sd=bound_lowest,
        efficiency_centre=trace,
        efficiency_radius=by_radius,
        efficiency_lowest=bound_lowest / lowest_sd,
        points=fits.numbers[:, 0].astype(np.int64),
        visible_fraction=fits.numbers[:, 1] / CELLS,
        stations=fits.numbers[:, 2].astype(np.int64),
        axes=nodes.axes,
        rms=fits.numbers[:, 3],
        scale=fits.numbers[:, 4],
        sizes=fits.sizes,
        second_sizes=fits.second,
        margin=margin,
        expected=expected,
        evidence=tuple(evidence),
        flag=tuple(flags),
        reason=tuple(reasons),
        noise=noise,
        radius_sd=radius_sd,
        station_sd=station_sd,
        message=message,
    )


def _unlisted(disagrees: bool, off: float, radius_sd: float, catalogue: Catalogue) -> bool:
    """Whether a ball that nothing else speaks against may be of a size that is none of the catalogue's.

    Without a catalogue every ball may. With one, that shows by a radius ``off`` mm from the size by far more than balls
    scatter, which is what points and priors disagree about.
    """
    if not len(catalogue.radii):
        return not disagrees
    return disagrees and abs(off) > UNLISTED * radius_sd


def doubted(found: Balls, beside: Floats) -> Balls:
    """Flag balls whose lowest points are no longer sure with a further covariance (k, 3, 3) of their centres."""
    sd = np.sqrt(found.lowest_sd**2 + beside[:, 2, 2])
    rows = [i for i, flag in enumerate(found.flag) if flag == "ok" and not sd[i] <= LARGEST_LOWEST_SD_MM]
    flags, reasons = list(found.flag), list(found.reason)
    for i in rows:
        flags[i] = "low-confidence"
        reasons[i] = f"what all ranges may be off alike leaves an sd of the lowest point of {sd[i]:.1f} mm"
    return replace(found, flag=tuple(flags), reason=tuple(reasons))


def ambiguous(found: Balls, rows: Bools) -> Balls:
    """Say of balls (k,) that poses of the design disagree on which of its balls they are: no size is wrong then."""
    reasons = list(found.reason)
    for i in np.flatnonzero(rows).tolist():
        reasons[i] = "; ".join(filter(None, (reasons[i], AMBIGUOUS_DESIGN)))
    return replace(found, reason=tuple(reasons))


def agreements(fits: Fits, nodes: Nodes, radius_sd: float) -> Floats:
    """Probabilities (k,) that points and priors of one ball differ as much as they do or more; 1 without both.

    What the points move an estimate by has the covariance that they take away from the prior.
    """
    found = np.ones(nodes.count)
    fitted = np.asarray(fits.numbers[:, 7] > 0)
    placed = np.isfinite(nodes.covariance).all(axis=(1, 2)) & np.asarray(fits.numbers[:, 6] > 0.0)
    sized = bool(np.isfinite(radius_sd))
    every = fits.states - fits.sizes[:, None] * np.array([0.0, 0.0, 0.0, 1.0])
    for has_place in (True, False):
        held = np.flatnonzero([has_place] * 3 + [sized])
        rows = np.flatnonzero(fitted & (placed == has_place))
        if not len(held) or not len(rows):
            continue
        prior = np.zeros((len(rows), 4, 4))
        if has_place:
            prior[:, :3, :3] = nodes.covariance[rows]
        if sized:
            prior[:, 3, 3] = radius_sd**2
        L = np.linalg.inv(np.linalg.cholesky(prior[:, held[:, None], held]))
        C = fits.covariance[rows][:, held[:, None], held]
        taken, axes = np.linalg.eigh(np.eye(len(held)) - L @ C @ np.swapaxes(L, 1, 2))
        along = np.einsum("kji,kjl,kl->ki", axes, L, every[rows][:, held])
        found[rows] = chdtrc(len(held), np.sum(along**2 / np.maximum(taken, LEAST_NEWS), axis=1))
    return found


# --- How far a ball's radius may be off its nominal one, by a standard's limits on the blank's diameter.


NAN = float("nan")


def blank_tolerance(radius: float, limits: Tolerance) -> tuple[float, float]:
    """How much smaller and larger in mm a ball's radius may be: half of the limits on the blank's diameter.

    Limits that do not speak of balls leave them to those of the default standard.
    """
    for one in (limits, standards.load(standards.DEFAULT)):
        for limit in one.limits:
            if limit.key.startswith("ball_blank_diameter_") and standards.applies(limit, 2.0 * radius):
                low, high = standards.bounds(limit, {"diameter": 2.0 * radius})
                return -0.5 * low, 0.5 * high
    return NAN, NAN


def beyond(radius: float, nominal: float, margin: float, limits: Tolerance) -> str:
    """Say that a radius is beyond the blank's tolerance by more than ``margin`` in mm; empty where it is not."""
    below, above = blank_tolerance(nominal, limits)
    error = radius - nominal
    if not (error < -below - margin or error > above + margin):
        return ""
    return f"radius {error:+.1f} mm from nominal, beyond the blank's +{above:g}/-{below:g} by {margin:.1f} mm"
