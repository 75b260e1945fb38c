"""Input and output of the stations' registration: points on tubes, and corrections with their covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.adjustment.body_motions import distance_derivative, point_covariances
from processor.geometry.linalg_small import product
from processor.large_arrays import blocks
from processor.model import Checked, Floats, Ints, Labels, Reason, Word, column, described, names, reasons
from processor.space_frame.stations import residual_kernels as kernels
from processor.space_frame.stations.posterior import common_motion, mean_gain


class StationStatus(Word):
    """How far the corrections of the stations can be relied on."""

    OK = "ok"
    WEAK = "weak"  # tubes and control points do not determine all of them
    SINGLE = "single"  # there is one station
    UNKNOWN = "unknown"  # the stations have no tube in common
    DOUBTFUL = "doubtful"  # the beam's width may explain the stations' errors


POINTS_AT_ONCE = 1 << 10  # whose derivatives by all stations are in memory together


@dataclass(frozen=True)
class TubePoints:
    """Points on tubes, sorted by tube: those of tube j are rows start[j]:start[j + 1], mm, in a canonical order.

    ``station`` (n,) is the row of the scanners; -1 = unknown, such points are left out.
    """

    points: Floats
    station: Labels
    start: Ints


@dataclass(frozen=True)
class Stations(Checked):
    """Corrections of all stations, and their covariance.

    A station's ``range_offset`` is subtracted from its ranges; then ``T_project_station`` (s, 4, 4) maps its points, in
    the project's frame as registered less the origin, to their corrected places: see :meth:`corrected`.

    ``covariance`` (7 s, 7 s) is of each station's (turn about x, y, z through ``places`` (s, 3), translation, range
    offset) in turn; rad and mm, T = exp(xi) T. It includes the errors between the stations and the motion that is
    common to all; NaN where it is unknown.
    """

    status: StationStatus = described(words=StationStatus)
    messages: tuple[Reason, ...] = described((), reasons="")  # about all stations
    T_project_station: Floats = column("s", 4, 4)
    places: Floats = column("s", 3)
    covariance: Floats = column("p", "p")
    before_mm: float = float("nan")  # sd of a station's translation along an axis, as registered
    before_rad: float = float("nan")  # and of its turn
    range_offset: Floats = column("s")  # of a station's ranges less the mean of all, mm
    range_offset_sd: float = float("nan")  # of all stations, as scanned
    shared_offset_sd: float = 0.0  # of an error common to all ranges, by an offset or a wide beam; in no covariance
    shared_offset: float = 0.0  # that the tubes show, mm; it is subtracted from no range
    observations: Ints = column("s", dtype=np.int64)  # tubes that a station has in common with others
    reasons: tuple[tuple[Reason, ...], ...] = reasons("s")  # why a station's correction is weak
    range_sd: Floats = column("s")  # scale of the residuals along the ray, mm
    floor_mm: float = 0.0  # sd by which an observation of a tube deviates beyond the points' noise
    axis_points: Floats = column("m", 3)  # of the tubes after the corrections, and their directions and radii
    axis_directions: Floats = column("m", 3)
    axis_radii: Floats = column("m")
    datum: tuple[Reason, ...] = described((), reasons="")  # what fixes all stations together, and its uncertainty
    control: tuple[str, ...] = names("c")  # control points, a row per sighting
    control_scan: tuple[str, ...] = names("c")  # the stations that saw them
    control_off: Floats = column("c", 3)  # target minus sighting after the corrections
    control_used: Ints = column("c", dtype=np.int64)  # 1 = yes

    def corrected(self, points: Floats, station: Labels) -> Floats:
        """Return points (n, 3) of stations (n,), less the origin, after the corrections; those of -1 unmoved."""
        return kernels.corrected(
            np.ascontiguousarray(points), station, self.places, self.range_offset, self.T_project_station
        )

    def effect(self, points: Floats, influence: Floats, relative: bool = False) -> Floats:
        """Covariance (k, d, d) that the stations add to estimates near points (k, 3).

        ``influence`` are the derivatives of an estimate by the stations' points: (k, s) weights that add up to 1, for
        centres that move with the weighted mean of the stations, or (k, s, d, 3) derivatives of d parameters by a shift
        of a station's points there. ``relative`` leaves out the motion common to all stations (:meth:`common`).
        """
        if influence.ndim == 2:
            influence = influence[:, :, None, None] * np.eye(3)
        covariance = self.covariance
        if relative and np.isfinite(self.before_mm):
            M = common_motion(self.places)
            relative_part = np.eye(len(covariance)) - product(M, mean_gain(M, self._precision()))
            covariance = product(product(relative_part, covariance), np.ascontiguousarray(relative_part.T))
        effects = np.empty((len(points), influence.shape[2], influence.shape[2]))
        for rows in blocks(len(points), POINTS_AT_ONCE):
            J = _by_stations(points[rows], influence[rows], self.places)
            with_all = product(J.reshape(-1, len(covariance)), covariance).reshape(J.shape)  # in one order of sums
            effects[rows] = np.einsum("kip,kjp->kij", with_all, J)
        return effects

    def common(self, place: Floats) -> Floats:
        """Covariance (6, 6) of the motion common to all stations: turn about ``place`` (3,), translation.

        That motion is the best fit to the motions of the stations that see tubes, weighted by their prior variances.
        """
        if not np.isfinite(self.before_mm):
            first: Floats = self.covariance[:6, :6].copy()
            return first
        gain = mean_gain(common_motion(self.places - place), self._precision())
        covariance: Floats = product(product(gain, self.covariance), np.ascontiguousarray(gain.T))
        return covariance

    def datum_at(self, points: Floats) -> Floats:
        """Covariance (k, 3, 3) that the motion common to all stations adds at points (k, 3)."""
        middle = points.mean(axis=0) if len(points) else np.zeros(3)
        return point_covariances(points - middle, self.common(middle))

    @property
    def between(self) -> Floats:
        """Covariance (s, 3, 3) of each station's place relative to the others: without their common motion."""
        return self.effect(self.places, np.eye(len(self.places)), relative=True)

    def _precision(self) -> Floats:
        station = np.repeat(np.array([self.before_rad, self.before_mm, self.range_offset_sd]), (3, 3, 1)) ** -2.0
        seeing = self.observations > 0
        return np.outer(seeing if seeing.any() else ~seeing, station).ravel()


def moved_by_offset(points: Floats, places: Floats) -> Floats:
    """Return how an offset of 1 mm of all ranges moves what stations at ``places`` (s, 3) see at points (k, 3).

    It moves along the mean of the rays. Of a station's points there are more the nearer it is.
    """
    ray = points[:, None] - places
    squared = np.maximum(np.sum(ray**2, axis=2, keepdims=True), 1e-300)
    near: Floats = np.sum(ray / squared**1.5, axis=1) / np.sum(1.0 / squared, axis=1)
    return near


def _by_stations(points: Floats, influence: Floats, places: Floats) -> Floats:
    """Return the derivative J (k, d, 7 s) of estimates by the stations' unknowns; see :meth:`Stations.effect`."""
    k, stations, d, _ = influence.shape
    arm = np.repeat(points[:, None] - places, d, axis=1).reshape(-1, 3)
    rays = arm / np.maximum(np.linalg.norm(arm, axis=1), 1e-300)[:, None]
    J = distance_derivative(arm, influence.reshape(-1, 3), rays).reshape(k, stations, d, -1)
    return np.swapaxes(J, 1, 2).reshape(k, d, -1)
