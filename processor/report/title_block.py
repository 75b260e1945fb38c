"""The title block of the report: what the project writes on it, what was read, and where it is signed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from processor.language.messages import Message, Text, label, text
from processor.model import Instrument, Scene, instruments
from processor.report.templates import data_uri

LABELS: Mapping[str, Message] = {
    "project": text("Project"),
    "drawing": text("Drawing"),
    "order": text("Order"),
    "scanner": text("Scanner"),
    "serial": text("Serial number"),
    "scanned": text("Scanned on"),
}
COMPANY, OPERATOR, APPROVED = "company", "operator", "approved"
SIGNATURES = ((text("Inspected"), OPERATOR), (text("Approved"), APPROVED))
DIGEST = 16  # hexadecimal digits of the input's hash that are shown; all are in the provenance


def of(scene: Scene, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the page shows: company, logo as a data address, rows of names and texts, and who signs."""
    given = entries(scene)
    elsewhere = (COMPANY, *(key for _, key in SIGNATURES))
    rows: list[tuple[Message, Message | str]] = [
        (LABELS.get(key) or label(key.replace("_", " ")), value) for key, value in given.items() if key not in elsewhere
    ]
    if math.isfinite(scene.temperature_C):
        rows.append((text("Steel while it was scanned"), f"{scene.temperature_C:g} °C"))
    if scene.tolerance is not None and scene.tolerance.standard:
        rows.append((text("Standard"), scene.tolerance.standard))
    rows += [(text("Instrument"), instrument(scene)), *facts(provenance)]
    return {
        "company": given.get(COMPANY, ""),
        "logo": _address(scene),
        "rows": rows,
        "signatures": [(who, given.get(key, "")) for who, key in SIGNATURES],
    }


def entries(scene: Scene) -> dict[str, str]:
    """Return the texts of the project's title block by their keys."""
    block = scene.title_block
    return {} if block is None else dict(zip(block.keys, block.values, strict=True))


def instrument(scene: Scene) -> Text:
    """Say whose errors the intervals hold, and by what check these are known."""
    each = [_instrument(one) for one in scene.instruments]
    return text("{each:;}", each=each) if each else text("{name} (class, assumed)", name=label(instruments.ASSUMED))


def _instrument(one: Instrument) -> Text:
    if one.checked:
        found = text("{name} {serial}, checked {day}", name=one.name, serial=one.serial, day=one.checked)
    elif one.name == one.scanner_class:
        found = text("{name} (class)", name=label(one.name))
    else:
        found = text("{name} {serial}, not checked", name=one.name, serial=one.serial)
    return text("{found} ({scans})", found=found, scans=list(one.scans)) if one.scans else found


def facts(provenance: Mapping[str, Any]) -> list[tuple[Message, str]]:
    """Return what identifies the input and the software."""
    return [
        (text("Input"), f"{provenance['input']}, SHA-256 {str(provenance['input_sha256'])[:DIGEST]}"),
        (text("Software"), f"processor {provenance['software'].get('processor', '')}"),
    ]


def head(scene: Scene) -> str:
    """Return the line that stands on top of every printed page."""
    given = entries(scene)
    return " · ".join(filter(None, [*(given.get(key, "") for key in (COMPANY, "project", "drawing")), scene.name]))


def foot(provenance: Mapping[str, Any]) -> str:
    """Return the line that stands below every printed page: what identifies input and software."""
    return ", ".join(value for _, value in facts(provenance))


def css_string(written: str) -> str:
    """Quote a text for a style sheet; no character of it can end the string or the element."""
    return '"' + "".join(c if c.isascii() and c.isalnum() else f"\\{ord(c):06x}" for c in written) + '"'


def _address(scene: Scene) -> str:
    block = scene.title_block
    return "" if block is None or not len(block.logo) else data_uri(block.logo.tobytes())
