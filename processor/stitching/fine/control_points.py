"""Control points in the adjustment: they give the network its frame, and correct it where several scans saw them.

The network is given as poses with their joint covariance, and enters as an observation of each scan's pose. Unknowns
are these poses, the motion of the network into the frame of the control points, and the true places of the control
points, whose known coordinates are observations too. Places are eliminated: a sighting is known place less seen place,
and sightings of one point share the error of its coordinates. Each Gauss-Newton step is the best linear unbiased
prediction of all errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve

from processor.adjustment import control_points, data_snooping
from processor.adjustment.control_points import LEAST_POINTS
from processor.geometry import rigid
from processor.model import Control, Floats, InputError, Ints
from processor.stitching import three_point
from processor.stitching.result import Held

Bools = npt.NDArray[np.bool_]

CLEAR = 10.0  # standard deviations that points must be off a line by; else the rotation about it is not determined
LEAST_SD_MM = 1e-3  # of a sighting, so that matrices are regular
ITERATIONS, CONVERGED = 12, 1e-10
MOST = 1000  # sightings; the equations are dense
LOOSENINGS = 30


@dataclass(frozen=True)
class Sightings:
    """Control points as scans saw them, one row per sighting; mm.

    ``seen`` (m, 3) is in the frame of scan ``scan`` (m,) less its cloud's origin, ``known`` (m, 3) in that of the
    control points less ``centre``. Rows of one ``point`` (m,) share its coordinates.
    """

    point: Ints
    scan: Ints
    seen: Floats
    seen_sd: Floats
    known: Floats
    known_sd: Floats

    def only(self, kept: Bools) -> Sightings:
        """Return some rows (m,)."""
        return Sightings(*(getattr(self, name)[kept] for name in self.__dataclass_fields__))

    @property
    def covariance(self) -> Floats:
        """Covariance (3m, 3m) of known less seen places, without that of the scans' poses."""
        return control_points.covariance(self.point, self.known_sd, self.seen_sd)


@dataclass(frozen=True)
class Fit:
    """A network fitted to control points. ``misfit`` (3m,) is known less seen place before errors are separated.

    ``M`` (4, 4) maps the network's frame to that of the control points; ``T`` (k, 4, 4) are the corrected poses in the
    network's frame. ``cofactor`` (3m, 3m) removes from a misfit what the motion M absorbs, and weights the rest.
    """

    M: Floats
    T: Floats
    misfit: Floats
    sighting_covariance: Floats  # (3m, 3m) of sightings and known places
    weight: Floats  # (3m, 3m) inverse of the misfit's covariance
    cofactor: Floats
    by_motion: Floats  # (3m, 6) derivative of placed points by the common motion, about the frame's origin
    by_scans: Floats  # (3m, 6k) derivative by rotations about the scans' origins and shifts, network's axes
    covariance: Floats  # (6 + 6k, 6 + 6k) of the common motion and those of the scans

    @property
    def chi2(self) -> float:
        """Chi-square of the misfits."""
        return float(self.misfit @ self.cofactor @ self.misfit)

    @property
    def free(self) -> int:
        """Degrees of freedom."""
        return len(self.misfit) - 6


@dataclass(frozen=True)
class Placed:
    """The network in the control points' frame less ``centre``; covariance (6k, 6k) of rotations about scans' origins.

    ``against`` (k,) is a message for each scan whose control points contradict its pose. Where ``held.holds`` is 0 the
    network is unchanged and ``M`` the identity.
    """

    T: Floats
    covariance: Floats
    M: Floats
    centre: Floats
    held: Held
    said: tuple[str, ...]
    against: tuple[str, ...]


def hold(
    control: Control, names: Sequence[str], T: Floats, covariance: Floats, origins: Floats, point_mm: float
) -> Placed:
    """Fit a network of poses T (k, 4, 4), covariance (6k, 6k), to the control points that its scans saw.

    ``origins`` (k, 3) were subtracted from the scans' coordinates. ``point_mm`` is the standard deviation of a sighting
    that has none of its own: taken as exact, it would be contradicted by any other. Raises InputError where units are
    mixed up.
    """
    if len(control.scan) > MOST:
        raise InputError(f"{len(control.scan)} sightings of control points; expected {MOST} at most")
    k = len(T)
    sure = np.array([np.isfinite(T[s]).all() and np.isfinite(_block(covariance, s)).all() for s in range(k)])
    there = sure[control.scan]
    centre = control.positions[control.point[there]].mean(axis=0) if there.any() else np.zeros(3)
    point_mm = max(point_mm, LEAST_SD_MM)  # also where it is not known
    seen_sd = np.where(control.seen_sd > 0.0, control.seen_sd, point_mm)
    every = Sightings(
        point=control.point,
        scan=control.scan,
        seen=control.seen - origins[control.scan],
        seen_sd=np.maximum(seen_sd, LEAST_SD_MM),
        known=control.positions[control.point] - centre,
        known_sd=control.sd[control.point],
    )
    used = every.only(there)
    why = _too_few(used)
    if why:
        few = f"control points not used: {why}, three that span a plane are needed"
        return Placed(
            T=T, covariance=covariance, M=np.eye(4), centre=centre, held=_unused(control, names), said=(few,),
            against=("",) * k,
        )  # fmt: skip
    rows = np.repeat(sure, 6)
    known = np.where(rows[:, None] & rows, covariance, 0.0)
    known = 0.5 * (known + known.T)
    poses = np.where(sure[:, None, None], T, np.eye(4))
    fit, kept, said, against, loosened = _tested(used, poses, known, control, names)
    at = there.copy()
    at[there] = kept
    off, sd, share = _residuals(every, at, there, fit, loosened)
    n, m = len(np.unique(every.point[at])), int(at.sum())
    rms = float(np.sqrt((off[at] ** 2).mean()))
    head = [f"held by {n} control points seen {m} times: residuals {rms:.2g} mm (rms), redundancy {fit.free}"]
    if not control.seen_sd[at].all():
        head.append(
            f"control points seen without a standard deviation are taken to be seen to {point_mm:.2g} mm, as a single "
            "point of the scans or a pick is"
        )
    held = replace(
        _unused(control, names), off=off, sd=sd, share=share, used=at.astype(np.uint8), holds=1, redundancy=fit.free,
        ratio=fit.chi2 / fit.free, loosened=loosened,
    )  # fmt: skip
    poses, C = _transformed(fit, T, sure)
    return Placed(
        T=poses, covariance=C, M=fit.M, centre=centre, held=held, said=(*head, *said), against=against
    )  # fmt: skip


def fitted(sightings: Sightings, T: Floats, known: Floats, loosened: float = 1.0) -> Fit:
    """Fit poses T (k, 4, 4) of covariance ``known`` (6k, 6k) to sightings; their covariance times ``loosened`` squared.

    Raises InputError where distances between control points say that units are mixed up.
    """
    Q = loosened**2 * sightings.covariance
    m, d = len(sightings.scan), np.zeros((len(T), 6))
    M = rigid.fit(_placed(sightings, T), sightings.known)
    scale = _scale(sightings, T)
    slip = three_point.units_slip(scale)
    if slip:
        raise InputError(
            f"control points lie {scale:.5g} times as far apart as scans have them: units mixed up ({slip})?"
        )
    for _ in range(ITERATIONS):
        now = _corrected(T, d)
        arm = np.einsum("mij,mj->mi", now[sightings.scan, :3, :3], sightings.seen)
        by_scan = np.zeros((m, 3, len(T), 6))
        by_scan[np.arange(m), :, sightings.scan] = M[:3, :3] @ rigid.motion(arm)
        J = by_scan.reshape(3 * m, -1)
        placed = rigid.apply(M, _placed(sightings, now))
        A = rigid.motion(placed).reshape(-1, 6)
        b = (sightings.known - placed).ravel() + J @ d.ravel()
        S = cho_factor(Q + J @ known @ J.T, lower=True)
        weighed = cho_solve(S, A)
        motion = np.linalg.inv(A.T @ weighed)
        step = motion @ weighed.T @ b
        gain = known @ cho_solve(S, J).T
        now_d = (gain @ (b - A @ step)).reshape(-1, 6)
        M = rigid.transform(rigid.rotation_from_vector(step[:3]), step[3:]) @ M
        change = max(float(np.abs(step).max()), float(np.abs(now_d - d).max()))
        d = now_d
        if change < CONVERGED:
            break
    weight = cho_solve(S, np.eye(3 * m))
    cofactor = weight - weighed @ motion @ weighed.T
    follows = gain @ A
    cross = -motion @ follows.T
    of_scans = known - gain @ J @ known + follows @ motion @ follows.T
    both = np.block([[motion, cross], [cross.T, of_scans]])
    return Fit(
        M=M, T=_corrected(T, d), misfit=b, sighting_covariance=Q, weight=weight, cofactor=cofactor, by_motion=A,
        by_scans=J, covariance=0.5 * (both + both.T),
    )  # fmt: skip


def _tested(
    used: Sightings, T: Floats, known: Floats, control: Control, names: Sequence[str]
) -> tuple[Fit, Bools, list[str], tuple[str, ...], float]:
    """Leave out what the others contradict, one at a time; loosen all where it cannot be decided which it is."""
    kept, said, against = np.ones(len(used.scan), bool), list[str](), [""] * len(T)
    loosened = 1.0
    while True:
        accepted = used.only(kept)
        fit = fitted(accepted, T, known)
        suspicion = data_snooping.strongest(fit, accepted.point, accepted.scan)
        if suspicion is None:
            break
        out = np.zeros(len(kept), bool)
        out[np.flatnonzero(kept)[suspicion.rows]] = True
        suspects = [_name_of(kind, number, accepted, control.ids, names) for kind, number in suspicion.rivals]
        if len(suspects) > 1 or _too_few(used.only(kept & ~out)):
            fit, loosened = _loosened(accepted, T, known)
            who = ", ".join(suspects[:3])
            said.append(
                f"what control points say is contradicted by {who}, and it cannot be told by which: their standard "
                f"deviations are taken to be {loosened:.2g} times as large"
            )
            break
        if suspicion.kind == "scan":
            against[suspicion.number] = f"its control points say that it stands {suspicion.size_mm:.1f} mm elsewhere"
        else:
            said.append(f"{suspects[0]} left out: {suspicion.size_mm:.1f} mm off what the others say")
        kept &= ~out
    if loosened == 1.0 and data_snooping.beyond_chance(fit.chi2, fit.free):
        fit, loosened = _loosened(used.only(kept), T, known)
        said.append(
            "control points scatter more than they should: their standard deviations are taken to be "
            f"{loosened:.2g} times as large"
        )
    return fit, kept, said, tuple(against), loosened


def _name_of(kind: str, number: int, sightings: Sightings, ids: Sequence[str], names: Sequence[str]) -> str:
    if kind == "scan":
        return f"the pose of {names[number]}"
    if kind == "point":
        return f"control point {ids[number]}"
    return f"the sighting of control point {ids[sightings.point[number]]} in {names[sightings.scan[number]]}"


def _loosened(sightings: Sightings, T: Floats, known: Floats) -> tuple[Fit, float]:
    """Return the fit with the control points' standard deviations enlarged until chi-square agrees, and the factor."""
    factor = 1.0
    for _ in range(LOOSENINGS):
        fit = fitted(sightings, T, known, factor)
        ratio = fit.chi2 / fit.free
        if ratio < 1.02:
            break
        factor *= float(np.sqrt(ratio))
    return fit, factor


def _too_few(sightings: Sightings) -> str:
    """Message if sightings do not determine the common motion: fewer than three points, or near a line; else empty."""
    first = np.unique(sightings.point, return_index=True)[1]
    if len(first) < LEAST_POINTS:
        return f"{len(first)} of them seen in scans that were placed"
    sd = float(np.hypot(sightings.known_sd, sightings.seen_sd).max())
    if not control_points.determine_motion(sightings.known[first], three_point.LEAST_HEIGHT, CLEAR * sd):
        return "all of them nearly on a line"
    return ""


def _scale(sightings: Sightings, T: Floats) -> float:
    """Ratio of the extent of the known places to that of the seen ones."""
    placed = _placed(sightings, T)
    known = sightings.known - sightings.known.mean(axis=0)
    return float(np.linalg.norm(known) / np.linalg.norm(placed - placed.mean(axis=0)))


def _placed(sightings: Sightings, T: Floats) -> Floats:
    """Seen places (m, 3) in the frame that poses T (k, 4, 4) map to."""
    at = T[sightings.scan]
    placed: Floats = np.einsum("mij,mj->mi", at[:, :3, :3], sightings.seen) + at[:, :3, 3]
    return placed


def _corrected(T: Floats, d: Floats) -> Floats:
    """Poses rotated about their own origins and shifted by d (k, 6)."""
    corrected: Floats = T.copy()
    for s in np.flatnonzero(np.abs(d).sum(axis=1) > 0.0):
        corrected[s, :3, :3] = rigid.rotation_from_vector(d[s, :3]) @ T[s, :3, :3]
        corrected[s, :3, 3] += d[s, 3:]
    return corrected


def _residuals(every: Sightings, at: Bools, there: Bools, fit: Fit, loosened: float) -> tuple[Floats, Floats, Floats]:
    """Return known less seen places (m, 3), their standard deviations, and the visible share (m,) of an error.

    The standard deviation of a sighting left out is that of its prediction by all others. NaN in scans without a pose.
    """
    m = len(at)
    off, sd, share = np.full((m, 3), np.nan), np.full((m, 3), np.nan), np.full(m, np.nan)
    off[there] = (every.known - rigid.apply(fit.M, _placed(every, fit.T)))[there]
    left = fit.sighting_covariance @ fit.cofactor
    sd[at] = np.sqrt(np.maximum(np.diag(left @ fit.sighting_covariance), 0.0)).reshape(-1, 3)
    # Redundancy number of correlated errors, from 0 to 1: the part of an error's square that remains in the misfits.
    share[at] = (np.diag(fit.cofactor) / np.diag(np.linalg.inv(fit.sighting_covariance))).reshape(-1, 3).mean(axis=1)
    for i in np.flatnonzero(there & ~at):
        s, R = every.scan[i], fit.M[:3, :3]
        arm = fit.T[s, :3, :3] @ every.seen[i]
        F = np.zeros((3, len(fit.covariance)))
        F[:, :6] = rigid.motion((every.known[i] - off[i])[None])[0]
        F[:, 6 + 6 * s : 12 + 6 * s] = R @ rigid.motion(arm[None])[0]
        variance = loosened**2 * (every.seen_sd[i] ** 2 + every.known_sd[i] ** 2)
        sd[i] = np.sqrt(np.diag(F @ fit.covariance @ F.T) + variance)
        share[i] = 1.0
    return off, sd, share


def _transformed(fit: Fit, T: Floats, sure: Bools) -> tuple[Floats, Floats]:
    """Poses in the control points' frame with their covariance; NaN for scans without one."""
    k = len(T)
    poses = np.where(sure[:, None, None], fit.M @ fit.T, fit.M @ T)
    H = np.zeros((6 * k, 6 + 6 * k))
    for s in np.flatnonzero(sure):
        H[6 * s : 6 * s + 6, :6] = np.eye(6)
        H[6 * s + 3 : 6 * s + 6, :6] = rigid.motion(poses[s, :3, 3][None])[0]
        H[6 * s : 6 * s + 3, 6 + 6 * s : 9 + 6 * s] = fit.M[:3, :3]
        H[6 * s + 3 : 6 * s + 6, 9 + 6 * s : 12 + 6 * s] = fit.M[:3, :3]
    rows = np.repeat(sure, 6)
    covariance: Floats = np.where(rows[:, None] & rows, H @ fit.covariance @ H.T, np.nan)
    return poses, covariance


def _block(covariance: Floats, s: int) -> Floats:
    return covariance[6 * s : 6 * s + 6, 6 * s : 6 * s + 6]


def _unused(control: Control, names: Sequence[str]) -> Held:
    """Return the sightings, none of them used."""
    m = len(control.scan)
    return Held(
        points=tuple(control.ids[p] for p in control.point), scans=tuple(names[s] for s in control.scan),
        off=np.full((m, 3), np.nan), sd=np.full((m, 3), np.nan), share=np.full(m, np.nan), used=np.zeros(m, np.uint8),
    )  # fmt: skip
