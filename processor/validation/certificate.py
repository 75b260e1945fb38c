"""The certificate of accuracy: what was measured, on which scenes, how well, and what that does not show.

It has the form of ISO 15530-3, where a calibrated workpiece is measured repeatedly under the conditions of use. Here
the scene made by the generator is the workpiece and its truth the calibration, so u_cal = 0 except for rounding. For
each quantity u_p is the standard deviation of all errors, b their mean, and u_b the standard uncertainty of b from the
scatter between scenes. As results are not corrected by b, U = k sqrt(u_cal^2 + u_p^2 + u_b^2) + |b| with k = 2. With
fewer than three scenes u_b is not known, and U uses u_p / sqrt(n) in its place, n the number of errors. The standard's
u_w, for differences of workpieces in material and make, is not included: recipes "as built" vary the make, and are
separate rows.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from processor.language.messages import text
from processor.model import Statistic
from processor.plain_text import tomllib
from processor.report import templates
from processor.robust_statistics import finite_median
from processor.store.json_values import json_ready
from processor.validation.cells import Case, Origin
from processor.validation.coverage import Coverage
from processor.validation.history import Figures, Row, by_quantity, of_items
from processor.validation.matrix import Matrix
from processor.validation.software_identity import Software

FORMAT, FORMAT_VERSION = "processor-certificate", "1.0"
COVERAGE_FACTOR = 2.0  # for 95 % (GUM, G.6.6)
LEAST_SCENES = 3  # for a scatter between scenes
METHOD = text(
    "After ISO 15530-3 (uncertainty from repeated measurement of a calibrated workpiece): the simulated structure is "
    "the workpiece, its truth the calibration (u_cal = 0). u_p: standard deviation of all errors. b: their mean, u_b "
    "its standard uncertainty from the scatter between scenes. Results are not corrected by b, so U = k sqrt(u_cal^2 "
    "+ u_p^2 + u_b^2) + |b| with k = 2. With fewer than three scenes u_b is not known; U then uses u_p / sqrt(n), n "
    "the number of errors, in its place. u_w (material and make of workpieces) is not included. Coverage: share of "
    "errors within the 95 % intervals of the results. Efficiency: 1 / rms(error / least possible standard deviation); "
    "no unbiased estimator exceeds 1 (Cramer-Rao). Errors are those of balls without a flag, and of all key points of "
    "bridges."
)
NOT_SHOWN = (
    text(
        "The scans are simulated, without an instrument. The scanner classes are rounded from data sheets, not "
        "calibrated against instruments: this is no calibration certificate and is not traceable."
    ),
    text(
        "Not simulated and so not covered: reflections between surfaces, movement during a scan, refraction; wet, "
        "oily or painted surfaces except for their brightness."
    ),
    text(
        "Structures, damage and surroundings are those of the recipes named. A row holds for its recipe, noise and "
        "density, and not for values between or beyond them."
    ),
    text(
        "Truth and scans of a scene come from one generator: effects that its models of steel and scanner lack are in "
        "no row of it. designgen shares no geometry with the processor. Foreign generators share no code with either, "
        "but come with the same software; their figures and those of designgen are never pooled."
    ),
    text(
        "u_p pools errors within scenes, which may have a common part; where scenes differ by more than the errors "
        "within them, u_b contains it, from three scenes on."
    ),
)


def make(
    night: str,
    rows: Sequence[Row],
    nights: Sequence[str],
    software: Software,
    matrix: Matrix,
    coverage: Sequence[Coverage] = (),
) -> dict[str, Any]:
    """Return what certificate.json holds, from the figures of ``nights``, all made by the present software.

    A line is of one quantity of one method on one kind of scene; what is not known is NaN, lengths are in its unit.
    """
    cases = list({entry.case.key: entry.case for entry in matrix.entries}.values())
    of_case = {case.key: case for case in cases}
    lines: list[dict[str, Any]] = []
    for (_, step, method, quantity), scenes in by_quantity(rows, nights).items():
        for key, case in of_case.items():
            own = [figures for (of, _), figures in scenes.items() if of == key]
            if any(Statistic.BIAS in figures for figures in own):
                lines.append(_line(case, step, method, quantity, own))
    order = {case.key: i for i, case in enumerate(cases)}
    by_title = {(case.recipe, case.settings): order[case.key] for case in reversed(cases)}
    origins = list(Origin)
    lines.sort(
        key=lambda line: (
            origins.index(line["origin"]),
            line["step"],
            by_title[line["recipe"], line["settings"]],
            line["method"],
            line["quantity"],
        )
    )
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "k": COVERAGE_FACTOR,
        "night": night,
        "nights": list(nights),
        "commit": software.commit,
        "versions": software.versions,
        "matrix": matrix.name,
        "matrix_sha256": matrix.sha256,
        "recipes": {case.recipe: case.recipe_sha256 for case in cases},  # hashes of their texts
        "lines": [line for line in lines if line["scenes"]],
        "coverage": [asdict(one) for one in coverage],
        "method": str(METHOD),
        "not_shown": list(map(str, NOT_SHOWN)),
    }


def _line(case: Case, step: str, method: str, quantity: str, scenes: Sequence[Figures]) -> dict[str, Any]:
    def of(statistic: Statistic) -> list[float]:
        return [scene[statistic].value if statistic in scene else math.nan for scene in scenes]

    numbers, biases, deviations = of(Statistic.NUMBER), of(Statistic.BIAS), of(Statistic.SD)
    used = [
        (n, b, s if n > 1 else 0.0)
        for n, b, s in zip(numbers, biases, deviations, strict=True)
        if n > 0 and math.isfinite(b) and (n == 1 or math.isfinite(s))
    ]
    total = sum(n for n, _, _ in used)
    bias = sum(n * b for n, b, _ in used) / total if total else math.nan
    spread = sum((n - 1.0) * s**2 + n * (b - bias) ** 2 for n, b, s in used)
    u_p = math.sqrt(spread / (total - 1.0)) if total > 1 else math.nan
    u_b = math.nan
    if len(used) >= LEAST_SCENES:
        count = len(used)
        # The scatter of the scenes, weighted as in the bias.
        u_b = math.sqrt(sum((n * (b - bias)) ** 2 for n, b, _ in used) * count / (count - 1.0)) / total
    unit = next(scene[Statistic.BIAS].unit for scene in scenes if Statistic.BIAS in scene)
    known_u_b = u_b if math.isfinite(u_b) else (u_p / math.sqrt(total) if total > 1 else math.nan)
    scanner, noise, density = conditions(case)
    return {
        "origin": case.origin,
        "recipe": case.recipe,
        "settings": case.settings,
        "scanner": scanner,
        "noise": noise,
        "density": density,
        "step": step,
        "method": method,
        "quantity": quantity,
        "unit": unit,
        "scenes": len(used),
        "number": int(total),
        "bias": bias,
        "u_b": u_b,
        "u_p": u_p,
        "U95": COVERAGE_FACTOR * math.hypot(u_p, known_u_b) + abs(bias),
        "error_95": finite_median(of(Statistic.ERROR_95)),  # median over the scenes
        "coverage": of_items(scenes, Statistic.COVERAGE)[0],  # %
        "efficiency": of_items(scenes, Statistic.EFFICIENCY)[0],
    }


def conditions(case: Case) -> tuple[str, str, str]:
    """Return the names of scanner, noise and density of a case, from its recipe and settings.

    Those of a foreign generator are in its settings, or its own defaults.
    """
    if case.origin is Origin.FOREIGN:
        given = dict(setting.split("=", 1) for setting in case.settings)
        return "default", given.get("noise", "default"), given.get("spacing", given.get("step_mrad", "default"))
    recipe: dict[str, Any] = tomllib.loads(case.recipe_text)
    for setting in case.settings:
        key, _, text = setting.partition("=")
        *sections, last = key.split(".")
        table = recipe
        for section in sections:
            table = table.setdefault(section, {})
        table[last] = tomllib.loads(f"value = {text}")["value"]
    scan, scanner = recipe.get("scan", {}), recipe.get("scanner", {})
    if scan.get("mode") == "rays":
        noise = ", ".join(f"{key} {value}" for key, value in scanner.items() if "noise" in key)
        return str(scan.get("scanner", "default")), noise or "the preset's", f"{scan.get('step_mrad', '?')} mrad"
    return "none (sampled)", f"{scan.get('sigma_mm', '?')} mm", f"{scan.get('spacing_mm', '?')} mm"


# --- as files -------------------------------------------------------------------------------------------------------


def as_json(certificate: Mapping[str, Any]) -> str:
    """Return the certificate as JSON; what is not known is null."""
    return json.dumps(json_ready(certificate), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def as_html(certificate: Mapping[str, Any], lang: str = "en") -> str:
    """Return the certificate as a page in the language ``lang``."""
    tables = {
        origin: [[one for one in certificate[name] if one["origin"] == origin] for name in ("lines", "coverage")]
        for origin in Origin
    }
    page = templates.render(
        "validation", "certificate.html", lang, certificate=certificate, tables=tables, method=METHOD,
        not_shown=NOT_SHOWN,
    )  # fmt: skip
    return page + "\n"
