"""The folder of ``processor compare``: compare.csv, compare.json, figures and a page."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from processor import large_arrays, pipeline
from processor.compare.compare import Comparison
from processor.geometry.m3c2 import FEWEST_FOR_LOD, Distances
from processor.geometry.normal_orientation import CONVENTION, Turned
from processor.language.messages import NO_NUMBER, Message, messages, text
from processor.model import Floats
from processor.report import templates, write_results
from processor.report.deviation import core_points_csv, face_maps
from processor.report.deviation import figures as deviation_figures
from processor.report.style import default_settings
from processor.results.fields_to_json import reason_json
from processor.store.json_values import json_ready
from processor.store.whole_output import whole_folder

TABLE, FIGURES, RECORD, PAGE = "compare.csv", ("map.png", "histogram.png"), "compare.json", "report.html"
LABEL = "compared minus reference along the normal"
MOST_DRAWN, SAMPLE = 1 << 20, 1 << 18  # core points; of a sample at least
OWN_NAMES = (TABLE, *FIGURES, RECORD, PAGE)
DEFINITION = (
    "distance = compared minus reference, means along the normal; lod95 = 1.96 (sqrt(std1^2/n1 + std2^2/n2) + "
    "registration error), population standard deviations; the cylinder reaches max depth to either side; "
    f"lod95 is nan below {FEWEST_FOR_LOD} points of either cloud, distance where either has none"
)


def check_output(out: Path, inputs: tuple[Path | None, ...]) -> None:
    """Raise UsageError for a folder that holds an input, or anything but an earlier comparison."""
    for path in inputs:
        if path is not None:
            write_results.check_output(out, path, RECORD, OWN_NAMES)


def as_json(result: Comparison) -> dict[str, Any]:
    """Build the object of compare.json; lengths in the clouds' unit."""
    request, scales, notes = result.request, result.scales, result.normals_notes
    names = ("reference", "compared", "core", "normals")
    files = {name: path for name in names if (path := getattr(request, name)) is not None}
    english = messages("en")
    written: dict[str, Any] = json_ready(
        {
            "format": "processor-comparison",
            "format_version": "1.0",
            "inputs": {
                name: {"file": path.name, "sha256": result.hashes[name], "points": result.points.get(name)}
                for name, path in files.items()
            },
            "unit": result.unit or "that of the files, which do not give it",
            "unit_note": result.unit_note and english.text(result.unit_note),
            "definition": DEFINITION,
            "normals": english.text(result.normals_from),
            "normals_note": english.sentences(notes) if notes else None,
            "notes": [reason_json(note) for note in result.notes],
            "normals_turned": None if result.turned is None else _turned(result.turned),
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
            "summary": _summary(result),
            "software": pipeline.software(),
        }
    )
    return written


def _summary(result: Comparison) -> dict[str, Any]:
    summary = result.summary
    share = summary.significant_share
    figures = {
        field.name: getattr(summary, field.name)
        for field in dataclasses.fields(summary)
        if field.name != "significant_share"
    }
    return figures | {"significant_share": share.share, "significant_share_ci95": [share.low, share.high]}


def _turned(turned: Turned) -> dict[str, Any]:
    return {
        "by_up": turned.up,
        "by_scanner": turned.scanner,
        "by_neighbours": turned.neighbours,
        "by_convention": turned.convention,
        "surfaces_by_convention": turned.surfaces,
        "convention": CONVENTION,
    }


def write(out: Path, result: Comparison, lang: str = "en") -> dict[str, Any]:
    """Write the folder in place of an earlier one, its page in ``lang``; returns the object of compare.json."""
    record = as_json(result)
    drawn = _drawn(result)
    with whole_folder(out, replaces=True) as making:
        table = core_points_csv.parts(result.origin, result.core, result.distances, result.normals)
        with (making / TABLE).open("w", encoding="utf-8") as file:
            file.writelines(table)
        record_text = json.dumps(record, indent=1, allow_nan=False, ensure_ascii=False)
        (making / RECORD).write_text(record_text + "\n", "utf-8")
        for name, (_, data) in zip(FIGURES, drawn, strict=True):
            (making / name).write_bytes(data)
        (making / PAGE).write_text(_page(result, record, drawn, lang), "utf-8")
    return record


def _drawn(result: Comparison) -> list[tuple[Message, bytes]]:
    """Draw the map and the histogram: captions and PNG."""
    core, normals, distances = _sample(result)
    with default_settings():
        band = face_maps.not_sure(distances, result.unit)
        drawn = [
            face_maps.face_maps(core + result.origin, normals, distances, band, (LABEL, result.unit)),
            deviation_figures.histogram(distances, LABEL, result.unit),
        ]
    if len(core) == len(result.core):
        return drawn
    said = text("of {count:,} of {all:,} core points, an even sample", count=len(core), all=len(result.core))
    return [(text("{parts:;}", parts=[caption, said]), data) for caption, data in drawn]


def _sample(result: Comparison) -> tuple[Floats, Floats, Distances]:
    """Return core points, normals and distances to draw: all, or of many every k-th, the least and the greatest."""
    core, normals, distances = result.core, result.normals, result.distances
    if len(core) <= MOST_DRAWN:
        return core, normals, distances
    rows = np.arange(0, len(core), len(core) // SAMPLE)
    known = [value for value in (result.summary.min, result.summary.max) if math.isfinite(value)]
    ends = [large_arrays.first_of(distances.distance, value) for value in known]
    rows = np.unique(np.concatenate([rows, np.array(ends, np.int64)]))
    core, normals = large_arrays.taken(core, rows), large_arrays.taken(normals, rows)
    return core, normals, Distances(**{name: large_arrays.taken(one, rows) for name, one in vars(distances).items()})


def lines(result: Comparison) -> list[Message]:
    """Summarise the outcome, for the terminal and the page."""
    summary = result.summary
    unit = f" {result.unit}" if result.unit else ""

    def number(value: float) -> str:
        return f"{value:.6g}{unit}" if math.isfinite(value) else NO_NUMBER

    with_lod = summary.core_points - summary.without_lod
    total = text("{count} core points, {known} with a level of detection", count=summary.core_points, known=with_lod)
    if not with_lod:
        return [total, *result.notes]
    share = summary.significant_share
    beyond = text(
        "beyond it: {count}, {share:.1f} % (95 %: {low:.1f}-{high:.1f})",
        count=summary.significant,
        share=100.0 * share.share,
        low=100.0 * share.low,
        high=100.0 * share.high,
    )
    distance = text(
        "distance: mean {mean}, median {median}, sd {sd}, "
        "least {least} (95 %: {least_low} to {least_high}), "
        "greatest {greatest} (95 %: {greatest_low} to {greatest_high})",
        mean=number(summary.mean),
        median=number(summary.median),
        sd=number(summary.sd),
        least=number(summary.min),
        least_low=number(summary.min_ci95[0]),
        least_high=number(summary.min_ci95[1]),
        greatest=number(summary.max),
        greatest_low=number(summary.max_ci95[0]),
        greatest_high=number(summary.max_ci95[1]),
    )
    lod95 = text("median level of detection {lod95}", lod95=number(summary.lod95_median))
    return [total, beyond, distance, lod95, *result.notes]


def _page(result: Comparison, record: dict[str, Any], drawn: list[tuple[Message, bytes]], lang: str) -> str:
    request = result.request
    return templates.render(
        "report",
        "comparison.html",
        lang,
        title=text("From {reference} to {compared}", reference=request.reference.name, compared=request.compared.name),
        lines=lines(result),
        figures=drawn,
        provenance=json.dumps(record, indent=2, ensure_ascii=False),
    )
