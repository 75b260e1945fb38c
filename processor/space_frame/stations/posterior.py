"""Posterior of the motions of all stations, with the variances of their prior estimated from the data."""

from __future__ import annotations

import numpy as np

from processor.adjustment import data_snooping
from processor.adjustment.control_points import Sightings
from processor.adjustment.data_snooping import Snooped
from processor.geometry import rigid
from processor.geometry.linalg_small import cholesky, product, solve
from processor.model import Floats
from processor.space_frame.stations import control_points
from processor.space_frame.stations.residual_kernels import STATION

# of turn (rad), translation and offset of the ranges (mm)
START = (5e-5, 2.0, 0.5)  # sd: start of the iteration
SMALLEST = (1e-8, 1e-3, 1e-3)  # sd: below anything that tubes show, and variances stay positive
LOOSE = (1e-2, 1e3, 1e2)  # sd: as good as no prior, beside any motion of a registered station
OFF_LINE = 0.05  # least second extent of targets that determine the whole cloud's pose, as a share of the first
LEAST_DETERMINED = 0.5  # number of motions that the data must determine for an estimate of their variance
ALLOWED = 6.0  # in log density below the most likely variance


def corrections(x: Floats, places: Floats) -> Floats:
    """Return T (s, 4, 4) of the stations' unknowns x (7 s,): turns about places (s, 3), then translations."""
    T = control_points.moved(x, places)
    T[:, :3, 3] = places - np.einsum("sij,sj->si", T[:, :3, :3], places) + x.reshape(-1, STATION)[:, 3:6]
    return T


def common_motion(places: Floats) -> Floats:
    """Return derivatives (7 s, 6) of the unknowns by a turn of all stations about the origin and a translation."""
    M = np.zeros((len(places), STATION, 6))
    M[:, :3, :3] = np.eye(3)
    M[:, 3:6] = rigid.motion(places)
    return M.reshape(-1, 6)


def mean_gain(M: Floats, precision: Floats) -> Floats:
    """Return derivatives (6, 7 s) of the best-fitting common motion by the stations' unknowns."""
    weighted = np.ascontiguousarray(M.T) * precision
    gain: Floats = solve(cholesky(product(weighted, M)), weighted)
    return gain


class Posterior:
    """The unknowns of stations at ``places`` (s, 3), x = (turn, translation, offset of the ranges) of each.

    A priori they are normal about zero, about a common shift of sd ``datum_mm`` an axis, or about any common motion
    where control points fix the whole cloud. The three variances are those for which the unknowns' sum of squares has
    its posterior expectation (MacKay 1992).
    """

    def __init__(self, places: Floats, control: Sightings | None, datum_mm: float = 0.0) -> None:
        self.places, self.datum_mm = places, datum_mm
        self.variance = np.array(START) ** 2
        self.M = common_motion(places - places.mean(axis=0))
        self.kind = np.tile(np.array([0, 0, 0, 1, 1, 1, 2]), len(places))
        self.control: Sightings | None = None
        self.hold(control)

    def hold(self, control: Sightings | None) -> None:
        """Take control points into the equations, or none."""
        if self.control is None:
            self.untouched = self.variance.copy()
        self.control = control
        # whether the control points alone determine the pose of the whole cloud: three of them, not on one line
        self.free = control is not None and rigid.points_determine_motion(control.places, OFF_LINE)
        # of each kind, the number that is not common to all stations where a common motion is free
        self.number = np.array([3.0, 3.0, 1.0]) * len(self.places) - np.array([3.0, 3.0, 0.0]) * self.free

    def doubted(self, control: Sightings, H: Floats, g: Floats, x: Floats) -> Snooped:
        """Test control points against each other and the stations; H and g are the tubes' equations at x."""
        # Where they do not fix the cloud alone, the variances were estimated with them, which would hide an outlier.
        P = self._prior(self.variance if self.free else self.untouched)
        if self.free:  # the rest without one of them may not fix the cloud
            gain = mean_gain(self.M, self.precision(self.variance))
            loose = np.repeat(np.array(LOOSE[:2]) ** -2.0, 3)
            P = P + product(np.ascontiguousarray(gain.T) * loose, gain)
        L, J = cholesky(H + P), control_points.derivative(control, self.places)
        change = solve(L, (g - product(P, x[:, None])[:, 0])[:, None])
        off = control_points.misfits(control, x, self.places).ravel() - product(J, change)[:, 0]
        spread = product(J, solve(L, np.ascontiguousarray(J.T)))
        return data_snooping.leave_out(control.point, off, control.covariance + 0.5 * (spread + spread.T))

    def step(self, H: Floats, g: Floats, x: Floats, rounds: int) -> tuple[Floats, Floats]:
        """Return the change of x (7 s,) and the posterior covariance; H and g are the tubes' equations at x.

        The variances are estimated again ``rounds`` times.
        """
        H, g = self._with_control(H, g, x)
        change, C = np.zeros(len(x)), np.zeros_like(H)
        for turn in range(rounds + 1):
            _, solution = self._solved(H, g, x, self.variance)
            change, C = solution[:, 0], solution[:, 1:]
            if turn < rounds:
                self._estimate(x + change, C)
        return change, C

    def integrated(self, H: Floats, g: Floats, x: Floats) -> tuple[Floats, Floats]:
        """Return change and covariance as :meth:`step` does, averaged over all variances that the data allow.

        With few stations or weak ties the variances are poorly known, and a single estimate of them would make the
        covariance too small. Their prior is uniform in log sd above the data's resolution, and in the sd itself below
        (Gelman 2006). The kinds are averaged one by one, about the most likely variances.
        """
        H, g = self._with_control(H, g, x)
        resolved = self._resolution(H)
        sd, nodes = np.sqrt(self.variance), [np.empty(0)] * len(START)
        for kind in (1, 0, 2, 1, 0):
            sd, nodes[kind] = self._allowed(H, g, x, sd, kind, resolved)
        _, best = self._solved(H, g, x, sd**2)
        change, C, variance = best[:, 0].copy(), best[:, 1:].copy(), np.zeros(len(START))
        for kind, values in enumerate(nodes):
            tried = np.tile(sd, (len(values), 1))
            tried[:, kind] = values
            solutions = [self._solved(H, g, x, trial**2) for trial in tried]
            log = np.array([
                self._evidence(L, g, solution[:, 0], x, trial**2, resolved)
                for (L, solution), trial in zip(solutions, tried, strict=True)
            ])  # fmt: skip
            weight = np.exp(log - log.max())
            weight /= weight.sum()
            mean = np.sum(weight[:, None] * np.array([solution[:, 0] for _, solution in solutions]), axis=0)
            change += mean - best[:, 0]
            for w, (_, solution) in zip(weight, solutions, strict=True):
                off = solution[:, 0] - mean
                C += w * (solution[:, 1:] - best[:, 1:] + off[:, None] * off)
            variance[kind] = float(np.sum(weight * values**2))
        self.variance = variance
        return change, 0.5 * (C + C.T)

    def precision(self, variance: Floats) -> Floats:
        """Information (7 s,) of the prior on each unknown."""
        precision: Floats = 1.0 / variance[self.kind]
        return precision

    def _solved(self, H: Floats, g: Floats, x: Floats, variance: Floats) -> tuple[Floats, Floats]:
        """Factor L of the posterior's matrix, and the change (7 s,) beside the covariance, (7 s, 1 + 7 s)."""
        P = self._prior(variance)
        L = cholesky(H + P)
        return L, solve(L, np.column_stack([g - product(P, x[:, None])[:, 0], np.eye(len(x))]))

    def _prior(self, variance: Floats) -> Floats:
        precision = self.precision(variance)
        P = np.diag(precision)
        if self.free:
            P -= product(precision[:, None] * self.M, mean_gain(self.M, precision))
        elif self.datum_mm > 0.0:  # a common shift of its own variance, by Woodbury's identity
            weighted = precision[:, None] * self.M[:, 3:]
            inner = product(np.ascontiguousarray(self.M[:, 3:].T), weighted) + np.eye(3) / self.datum_mm**2
            P -= product(weighted, solve(cholesky(inner), np.ascontiguousarray(weighted.T)))
        symmetric: Floats = 0.5 * (P + P.T)
        return symmetric

    def _with_control(self, H: Floats, g: Floats, x: Floats) -> tuple[Floats, Floats]:
        return (H, g) if self.control is None else control_points.added(self.control, H, g, x, self.places)

    def _estimate(self, x: Floats, C: Floats) -> None:
        motion, spread = x, np.diag(C)
        if self.free:
            gain = np.eye(len(x)) - product(self.M, mean_gain(self.M, self.precision(self.variance)))
            motion, spread = product(gain, x[:, None])[:, 0], np.einsum("pq,pq->p", product(gain, C), gain)
        for kind, least in enumerate(SMALLEST):
            of_kind = self.kind == kind
            determined = self.number[kind] - float(spread[of_kind].sum()) / self.variance[kind]
            if determined > LEAST_DETERMINED:
                self.variance[kind] = max(float(np.sum(motion[of_kind] ** 2)) / determined, least**2)

    def _resolution(self, H: Floats) -> Floats:
        """Sd (3,) with which the data resolve a station's unknowns relative to the others', without a prior.

        A station that sees no tube says nothing of the others: it is left out of their mean.
        """
        loose = np.array(LOOSE) ** 2
        C = solve(cholesky(H + self._prior(loose)), np.eye(len(H)))
        seen = np.repeat(np.diag(H).reshape(-1, STATION).any(axis=1), STATION)
        seen |= ~seen.any()
        weight = self.precision(loose) * seen
        gain = (np.eye(len(H)) - product(self.M, mean_gain(self.M, weight)))[seen]
        spread, of_seen = np.einsum("pq,pq->p", product(gain, C), gain), self.kind[seen]
        return np.array([float(np.sqrt(np.median(spread[of_seen == kind]))) for kind in range(len(START))])

    def _allowed(
        self, H: Floats, g: Floats, x: Floats, sd: Floats, kind: int, resolved: Floats
    ) -> tuple[Floats, Floats]:
        """Return the most likely sd (3,) along one ``kind``, and those (n,) that the data allow, even in the log."""
        if self.number[kind] < 1.0:  # one station, fixed by control points: nothing to compare it with
            return sd, sd[kind : kind + 1]

        def density(value: float) -> float:
            tried = sd.copy()
            tried[kind] = value
            P = self._prior(tried**2)
            L = cholesky(H + P)
            right = g - product(P, x[:, None])[:, 0]
            return self._evidence(L, g, solve(L, right[:, None])[:, 0], x, tried**2, resolved)

        coarse = resolved[kind] * 2.0 ** np.arange(-5, 14)
        value = np.array([density(trial) for trial in coarse])
        best = sd.copy()
        top = int(np.argmax(value))
        best[kind] = coarse[top]
        near = np.flatnonzero(value > value[top] - ALLOWED)
        if len(near) > 4 or top in (0, len(coarse) - 1):
            return best, coarse[near]
        step = 0.25 * np.log(2.0)
        peak, width = float(np.log(coarse[top])), step
        for _ in range(2):  # the density is almost normal: two parabolas find its top and width
            low, middle, high = (density(float(np.exp(peak + shift))) for shift in (-step, 0.0, step))
            bend = low - 2.0 * middle + high
            if not bend < 0.0:
                return best, coarse[near]
            width = step / np.sqrt(-bend)
            peak += float(np.clip(0.5 * step * (low - high) / bend, -2.0 * step, 2.0 * step))
        best[kind] = np.exp(peak)
        return best, np.exp(peak + width * np.arange(-2.0, 2.5))

    def _evidence(self, L: Floats, g: Floats, change: Floats, x: Floats, variance: Floats, resolved: Floats) -> float:
        """Log density of log variances given the data, up to a constant."""
        P = self._prior(variance)
        Px = product(P, x[:, None])[:, 0]
        fit = float(np.sum((g - Px) * change)) - float(np.sum(x * Px))
        sd = np.sqrt(variance)
        log_prior = -float(np.sum(self.number * np.log(sd))) + float(np.sum(np.log(sd / (sd + resolved))))
        return log_prior - float(np.sum(np.log(np.diag(L)))) + 0.5 * fit
