"""Control points in the stations' adjustment: their equations, and which of them the others speak against."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from processor.geometry import rigid
from processor.geometry.linalg_small import cholesky, product, solve
from processor.model import Checked, Floats, Ints, column, names
from processor.space_frame.stations.residual_kernels import STATION

Bools = npt.NDArray[np.bool_]

HOLD_ALL = 3  # targets that can hold a cloud alone
UNLIKELY = 1e-4  # a good target is doubted as often as this


@dataclass(frozen=True)
class ControlPoints(Checked):
    """Targets with known coordinates as stations saw them, a row a sighting; mm, less one origin.

    ``share`` (c, s) is how much of a sighting comes from each station (rows add up to 1). ``sd`` (c, 3) is that of
    ``measured`` without the stations' errors. Sightings of one target bear one number ``point``, and share the error of
    ``target``, of ``target_sd`` a coordinate; where these are left out each has a target of its own, known exactly.
    """

    ids: tuple[str, ...] = names("c")
    measured: Floats = column("c", 3)
    target: Floats = column("c", 3)
    sd: Floats = column("c", 3)
    share: Floats = column("c", "s")
    point: Ints = column("c", dtype=np.int64)
    target_sd: Floats = column("c")
    scanners: tuple[str, ...] = ()  # names of the s stations

    @property
    def points(self) -> Ints:
        """Number (c,) of each sighting's target."""
        return self.point if len(self.point) else np.arange(len(self.ids))

    @property
    def scans(self) -> tuple[str, ...]:
        """Name of the station that each sighting is of; empty where several share it."""
        known = self.scanners or tuple(f"station {i}" for i in range(self.share.shape[1]))
        return tuple(known[int(np.argmax(row))] if row.max() > 0.99 else "" for row in self.share)

    @property
    def count(self) -> int:
        """Targets."""
        return len(np.unique(self.points))

    @property
    def hold_all(self) -> bool:
        """Whether they alone say where the whole cloud lies: three of them, not on one line."""
        targets = self.target[np.unique(self.points, return_index=True)[1]]
        if len(targets) < HOLD_ALL:
            return False
        extent = np.linalg.svd(targets - targets.mean(axis=0), compute_uv=False)
        return bool(extent[1] > 0.05 * extent[0])

    def only(self, kept: Bools) -> ControlPoints:
        """Return these sightings (c,) alone."""
        few = {name: getattr(self, name)[kept] for name in ("measured", "target", "sd", "share", "point", "target_sd")
               if len(getattr(self, name))}  # fmt: skip
        return replace(self, ids=tuple(np.array(self.ids, object)[kept].tolist()), **few)

    def off(self, x: Floats, places: Floats) -> Floats:
        """Target minus sighting (c, 3) where the stations' unknowns x (7 s,) put it."""
        R, t = motions(x, places)
        offset = x[STATION - 1 :: STATION]
        seen = self.measured[:, None] - (offset - offset.mean())[:, None] * self._rays(places)
        moved = np.einsum("sij,csj->sci", R, seen - places) + (places + t)[:, None]
        found: Floats = self.target - np.einsum("cs,sci->ci", self.share, moved)
        return found

    def follows(self, places: Floats) -> Floats:
        """How corrected sightings (3 c,) follow the stations' unknowns (7 s,): a matrix (3 c, 7 s)."""
        J = np.zeros((len(self.ids), 3, len(places), STATION))
        J[..., :6] = np.stack([rigid.motion(self.measured - place) for place in places], axis=2)
        J[..., 6] = -self._rays(places).transpose(0, 2, 1)
        J *= self.share[:, None, :, None]
        J[..., 6] -= J[..., 6].mean(axis=2, keepdims=True)  # of the offsets, what a station's is off their mean
        found: Floats = J.reshape(3 * len(self.ids), -1)
        return found

    def covariance(self) -> Floats:
        """Covariance (3 c, 3 c) of target minus sighting, without the stations' errors."""
        one = self.target_sd**2 if len(self.target_sd) else np.zeros(len(self.ids))
        same = (self.points[:, None] == self.points) * np.sqrt(one[:, None] * one)
        found: Floats = np.diag(self.sd.ravel() ** 2) + np.kron(same, np.eye(3))
        return found

    def added(self, H: Floats, g: Floats, x: Floats, places: Floats) -> tuple[Floats, Floats]:
        """Return the normal equations H (7 s, 7 s), g (7 s,) at x with those of the sightings in them."""
        if not self.ids:
            return H, g
        A = self.follows(places)
        weighted = np.ascontiguousarray(solve(cholesky(self.covariance()), A).T)
        return H + product(weighted, A), g + product(weighted, self.off(x, places).reshape(-1, 1))[:, 0]

    def _rays(self, places: Floats) -> Floats:
        ray = self.measured[:, None] - places
        found: Floats = ray / np.maximum(np.linalg.norm(ray, axis=2), 1e-300)[..., None]
        return found


def motions(x: Floats, places: Floats) -> tuple[Floats, Floats]:
    """Return turns R (s, 3, 3) about the places and translations t (s, 3) of the stations' unknowns x (7 s,)."""
    every = x.reshape(-1, STATION)
    return np.array([rigid.rotation_from_vector(one[:3]) for one in every]), every[:, 3:6]


@dataclass(frozen=True)
class Doubt:
    """What the targets say of each other: sightings to keep (c,), and what they lie off (3,) where none can be told."""

    kept: Bools
    off: Floats
    said: tuple[str, ...] = ()


Solved = Callable[[ControlPoints], tuple[Floats, Floats]]


def doubted(control: ControlPoints, x: Floats, places: Floats, solved: Solved) -> Doubt:
    """Hold each target against what all others predict of it (Baarda 1968), and leave out the one that must be wrong.

    Of a target that several stations saw, single sightings are left out where that is enough, and no more than half.
    ``solved`` gives change (7 s,) and covariance of the stations' unknowns with some sightings alone. Where it cannot
    be told which target is wrong, all are kept, and what the worst lies off is returned.
    """
    kept, said = np.ones(len(control.ids), bool), []
    while kept.any():
        worst, ratio, off = _worst(control, kept, x, places, solved)
        if ratio <= 1.0:
            break
        stray = _stray(control, kept, worst, x, places, solved)
        if stray:
            for row, away in stray:
                name, scan = control.ids[row], control.scans[row]
                said.append(
                    f"sighting of control point {name} by {scan} left out: {away:.2g} mm off what the others say"
                )
                kept[row] = False
            continue
        without = [number for number in np.unique(control.points[kept])
                   if _worst(control, kept & (control.points != number), x, places, solved)[1] <= 1.0]  # fmt: skip
        remain = len(np.unique(control.points[kept])) - 1
        if remain >= HOLD_ALL and (len(without) == 1 or (not without and remain > HOLD_ALL)):
            number = without[0] if without else worst
            name = control.ids[int(np.argmax(control.points == number))]
            size = _apart(control, kept, control.points == number, x, places, solved)[1]
            said.append(f"control point {name} left out: {np.linalg.norm(size):.2g} mm off what the others say")
            kept = kept & (control.points != number)
            continue
        name = control.ids[int(np.argmax(control.points == worst))]
        others = "the other control points and the stations" if remain else "the stations"
        what = f"control point {name} and {others} contradict each other by {np.linalg.norm(off):.2g} mm"
        return Doubt(kept, off, (*said, f"{what}, and it cannot be told which is wrong: intervals hold that"))
    return Doubt(kept, np.zeros(3), tuple(said))


def _worst(control: ControlPoints, kept: Bools, x: Floats, places: Floats, solved: Solved) -> tuple[int, float, Floats]:
    """Target that is least like what the others say, by how much (1 = just not likely), and what it is off (3,)."""
    found: tuple[int, float, Floats] = (-1, 0.0, np.zeros(3))
    for number in np.unique(control.points[kept]).tolist():
        ratio, off = _apart(control, kept, control.points == number, x, places, solved)
        if ratio > found[1]:
            found = (number, ratio, off)
    return found


def _stray(
    control: ControlPoints, kept: Bools, number: int, x: Floats, places: Floats, solved: Solved
) -> list[tuple[int, float]]:
    """Return the sightings of a target that must go for the rest of it to agree with all else, and how far off each is.

    The one with the largest normalised residual against all others goes first. None where that does not help, or
    where more than half of the sightings had to go: then the target itself may as well be wrong.
    """
    own, left = control.points == number, kept.copy()
    found: list[tuple[int, float]] = []
    count = int((kept & own).sum())
    while 2 * (len(found) + 1) <= count:
        alone = np.flatnonzero(left & own).tolist()
        apart = [_apart(control, left, np.arange(len(left)) == one, x, places, solved) for one in alone]
        (ratio, off), row = max(zip(apart, alone, strict=True), key=lambda one: one[0][0])
        if ratio <= 1.0:
            return []
        found.append((row, float(np.linalg.norm(off))))
        left[row] = False
        if _apart(control, left, own, x, places, solved)[0] <= 1.0:
            return found
    return []


def _apart(
    control: ControlPoints, kept: Bools, which: Bools, x: Floats, places: Floats, solved: Solved
) -> tuple[float, Floats]:
    """How unlikely sightings ``which`` (c,) are by all other kept ones (1 = just not), and what they are off (3,)."""
    own = control.only(kept & which)
    change, C = solved(control.only(kept & ~which))
    A = own.follows(places)
    off = own.off(x, places).ravel() - product(A, change[:, None])[:, 0]
    S = own.covariance() + product(product(A, C), np.ascontiguousarray(A.T))
    square = float(off @ solve(cholesky(S), off[:, None])[:, 0])
    return square / float(chdtri(len(off), UNLIKELY)), off.reshape(-1, 3).mean(axis=0)
