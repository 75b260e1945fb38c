"""The returns of a scanner's rays at one station: echoes, mixed pixels, lost signals, outliers, noise.

Each ray is rotated by the encoders' noise, while its point lies in the nominal direction. A footprint on one surface
gives the range of its middle. One that meets an edge is divided into sub-rays and gives a mixed pixel by the device's
behaviour. Weak signals are lost, and some returns become outliers. A station has one systematic offset, scale and tilt.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from designgen.randomness import generator
from designgen.rigid import inverse
from designgen.scanning import edge_footprints, ray_kernels, raycast
from designgen.scanning.ray_kernels import Beam, Strip
from designgen.scanning.raycast import Grid
from designgen.scanning.scanner import BEAM_RINGS, Params, Scanner
from designgen.scanning.surfaces import Surfaces
from processor.model import SOURCES, Bools, Codes, Floats, Labels, Shorts

STRIP = 64  # columns processed at a time
# Elevation of a scanner's rays: 300 degrees in a vertical plane, as of phase scanners; the base hides the rest.
LOWEST_DEG, HIGHEST_DEG = -60.0, 90.0
TAN_MOST = 20.0  # largest tangent of the angle of incidence, for the noise due to the footprint
SPECKLE_LOOKS = 8.0  # chosen: the signal scatters by 1 / sqrt(8) = 35 %, independent speckles in a footprint
ENCODER_SIGMAS = 7.0  # bound of a normal deviate in 32 bits
LEAST_SHARE = 0.25  # least fraction of the beam's energy that gives a return
SURFACE, MIXED, OUTLIER = range(len(SOURCES))


@dataclass(frozen=True)
class Returns:
    """Measured points, a row each, in the order of the grid's columns and rows."""

    points: Floats  # (n, 3), scanner's frame
    intensity: Shorts
    row: Labels
    column: Labels
    part: Labels  # rows of part names, -1 = none
    surface: Labels  # rows of Surfaces.surface_names, -1 = none
    source: Codes
    range_error_mm: Shorts  # measured less true range of the ray's middle, without systematic errors
    incidence_cos: Shorts
    sigma_mm: Shorts  # standard deviation of the range
    hits: Floats  # (n, 3) true hit of the ray's middle, NaN for none; (n, 0) without keep_hits


@dataclass(frozen=True)
class StationScan:
    """The returns of one station, and its systematic errors: offset (mm), scale (ppm), tilt about x and y (rad)."""

    returns: Returns
    systematic: tuple[float, float, float, float]


@dataclass(frozen=True)
class Echoes:
    """Echoes before noise, a row each."""

    row: Labels  # of the grid
    column: Labels
    shape: Labels  # row of Surfaces
    t: Floats  # true range of the ray's middle, mm; NaN for none
    range: Floats  # range of the whole footprint, mm
    signal: Floats  # relative to that of a white matt surface at normal incidence and 10 m
    cosine: Floats  # of the angle of incidence
    ray: Floats  # (n, 3) unit vector of the ray's middle, scanner's frame
    source: Codes  # row of SOURCES
    spread: Floats  # standard deviation of the ranges in the footprint by their energies, mm
    reflectance: Floats  # mean over the footprint by energy


Columns = TypeVar("Columns", Returns, Echoes)


def map_columns(record: Columns, function: Callable[[str], Any]) -> Columns:
    """Return a record of the same class whose columns are a function of their names."""
    return type(record)(**{field.name: function(field.name) for field in dataclasses.fields(record)})


def join(pieces: Sequence[Columns]) -> Columns:
    """Return the rows of all pieces, in order."""
    return map_columns(pieces[0], lambda name: np.concatenate([getattr(piece, name) for piece in pieces]))


def rows_of(record: Columns, rows: Any) -> Columns:
    """Return the rows of a record that numbers or a mask select."""
    return map_columns(record, lambda name: getattr(record, name)[rows])


def scan_station(
    surfaces: Surfaces,
    T_scene_scanner: Floats,
    scanner: Scanner,
    params: Params,
    seed: int,
    station: str,
    keep_hits: bool = False,
) -> StationScan:
    """Scan ``surfaces`` from the station named ``station``; ``T_scene_scanner`` (4, 4) is its true pose, mm.

    All random numbers depend only on ``seed``, the station's name and the grid. With ``keep_hits`` the returns have the
    true hits as well.
    """
    draws = generator(seed, f"station {station}").standard_normal(4)
    offset, scale = scanner.offset_mm * draws[0], scanner.scale_ppm * draws[1]
    tilt = 1e-6 * scanner.tilt_urad * draws[2:]
    caster = _StationCaster(surfaces, T_scene_scanner, scanner, params, seed, station, keep_hits)
    grid = caster.grid
    threads = int(os.environ.get("OMP_NUM_THREADS") or os.cpu_count() or 1)
    with ThreadPoolExecutor(threads) as pool:  # the kernels release the interpreter's lock
        # One strip at least: it gives the columns of an empty scan their types.
        strips = [number for number in caster.view.occupied() if caster.in_view(number)] or [0]
        returns = join(list(pool.map(caster.strip, strips)))
    if not params.turns:
        azimuth = 2.0 * np.pi * returns.column.astype(np.float64) / grid.columns
        elevation = grid.lowest + grid.step * returns.row.astype(np.float64)
        returns = rows_of(returns, params.in_view(azimuth, elevation))
    measured = np.linalg.norm(returns.points, axis=1)
    factor = (measured * (1.0 + 1e-6 * scale) + offset) / measured
    turned = np.array([[1.0, 0.0, tilt[1]], [0.0, 1.0, -tilt[0]], [-tilt[1], tilt[0], 1.0]])
    returns = dataclasses.replace(returns, points=(returns.points * factor[:, None]) @ turned.T)
    return StationScan(returns, (float(offset), float(scale), float(tilt[0]), float(tilt[1])))


def beam(count: int, aspect: float = 1.0) -> tuple[Floats, Floats]:
    """Return the offsets (k, 2) of sub-rays in horizontal radii of the beam, the middle first, and their energies (k,).

    The energies have the sum 1. The beam is Gaussian, with a vertical radius ``aspect`` times the horizontal one.
    """
    places, energy = [(0.0, 0.0)], [1.0 - sum(ring for *_, ring in BEAM_RINGS[count])]
    for radius, number, ring in BEAM_RINGS[count]:
        turns = (np.arange(number) + 0.5) * 2.0 * np.pi / number
        places += list(zip(radius * np.cos(turns), radius * np.sin(turns), strict=True))
        energy += [ring / number] * number
    return np.array(places) * (1.0, aspect), np.array(energy)


def reach(scanner: Scanner, count: int) -> Beam:
    """Return a beam whose radius grows evenly with the range, and in which all sub-rays lie."""
    widest = float(np.linalg.norm(beam(count, scanner.beam_aspect)[0], axis=1).max())
    half = 0.5e-3 * scanner.divergence_mrad
    return Beam(widest * (0.5 * scanner.beam_waist_mm + half * scanner.beam_focus_mm), widest * half)


class _StationCaster:
    """Rays of one station, and the steps from them to returns for each strip; arguments as of :func:`scan_station`."""

    def __init__(
        self,
        surfaces: Surfaces,
        T_scene_scanner: Floats,
        scanner: Scanner,
        params: Params,
        seed: int,
        station: str,
        keep_hits: bool,
    ) -> None:
        self.surfaces, self.scanner, self.params = surfaces, scanner, params
        self.seed, self.station, self.keep_hits = seed, station, keep_hits
        step = 1e-3 * params.step_mrad
        self.grid = Grid(
            step=step,
            lowest=float(np.radians(LOWEST_DEG)),
            rows=int(np.radians(HIGHEST_DEG - LOWEST_DEG) / step),
            columns=max(8, round(2.0 * np.pi / step)),
        )
        self.T_scanner_scene = inverse(T_scene_scanner)
        nearest = np.array([max(scanner.min_range_mm, 1.0)])
        wide = float(scanner.beam_angle(nearest)[0]) * max(1.0, scanner.beam_aspect)
        spread = 2.0 * wide + ENCODER_SIGMAS * 1e-6 * scanner.encoder_urad
        # Lower bound of the range to any surface, mm
        self.least = max(float(nearest[0]), edge_footprints.nearest_mm(surfaces, T_scene_scanner[:3, 3]))
        self.outermost = reach(scanner, params.sub_rays)  # in which all sub-rays lie
        widest = self.outermost.half_divergence + self.outermost.exit_radius / self.least
        self.margin = edge_footprints.margin(self.grid, widest)
        self.view = raycast.view(
            surfaces, self.T_scanner_scene, self.grid, STRIP, self.margin.side, scanner.max_range_mm, spread
        )

    def in_view(self, number: int) -> bool:
        """Whether any column of a strip is in the scanner's field of view."""
        if self.params.turns:
            return True
        columns = self.view.strips[number].first + np.arange(STRIP)
        middle = np.full(STRIP, np.radians(self.params.elevation_deg))
        return bool(self.params.in_view(2.0 * np.pi * columns / self.grid.columns, middle).any())

    def strip(self, number: int) -> Returns:
        """Return the returns of one strip of columns."""
        strip = self.view.strips[number]
        # From 1: a 0 at the end gives the same generator as without, which is that of the station.
        rng = generator(self.seed, f"station {self.station}", number + 1)
        used, side = min(STRIP, self.grid.columns - strip.first), strip.side
        rays = self._rays(rng, used)
        shape, t, thin = self.view.cast(number, self.grid, rays, self.outermost, self.margin.cast_columns)
        inside = shape >= 0
        inside[:side], inside[side + used :] = False, False
        edge, near = np.zeros(shape.shape, bool), t
        if self.params.sub_rays > 1:
            surface = np.where(shape >= 0, self.surfaces.surface[shape], -1)
            edge, near = edge_footprints.mark_edges(
                surface, t, thin, used, self.margin, self.grid, self.outermost, self.least
            )
            inside &= ~edge
        column, row = (index.astype(np.int32) for index in np.nonzero(inside))
        on_surfaces = self._on_surfaces(strip, column, row, shape[column, row], t[column, row], rays)
        at_edges = self._at_edges(number, edge, near, rays) if edge.any() else []
        echoes = join([on_surfaces, *at_edges])
        return self._returns(rng, rows_of(echoes, np.lexsort((echoes.row, echoes.column))))

    def _rays(self, rng: np.random.Generator, used: int) -> ray_kernels.Rays:
        """Draw the encoders' noise of a strip with ``used`` columns; the rays beside it have none."""
        side, encoder = self.margin.side, 1e-6 * self.scanner.encoder_urad
        jitter = np.zeros((STRIP + 2 * side, self.grid.rows, 2), np.float32)
        if encoder:
            drawn = jitter[side : side + used]
            drawn[:] = rng.standard_normal((used, self.grid.rows, 2), np.float32)
            drawn *= np.float32(encoder)
            # A change of azimuth rotates a ray by the cosine of its elevation times as much.
            drawn[:, :, 0] *= self.margin.cos_elevation
        # Two perpendicular encoders rotate a ray by at most sqrt 2 times as much; the rest is for rounding.
        largest = 1.5e-6 * ENCODER_SIGMAS * self.scanner.encoder_urad + 1e-6
        return ray_kernels.Rays(jitter, largest, self.scanner.min_range_mm, self.scanner.max_range_mm)

    def _on_surfaces(
        self, strip: Strip, column: Labels, row: Labels, shape: Labels, t: Floats, rays: ray_kernels.Rays
    ) -> Echoes:
        """Return the echoes of footprints on a single surface each."""
        columns = (strip.first + column - strip.side).astype(np.int32)
        ray = self.grid.directions(row, columns, rays.jitter[column, row])
        exact, cosine = raycast.refine_hits(self.view, self.surfaces, self.T_scanner_scene, shape, ray, t)
        met = np.isfinite(exact)
        t, cosine = exact[met], cosine[met]
        return Echoes(
            row=row[met],
            column=columns[met],
            shape=shape[met],
            t=t,
            range=t,
            signal=self.surfaces.albedo[shape[met]] * self.params.signal(cosine, t),
            cosine=cosine,
            ray=ray[met],
            source=np.full(len(t), SURFACE, np.uint8),
            spread=np.zeros(len(t)),
            reflectance=self.params.reflectance * self.surfaces.albedo[shape[met]],
        )

    def _at_edges(self, number: int, edge: Bools, near: Floats, rays: ray_kernels.Rays) -> list[Echoes]:
        """Return the echoes of the rays marked in ``edge``: of footprints on one surface after all, and mixed ones."""
        strip = self.view.strips[number]
        column, row = (index.astype(np.int32) for index in np.nonzero(edge))
        numbered = np.full(edge.shape, -1, np.int32)
        numbered[column, row] = np.arange(len(column), dtype=np.int32)
        offsets = beam(self.params.sub_rays, self.scanner.beam_aspect)[0]
        angle = self.scanner.beam_angle(near[column, row])
        subs, ranges = self.view.cast_around(number, self.grid, rays, numbered, angle, offsets)
        surface = np.where(subs >= 0, self.surfaces.surface[subs], -1)
        whole = (surface == surface[:, :1]).all(axis=1) & (subs[:, 0] >= 0)
        some = (subs >= 0).any(axis=1) & ~whole
        return [
            self._on_surfaces(strip, column[whole], row[whole], subs[whole, 0], ranges[whole, 0], rays),
            self._mixed(strip, column[some], row[some], subs[some], ranges[some], angle[some], rays),
        ]

    def _mixed(
        self,
        strip: Strip,
        column: Labels,
        row: Labels,
        subs: Labels,
        ranges: Floats,
        angle: Floats,
        rays: ray_kernels.Rays,
    ) -> Echoes:
        """Return the echoes of footprints on several surfaces, or partly on none; ``subs``, ``ranges`` (n, k)."""
        offsets, share = beam(self.params.sub_rays, self.scanner.beam_aspect)
        jitter = rays.jitter[column, row]
        columns = (strip.first + column - strip.side).astype(np.int32)
        t, cosine = np.full(ranges.shape, np.nan), np.zeros(ranges.shape)
        n, k = np.nonzero(subs >= 0)
        ray = self.grid.directions(row[n], columns[n], jitter[n] + angle[n, None] * offsets[k])
        t[n, k], cosine[n, k] = raycast.refine_hits(
            self.view, self.surfaces, self.T_scanner_scene, subs[n, k], ray, ranges[n, k]
        )
        hit = np.isfinite(t)
        ranges, t, cosine = np.where(hit, t, np.inf), np.where(hit, t, 1.0), np.where(hit, cosine, 0.0)
        albedo = self.surfaces.albedo[np.maximum(subs, 0)]
        energy = np.where(hit, share * albedo * self.params.signal(cosine, t), 0.0)
        if self.scanner.behaviour == "pulse":
            energy = strongest_echo(ranges, energy, self.scanner.separation_mm)
        back = np.where(energy > 0.0, share, 0.0).sum(axis=1) > LEAST_SHARE
        total = energy[back].sum(axis=1)
        most = np.argmax(energy[back], axis=1)[:, None]
        middle = np.where(hit[back, 0], t[back, 0], np.nan)
        mean = (energy[back] * t[back]).sum(axis=1) / total
        spread = np.sqrt((energy[back] * (t[back] - mean[:, None]) ** 2).sum(axis=1) / total)
        return Echoes(
            row=row[back],
            column=columns[back],
            shape=np.take_along_axis(subs[back], most, axis=1)[:, 0],
            t=middle,
            range=mean,
            signal=total,
            cosine=np.take_along_axis(cosine[back], most, axis=1)[:, 0],
            ray=self.grid.directions(row[back], columns[back], jitter[back]),
            source=np.full(len(total), MIXED, np.uint8),
            spread=spread,
            reflectance=self.params.reflectance * (energy[back] * albedo[back]).sum(axis=1) / total,
        )

    def _returns(self, rng: np.random.Generator, echoes: Echoes) -> Returns:
        """Drop weak echoes, turn some into outliers, add noise."""
        n = len(echoes.t)
        speckle = rng.gamma(SPECKLE_LOOKS, 1.0 / SPECKLE_LOOKS, n)
        stray, where = rng.random(n) < self.scanner.flying_share, rng.random(n)
        tangent = np.minimum(np.sqrt(1.0 - echoes.cosine**2) / np.maximum(echoes.cosine, 1e-3), TAN_MOST)
        sigma = self.scanner.noise(echoes.range, echoes.signal, tangent, echoes.spread)
        low = self.scanner.min_range_mm
        measured = echoes.range + self.scanner.bias(echoes.reflectance) + sigma * rng.standard_normal(n)
        measured = np.where(stray, low + where * (echoes.range - low), measured)
        surface = self.surfaces.label[echoes.shape]
        bright = echoes.signal
        if self.scanner.intensity_noise > 0.0:
            bright = bright * np.maximum(1.0 + self.scanner.intensity_noise * rng.standard_normal(n), 0.0)
        returns = Returns(
            points=self.grid.directions(echoes.row, echoes.column) * measured[:, None],
            intensity=bright.astype(np.float32),
            row=echoes.row,
            column=echoes.column,
            part=np.where(stray, -1, self.surfaces.part[echoes.shape]).astype(np.int32),
            surface=np.where(stray, -1, surface).astype(np.int32),
            source=np.where(stray, OUTLIER, echoes.source).astype(np.uint8),
            range_error_mm=(measured - echoes.t).astype(np.float32),
            incidence_cos=echoes.cosine.astype(np.float32),
            sigma_mm=sigma.astype(np.float32),
            hits=echoes.ray * echoes.t[:, None] if self.keep_hits else np.empty((n, 0)),
        )
        detected = (echoes.signal * speckle >= self.scanner.threshold) & (measured > 0.0)
        return rows_of(returns, detected)


def strongest_echo(ranges: Floats, energy: Floats, separation_mm: float) -> Floats:
    """Return the energies (n, k) of the sub-rays of the strongest echo, 0 for all others.

    Sub-rays whose ranges (n, k) differ by at most ``separation_mm`` from the next are one echo; infinite: no hit.
    """
    order = np.argsort(ranges, axis=1, kind="stable")
    t, e = np.take_along_axis(ranges, order, axis=1), np.take_along_axis(energy, order, axis=1)
    with np.errstate(invalid="ignore"):  # the difference of two infinite ranges is NaN
        echo = np.cumsum(np.diff(t, axis=1, prepend=t[:, :1]) > separation_mm, axis=1)
    sums = np.stack([(e * (echo == k)).sum(axis=1) for k in range(t.shape[1])], axis=1)
    strongest = np.where(echo == np.argmax(sums, axis=1)[:, None], e, 0.0)
    result = np.zeros_like(energy)
    np.put_along_axis(result, order, strongest, axis=1)
    return result
