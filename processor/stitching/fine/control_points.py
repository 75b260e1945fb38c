"""Control points in the adjustment: they fix the frame of a network of scans, and correct the poses.

The network's poses with their joint covariance are observations. Unknown are the poses, the motion of the network into
the frame of the control points, and the true places of these, of which the known places are observations too. Places
are eliminated: a sighting is known place less seen place, and sightings of one point share the error of the known one.
Each Gauss-Newton step is the best linear unbiased prediction of all errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from processor.adjustment import data_snooping
from processor.adjustment.body_motions import variances
from processor.adjustment.control_points import Sightings
from processor.geometry import rigid
from processor.model import Bools, Control, Floats, InputError, Reason, reason
from processor.stitching import common_point_checks
from processor.stitching.result import ControlPoints, ControlSightings

CLEAR = 10.0  # least distance from a line in standard deviations; nearer points do not determine the rotation about it
LEAST_SD_MM = 1e-3  # of a sighting; the covariance would be singular without
# Of the sightings of a scan that give it a pose: greatest misfit, and least extent across their longest one.
GROSS_MM, LEAST_SPREAD_MM = 50.0, 300.0
ROUNDS, STILL = 12, 1e-10  # of relinearisation, and the step (rad, mm) that ends it: rounding
MOST = 1000  # sightings; the equations are dense
LOOSENED = 30  # rounds at most


@dataclass(frozen=True)
class Fit:
    """A network adjusted on control points; ``misfit`` (3m,) is known less seen place by the uncorrected poses.

    ``M`` (4, 4) maps the network's frame to the control points', ``T`` (k, 4, 4) are the corrected poses in the
    network's frame. ``cofactor`` (3m, 3m) is ``weight`` less the part that the motion M absorbs.
    """

    M: Floats
    T: Floats
    misfit: Floats
    observed: Floats  # (3m, 3m) covariance of sightings and known places
    weight: Floats  # (3m, 3m) inverse of the misfit's covariance
    cofactor: Floats
    J: Floats  # (3m, 6k) derivative of the places by rotations of scans about their origins, and by shifts
    covariance: Floats  # (6 + 6k, 6 + 6k) of the motion M and the scans' motions

    @property
    def chi2(self) -> float:
        """Chi-square of the misfits."""
        return float(self.misfit @ self.cofactor @ self.misfit)

    @property
    def free(self) -> int:
        """Redundancy."""
        return len(self.misfit) - 6


@dataclass(frozen=True)
class Placed:
    """The network in the control points' frame less ``centre``; covariance (6k, 6k) of rotations about scans' origins.

    ``contradictions`` (k,) are those of each scan's pose by its control points. Where ``control.holds`` is False the
    network stays as it was, and ``M`` is no motion.
    """

    T: Floats
    covariance: Floats
    M: Floats
    centre: Floats
    control: ControlPoints
    reasons: tuple[Reason, ...]
    contradictions: tuple[Reason | None, ...]


def adjust(
    control: Control, names: Sequence[str], T: Floats, covariance: Floats, origins: Floats, point_mm: float
) -> Placed:
    """Adjust a network of poses T (k, 4, 4), covariance (6k, 6k), on the control points that its scans saw.

    ``origins`` (k, 3) were subtracted from the scans' coordinates. ``point_mm`` is the standard deviation of a sighting
    that comes without its own: taken as exact, it would be contradicted by any other. Raises InputError where units
    are mixed up.
    """
    if len(control.scan) > MOST:
        raise InputError(f"{len(control.scan)} sightings of control points; expected {MOST} at most")
    k = len(T)
    own = covariance.reshape(k, 6, k, 6)[np.arange(k), :, np.arange(k)]
    posed: Bools = np.asarray(np.isfinite(T).all(axis=(1, 2)) & np.isfinite(own).all(axis=(1, 2)))
    of_posed = posed[control.scan]
    centre = control.positions[control.point[of_posed]].mean(axis=0) if of_posed.any() else np.zeros(3)
    point_mm = max(point_mm, LEAST_SD_MM)  # also where it is not known
    seen_sd = np.where(control.seen_sd > 0.0, control.seen_sd, point_mm)
    every = Sightings(
        point=control.point, body=control.scan, seen=control.seen - origins[control.scan],
        seen_sd=np.maximum(seen_sd, LEAST_SD_MM), known=control.positions[control.point] - centre,
        known_sd=control.sd[control.point], point_name=tuple(control.ids[p] for p in control.point),
        body_name=tuple(names[s] for s in control.scan),
    )  # fmt: skip
    shortage = _shortage(every.take(of_posed))
    if shortage:
        return Placed(
            T=T, covariance=covariance, M=np.eye(4), centre=centre, contradictions=(None,) * k,
            control=ControlPoints(sightings=_unused(every)),
            reasons=(reason("stitch.control-not-used", shortage=shortage),),
        )  # fmt: skip
    rows = np.repeat(posed, 6)
    prior = np.where(rows[:, None] & rows, covariance, 0.0)
    prior = 0.5 * (prior + prior.T)
    poses = np.where(posed[:, None, None], T, np.eye(4))
    fit, accepted, reasons, contradictions, factor = _without_blunders(every.take(of_posed), poses, prior)
    used = of_posed.copy()
    used[of_posed] = accepted
    off, sd, share = _residuals(every, used, of_posed, fit, factor)
    sightings = replace(_unused(every), off=off, sd=sd, share=share, used=used)
    about = [reason(
        "stitch.control-used", points=len(np.unique(every.point[used])), sightings=int(used.sum()),
        rms_mm=float(np.sqrt((off[used] ** 2).mean())), redundancy=fit.free,
    )]  # fmt: skip
    if not control.seen_sd[used].all():
        about.append(reason("stitch.control-sd-assumed", sd_mm=point_mm))
    poses, C = _in_control_frame(fit, T, posed)
    return Placed(
        T=poses, covariance=C, M=fit.M, centre=centre, reasons=(*about, *reasons), contradictions=contradictions,
        control=ControlPoints(
            holds=True, redundancy=fit.free, ratio=fit.chi2 / fit.free, loosened=factor, sightings=sightings
        ),
    )  # fmt: skip


def poses_of_scans(control: Control | None, origins: Sequence[Floats]) -> dict[int, Floats]:
    """Return the pose (4, 4) of each scan whose own sightings determine it, of coordinates less the scan's origin (3,).

    All are in one frame, that of the control points less their middle. A scan whose sightings fit a rigid motion worse
    than GROSS_MM has none: one of them is wrong, or their unit.
    """
    if control is None or not len(control.scan):
        return {}
    poses, middle = {}, control.positions.mean(axis=0)
    for s in np.unique(control.scan).tolist():
        rows = control.scan == s
        seen, known = control.seen[rows] - origins[s], control.positions[control.point[rows]] - middle
        if rigid.points_determine_motion(known, common_point_checks.LEAST_HEIGHT, LEAST_SPREAD_MM):
            T = rigid.fit(seen, known)
            if np.linalg.norm(rigid.apply(T, seen) - known, axis=1).max() <= GROSS_MM:
                poses[s] = T
    return poses


def fitted(sightings: Sightings, T: Floats, prior: Floats, factor: float = 1.0) -> Fit:
    """Adjust poses T (k, 4, 4) of covariance ``prior`` (6k, 6k) on sightings, their standard deviations by ``factor``.

    Raises InputError where the distances between control points suggest that units are mixed up.
    """
    Q = factor**2 * sightings.covariance
    m, d, k = len(sightings.point), np.zeros((len(T), 6)), len(T)
    placed, known = sightings.placed(T), sightings.known
    M = rigid.fit(placed, known)
    scale = float(np.linalg.norm(known - known.mean(axis=0)) / np.linalg.norm(placed - placed.mean(axis=0)))
    slip = common_point_checks.units_slip(scale)
    if slip:
        raise InputError(
            f"the distances between control points are {scale:.5g} times those in the scans: units mixed up ({slip})?"
        )
    for _ in range(ROUNDS):
        poses = rigid.moved_about_own_origins(T, d)
        placed = sightings.placed(poses)
        by_scans = sightings.derivative(placed - poses[sightings.body, :3, 3], k).reshape(m, 3, -1)
        J, placed = (M[:3, :3] @ by_scans).reshape(3 * m, -1), rigid.apply(M, placed)
        A = rigid.motion(placed).reshape(-1, 6)
        b = (known - placed).ravel() + J @ d.ravel()
        S = cho_factor(Q + J @ prior @ J.T, lower=True)
        weighted = cho_solve(S, A)
        motion = np.linalg.inv(A.T @ weighted)
        step = motion @ weighted.T @ b
        gain = prior @ cho_solve(S, J).T
        before, d = d, (gain @ (b - A @ step)).reshape(-1, 6)
        M = rigid.transform(rigid.rotation_from_vector(step[:3]), step[3:]) @ M
        if max(float(np.abs(step).max()), float(np.abs(d - before).max())) < STILL:
            break
    weight = cho_solve(S, np.eye(3 * m))
    gain_A = gain @ A
    cross = -motion @ gain_A.T
    of_scans = prior - gain @ J @ prior + gain_A @ motion @ gain_A.T
    joint = np.block([[motion, cross], [cross.T, of_scans]])
    return Fit(
        M=M, T=rigid.moved_about_own_origins(T, d), misfit=b, observed=Q, weight=weight,
        cofactor=weight - weighted @ motion @ weighted.T, J=J, covariance=0.5 * (joint + joint.T),
    )  # fmt: skip


def _without_blunders(
    used: Sightings, T: Floats, prior: Floats
) -> tuple[Fit, Bools, list[Reason], tuple[Reason | None, ...], float]:
    """Leave out what the others contradict, one at a time; where it is undecided which, raise all standard deviations.

    Returns the fit, the sightings accepted (m,), reasons, contradictions of the scans' poses (k,), and the factor of
    the standard deviations.
    """
    accepted, reasons = np.ones(len(used.point), bool), list[Reason]()
    contradictions: list[Reason | None] = [None] * len(T)
    factor = 1.0
    while True:
        rest = used.take(accepted)
        fit = fitted(rest, T, prior)
        suspicion = data_snooping.strongest(fit.misfit, fit.weight, fit.cofactor, fit.J, rest.point, rest.body)
        if suspicion is None:
            break
        out = np.zeros(len(accepted), bool)
        out[np.flatnonzero(accepted)[suspicion.rows]] = True
        suspects = [_suspect(kind, number, rest) for kind, number in suspicion.rivals]
        if len(suspects) > 1 or _shortage(used.take(accepted & ~out)):
            fit, factor = _loosened(rest, T, prior)
            reasons.append(reason("stitch.control-undecided", suspects=tuple(suspects[:3]), factor=factor))
            break
        if suspicion.kind == "body":
            contradictions[suspicion.number] = reason("stitch.control-contradicts", shift_mm=suspicion.size_mm)
        else:
            reasons.append(reason("stitch.control-left-out", suspect=suspects[0], size_mm=suspicion.size_mm))
        accepted &= ~out
    if factor == 1.0 and data_snooping.beyond_chance(fit.chi2, fit.free):
        fit, factor = _loosened(used.take(accepted), T, prior)
        reasons.append(reason("stitch.control-scatters", factor=factor))
    return fit, accepted, reasons, tuple(contradictions), factor


def _suspect(kind: str, number: int, sightings: Sightings) -> Reason:
    if kind == "body":
        return reason("stitch.suspect-pose", scan=sightings.body_name[int(np.argmax(sightings.body == number))])
    if kind == "point":
        return reason("stitch.suspect-point", point=sightings.point_name[int(np.argmax(sightings.point == number))])
    point, scan = sightings.point_name[number], sightings.body_name[number]
    return reason("stitch.suspect-sighting", point=point, scan=scan)


def _loosened(sightings: Sightings, T: Floats, prior: Floats) -> tuple[Fit, float]:
    """Return the fit with standard deviations of control points that explain the misfits, and their factor."""
    factor = 1.0
    for _ in range(LOOSENED):
        fit = fitted(sightings, T, prior, factor)
        ratio = fit.chi2 / fit.free
        if ratio < 1.02:
            break
        factor *= float(np.sqrt(ratio))
    return fit, factor


def _shortage(sightings: Sightings) -> Reason | None:
    """Return why sightings do not determine the frame, or None: fewer than three points, or nearly on a line."""
    places = sightings.places
    if len(places) < rigid.LEAST_POINTS:
        return reason("stitch.control-few", points=len(places))
    sd = float(np.hypot(sightings.known_sd, sightings.seen_sd).max())
    if not rigid.points_determine_motion(places, common_point_checks.LEAST_HEIGHT, CLEAR * sd):
        return reason("stitch.control-on-a-line")
    return None


def _residuals(every: Sightings, used: Bools, placed: Bools, fit: Fit, factor: float) -> tuple[Floats, Floats, Floats]:
    """Return known less seen places (m, 3), their standard deviations, and the share of an error visible in them (m,).

    The standard deviation of an unused sighting is that of its prediction by all others. NaN in scans without a pose.
    """
    m = len(used)
    off, sd, share = np.full((m, 3), np.nan), np.full((m, 3), np.nan), np.full(m, np.nan)
    off[placed] = (every.known - rigid.apply(fit.M, every.placed(fit.T)))[placed]
    left = fit.observed @ fit.cofactor
    sd[used] = np.sqrt(np.maximum(np.diag(left @ fit.observed), 0.0)).reshape(-1, 3)
    # Of correlated errors: the part of the square of one by its own covariance that is left in the misfits, 0 to 1.
    share[used] = (np.diag(fit.cofactor) / np.diag(np.linalg.inv(fit.observed))).reshape(-1, 3).mean(axis=1)
    rest = placed & ~used
    if rest.any():
        unused = every.take(rest)
        arm = unused.placed(fit.T) - fit.T[unused.body, :3, 3]
        by_scans = fit.M[:3, :3] @ unused.derivative(arm, len(fit.T)).reshape(len(arm), 3, -1)
        J = np.concatenate([rigid.motion(unused.known - off[rest]), by_scans], axis=2).reshape(3 * len(arm), -1)
        own = factor**2 * (unused.seen_sd**2 + unused.known_sd**2)
        sd[rest] = np.sqrt(variances(J, fit.covariance).reshape(-1, 3) + own[:, None])
        share[rest] = 1.0
    return off, sd, share


def _in_control_frame(fit: Fit, T: Floats, posed: Bools) -> tuple[Floats, Floats]:
    """Return poses in the control points' frame with their covariance, NaN for scans (k,) without a known one."""
    k = len(T)
    poses = np.where(posed[:, None, None], fit.M @ fit.T, fit.M @ T)
    H = np.zeros((6 * k, 6 + 6 * k))
    for s in np.flatnonzero(posed):
        H[6 * s : 6 * s + 6, :6] = np.eye(6)
        H[6 * s + 3 : 6 * s + 6, :6] = rigid.motion(poses[s, :3, 3][None])[0]
        H[6 * s : 6 * s + 3, 6 + 6 * s : 9 + 6 * s] = fit.M[:3, :3]
        H[6 * s + 3 : 6 * s + 6, 9 + 6 * s : 12 + 6 * s] = fit.M[:3, :3]
    rows = np.repeat(posed, 6)
    covariance: Floats = np.where(rows[:, None] & rows, H @ fit.covariance @ H.T, np.nan)
    return poses, covariance


def _unused(sightings: Sightings) -> ControlSightings:
    """Return the sightings, none of them used."""
    m = len(sightings.point)
    return ControlSightings(
        point=sightings.point_name, scan=sightings.body_name, off=np.full((m, 3), np.nan), sd=np.full((m, 3), np.nan),
        share=np.full(m, np.nan), used=np.zeros(m, bool),
    )  # fmt: skip
