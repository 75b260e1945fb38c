"""The page's script and its data, for the live figures of all steps."""

from __future__ import annotations

import base64
import hashlib
import importlib.resources
import json
from typing import Any

SCRIPTS = ("space_view.js", "line_chart.js", "preassembly_charts.js", "start.js")


def embedded(data: dict[str, Any]) -> str:
    """Write JSON that can stand within a script element: no character of it can end the element or open another."""
    text = json.dumps(data, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def script() -> tuple[str, str]:
    """Return the page's script and its SHA-256 as a content security policy writes it."""
    folder = importlib.resources.files("processor.report.scripts")
    text = "".join((folder / name).read_text("utf-8") for name in SCRIPTS)
    digest = base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
    return text, f"'sha256-{digest}'"
