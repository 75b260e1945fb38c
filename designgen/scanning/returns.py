"""What a scanner makes of its rays, station by station: echoes, mixed pixels, losses, strays, noise.

Encoders turn each ray a little; the point is put where they say it was. A footprint on one surface gives the range of
its middle; one that meets an edge is cut into sub-rays, and gives a mixed pixel by the device's behaviour. Weak signals
are lost, some returns stray. What a station does systematically wrong is drawn once: offset, scale, tilt.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from designgen.scanning import footprints, raycast
from designgen.scanning.raycast import Grid, Seen
from designgen.scanning.scanner import Params, Scanner
from designgen.scanning.surfaces import Bools, Surfaces
from processor.model import SOURCES, Codes, Floats, Labels, Shorts

STRIP = 64  # columns worked on at a time
LOWEST_DEG, HIGHEST_DEG = -60.0, 90.0
TAN_MOST = 20.0  # of incidence, for the spread of a footprint
SPECKLE_LOOKS = 8.0
ENCODER_SIGMAS = 7.0  # no ray is turned further: a normal deviate in 32 bits stays below
LEAST_SHARE = 0.25  # of the beam's energy that must come back for a return
SURFACE, MIXED, OUTLIER = range(len(SOURCES))


@dataclass(frozen=True)
class Returns:
    """Points as measured, a row each, in the order of the grid's columns and rows."""

    points: Floats  # (n, 3), scanner's frame
    intensity: Shorts
    row: Labels
    column: Labels
    part: Labels  # rows of part names, -1 = none
    surface: Labels  # rows of Surfaces.surface_names, -1 = none
    source: Codes
    range_error_mm: Shorts  # measured less true range of the ray's middle, without what is systematic
    incidence_cos: Shorts
    sigma_mm: Shorts  # standard deviation of the range
    hits: Floats  # (n, 3) where the ray's middle truly met the surface, NaN where none; (n, 0) unless asked for


@dataclass(frozen=True)
class StationScan:
    """What one station saw, and its systematic terms: offset (mm), scale (ppm), tilt about x and y (rad)."""

    returns: Returns
    systematic: tuple[float, float, float, float]


@dataclass(frozen=True)
class Echoes:
    """What came back to a scanner before noise, a row an echo; ``t`` is the true range of the ray's middle."""

    row: Labels
    column: Labels
    shape: Labels
    t: Floats
    range: Floats
    signal: Floats
    cosine: Floats
    ray: Floats  # (n, 3)
    source: Codes


def scan(
    surfaces: Surfaces,
    T_scene_scanner: Floats,
    scanner: Scanner,
    params: Params,
    seed: int,
    station: str,
    keep_hits: bool = False,
) -> StationScan:
    """Scan from one station. Every random number follows from seed, station and the grid alone."""
    key = (seed, int.from_bytes(hashlib.sha256(f"station {station}".encode()).digest()[:8], "little"))
    draws = np.random.default_rng(key).standard_normal(4)
    offset, scale = scanner.offset_mm * draws[0], scanner.scale_ppm * draws[1]
    tilt = 1e-6 * scanner.tilt_urad * draws[2:]
    step = 1e-3 * params.step_mrad
    grid = Grid(
        step,
        float(np.radians(LOWEST_DEG)),
        int(np.radians(HIGHEST_DEG - LOWEST_DEG) / step),
        max(8, round(2.0 * np.pi / step)),
    )
    R = T_scene_scanner[:3, :3].T
    T: Floats = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ T_scene_scanner[:3, 3]
    nearest = np.array([max(scanner.min_range_mm, 1.0)])
    spread = 2.0 * float(scanner.beam_angle(nearest)[0]) + ENCODER_SIGMAS * 1e-6 * scanner.encoder_urad
    place: Floats = T_scene_scanner[:3, 3]
    least = max(float(nearest[0]), footprints.nearest_mm(surfaces, place))
    margin = footprints.margin(grid, outermost(params.sub_rays) * float(scanner.beam_angle(np.array([least]))[0]))
    seen = raycast.see(surfaces, T, grid, STRIP, margin.side, scanner.max_range_mm, spread)
    job = _Job(surfaces, seen, T, grid, scanner, params, key, keep_hits, margin, least)
    with ThreadPoolExecutor(_threads()) as pool:  # the kernels let go of the interpreter's lock
        returns = _joined_returns(list(pool.map(job.strip, range(-(-grid.columns // STRIP)))))
    measured = np.linalg.norm(returns.points, axis=1)
    factor = (measured * (1.0 + 1e-6 * scale) + offset) / measured
    turned = np.array([[1.0, 0.0, tilt[1]], [0.0, 1.0, -tilt[0]], [-tilt[1], tilt[0], 1.0]])
    returns = dataclasses.replace(returns, points=(returns.points * factor[:, None]) @ turned.T)
    return StationScan(returns, (float(offset), float(scale), float(tilt[0]), float(tilt[1])))


def _threads() -> int:
    return int(os.environ.get("OMP_NUM_THREADS") or os.cpu_count() or 1)


def _joined_returns(pieces: Sequence[Returns]) -> Returns:
    """Join the strips' returns, letting each column go once it is joined."""
    names = [field.name for field in dataclasses.fields(Returns)]
    return Returns(**{name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in names})


def beam(count: int) -> tuple[Floats, Floats]:
    """Directions (k, 2) of sub-rays in radii of the beam, the middle first, and their share (k,) of its energy.

    The beam is Gaussian; its radius is where the intensity is 1/e^2.
    """
    rings: dict[int, list[tuple[float, int]]] = {1: [], 7: [(0.7, 6)], 19: [(0.45, 6), (0.9, 12)]}
    places = [(0.0, 0.0)]
    for radius, number in rings[count]:
        turns = (np.arange(number) + 0.5) * 2.0 * np.pi / number
        places += list(zip(radius * np.cos(turns), radius * np.sin(turns), strict=True))
    offsets = np.array(places)
    energy = np.exp(-2.0 * (offsets**2).sum(axis=1))
    return offsets, energy / energy.sum()


def outermost(count: int) -> float:
    """Return how far from a beam's middle its sub-rays lie, in radii of the beam."""
    return float(np.linalg.norm(beam(count)[0], axis=1).max())


@dataclass(frozen=True)
class _Job:
    """One station's work, strip by strip."""

    surfaces: Surfaces
    seen: Seen
    T_scanner_scene: Floats
    grid: Grid
    scanner: Scanner
    params: Params
    key: tuple[int, int]
    keep_hits: bool
    margin: footprints.Margin
    least: float  # nothing is seen nearer, mm

    @property
    def limits(self) -> tuple[float, float]:
        """Ranges that the scanner sees, mm."""
        return self.scanner.min_range_mm, self.scanner.max_range_mm

    @property
    def turned(self) -> float:
        """Angle by which encoders turn no ray further, rad, and what rounding may do."""
        return 1.5e-6 * ENCODER_SIGMAS * self.scanner.encoder_urad + 1e-6  # by two encoders, square to each other

    def strip(self, number: int) -> Returns:
        """Return what the rays of one strip of columns give."""
        if self.seen.strip_start[number] == self.seen.strip_start[number + 1]:
            return self._returns(np.random.default_rng(0), _joined([]))
        # From 1: a key that ends in 0 is the same as the key without it, which is the station's own.
        rng = np.random.default_rng([*self.key, number + 1])
        used, side = min(STRIP, self.grid.columns - number * STRIP), self.margin.side
        jitter = np.zeros((STRIP + 2 * side, self.grid.rows, 2), np.float32)
        if self.scanner.encoder_urad:
            own = jitter[side : side + used]
            own[:] = rng.standard_normal((used, self.grid.rows, 2), np.float32)
            own *= np.float32(1e-6 * self.scanner.encoder_urad)
            # An azimuth moves a ray less the higher it looks.
            own[:, :, 0] *= footprints.levels(self.grid)
        half = (0.5 * self.scanner.beam_exit_mm, 0.5e-3 * self.scanner.divergence_mrad)
        shape, t, thin = raycast.cast(
            self.seen, self.grid, number, jitter, self.turned, self.limits, half, self.margin.cast
        )
        inside = shape >= 0
        inside[:side], inside[side + used :] = False, False
        edge, near = np.zeros(shape.shape, bool), t
        if self.params.sub_rays > 1:
            surface = np.where(shape >= 0, self.surfaces.surface[shape], -1)
            edge, near = self._edges(surface, t, thin, used, half)
            inside &= ~edge
        column, row = (index.astype(np.int32) for index in np.nonzero(inside))
        found = [self._on_one(number, column, row, shape[column, row], t[column, row], jitter[column, row])]
        if edge.any():
            found += self._at_edges(number, edge, near, jitter)
        return self._returns(rng, _joined(found))

    def _edges(
        self, surface: Labels, t: Floats, thin: Floats, used: int, half: tuple[float, float]
    ) -> tuple[Bools, Floats]:
        """Mark the strip's rays whose footprints may meet several surfaces, and give the nearest range of each."""
        margin, grid = self.margin, self.grid
        edge, near = footprints.mark(
            surface, t, thin, margin.side, used, margin.marked, margin.whole, footprints.levels(grid), grid.step,
            2.0 * np.pi / grid.columns, self.least, half, outermost(self.params.sub_rays),
        )  # fmt: skip
        return edge, near

    def _on_one(self, strip: int, column: Labels, row: Labels, shape: Labels, t: Floats, jitter: Shorts) -> Echoes:
        """Return the echoes of footprints on one surface."""
        columns = (strip * STRIP + column - self.margin.side).astype(np.int32)
        ray = raycast.directions(self.grid, row, columns, jitter)
        exact, cosine = raycast.meet(self.seen, self.surfaces, self.T_scanner_scene, shape, ray, t)
        met = np.isfinite(exact)
        columns, row, shape, ray, t, cosine = columns[met], row[met], shape[met], ray[met], exact[met], cosine[met]
        source = np.full(len(t), SURFACE, np.uint8)
        return Echoes(row, columns, shape, t, t, self.params.signal(cosine, t), cosine, ray, source)

    def _at_edges(self, strip: int, edge: Bools, near: Floats, jitter: Shorts) -> list[Echoes]:
        """Return the echoes of rays near an edge: of footprints on one surface all the same, and mixed ones."""
        column, row = (index.astype(np.int32) for index in np.nonzero(edge))
        number = np.full(edge.shape, -1, np.int32)
        number[column, row] = np.arange(len(column), dtype=np.int32)
        beam_ = beam(self.params.sub_rays)
        angle = self.scanner.beam_angle(near[column, row])
        subs, ranges = raycast.cast_around(
            self.seen, self.grid, strip, jitter, self.turned, self.limits, number, angle, beam_[0]
        )
        surface = np.where(subs >= 0, self.surfaces.surface[subs], -1)
        whole = (surface == surface[:, :1]).all(axis=1) & (subs[:, 0] >= 0)
        some = (subs >= 0).any(axis=1) & ~whole
        turned = jitter[column, row]
        return [
            self._on_one(strip, column[whole], row[whole], subs[whole, 0], ranges[whole, 0], turned[whole]),
            self._mixed(strip, column[some], row[some], subs[some], ranges[some], turned[some], angle[some], beam_),
        ]

    def _mixed(
        self,
        strip: int,
        column: Labels,
        row: Labels,
        subs: Labels,
        ranges: Floats,
        jitter: Shorts,
        angle: Floats,
        beam_: tuple[Floats, Floats],
    ) -> Echoes:
        """Return the echoes of footprints on several surfaces, or partly on none; ``subs``, ``ranges`` (n, k)."""
        offsets, share = beam_
        columns = (strip * STRIP + column - self.margin.side).astype(np.int32)
        t, cosine = np.full(ranges.shape, np.nan), np.zeros(ranges.shape)
        which, k = np.nonzero(subs >= 0)
        ray = raycast.directions(self.grid, row[which], columns[which], jitter[which] + angle[which, None] * offsets[k])
        t[which, k], cosine[which, k] = raycast.meet(
            self.seen, self.surfaces, self.T_scanner_scene, subs[which, k], ray, ranges[which, k]
        )
        hit = np.isfinite(t)
        ranges, t, cosine = np.where(hit, t, np.inf), np.where(hit, t, 1.0), np.where(hit, cosine, 0.0)
        energy = np.where(hit, share * self.params.signal(cosine, t), 0.0)
        if self.scanner.behaviour == "pulse":
            energy = strongest_echo(ranges, energy, self.scanner.separation_mm)
        back = np.where(energy > 0.0, share, 0.0).sum(axis=1) > LEAST_SHARE
        total = energy[back].sum(axis=1)
        most = np.argmax(energy[back], axis=1)[:, None]
        middle = np.where(hit[back, 0], t[back, 0], np.nan)
        return Echoes(
            row[back],
            columns[back],
            np.take_along_axis(subs[back], most, axis=1)[:, 0],
            middle,
            (energy[back] * t[back]).sum(axis=1) / total,
            total,
            np.take_along_axis(cosine[back], most, axis=1)[:, 0],
            raycast.directions(self.grid, row[back], columns[back], jitter[back]),
            np.full(len(total), MIXED, np.uint8),
        )

    def _returns(self, rng: np.random.Generator, found: Echoes) -> Returns:
        """Lose weak echoes, let some stray, add noise."""
        n = len(found.t)
        speckle = rng.gamma(SPECKLE_LOOKS, 1.0 / SPECKLE_LOOKS, n)
        stray, where = rng.random(n) < self.scanner.flying_share, rng.random(n)
        tangent = np.minimum(np.sqrt(1.0 - found.cosine**2) / np.maximum(found.cosine, 1e-3), TAN_MOST)
        sigma = self.scanner.noise(found.range, found.signal, tangent)
        low = self.scanner.min_range_mm
        measured = found.range + sigma * rng.standard_normal(n)
        measured = np.where(stray, low + where * (found.range - low), measured)
        surface = self.surfaces.surface_label[self.surfaces.surface[found.shape]]
        returns = Returns(
            self.grid.directions(found.row, found.column) * measured[:, None],
            found.signal.astype(np.float32),
            found.row,
            found.column,
            np.where(stray, -1, self.surfaces.part[found.shape]).astype(np.int32),
            np.where(stray, -1, surface).astype(np.int32),
            np.where(stray, OUTLIER, found.source).astype(np.uint8),
            (measured - found.t).astype(np.float32),
            found.cosine.astype(np.float32),
            sigma.astype(np.float32),
            found.ray * found.t[:, None] if self.keep_hits else np.empty((n, 0)),
        )
        kept = (found.signal * speckle >= self.scanner.threshold) & (measured > 0.0)
        columns = {field.name: getattr(returns, field.name)[kept] for field in dataclasses.fields(Returns)}
        return Returns(**columns)


def _joined(pieces: Sequence[Echoes]) -> Echoes:
    """Join echoes in the order of the grid: by columns, then rows."""
    if not pieces:
        none, no_label = np.empty(0), np.empty(0, np.int32)
        return Echoes(no_label, no_label, no_label, none, none, none, none, np.empty((0, 3)), np.empty(0, np.uint8))
    names = [field.name for field in dataclasses.fields(Echoes)]
    columns = {name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in names}
    order = np.lexsort((columns["row"], columns["column"]))
    return Echoes(**{name: column[order] for name, column in columns.items()})


def strongest_echo(ranges: Floats, energy: Floats, separation_mm: float) -> Floats:
    """Keep the energies (n, k) of the sub-rays of the strongest echo, 0 for others.

    Sub-rays of ranges (n, k), infinite for none, whose neighbours are within ``separation_mm`` are one echo.
    """
    order = np.argsort(ranges, axis=1, kind="stable")
    t, e = np.take_along_axis(ranges, order, axis=1), np.take_along_axis(energy, order, axis=1)
    with np.errstate(invalid="ignore"):  # two misses are infinitely far: their difference is no number
        echo = np.cumsum(np.diff(t, axis=1, prepend=t[:, :1]) > separation_mm, axis=1)
    sums = np.stack([(e * (echo == k)).sum(axis=1) for k in range(t.shape[1])], axis=1)
    strongest = np.where(echo == np.argmax(sums, axis=1)[:, None], e, 0.0)
    result = np.zeros_like(energy)
    np.put_along_axis(result, order, strongest, axis=1)
    return result
