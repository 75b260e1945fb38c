"""The folder of ``processor compare``: compare.csv, compare.json, figures and a page."""

from __future__ import annotations

import base64
import dataclasses
import json
from pathlib import Path
from typing import Any

import matplotlib as mpl

from processor import pipeline
from processor.compare.compare import Comparison, turned_note, unit_note
from processor.geometry.m3c2 import FEWEST_FOR_LOD
from processor.geometry.normal_orientation import CONVENTION, Turned
from processor.language import language
from processor.language.messages import Message
from processor.report import results_folder
from processor.report.deviation import csv
from processor.report.deviation import figures as deviation_figures

TABLE, FIGURES, RECORD, PAGE = "compare.csv", ("map.png", "histogram.png"), "compare.json", "report.html"
OWN_NAMES = (TABLE, *FIGURES, RECORD, PAGE)
DEFINITION = (
    "distance = compared minus reference, means along the normal; lod95 = 1.96 (sqrt(std1^2/n1 + std2^2/n2) + "
    "registration error), population standard deviations; the cylinder reaches max depth to either side; "
    f"lod95 is nan below {FEWEST_FOR_LOD} points of either cloud, distance where either has none"
)


def check_output(out: Path, found: tuple[Path | None, ...]) -> None:
    """Refuse a folder that holds anything but an earlier comparison, or one of the inputs: UsageError."""
    for path in found:
        if path is not None:
            results_folder.check_output(out, path, RECORD, OWN_NAMES)


def as_json(found: Comparison) -> dict[str, Any]:
    """Build the object of compare.json; lengths in the clouds' unit."""
    request, scales, summary = found.request, found.scales, found.summary
    files = {"reference": request.reference, "compared": request.compared, "core": request.core}
    files["normals"] = request.normals
    share = summary.significant_share
    figures = {
        field.name: getattr(summary, field.name)
        for field in dataclasses.fields(summary)
        if field.name not in ("significant_share", "min_lod95", "max_lod95")
    }
    for end, half in (("min", summary.min_lod95), ("max", summary.max_lod95)):
        figures[f"{end}_ci95"] = [figures[end] - half, figures[end] + half]
    written: dict[str, Any] = json.loads(
        pipeline.as_json(
            {
                "format": "processor-comparison",
                "format_version": "1.0",
                "inputs": {
                    name: {"file": path.name, "sha256": found.hashes[name], "points": found.points.get(name)}
                    for name, path in files.items()
                    if path is not None
                },
                "unit": found.unit or "that of the files, which do not say it",
                "unit_note": unit_note(found.units, {name: path.name for name, path in files.items() if path}) or None,
                "definition": DEFINITION,
                "normals": found.normals_from,
                "normals_note": None if found.turned is None else turned_note(found.turned) or None,
                "normals_turned": None if found.turned is None else _turned(found.turned),
                "parameters": {
                    "normal_diameter": None if request.normals else scales.normal_diameter_mm,
                    "projection_diameter": scales.projection_diameter_mm,
                    "max_depth": scales.max_depth_mm,
                    "registration_error": request.registration_error,
                    "given": [
                        name
                        for name in ("normal_diameter", "projection_diameter", "max_depth", "registration_error")
                        if getattr(request, name) and not (name == "normal_diameter" and request.normals)
                    ],
                },
                "spacing": {"reference": scales.reference_spacing_mm, "compared": scales.compared_spacing_mm},
                "summary": {
                    **figures,
                    "significant_share": share.share,
                    "significant_share_ci95": [share.low, share.high],
                },
                "software": pipeline.software(),
            }
        )
    )
    return written


def _turned(turned: Turned) -> dict[str, Any]:
    return {
        "by_up": turned.up,
        "by_scanner": turned.scanner,
        "by_neighbours": turned.neighbours,
        "by_convention": turned.convention,
        "surfaces_by_convention": turned.surfaces,
        "convention": CONVENTION,
    }


def write(out: Path, found: Comparison, lang: str = "en") -> dict[str, Any]:
    """Write the folder, in place of an earlier one, its page in ``lang``; returns what compare.json holds."""
    record = as_json(found)
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams["text.parse_math"] = False
        drawn = [
            deviation_figures.deviation_map(found.core + found.origin, found.normals, found.distances, found.unit),
            deviation_figures.histogram(found.distances, found.unit),
        ]
    with results_folder.whole(out) as making:
        text = csv.csv_text(found.origin, found.core, found.distances, found.normals)
        results_folder.write_text(making / TABLE, text)
        record_text = json.dumps(record, indent=1, allow_nan=False, ensure_ascii=False)
        results_folder.write_text(making / RECORD, record_text + "\n")
        for name, (_, data) in zip(FIGURES, drawn, strict=True):
            results_folder.write_bytes(making / name, data)
        results_folder.write_text(making / PAGE, _page(record, drawn, lang))
    return record


def lines(record: dict[str, Any]) -> list[str]:
    """Say the outcome in words, for the terminal and the page."""
    summary = record["summary"]
    unit = f" {record['unit']}" if len(record["unit"]) < 8 else ""

    def number(key: str) -> str:
        return "–" if summary[key] is None else f"{summary[key]:.6g}{unit}"

    def end(key: str) -> str:
        low, high = summary.get(f"{key}_ci95") or (None, None)
        return number(key) if low is None else f"{summary[key]:.6g} ± {0.5 * (high - low):.3g}{unit}"

    known = summary["core_points"] - summary["without_lod"]
    found = [f"{summary['core_points']} core points, {known} with a level of detection"]
    if known:
        low, high = (f"{100.0 * one:.1f}" for one in summary["significant_share_ci95"])
        found += [
            f"beyond it: {summary['significant']}, {100.0 * summary['significant_share']:.1f} % (95 %: {low}-{high})",
            f"distance: mean {number('mean')}, median {number('median')}, sd {number('sd')}, "
            f"from {end('min')} to {end('max')}",
            f"median level of detection {number('lod95_median')}",
        ]
    return found + [note for note in (record.get("unit_note"), record.get("normals_note")) if note]


def _page(record: dict[str, Any], drawn: list[tuple[Message, bytes]], lang: str) -> str:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("processor", "report"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["say"] = language(lang).say
    text: str = environment.get_template("comparison.html").render(
        lang=lang,
        title=f"From {record['inputs']['reference']['file']} to {record['inputs']['compared']['file']}",
        lines=lines(record),
        figures=[(caption, base64.b64encode(data).decode("ascii")) for caption, data in drawn],
        provenance=json.dumps(record, indent=2, ensure_ascii=False),
    )
    return text
