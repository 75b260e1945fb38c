"""The field check of a scanner: terms with their intervals, the verdicts against the class, and what a project takes.

A test of a standard deviation rejects the class where its chi-square exceeds the 95 % point, as in ISO 17123-9; that of
a bias where it is beyond 1.96 of the class's and the check's standard deviations together. The whole is rejected by all
sightings together, or where a term is beyond the 95 % point shared among the terms (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy.special import chdtrc, ndtr

from processor.adjustment import scanner_class_errors
from processor.field_check import sightings
from processor.field_check.sightings import Seen
from processor.field_check.variance_components import Adjusted, Estimate, Sightings, adjust
from processor.model import NORMAL_95, Floats, Instrument, Reason, Scene, Verdict, instruments, reason
from processor.robust_statistics import student_factor
from processor.writers import toml

LEAST_DOF = 7  # of all sightings: chi-square then sees twice the class in 80 % of cases
RISK = 0.05  # of rejecting a scanner of its class
POWER = 0.8  # customary: a test that sees twice the class less often than this decides nothing
# Degrees of freedom that the class counts for beside the check: an uncertainty by a factor of two amounts to four.
OF_CLASS = 4.0
SIGNAL_RANGE_MM = 10_000.0  # at which the signal of a white matt surface is 1
WHITE, BLACK = 0.9, 0.035  # reflectance of printed fields; black returned 21 to 33 times less than white
LAW_SD = 0.2  # of the logarithm of a class's noise: instruments of a class differ by some 20 %
REPEAT_SHARE = 0.2  # of the class's error of a view: repeats at one station share most of it
LEAST_MM, LEAST_URAD = 0.01, 0.1  # in a scanner.toml
UNITS = {"scale": "ppm", "angle_horizontal": "urad", "angle_vertical": "urad"}  # others: mm
PER_UNIT = {"ppm": 1e6, "urad": 1e6, "mm": 1.0}  # millionths, and mm as inside


@dataclass(frozen=True, kw_only=True)
class Term:
    """A number of the instrument: its value, half its 95 % interval, what the class has, and the verdict."""

    name: str
    value: float
    ci95: float
    unit: str
    of_class: float
    dof: float
    chance: float
    verdict: Verdict


@dataclass(frozen=True, kw_only=True)
class FieldCheck:
    """The outcome: terms, distances between targets from pairs of stations, and the instrument for projects."""

    name: str
    seen: Seen
    adjusted: Adjusted
    terms: tuple[Term, ...]
    tested: Instrument
    instrument: Instrument
    distances: tuple[dict[str, Any], ...]
    chance: float
    verdict: Verdict
    reasons: tuple[Reason, ...]


def check(scene: Scene) -> FieldCheck:
    """Check the scanner of a folder of scans of targets. Raises InputError where these make no field check."""
    return check_of(scene.name, sightings.seen_in(scene), scene)


def check_of(name: str, seen: Seen, scene: Scene) -> FieldCheck:
    """Check a scanner by what a scene shows of it."""
    tested = scene.instruments[0] if scene.instruments else instruments.of_class()
    known = scanner_class_errors.errors_of(tested)
    of_class = {
        "range_view": known.view_mm, "range_repeat": REPEAT_SHARE * known.view_mm,
        "angle_horizontal": known.direction_rad, "angle_vertical": known.direction_rad,
    }  # fmt: skip
    adjusted = adjust(seen.sightings, seen.places, seen.poses, of_class)
    biases = {"range_offset": known.offset_mm, "scale": known.scale}
    terms = [_term(name, one, {**of_class, **biases}[name]) for name, one in adjusted.estimates.items()]
    terms += _noise_terms(seen, tested.scanner_class)
    chance = float(chdtrc(adjusted.dof, adjusted.chi2)) if adjusted.dof > 0 else 1.0
    failed = chance < RISK or any(term.chance < RISK / len(terms) for term in terms)
    decided = Verdict.FAIL if failed else Verdict.PASS if adjusted.dof >= LEAST_DOF else Verdict.INDETERMINATE
    made, remarks = _instrument(terms, tested, known, scene, seen)
    return FieldCheck(
        name=name, seen=seen, adjusted=adjusted, terms=tuple(terms), tested=tested, instrument=made,
        distances=tuple(_distances(seen, known)), chance=chance, verdict=decided,
        reasons=(*seen.reasons, *remarks),
    )  # fmt: skip


def _term(name: str, one: Estimate, limit: float) -> Term:
    unit = UNITS.get(name, "mm")
    chance, power = one.chance, one.power
    if np.isnan(chance):  # of a bias
        sd = one.ci95 / (NORMAL_95 * float(student_factor(one.dof)))
        chance = 2.0 * float(ndtr(-abs(one.value) / np.hypot(limit, sd)))
        power = 1.0 if sd < limit else 0.0
    verdict = Verdict.FAIL if chance < RISK else Verdict.PASS if power >= POWER else Verdict.INDETERMINATE
    return Term(
        name=name, value=PER_UNIT[unit] * one.value, ci95=PER_UNIT[unit] * one.ci95, unit=unit,
        of_class=PER_UNIT[unit] * limit, dof=one.dof, chance=chance, verdict=verdict,
    )  # fmt: skip


def _noise_terms(seen: Seen, scanner_class: str) -> list[Term]:
    """Return the noise of ranges on white and black, and black less white, at the ranges of the targets.

    The class's is that of its law at the same ranges and angles. Intervals are by the scatter over the sightings.
    """
    numbers, R = instruments.classes()[scanner_class], seen.sightings.ranges
    near = np.minimum(R / numbers["noise_near_mm"], 1.0) if numbers["noise_near_mm"] else np.ones(len(R))
    terms = []
    for field, reflectance in (("white", WHITE), ("black", BLACK)):
        noise: Floats = getattr(seen.noise, field)
        on = np.isfinite(noise) & (noise > 0.0)
        if on.sum() < 2:
            continue
        signal = reflectance * np.nan_to_num(seen.noise.cosine, nan=1.0) * (SIGNAL_RANGE_MM / R * near) ** 2
        law = np.sqrt(
            numbers["noise_mm"] ** 2
            + (1e-6 * numbers["noise_ppm"] * R) ** 2
            + (numbers["noise_signal_mm"] * signal ** numbers["signal_power"]) ** 2
        )[on]
        ratio = np.log(noise[on] / law)
        value, limit, dof = float(np.sqrt(np.mean(noise[on] ** 2))), float(np.sqrt(np.mean(law**2))), on.sum() - 1.0
        sd = float(ratio.std(ddof=1) / np.sqrt(on.sum()))
        chance = float(ndtr(-float(ratio.mean()) / np.hypot(sd, LAW_SD)))
        terms.append(
            Term(
                name=f"range_noise_{field}", value=value,
                ci95=value * NORMAL_95 * float(student_factor(dof)) * sd, unit="mm",
                of_class=limit, dof=dof, chance=chance, verdict=Verdict.FAIL if chance < RISK else Verdict.PASS,
            )
        )  # fmt: skip
    return terms


def _distances(seen: Seen, known: scanner_class_errors.ScannerErrors) -> list[dict[str, Any]]:
    """Return the distances of all pairs of targets, from the mean of each station's scans, and their differences.

    ``sd`` is that of a difference of two stations by the class.
    """
    s = seen.sightings
    found: list[dict[str, Any]] = []
    for a, b in combinations(range(len(seen.targets)), 2):
        of_stations: list[tuple[float, float]] = []
        for station in np.unique(s.station).tolist():
            lengths, variances = [], []
            for scan in np.unique(s.scan[s.station == station]).tolist():
                rows = [np.flatnonzero((s.scan == scan) & (s.target == t)) for t in (a, b)]
                if min(map(len, rows)):
                    i, j = int(rows[0][0]), int(rows[1][0])
                    lengths.append(float(np.linalg.norm(s.places[i] - s.places[j])))
                    variances.append(_variance_of_length(s, i, j, known))
            if lengths:
                of_stations.append((float(np.mean(lengths)), float(np.mean(variances))))
        for (first, u), (second, v) in combinations(of_stations, 2):
            found.append(
                {"a": seen.targets[a], "b": seen.targets[b], "first": first, "second": second,
                 "difference": second - first, "sd": float(np.sqrt(u + v))}
            )  # fmt: skip
    return found


def _variance_of_length(s: Sightings, i: int, j: int, known: scanner_class_errors.ScannerErrors) -> float:
    """Return the variance, mm^2, of the distance of two sightings of a scan by fit and class."""
    along = (s.places[i] - s.places[j]) / np.linalg.norm(s.places[i] - s.places[j])
    total = 0.0
    for k in (i, j):
        of_axes = s.axes[k] @ along
        sd = np.array([known.view_mm, *([known.direction_rad * s.ranges[k]] * 2)])
        total += float(along @ s.covariance[k] @ along) + float(((of_axes * sd) ** 2).sum())
    return total


def _instrument(
    terms: list[Term], tested: Instrument, known: scanner_class_errors.ScannerErrors, scene: Scene, seen: Seen
) -> tuple[Instrument, list[Reason]]:
    """Return the instrument as a project takes it: the check together with the class, which counts for OF_CLASS.

    Where a term rejects the class, it counts for nothing.
    """
    by_name = {term.name: term for term in terms}
    found = dict(tested.known)
    view = by_name["range_view"]
    repeat = by_name.get("range_repeat")
    square = view.value**2 + (repeat.value**2 if repeat is not None else 0.0)
    found["view_mm"] = _pooled(np.sqrt(square), view, known.view_mm, LEAST_MM)
    for key, name in (("horizontal_urad", "angle_horizontal"), ("vertical_urad", "angle_vertical")):
        found[key] = _pooled(by_name[name].value, by_name[name], 1e6 * known.direction_rad, LEAST_URAD)
    for key, name, limit in (("zero_mm", "range_offset", known.offset_mm), ("scale_ppm", "scale", 1e6 * known.scale)):
        if (term := by_name.get(name)) is not None:
            sd = term.ci95 / NORMAL_95
            share = 1.0 if term.verdict is Verdict.FAIL else limit**2 / (limit**2 + sd**2)
            found[key] = instruments.Known(share * term.value, float(np.sqrt(share)) * sd)
    block = (
        {} if scene.title_block is None else dict(zip(scene.title_block.keys, scene.title_block.values, strict=True))
    )
    day = block.get("scanned", "") or (scene.scanned[-1] if scene.scanned else "")
    name, serial = block.get("scanner", ""), block.get("serial", "")
    source = (
        f"field check: {len(seen.scans)} scans from {len(np.unique(seen.sightings.station))} stations, "
        f"{len(seen.targets)} targets"
    )
    missing = [key for key, value in (("scanner", name), ("serial", serial), ("scanned", day)) if not value]
    remarks = [reason("field-check.not-named", keys=tuple(missing))] if missing else []
    made = instruments.made(
        found, name=name or tested.scanner_class, scanner_class=tested.scanner_class, serial=serial,
        checked="" if missing else day, source=source,
    )  # fmt: skip
    return made, remarks


def _pooled(value: float, term: Term, limit: float, least: float) -> instruments.Known:
    """Return a standard deviation by check and class, and its own by their degrees of freedom."""
    prior = 0.0 if term.verdict is Verdict.FAIL else OF_CLASS
    dof = max(term.dof, 1.0) + prior
    pooled = max(float(np.sqrt((max(term.dof, 1.0) * value**2 + prior * limit**2) / dof)), least)
    return instruments.Known(pooled, pooled / float(np.sqrt(2.0 * dof)))


def scanner_toml(made: Instrument) -> str:
    """Return the file that a project names as its scanner."""
    about = {
        "scanner_class": made.scanner_class, "about": made.name, "serial": made.serial, "checked": made.checked,
        "source": made.source,
    }  # fmt: skip
    terms: Mapping[str, Any] = {
        name: {"value": float(f"{one.value:.4g}"), "sd": float(f"{one.sd:.4g}")} if one.sd else one.value
        for name, one in made.known.items()
    }
    content = {key: value for key, value in about.items() if value} | dict(terms)
    return "".join(f"{key} = {toml.as_toml(value)}\n" for key, value in content.items())
