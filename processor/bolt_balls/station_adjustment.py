"""The motions of all stations a posteriori, the variances of their prior being estimated along the way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.bolt_balls.station_kernels import cholesky, product, solve
from processor.geometry import rigid
from processor.model import Checked, Floats, column, names

START_RAD, START_MM = 5e-5, 2.0  # sd of the registration: where the iteration starts, nothing more
SMALLEST_RAD, SMALLEST_MM = 1e-8, 1e-3
LEAST_TOLD = 0.5  # motions the data must tell of before they say anything of a variance
LOOSE_RAD, LOOSE_MM = 1e-2, 1e3
ALLOWED = 6.0  # in log density below the likeliest variance


@dataclass(frozen=True)
class ControlPoints(Checked):
    """Points with known coordinates: where the cloud has them, and where they are; mm, less one origin.

    ``share`` (c, s) is how much of the measurement comes from each station (rows add up to 1). ``sd`` (c, 3) is that of
    measured minus target without the stations' errors.
    """

    ids: tuple[str, ...] = names("c")
    measured: Floats = column("c", 3)
    target: Floats = column("c", 3)
    sd: Floats = column("c", 3)
    share: Floats = column("c", "s")

    @property
    def hold_all(self) -> bool:
        """Whether they alone say where the whole cloud lies: three of them, not on one line."""
        if len(self.ids) < 3:
            return False
        extent = np.linalg.svd(self.target - self.target.mean(axis=0), compute_uv=False)
        return bool(extent[1] > 0.05 * extent[0])


def corrections(x: Floats, places: Floats) -> Floats:
    """Return T (s, 4, 4) of motions x (6 s,): turns about places (s, 3), then translations."""
    found = np.empty((len(places), 4, 4))
    for i, (one, place) in enumerate(zip(x.reshape(-1, 6), places, strict=True)):
        R = rigid.rotation_from_vector(one[:3])
        found[i] = rigid.transform(R, place - R @ place + one[3:])
    return found


def common_motion(places: Floats) -> Floats:
    """How the motions (6 s,) of stations follow a turn about the frame's origin and a translation (6,) of them all."""
    found = np.zeros((len(places), 6, 6))
    found[:, :3, :3] = np.eye(3)
    found[:, 3:] = rigid.motion(places)
    return found.reshape(-1, 6)


def mean_gain(M: Floats, precision: Floats) -> Floats:
    """How the common motion (6,) that fits the stations' motions best follows each of them (6, 6 s)."""
    weighted = np.ascontiguousarray(M.T) * precision
    found: Floats = solve(cholesky(product(weighted, M)), weighted)
    return found


class Posterior:
    """The motions of stations at ``places`` (s, 3), x = (turn, translation) of each, given what the tubes tell.

    A priori they are normal about zero, or about a common motion where control points hold the whole cloud. The two
    variances are those under which the motions' sum of squares is what the data make one expect (MacKay 1992).
    """

    def __init__(self, places: Floats, control: ControlPoints | None) -> None:
        self.places, self.control = places, control
        self.variance = np.array([START_RAD**2, START_MM**2])
        self.told = np.zeros(2)  # number of turns and of translations that the data tell of
        self.free = control is not None and control.hold_all
        self.M = common_motion(places - places.mean(axis=0))

    def step(self, H: Floats, g: Floats, x: Floats, rounds: int) -> tuple[Floats, Floats]:
        """Return the change of x (6 s,) and the covariance a posteriori; H and g are the tubes' equations at x.

        ``rounds`` is how often the variances are estimated anew.
        """
        H, g = self._with_control(H, g, x)
        change, C = np.zeros(len(x)), np.zeros_like(H)
        for turn in range(rounds + 1):
            P = self._prior(self.variance)
            L = cholesky(H + P)
            solved = solve(L, np.column_stack([g - product(P, x[:, None])[:, 0], np.eye(len(x))]))
            change, C = solved[:, 0], solved[:, 1:]
            if turn < rounds:
                self._estimate(x + change, C)
        return change, C

    def integrated(self, H: Floats, g: Floats, x: Floats) -> tuple[Floats, Floats]:
        """Return change and covariance as :meth:`step` does, averaged over all variances that the data allow.

        With few stations, or weak ties, the variances are known poorly: one guess of them would make the covariance
        too small. Their prior is uniform in log sd above what the data can resolve and in the sd itself below
        (Gelman 2006 on why not in the log there).
        """
        H, g = self._with_control(H, g, x)
        resolved = self._resolution(H)
        sd, nodes = np.sqrt(self.variance), [np.empty(0), np.empty(0)]
        for kind in (1, 0, 1):
            sd, nodes[kind] = self._allowed(H, g, x, sd, kind, resolved)
        found = []
        for turn in nodes[0]:
            for shift in nodes[1]:
                variance = np.array([turn, shift]) ** 2
                P = self._prior(variance)
                L = cholesky(H + P)
                right = g - product(P, x[:, None])[:, 0]
                solved = solve(L, np.column_stack([right, np.eye(len(x))]))
                found.append((self._evidence(L, right, solved[:, 0], P, x, variance, resolved), solved, variance))
        weight = np.exp(np.array([one[0] for one in found]) - max(one[0] for one in found))
        weight /= weight.sum()
        change, C, variance = np.zeros(len(x)), np.zeros_like(H), np.zeros(2)
        for w, (_, solved, own) in zip(weight, found, strict=True):
            change, variance = change + w * solved[:, 0], variance + w * own
        for w, (_, solved, _) in zip(weight, found, strict=True):
            off = solved[:, 0] - change
            C += w * (solved[:, 1:] + off[:, None] * off)
        self.variance = variance
        return change, 0.5 * (C + C.T)

    def _resolution(self, H: Floats) -> Floats:
        """Sd (2,) with which the data tell a station's turn and translation from the others', whatever they are."""
        C = solve(cholesky(H + self._prior(np.array([LOOSE_RAD, LOOSE_MM]) ** 2)), np.eye(len(H)))
        gain = np.eye(len(H)) - product(self.M, mean_gain(self.M, self.precision(np.array([LOOSE_RAD, LOOSE_MM]) ** 2)))
        spread = np.einsum("pq,pq->p", product(gain, C), gain).reshape(-1, 2, 3)
        found: Floats = np.sqrt(np.median(spread, axis=(0, 2)))
        return found

    def _allowed(
        self, H: Floats, g: Floats, x: Floats, sd: Floats, kind: int, resolved: Floats
    ) -> tuple[Floats, Floats]:
        """The likeliest sd (2,) along one ``kind``, and those (n,) of that kind that the data allow, even in the log."""

        def density(value: float) -> float:
            tried = sd.copy()
            tried[kind] = value
            return self._at(H, g, x, tried**2, resolved)

        coarse = resolved[kind] * 2.0 ** np.arange(-5, 14)
        value = np.array([density(one) for one in coarse])
        best = sd.copy()
        top = int(np.argmax(value))
        best[kind] = coarse[top]
        near = np.flatnonzero(value > value[top] - ALLOWED)
        if len(near) > 4 or top in (0, len(coarse) - 1):
            return best, coarse[near]
        step = 0.25 * np.log(2.0)
        peak, width = float(np.log(coarse[top])), step
        for _ in range(2):  # the density is next to normal: two parabolas find its top and width
            low, middle, high = (density(float(np.exp(peak + shift))) for shift in (-step, 0.0, step))
            bend = low - 2.0 * middle + high
            if not bend < 0.0:
                return best, coarse[near]
            width = step / np.sqrt(-bend)
            peak += float(np.clip(0.5 * step * (low - high) / bend, -2.0 * step, 2.0 * step))
        best[kind] = np.exp(peak)
        return best, np.exp(peak + width * np.arange(-2.0, 2.5))

    def _evidence(
        self, L: Floats, right: Floats, change: Floats, P: Floats, x: Floats, variance: Floats, resolved: Floats
    ) -> float:
        """Log density of log variances given the data, up to a constant."""
        free = 3.0 if self.free else 0.0
        log_prior = (0.5 * (len(x) // 2) - 0.5 * free) * float(np.sum(np.log(1.0 / variance)))
        fit = float(np.sum(right * change)) - float(np.sum(x * product(P, x[:, None])[:, 0]))
        sd = np.sqrt(variance)
        return log_prior - float(np.sum(np.log(np.diag(L)))) + 0.5 * fit + float(np.sum(np.log(sd / (sd + resolved))))

    def _at(self, H: Floats, g: Floats, x: Floats, variance: Floats, resolved: Floats) -> float:
        P = self._prior(variance)
        L = cholesky(H + P)
        right = g - product(P, x[:, None])[:, 0]
        return self._evidence(L, right, solve(L, right[:, None])[:, 0], P, x, variance, resolved)

    def precision(self, variance: Floats) -> Floats:
        """Information (6 s,) of the prior on each motion."""
        return np.tile(np.repeat(1.0 / variance, 3), len(self.places))

    def _prior(self, variance: Floats) -> Floats:
        precision = self.precision(variance)
        P = np.diag(precision)
        if self.free:
            P -= product(precision[:, None] * self.M, mean_gain(self.M, precision) * 1.0)
            P = 0.5 * (P + P.T)
        return P

    def _with_control(self, H: Floats, g: Floats, x: Floats) -> tuple[Floats, Floats]:
        if self.control is None:
            return H, g
        own = self.control
        T = corrections(x, self.places)
        moved = np.einsum("sij,cj->sci", T[:, :3, :3], own.measured) + T[:, None, :3, 3]
        off = own.target - np.einsum("cs,sci->ci", own.share, moved)
        J = np.stack([rigid.motion(own.measured - place) for place in self.places], axis=2)
        J = (own.share[:, None, :, None] * J).reshape(3 * len(own.ids), -1)
        weighted = np.ascontiguousarray(J.T) / own.sd.ravel() ** 2
        return H + product(weighted, J), g + product(weighted, off.reshape(-1, 1))[:, 0]

    def _estimate(self, x: Floats, C: Floats) -> None:
        own, spread, free = x, np.diag(C), 0.0
        if self.free:
            gain = np.eye(len(x)) - product(self.M, mean_gain(self.M, self.precision(self.variance)))
            own, free = product(gain, x[:, None])[:, 0], 3.0
            spread = np.einsum("pq,pq->p", product(gain, C), gain)
        for kind, least in enumerate((SMALLEST_RAD**2, SMALLEST_MM**2)):
            of_kind = np.arange(len(x)) % 6 // 3 == kind
            told = float(of_kind.sum()) - free - float(spread[of_kind].sum()) / self.variance[kind]
            self.told[kind] = max(told, 0.0)
            if told > LEAST_TOLD:
                self.variance[kind] = max(float(np.sum(own[of_kind] ** 2)) / told, least)
