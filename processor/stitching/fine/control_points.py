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
from processor.adjustment.sighting_covariance import sighting_covariance
from processor.geometry import rigid
from processor.model import Bools, Columns, Control, Floats, InputError, Ints, Reason, reason
from processor.stitching import common_point_checks
from processor.stitching.result import ControlPoints, ControlSightings

CLEAR = 10.0  # least distance from a line in standard deviations; nearer points do not determine the rotation about it
LEAST_SD_MM = 1e-3  # of a sighting; the covariance would be singular without
# Of the sightings of a scan that give it a pose: greatest misfit, and least extent across their longest one.
GROSS_MM, LEAST_SPREAD_MM = 50.0, 300.0
ROUNDS, STILL = 12, 1e-10
MOST = 1000  # sightings; the equations are dense
LOOSENED = 30  # rounds at most


@dataclass(frozen=True)
class Sightings(Columns):
    """Sightings of control points by scans, a row per sighting; mm.

    ``seen`` (m, 3) is in the frame of scan ``scan`` (m,) less its cloud's origin, ``known`` (m, 3) in that of the
    control points less ``centre``. Rows of one ``point`` (m,) share the known place and its error.
    """

    point: Ints
    scan: Ints
    seen: Floats
    seen_sd: Floats
    known: Floats
    known_sd: Floats

    @property
    def covariance(self) -> Floats:
        """Covariance (3m, 3m) of known less seen places, without that of the scans' poses; the same along all axes."""
        return sighting_covariance(self.point, self.known_sd, self.seen_sd)


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
    by_scans: Floats  # (3m, 6k) derivative of the places by rotations of scans about their origins, and by shifts
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
    posed = np.array([np.isfinite(T[s]).all() and np.isfinite(_block(covariance, s)).all() for s in range(k)])
    of_posed = posed[control.scan]
    centre = control.positions[control.point[of_posed]].mean(axis=0) if of_posed.any() else np.zeros(3)
    point_mm = max(point_mm, LEAST_SD_MM)  # also where it is not known
    seen_sd = np.where(control.seen_sd > 0.0, control.seen_sd, point_mm)
    every = Sightings(
        point=control.point, scan=control.scan, seen=control.seen - origins[control.scan],
        seen_sd=np.maximum(seen_sd, LEAST_SD_MM), known=control.positions[control.point] - centre,
        known_sd=control.sd[control.point],
    )  # fmt: skip
    shortage = _shortage(every.take(of_posed))
    if shortage:
        return Placed(
            T=T, covariance=covariance, M=np.eye(4), centre=centre, contradictions=(None,) * k,
            control=ControlPoints(sightings=_unused(control, names)),
            reasons=(reason("stitch.control-not-used", shortage=shortage),),
        )  # fmt: skip
    rows = np.repeat(posed, 6)
    prior = np.where(rows[:, None] & rows, covariance, 0.0)
    prior = 0.5 * (prior + prior.T)
    poses = np.where(posed[:, None, None], T, np.eye(4))
    fit, accepted, reasons, contradictions, factor = _without_blunders(
        every.take(of_posed), poses, prior, control, names
    )
    used = of_posed.copy()
    used[of_posed] = accepted
    off, sd, share = _residuals(every, used, of_posed, fit, factor)
    sightings = replace(_unused(control, names), off=off, sd=sd, share=share, used=used)
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
    m, d = len(sightings.scan), np.zeros((len(T), 6))
    M = rigid.fit(_placed(sightings, T), sightings.known)
    scale = _scale(sightings, T)
    slip = common_point_checks.units_slip(scale)
    if slip:
        raise InputError(
            f"the distances between control points are {scale:.5g} times those in the scans: units mixed up ({slip})?"
        )
    for _ in range(ROUNDS):
        poses = rigid.moved_about_own_origins(T, d)
        arm = np.einsum("mij,mj->mi", poses[sightings.scan, :3, :3], sightings.seen)
        by_scan = np.zeros((m, 3, len(T), 6))
        by_scan[np.arange(m), :, sightings.scan] = M[:3, :3] @ rigid.motion(arm)
        J = by_scan.reshape(3 * m, -1)
        placed = rigid.apply(M, _placed(sightings, poses))
        A = rigid.motion(placed).reshape(-1, 6)
        b = (sightings.known - placed).ravel() + J @ d.ravel()
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
        cofactor=weight - weighted @ motion @ weighted.T, by_scans=J, covariance=0.5 * (joint + joint.T),
    )  # fmt: skip


def _without_blunders(
    used: Sightings, T: Floats, prior: Floats, control: Control, names: Sequence[str]
) -> tuple[Fit, Bools, list[Reason], tuple[Reason | None, ...], float]:
    """Leave out what the others contradict, one at a time; where it is undecided which, raise all standard deviations.

    Returns the fit, the sightings accepted (m,), reasons, contradictions of the scans' poses (k,), and the factor of
    the standard deviations.
    """
    accepted, reasons = np.ones(len(used.scan), bool), list[Reason]()
    contradictions: list[Reason | None] = [None] * len(T)
    factor = 1.0
    while True:
        rest = used.take(accepted)
        fit = fitted(rest, T, prior)
        suspicion = data_snooping.strongest(fit, rest.point, rest.scan)
        if suspicion is None:
            break
        out = np.zeros(len(accepted), bool)
        out[np.flatnonzero(accepted)[suspicion.rows]] = True
        suspects = [_suspect(kind, number, rest, control.ids, names) for kind, number in suspicion.rivals]
        if len(suspects) > 1 or _shortage(used.take(accepted & ~out)):
            fit, factor = _loosened(rest, T, prior)
            reasons.append(reason("stitch.control-undecided", suspects=tuple(suspects[:3]), factor=factor))
            break
        if suspicion.kind == "scan":
            contradictions[suspicion.number] = reason("stitch.control-contradicts", shift_mm=suspicion.size_mm)
        else:
            reasons.append(reason("stitch.control-left-out", suspect=suspects[0], size_mm=suspicion.size_mm))
        accepted &= ~out
    if factor == 1.0 and data_snooping.beyond_chance(fit.chi2, fit.free):
        fit, factor = _loosened(used.take(accepted), T, prior)
        reasons.append(reason("stitch.control-scatters", factor=factor))
    return fit, accepted, reasons, tuple(contradictions), factor


def _suspect(kind: str, number: int, sightings: Sightings, ids: Sequence[str], names: Sequence[str]) -> Reason:
    if kind == "scan":
        return reason("stitch.suspect-pose", scan=names[number])
    if kind == "point":
        return reason("stitch.suspect-point", point=ids[number])
    point, scan = ids[sightings.point[number]], names[sightings.scan[number]]
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
    first = np.unique(sightings.point, return_index=True)[1]
    if len(first) < rigid.LEAST_POINTS:
        return reason("stitch.control-few", points=len(first))
    sd = float(np.hypot(sightings.known_sd, sightings.seen_sd).max())
    if not rigid.points_determine_motion(sightings.known[first], common_point_checks.LEAST_HEIGHT, CLEAR * sd):
        return reason("stitch.control-on-a-line")
    return None


def _scale(sightings: Sightings, T: Floats) -> float:
    """Return the ratio of the distances between known places to those between the seen ones."""
    placed, known = _placed(sightings, T), sightings.known
    return float(np.linalg.norm(known - known.mean(axis=0)) / np.linalg.norm(placed - placed.mean(axis=0)))


def _placed(sightings: Sightings, T: Floats) -> Floats:
    """Return sightings (m, 3) in the frame that poses T (k, 4, 4) map to."""
    poses = T[sightings.scan]
    placed: Floats = np.einsum("mij,mj->mi", poses[:, :3, :3], sightings.seen) + poses[:, :3, 3]
    return placed


def _residuals(every: Sightings, used: Bools, placed: Bools, fit: Fit, factor: float) -> tuple[Floats, Floats, Floats]:
    """Return known less seen places (m, 3), their standard deviations, and the share of an error visible in them (m,).

    The standard deviation of an unused sighting is that of its prediction by all others. NaN in scans without a pose.
    """
    m = len(used)
    off, sd, share = np.full((m, 3), np.nan), np.full((m, 3), np.nan), np.full(m, np.nan)
    off[placed] = (every.known - rigid.apply(fit.M, _placed(every, fit.T)))[placed]
    left = fit.observed @ fit.cofactor
    sd[used] = np.sqrt(np.maximum(np.diag(left @ fit.observed), 0.0)).reshape(-1, 3)
    # Of correlated errors: the part of the square of one by its own covariance that is left in the misfits, 0 to 1.
    share[used] = (np.diag(fit.cofactor) / np.diag(np.linalg.inv(fit.observed))).reshape(-1, 3).mean(axis=1)
    for i in np.flatnonzero(placed & ~used):
        s, R = every.scan[i], fit.M[:3, :3]
        arm = fit.T[s, :3, :3] @ every.seen[i]
        F = np.zeros((3, len(fit.covariance)))
        F[:, :6] = rigid.motion((every.known[i] - off[i])[None])[0]
        F[:, 6 + 6 * s : 12 + 6 * s] = R @ rigid.motion(arm[None])[0]
        variance = factor**2 * (every.seen_sd[i] ** 2 + every.known_sd[i] ** 2)
        sd[i] = np.sqrt(np.diag(F @ fit.covariance @ F.T) + variance)
        share[i] = 1.0
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


def _block(covariance: Floats, s: int) -> Floats:
    return covariance[6 * s : 6 * s + 6, 6 * s : 6 * s + 6]


def _unused(control: Control, names: Sequence[str]) -> ControlSightings:
    """Return the sightings, none of them used."""
    m = len(control.scan)
    return ControlSightings(
        point=tuple(control.ids[p] for p in control.point), scan=tuple(names[s] for s in control.scan),
        off=np.full((m, 3), np.nan), sd=np.full((m, 3), np.nan), share=np.full(m, np.nan), used=np.zeros(m, bool),
    )  # fmt: skip
