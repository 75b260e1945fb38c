"""The folder of ``processor field-check``: scanner.toml, results.json, sightings.csv and a page to sign."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from processor import pipeline
from processor.field_check.check import FieldCheck, Term, scanner_toml
from processor.language.messages import Message, label, text
from processor.model import Verdict
from processor.report import templates, title_block, write_results
from processor.report.headline import BANNER
from processor.report.page import TONES
from processor.results.fields_to_json import reason_json
from processor.results.file_names import REPORT_PAGE, RESULTS_JSON
from processor.results.to_json import text_of
from processor.store.json_values import json_ready
from processor.store.whole_output import whole_folder

SCANNER, TABLE, FORMAT = "scanner.toml", "sightings.csv", "processor-field-check"
TERMS = {
    "range_view": text("range to a target, from place to place"),
    "range_repeat": text("range to a target, in repeats"),
    "range_offset": text("offset of ranges (zero point)"),
    "scale": text("scale of ranges"),
    "range_noise_white": text("noise of ranges on white"),
    "range_noise_black": text("noise of ranges on black"),
    "angle_horizontal": text("horizontal direction"),
    "angle_vertical": text("vertical direction"),
}


def check_output(out: Path, source: Path) -> None:
    """Raise UsageError for a folder that holds the input, or anything but an earlier check."""
    write_results.check_output(out, source, RESULTS_JSON, (SCANNER, TABLE, RESULTS_JSON, REPORT_PAGE))


def as_json(found: FieldCheck) -> dict[str, Any]:
    """Build the object of results.json: mm, and urad or ppm where a term's unit says so."""
    s = found.seen.sightings
    noise = found.seen.noise
    rows = zip(
        s.scan.tolist(), s.station.tolist(), s.target.tolist(), s.ranges.tolist(), found.adjusted.residuals.tolist(),
        noise.white.tolist(), noise.black.tolist(), noise.bias.tolist(), strict=True,
    )  # fmt: skip
    written: dict[str, Any] = json_ready(
        {
            "format": FORMAT,
            "format_version": "1.0",
            "input": found.name,
            "software": pipeline.software(),
            "class": found.tested.name,
            "verdict": found.verdict,
            "chi2": found.adjusted.chi2,
            "dof": found.adjusted.dof,
            "chance": found.chance,
            "terms": [_term(one) for one in found.terms],
            "distances": found.distances,
            "sightings": [
                {"scan": found.seen.scans[scan], "station": station + 1, "target": found.seen.targets[target],
                 "range": r, "along": d[0], "horizontal": d[1], "vertical": d[2], "noise_white": white,
                 "noise_black": black, "black_less_white": bias}
                for scan, station, target, r, d, white, black, bias in rows
            ],
            "reasons": [reason_json(one) for one in found.reasons],
        }
    )  # fmt: skip
    return written


def _term(one: Term) -> dict[str, Any]:
    return {
        "name": one.name, "value": one.value, "ci95": one.ci95, "unit": one.unit, "class": one.of_class,
        "dof": one.dof, "chance": one.chance, "verdict": one.verdict,
    }  # fmt: skip


def write(out: Path, found: FieldCheck, lang: str = "en") -> dict[str, Any]:
    """Write the folder in place of an earlier one, its page in ``lang``; returns the object of results.json."""
    record = as_json(found)
    header = list(record["sightings"][0])
    lines = [
        ",".join(header),
        *(",".join("" if v is None else str(v) for v in row.values()) for row in record["sightings"]),
    ]
    with whole_folder(out, replaces=True) as making:
        (making / SCANNER).write_text(scanner_toml(found.instrument), "utf-8")
        (making / TABLE).write_text("\n".join(lines) + "\n", "utf-8")
        (making / RESULTS_JSON).write_text(text_of(record), "utf-8")
        (making / REPORT_PAGE).write_text(_page(found, record, lang), "utf-8")
    return record


def lines(found: FieldCheck) -> list[Message]:
    """Summarise the outcome, for the terminal and the page."""
    first = text(
        "{verdict}: {scans} scans of {targets} targets from {stations} places, against class {name}: "
        "chi-square {chi2:.1f} of {dof} degrees of freedom",
        verdict=BANNER[found.verdict],
        scans=len(found.seen.scans),
        targets=len(found.seen.targets),
        stations=int(found.seen.sightings.station.max()) + 1,
        name=label(found.tested.name),
        chi2=found.adjusted.chi2,
        dof=found.adjusted.dof,
    )
    return [first, *(_line(one) for one in found.terms), *found.reasons]


def _line(one: Term) -> Message:
    return text(
        "{term}: {value:.3g} ± {ci95:.2g} {unit}, class {limit:.3g}: {verdict}",
        term=TERMS[one.name], value=one.value, ci95=one.ci95, unit=one.unit, limit=one.of_class, verdict=one.verdict,
    )  # fmt: skip


def _page(found: FieldCheck, record: dict[str, Any], lang: str) -> str:
    return templates.render(
        "report",
        "field_check.html",
        lang,
        title=found.instrument.name,
        found=found,
        banner=BANNER[found.verdict],
        tone=TONES[found.verdict],
        lines=[lines(found)[0], *found.reasons],
        terms=[(TERMS[one.name], one) for one in found.terms],
        rows=record["sightings"],
        signatures=title_block.SIGNATURES,
        scanner=scanner_toml(found.instrument),
        failed=Verdict.FAIL,
    )
