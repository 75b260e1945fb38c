"""Control points in the adjustment: they say where the network lies, and correct it where several scans saw them.

The network comes as poses with their joint covariance, and enters as an observation of each scan's pose. Unknown are
these poses, the motion of the whole into the frame of the control points, and the control points' true places, of which
what is known is an observation too. Places are eliminated: a sighting is known place less seen place, and sightings of
one point share the error of what is known. Gauss-Newton steps, each the best linear unbiased prediction of all errors.
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

CLEAR = 10.0  # standard deviations that points must lie off a line by, or the scans might be laid round it either way
LEAST_SD_MM = 1e-3  # of a sighting, or no matrix could be inverted
ROUNDS, STILL = 12, 1e-10
MOST = 1000  # sightings; the equations are dense
LOOSENED = 30  # rounds at most


@dataclass(frozen=True)
class Sightings:
    """Control points as scans saw them, a row a sighting; mm.

    ``seen`` (m, 3) is in the frame of scan ``scan`` (m,) less its cloud's origin, ``known`` (m, 3) in that of the
    control points less ``centre``. Rows of one ``point`` (m,) share what is known.
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
        """Covariance (3m, 3m) of known less seen places, without that of the scans' poses; the same along all axes."""
        return control_points.covariance(self.point, self.known_sd, self.seen_sd)


@dataclass(frozen=True)
class Fit:
    """A network laid to control points. ``misfit`` (3m,) is known less seen place before any error is told apart.

    ``M`` (4, 4) leads from the network's frame to the control points', ``T`` (k, 4, 4) are the corrected poses in the
    network's frame. ``cofactor`` (3m, 3m) takes from a misfit what the motion M takes up and weighs the rest.
    """

    M: Floats
    T: Floats
    misfit: Floats
    own: Floats  # (3m, 3m) covariance of sightings and known places
    weight: Floats  # (3m, 3m) inverse of the misfit's covariance
    cofactor: Floats
    by_motion: Floats  # (3m, 6) how placed points follow the motion of all, about the frame's origin
    by_scans: Floats  # (3m, 6k) the same of single scans' turns about their origins and shifts, network's axes
    covariance: Floats  # (6 + 6k, 6 + 6k) of the motion of all and the scans'

    @property
    def chi2(self) -> float:
        """Square of what contradicts, by covariances."""
        return float(self.misfit @ self.cofactor @ self.misfit)

    @property
    def free(self) -> int:
        """Freedoms that are left."""
        return len(self.misfit) - 6


@dataclass(frozen=True)
class Placed:
    """The network in the control points' frame less ``centre``; covariance (6k, 6k) of turns about scans' origins.

    ``against`` (k,) says of a scan what its control points have against its pose. Where ``held.holds`` is 0 the
    network stays as it was, and ``M`` is no motion.
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
    """Lay a network of poses T (k, 4, 4), covariance (6k, 6k), to the control points that its scans saw.

    ``origins`` (k, 3) were taken off the scans' coordinates; ``point_mm`` is the standard deviation of a sighting that
    comes without its own: none is exact, and taken so it would be contradicted by any other. Raises InputError where
    units are mixed up.
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
        control.point, control.scan, control.seen - origins[control.scan], np.maximum(seen_sd, LEAST_SD_MM),
        control.positions[control.point] - centre, control.sd[control.point],
    )  # fmt: skip
    used = every.only(there)
    why = _too_few(used)
    if why:
        few = f"control points not used: {why}, three that span a plane are needed"
        return Placed(T, covariance, np.eye(4), centre, _held(control, names), (few,), ("",) * k)
    rows = np.repeat(sure, 6)
    known = np.where(rows[:, None] & rows, covariance, 0.0)
    known = 0.5 * (known + known.T)
    poses = np.where(sure[:, None, None], T, np.eye(4))
    found, kept, said, against, loosened = _settled(used, poses, known, control, names)
    at = there.copy()
    at[there] = kept
    off, sd, share = _residuals(every, at, there, found, loosened)
    n, m = len(np.unique(every.point[at])), int(at.sum())
    rms = float(np.sqrt((off[at] ** 2).mean()))
    head = [f"held by {n} control points seen {m} times: residuals {rms:.2g} mm (rms), redundancy {found.free}"]
    if not control.seen_sd[at].all():
        head.append(
            f"control points seen without a standard deviation are taken to be seen to {point_mm:.2g} mm, as a single "
            "point of the scans or a pick is"
        )
    ratio = found.chi2 / found.free
    held = replace(
        _held(control, names), off=off, sd=sd, share=share, used=at.astype(np.uint8), holds=1, redundancy=found.free,
        ratio=ratio, loosened=loosened,
    )  # fmt: skip
    moved, C = _carried(found, T, sure)
    return Placed(moved, C, found.M, centre, held, (*head, *said), against)


def fitted(own: Sightings, T: Floats, known: Floats, loosened: float = 1.0) -> Fit:
    """Lay poses T (k, 4, 4) of covariance ``known`` (6k, 6k) to sightings; their covariance times ``loosened`` squared.

    Raises InputError where distances between control points say that units are mixed up.
    """
    Q = loosened**2 * own.covariance
    m, d = len(own.scan), np.zeros((len(T), 6))
    M = rigid.fit(_placed(own, T), own.known)
    slip = three_point.units_slip(_scale(own, T))
    if slip:
        raise InputError(
            f"control points lie {_scale(own, T):.5g} times as far apart as scans have them: units mixed up ({slip})?"
        )
    for _ in range(ROUNDS):
        now = _corrected(T, d)
        arm = np.einsum("mij,mj->mi", now[own.scan, :3, :3], own.seen)
        by_scan = np.zeros((m, 3, len(T), 6))
        by_scan[np.arange(m), :, own.scan] = M[:3, :3] @ rigid.motion(arm)
        J = by_scan.reshape(3 * m, -1)
        placed = rigid.apply(M, _placed(own, now))
        A = rigid.motion(placed).reshape(-1, 6)
        b = (own.known - placed).ravel() + J @ d.ravel()
        S = cho_factor(Q + J @ known @ J.T, lower=True)
        weighed = cho_solve(S, A)
        motion = np.linalg.inv(A.T @ weighed)
        step = motion @ weighed.T @ b
        gain = known @ cho_solve(S, J).T
        now_d = (gain @ (b - A @ step)).reshape(-1, 6)
        M = rigid.transform(rigid.rotation_from_vector(step[:3]), step[3:]) @ M
        moved = max(float(np.abs(step).max()), float(np.abs(now_d - d).max()))
        d = now_d
        if moved < STILL:
            break
    weight = cho_solve(S, np.eye(3 * m))
    cofactor = weight - weighed @ motion @ weighed.T
    follows = gain @ A
    cross = -motion @ follows.T
    own_of_scans = known - gain @ J @ known + follows @ motion @ follows.T
    both = np.block([[motion, cross], [cross.T, own_of_scans]])
    return Fit(M, _corrected(T, d), b, Q, weight, cofactor, A, J, 0.5 * (both + both.T))


def _settled(
    used: Sightings, T: Floats, known: Floats, control: Control, names: Sequence[str]
) -> tuple[Fit, Bools, list[str], tuple[str, ...], float]:
    """Leave out what the others speak against, one at a time; loosen all where it cannot be told which it is."""
    kept, said, against = np.ones(len(used.scan), bool), list[str](), [""] * len(T)
    loosened = 1.0
    while True:
        own = used.only(kept)
        found = fitted(own, T, known)
        verdict = data_snooping.strongest(found, own.point, own.scan)
        if verdict is None:
            break
        out = np.zeros(len(kept), bool)
        out[np.flatnonzero(kept)[verdict.rows]] = True
        called = [_called(kind, number, own, control.ids, names) for kind, number in verdict.rivals]
        if len(called) > 1 or _too_few(used.only(kept & ~out)):
            found, loosened = _loosened(own, T, known)
            who = ", ".join(called[:3])
            said.append(
                f"what control points say is contradicted by {who}, and it cannot be told by which: their standard "
                f"deviations are taken to be {loosened:.2g} times as large"
            )
            break
        if verdict.kind == "scan":
            against[verdict.number] = f"its control points say that it stands {verdict.size_mm:.1f} mm elsewhere"
        else:
            said.append(f"{called[0]} left out: {verdict.size_mm:.1f} mm off what the others say")
        kept &= ~out
    if loosened == 1.0 and data_snooping.beyond_chance(found.chi2, found.free):
        found, loosened = _loosened(used.only(kept), T, known)
        said.append(
            "control points scatter more than they should: their standard deviations are taken to be "
            f"{loosened:.2g} times as large"
        )
    return found, kept, said, tuple(against), loosened


def _called(kind: str, number: int, own: Sightings, ids: Sequence[str], names: Sequence[str]) -> str:
    if kind == "scan":
        return f"the pose of {names[number]}"
    if kind == "point":
        return f"control point {ids[number]}"
    return f"the sighting of control point {ids[own.point[number]]} in {names[own.scan[number]]}"


def _loosened(own: Sightings, T: Floats, known: Floats) -> tuple[Fit, float]:
    """Return the fit with standard deviations of control points so large that what is left is what they let expect."""
    factor = 1.0
    for _ in range(LOOSENED):
        found = fitted(own, T, known, factor)
        ratio = found.chi2 / found.free
        if ratio < 1.02:
            break
        factor *= float(np.sqrt(ratio))
    return found, factor


def _too_few(own: Sightings) -> str:
    """Say why sightings cannot tell where the whole lies, or nothing: fewer than three points, or near a line."""
    first = np.unique(own.point, return_index=True)[1]
    if len(first) < LEAST_POINTS:
        return f"{len(first)} of them seen in scans that were placed"
    sd = float(np.hypot(own.known_sd, own.seen_sd).max())
    if not control_points.determine_motion(own.known[first], three_point.LEAST_HEIGHT, CLEAR * sd):
        return "all of them nearly on a line"
    return ""


def _scale(own: Sightings, T: Floats) -> float:
    """How much farther apart known places lie than seen ones."""
    placed = _placed(own, T)
    return float(np.linalg.norm(own.known - own.known.mean(axis=0)) / np.linalg.norm(placed - placed.mean(axis=0)))


def _placed(own: Sightings, T: Floats) -> Floats:
    """Sightings (m, 3) in the frame that poses lead to."""
    at = T[own.scan]
    found: Floats = np.einsum("mij,mj->mi", at[:, :3, :3], own.seen) + at[:, :3, 3]
    return found


def _corrected(T: Floats, d: Floats) -> Floats:
    """Poses turned about their own origins and shifted by d (k, 6)."""
    found: Floats = T.copy()
    for s in np.flatnonzero(np.abs(d).sum(axis=1) > 0.0):
        found[s, :3, :3] = rigid.rotation_from_vector(d[s, :3]) @ T[s, :3, :3]
        found[s, :3, 3] += d[s, 3:]
    return found


def _residuals(every: Sightings, at: Bools, there: Bools, found: Fit, loosened: float) -> tuple[Floats, Floats, Floats]:
    """Return known less seen places (m, 3), their standard deviations, and the share of an error that shows (m,).

    Of what was left out the standard deviation is that of the prediction by all others. NaN in scans without a place.
    """
    m = len(at)
    off, sd, share = np.full((m, 3), np.nan), np.full((m, 3), np.nan), np.full(m, np.nan)
    off[there] = (every.known - rigid.apply(found.M, _placed(every, found.T)))[there]
    left = found.own @ found.cofactor
    sd[at] = np.sqrt(np.maximum(np.diag(left @ found.own), 0.0)).reshape(-1, 3)
    # Of correlated errors: what of one's square by its own covariance is left in the misfits, from 0 to 1.
    share[at] = (np.diag(found.cofactor) / np.diag(np.linalg.inv(found.own))).reshape(-1, 3).mean(axis=1)
    for i in np.flatnonzero(there & ~at):
        s, R = every.scan[i], found.M[:3, :3]
        arm = found.T[s, :3, :3] @ every.seen[i]
        F = np.zeros((3, len(found.covariance)))
        F[:, :6] = rigid.motion((every.known[i] - off[i])[None])[0]
        F[:, 6 + 6 * s : 12 + 6 * s] = R @ rigid.motion(arm[None])[0]
        own = loosened**2 * (every.seen_sd[i] ** 2 + every.known_sd[i] ** 2)
        sd[i] = np.sqrt(np.diag(F @ found.covariance @ F.T) + own)
        share[i] = 1.0
    return off, sd, share


def _carried(found: Fit, T: Floats, sure: Bools) -> tuple[Floats, Floats]:
    """Poses in the control points' frame with their covariance; scans whose own is not known stay without."""
    k = len(T)
    moved = np.where(sure[:, None, None], found.M @ found.T, found.M @ T)
    H = np.zeros((6 * k, 6 + 6 * k))
    for s in np.flatnonzero(sure):
        own = slice(6 * s, 6 * s + 6)
        H[own, :6] = np.eye(6)
        H[6 * s + 3 : 6 * s + 6, :6] = rigid.motion(moved[s, :3, 3][None])[0]
        H[6 * s : 6 * s + 3, 6 + 6 * s : 9 + 6 * s] = found.M[:3, :3]
        H[6 * s + 3 : 6 * s + 6, 9 + 6 * s : 12 + 6 * s] = found.M[:3, :3]
    rows = np.repeat(sure, 6)
    covariance: Floats = np.where(rows[:, None] & rows, H @ found.covariance @ H.T, np.nan)
    return moved, covariance


def _block(covariance: Floats, s: int) -> Floats:
    return covariance[6 * s : 6 * s + 6, 6 * s : 6 * s + 6]


def _held(control: Control, names: Sequence[str]) -> Held:
    """Return the sightings, none of them used."""
    m = len(control.scan)
    return Held(
        tuple(control.ids[p] for p in control.point), tuple(names[s] for s in control.scan),
        np.full((m, 3), np.nan), np.full((m, 3), np.nan), np.full(m, np.nan), np.zeros(m, np.uint8),
    )  # fmt: skip
