"""Control points in the stations' adjustment: their equations, and which of them the others contradict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from processor.adjustment import data_snooping
from processor.adjustment.sighting_covariance import sighting_covariance
from processor.geometry import rigid
from processor.geometry.linalg_small import cholesky, product, solve
from processor.model import Bools, Checked, Floats, Ints, Reason, column, names, reason
from processor.space_frame.stations.residual_kernels import STATION

OFF_LINE = 0.05  # least second extent of targets that determine the whole cloud's pose, as a share of the first


@dataclass(frozen=True)
class ControlPoints(Checked):
    """Targets with known coordinates as stations saw them, one row per sighting; mm, less one origin.

    ``share`` (c, s) is that of each station in a sighting (rows add up to 1). ``sd`` (c, 3) is that of ``measured``
    without the stations' errors. Sightings of one target have the same number ``point`` and share the error of
    ``target``, of ``target_sd`` per coordinate. Without these each has a target of its own, known exactly.
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
        """Name of the station that made each sighting; empty where several share it."""
        known = self.scanners or tuple(f"station {i}" for i in range(self.share.shape[1]))
        return tuple(known[int(np.argmax(row))] if row.max() > 0.99 else "" for row in self.share)

    @property
    def count(self) -> int:
        """Number of targets."""
        return len(np.unique(self.points))

    @property
    def hold_all(self) -> bool:
        """Whether they alone determine the pose of the whole cloud: three of them, not on one line."""
        targets = self.target[np.unique(self.points, return_index=True)[1]]
        return rigid.points_determine_motion(targets, OFF_LINE)

    def name_of(self, number: int) -> str:
        """Name of the target with a number."""
        return self.ids[int(np.argmax(self.points == number))]

    def only(self, kept: Bools) -> ControlPoints:
        """Return these sightings (c,) alone."""
        few = {name: getattr(self, name)[kept] for name in ("measured", "target", "sd", "share", "point", "target_sd")
               if len(getattr(self, name))}  # fmt: skip
        return replace(self, ids=tuple(np.array(self.ids, object)[kept].tolist()), **few)

    def off(self, x: Floats, places: Floats) -> Floats:
        """Target minus sighting (c, 3) by the stations' unknowns x (7 s,)."""
        R, t = motions(x, places)
        offset = x[STATION - 1 :: STATION]
        seen = self.measured[:, None] - (offset - offset.mean())[:, None] * self._rays(places)
        moved = np.einsum("sij,csj->sci", R, seen - places) + (places + t)[:, None]
        off: Floats = self.target - np.einsum("cs,sci->ci", self.share, moved)
        return off

    def follows(self, places: Floats) -> Floats:
        """Return the derivative (3 c, 7 s) of corrected sightings (3 c,) by the stations' unknowns (7 s,)."""
        J = np.zeros((len(self.ids), 3, len(places), STATION))
        J[..., :6] = np.stack([rigid.motion(self.measured - place) for place in places], axis=2)
        J[..., 6] = -self._rays(places).transpose(0, 2, 1)
        J *= self.share[:, None, :, None]
        J[..., 6] -= J[..., 6].mean(axis=2, keepdims=True)  # offsets count relative to their mean
        derivative: Floats = J.reshape(3 * len(self.ids), -1)
        return derivative

    def covariance(self) -> Floats:
        """Covariance (3 c, 3 c) of target minus sighting, without the stations' errors."""
        target_sd = self.target_sd if len(self.target_sd) else np.zeros(len(self.ids))
        return sighting_covariance(self.points, target_sd, self.sd)

    def added(self, H: Floats, g: Floats, x: Floats, places: Floats) -> tuple[Floats, Floats]:
        """Return the normal equations H (7 s, 7 s), g (7 s,) at x with those of the sightings added."""
        if not self.ids:
            return H, g
        A = self.follows(places)
        weighted = np.ascontiguousarray(solve(cholesky(self.covariance()), A).T)
        return H + product(weighted, A), g + product(weighted, self.off(x, places).reshape(-1, 1))[:, 0]

    def _rays(self, places: Floats) -> Floats:
        ray = self.measured[:, None] - places
        unit: Floats = ray / np.maximum(np.linalg.norm(ray, axis=2), 1e-300)[..., None]
        return unit


def motions(x: Floats, places: Floats) -> tuple[Floats, Floats]:
    """Return turns R (s, 3, 3) about the places and translations t (s, 3) of the stations' unknowns x (7 s,)."""
    every = x.reshape(-1, STATION)
    return np.array([rigid.rotation_from_vector(unknowns[:3]) for unknowns in every]), every[:, 3:6]


@dataclass(frozen=True)
class Doubt:
    """Sightings (c,) to keep, the offset (3,) of a target where it cannot be decided which is wrong, and messages."""

    kept: Bools
    off: Floats
    reasons: tuple[Reason, ...] = ()


Solved = Callable[[ControlPoints], tuple[Floats, Floats]]


def doubted(control: ControlPoints, x: Floats, places: Floats, solved: Solved) -> Doubt:
    """Test each target against the prediction by all others and the stations, and leave out those that must be wrong.

    ``solved`` returns change (7 s,) and covariance of the stations' unknowns with some sightings alone. Where it cannot
    be decided which target is wrong, all are kept, and the offset of the worst is returned.
    """

    def predicted(which: Bools, others: Bools) -> tuple[Floats, Floats]:
        tested = control.only(which)
        change, C = solved(control.only(others))
        A = tested.follows(places)
        off = tested.off(x, places).ravel() - product(A, change[:, None])[:, 0]
        return off, tested.covariance() + product(product(A, C), np.ascontiguousarray(A.T))

    tests = data_snooping.leave_out(control.points, predicted)
    reasons = []
    for rejection in tests.rejected:
        row, off = rejection.row, rejection.off_mm
        if row is None:
            reasons.append(reason("spheres.control-left-out", point=control.name_of(rejection.number), off=off))
        else:
            reasons.append(
                reason("spheres.sighting-left-out", point=control.ids[row], scan=control.scans[row], off=off)
            )
    if tests.contradiction is not None:
        name, off = control.name_of(tests.contradiction), float(np.linalg.norm(tests.off))
        if tests.alone:
            reasons.append(reason("spheres.control-contradicts-stations", point=name, off=off))
        else:
            reasons.append(reason("spheres.control-contradicts", point=name, off=off))
    return Doubt(tests.accepted, tests.off, tuple(reasons))
