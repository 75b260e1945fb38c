"""Evidence, flag and reasons of each fitted sphere."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.special import chdtrc

from processor.limits import standards
from processor.model import NORMAL_95, Floats, Tolerance
from processor.space_frame.catalogue import Catalogue
from processor.space_frame.members.records import Nodes
from processor.space_frame.spheres.final_fit import BANDS, SECTORS
from processor.space_frame.spheres.records import (
    AMBIGUOUS,
    CELLS,
    CENTRE_CHI2,
    DEGREES,
    POINTS,
    RMS,
    SCALE,
    STATIONS,
    Fits,
    Spheres,
)

Bools = npt.NDArray[np.bool_]

AMBIGUOUS_DESIGN = "ambiguous which ball of the design this is, and these differ in size: none is called wrong"
LEAST_POINTS = 8
LARGEST_LOWEST_SD_MM = 0.8  # an error of 3 mm is then nearly four standard deviations
LARGEST_RADIUS_SD = 0.05
LARGEST_SCALE = 1.6
UNLIKELY = 1e-3  # probability below which points and priors disagree
LEAST_GAIN = 0.02  # share of a prior's variance that points must remove to be tested against it
SURE = 3.0  # standard deviations beyond which an offset of all radii is reported
UNLISTED = 6.0  # scatters of radii off its size, from which on a sphere is of no size of the catalogue
FEW = 30
FEW_MARGIN = 10.0  # added to the margin that the runner-up must lose by, where points are few
NAN = float("nan")
DOWN = np.array([0.0, 0.0, 1.0, -1.0])  # height of the lowest point by (x, y, z, radius)


@dataclass(frozen=True)
class Conditions:
    """Facts about a whole fit that each sphere is assessed by.

    ``radius_offset`` is the mean deviation of radii from their sizes and its standard deviation, mm. It may come from
    an offset of all ranges or from the beam's width, so it is not removed: it enters the covariances of radii. Seen
    from below, the surface is not moved by it. ``limits`` has the tolerance of a sphere's blank, by which a size is
    wrong where no catalogue decides it.
    """

    catalogue: Catalogue
    rays: bool  # scanners are known
    noise: Floats
    radius_sd: float
    station_sd: float
    radius_offset: tuple[float, float]
    limits: Tolerance


def assess(fits: Fits, nodes: Nodes, expected: Floats, conditions: Conditions) -> Spheres:
    """Return the spheres with evidence, flag and reason; ``expected`` (k,) are nominal radii, NaN = none."""
    state, covariance = _states(fits, nodes, expected, conditions)
    evidence, flags, reasons = _verdicts(fits, nodes, expected, conditions, state, covariance)
    centres = nodes.positions + state[:, :3]
    bound = fits.bound
    lowest_sd = np.sqrt(np.einsum("i,kij,j->k", DOWN, covariance, DOWN))
    bound_lowest = np.sqrt(np.einsum("i,kij,j->k", DOWN, bound, DOWN))
    with np.errstate(invalid="ignore"):
        trace = np.sqrt(np.einsum("kii->k", bound[:, :3, :3]) / np.einsum("kii->k", covariance[:, :3, :3]))
        by_radius = np.sqrt(bound[:, 3, 3] / covariance[:, 3, 3])
    return Spheres(
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
        points=fits.numbers[:, POINTS].astype(np.int64),
        visible_fraction=fits.numbers[:, CELLS] / (BANDS * SECTORS),
        stations=fits.numbers[:, STATIONS].astype(np.int64),
        axes=nodes.axes,
        rms=fits.numbers[:, RMS],
        scale=fits.numbers[:, SCALE],
        sizes=fits.sizes,
        second_sizes=fits.second,
        margin=fits.margin,
        expected=expected,
        evidence=tuple(evidence),
        flag=tuple(flags),
        reason=tuple(reasons),
        noise=conditions.noise,
        radius_sd=conditions.radius_sd,
        station_sd=conditions.station_sd,
        message=_message(conditions),
    )


def _states(fits: Fits, nodes: Nodes, expected: Floats, conditions: Conditions) -> tuple[Floats, Floats]:
    """States (k, 4) and their covariances: those of the fits, or of the axes and the design where there is no fit."""
    state = fits.states.copy()
    degrees = fits.numbers[:, DEGREES]
    # The scale is estimated: the variance of Student's t is wider than the normal one.
    wider = np.where(degrees > 4.0, degrees / np.maximum(degrees - 2.0, 1.0), 2.0)
    common = np.array([0.0, 0.0, 1.0, 1.0]) * conditions.radius_offset[0]
    covariance = fits.covariance * wider[:, None, None] + np.outer(common, common)
    for i in np.flatnonzero(~fits.fitted).tolist():
        state[i, :3] = 0.0
        state[i, 3] = expected[i]
        covariance[i] = np.nan
        covariance[i, :3, :3] = nodes.covariance[i]
        if np.isfinite(expected[i]):
            covariance[i, 3, :], covariance[i, :, 3] = 0.0, 0.0
            covariance[i, 3, 3] = conditions.radius_sd**2
    return state, covariance


def _verdicts(
    fits: Fits, nodes: Nodes, expected: Floats, conditions: Conditions, state: Floats, covariance: Floats
) -> tuple[list[str], list[str], list[str]]:
    """Evidence, flag and reason of each node."""
    sized = len(conditions.catalogue.radii) > 0
    axes_known = np.asarray(np.isfinite(nodes.covariance).all(axis=(1, 2)))
    agreement = agreements(fits, nodes, conditions.radius_sd if sized else np.inf)
    margin = fits.margin
    evidence, flags, reasons = [], [], []
    for i, fitted in enumerate(fits.fitted.tolist()):
        if not fitted:
            flag, reason = _without_points(int(nodes.axes[i]), bool(axes_known[i]), bool(np.isfinite(expected[i])))
            evidence.append("axes")
        else:
            evidence.append("fused" if axes_known[i] and fits.numbers[i, CENTRE_CHI2] > 0.0 else "ball")
            doubts = _doubts(fits, i, margin[i], state[i], covariance[i])
            flag, reason = _verdict(
                doubts, state[i], float(np.sqrt(covariance[i, 3, 3])), fits.sizes[i], expected[i],
                bool(agreement[i] < UNLIKELY), conditions,
            )  # fmt: skip
        flags.append(flag)
        reasons.append(reason)
    return evidence, flags, reasons


def _without_points(axes: int, axes_known: bool, radius_known: bool) -> tuple[str, str]:
    """Flag and reason of a node whose sphere no point lies on."""
    if not axes_known or axes < 2:
        return "not-found", "no ball seen, and no two axes that fix the node"
    source = "the radius is the design's" if radius_known else "the radius is unknown"
    return "low-confidence", f"no ball seen, known from {axes} axes alone; {source}"


def _doubts(fits: Fits, i: int, margin: float, state: Floats, C: Floats) -> list[str]:
    """Reasons against relying on fit ``i``, from its points alone."""
    n, scale = int(fits.numbers[i, POINTS]), fits.numbers[i, SCALE]
    lowest_sd = float(np.sqrt(max(C[2, 2] + C[3, 3] - 2.0 * C[2, 3], 0.0)))
    doubts: list[str] = []
    if n < LEAST_POINTS:
        doubts.append(f"{n} points, fewer than {LEAST_POINTS}")
    if not lowest_sd <= LARGEST_LOWEST_SD_MM:
        doubts.append(f"ill-conditioned: sd of the lowest point {lowest_sd:.1f} mm")
    if not np.sqrt(C[3, 3]) <= LARGEST_RADIUS_SD * state[3]:
        doubts.append(f"ill-conditioned: sd of the radius {np.sqrt(C[3, 3]):.1f} mm")
    if margin < AMBIGUOUS + (FEW_MARGIN if n < FEW else 0.0):
        doubts.append(f"size ambiguous: {fits.second[i]:.0f} mm fits nearly as well ({margin:.0f})")
    if scale > LARGEST_SCALE:
        doubts.append(f"not round: residuals {scale:.1f} times the noise of all balls")
    return doubts


def _verdict(
    doubts: list[str],
    state: Floats,
    radius_sd: float,
    size: float,
    expected: float,
    disagrees: bool,
    conditions: Conditions,
) -> tuple[str, str]:
    """Flag and reason of a fitted sphere, by its doubts, its priors (``disagrees``) and its nominal radius."""
    catalogue = conditions.catalogue
    away, off = float(np.linalg.norm(state[:3])), float(state[3] - size)
    if not doubts and _unlisted(disagrees, off, conditions.radius_sd, catalogue):
        message = beyond(state[3], expected, NORMAL_95 * radius_sd, conditions.limits)
        if message:
            return "wrong-size", message
    if disagrees:
        sized = f" and its radius off the size by {off:+.1f} mm" if len(catalogue.radii) else ""
        doubts = [*doubts, f"ball and axes disagree: centres {away:.1f} mm apart{sized}"]
    if doubts:
        return "low-confidence", "; ".join(doubts)
    if np.isfinite(expected) and len(catalogue.radii) and size != expected:
        return "wrong-size", f"size {size:g} mm instead of {expected:g} mm"
    return "ok", ""


def _unlisted(disagrees: bool, off: float, radius_sd: float, catalogue: Catalogue) -> bool:
    """Whether a sphere without other doubts may be of a size that the catalogue does not list.

    Without a catalogue every sphere may. With one, points and priors must disagree, and the radius must be ``off`` mm
    from the size by far more than radii scatter.
    """
    if not len(catalogue.radii):
        return not disagrees
    return disagrees and abs(off) > UNLISTED * radius_sd


def _message(conditions: Conditions) -> str:
    """Return the message about all spheres of a fit."""
    offset, offset_sd = conditions.radius_offset
    catalogue = conditions.catalogue
    message = (
        "ranges from the known scanners"
        if conditions.rays
        else "orthogonal distances, for the scanners are unknown: the bias of range noise stands, from none to that of "
        "noise in all directions; the middle is taken off, the rest is in the intervals"
    )
    if conditions.station_sd > 0.0:
        message += f"; stations disagree by {conditions.station_sd:.1f} mm an axis (sd), which every covariance holds"
    if abs(offset) > SURE * offset_sd:
        message += f"; radii lie {offset:+.2f} mm off their sizes on the whole, as where all ranges err alike or "
        message += "the beam is wide: their intervals hold that"
    if len(catalogue.radii) and not catalogue.verified:
        message += f"; the catalogue of radii ({catalogue.name}) was not held against a published one"
    return message


def agreements(fits: Fits, nodes: Nodes, radius_sd: float) -> Floats:
    """Probabilities (k,) that points and priors of one sphere differ by as much as they do or more; 1 without both.

    The change of an estimate by the points has the covariance by which they reduce that of the prior.
    """
    probability = np.ones(nodes.count)
    placed = np.isfinite(nodes.covariance).all(axis=(1, 2)) & np.asarray(fits.numbers[:, CENTRE_CHI2] > 0.0)
    sized = bool(np.isfinite(radius_sd))
    change = fits.states - fits.sizes[:, None] * np.array([0.0, 0.0, 0.0, 1.0])
    for has_place in (True, False):
        known = np.flatnonzero([has_place] * 3 + [sized])
        rows = np.flatnonzero(fits.fitted & (placed == has_place))
        if not len(known) or not len(rows):
            continue
        prior = np.zeros((len(rows), 4, 4))
        if has_place:
            prior[:, :3, :3] = nodes.covariance[rows]
        if sized:
            prior[:, 3, 3] = radius_sd**2
        L = np.linalg.inv(np.linalg.cholesky(prior[:, known[:, None], known]))
        C = fits.covariance[rows][:, known[:, None], known]
        reduction, axes = np.linalg.eigh(np.eye(len(known)) - L @ C @ np.swapaxes(L, 1, 2))
        along = np.einsum("kji,kjl,kl->ki", axes, L, change[rows][:, known])
        probability[rows] = chdtrc(len(known), np.sum(along**2 / np.maximum(reduction, LEAST_GAIN), axis=1))
    return probability


# --- later changes of flags and reasons ------------------------------------------------------------------------------


def with_shared_offset(spheres: Spheres, covariance: Floats) -> Spheres:
    """Flag spheres whose lowest points are too uncertain with a further covariance (k, 3, 3) of their centres."""
    sd = np.sqrt(spheres.lowest_sd**2 + covariance[:, 2, 2])
    rows = [i for i, flag in enumerate(spheres.flag) if flag == "ok" and not sd[i] <= LARGEST_LOWEST_SD_MM]
    flags, reasons = list(spheres.flag), list(spheres.reason)
    for i in rows:
        flags[i] = "low-confidence"
        reasons[i] = f"what all ranges may be off alike leaves an sd of the lowest point of {sd[i]:.1f} mm"
    return replace(spheres, flag=tuple(flags), reason=tuple(reasons))


def with_ambiguous_design(spheres: Spheres, rows: Bools) -> Spheres:
    """Add a reason to spheres (k,) for which poses of the design give different nominal radii: none is wrong then."""
    reasons = list(spheres.reason)
    for i in np.flatnonzero(rows).tolist():
        reasons[i] = "; ".join(filter(None, (reasons[i], AMBIGUOUS_DESIGN)))
    return replace(spheres, reason=tuple(reasons))


# --- deviation of a radius from the nominal one, by a standard's limits on the blank's diameter ----------------------


def blank_tolerance(radius: float, limits: Tolerance) -> tuple[float, float]:
    """Return by how much (mm) a radius may be smaller and larger: half of the limits on the blank's diameter.

    Where ``limits`` has none for spheres, those of the default standard are used.
    """
    for standard in (limits, standards.load(standards.DEFAULT)):
        for limit in standard.limits:
            if limit.key.startswith("ball_blank_diameter_") and standards.applies(limit, 2.0 * radius):
                low, high = standards.bounds(limit, {"diameter": 2.0 * radius})
                return -0.5 * low, 0.5 * high
    return NAN, NAN


def beyond(radius: float, nominal: float, margin: float, limits: Tolerance) -> str:
    """Return a message if a radius exceeds the blank's tolerance by more than ``margin`` mm; else an empty text."""
    below, above = blank_tolerance(nominal, limits)
    error = radius - nominal
    if not (error < -below - margin or error > above + margin):
        return ""
    return f"radius {error:+.1f} mm from nominal, beyond the blank's +{above:g}/-{below:g} by {margin:.1f} mm"
