"""A guess of what a scan folder's project.toml should say, as that file and as JSON."""

from __future__ import annotations

import json
from typing import Any

from processor.project_guess import PROJECT, Guess, ScanGuess


def written(found: Guess) -> str:
    """Return project.toml, with comments that say why, and what may be added."""
    lines = ["# Made by `processor init`. What is unsure is marked with a question mark."]
    lines += [f"# ? {_one_line(text)}" for text in found.unsure] + [""]
    lines.append(f"name = {_text(found.name)}")
    lines.append(f"kind = {_text(found.kind)}  # {_one_line(found.kind_reason)}")
    if found.units:
        lines.append(
            f"units = {_text(found.units)}  # of scans whose format says none: {_one_line(found.units_reason)}"
        )
    else:
        lines.append(f'# units = "m"  # not needed: {_one_line(found.units_reason)}')
    if found.design:
        lines.append(f"design = {_text(found.design)}  # {_one_line(found.design_reason)}")
    else:
        lines.append('# design = "design.json"  # or one mesh, STEP or IFC file of the whole, of kind structure')
    if found.design_units:
        lines.append(f"design_units = {_text(found.design_units)}  # of the mesh, which does not say")
    lines.append("# temperature_C = 20.0  # of the steel while it was scanned")
    if found.stations:
        lines.append(f"# {_one_line(found.stations)}")
    for one in found.scans:
        lines += ["", *_scan_lines(one)]
    lines += ["", "# [tolerance]", '# standard = "GB 50205-2020"', ""]
    return "\n".join(lines)


def _scan_lines(one: ScanGuess) -> list[str]:
    if one.error:
        return [f"# {one.file!a} cannot be read: {_one_line(one.error)}", "# [[scan]]", f"# file = {_text(one.file)}"]
    lines = ["[[scan]]", f"file = {_text(one.file)}"]
    reason = f"  # {'' if one.sure else '? '}{_one_line(one.reason)}" if one.reason else ""
    if one.component:
        lines.append(f"component = {_text(one.component)}{reason}")
    elif reason:
        lines.append(reason.strip())
    if one.station:
        lines.append(f"# station = {_text(one.station)}")
    return lines


def _text(text: str) -> str:
    """Return a text as TOML has it between quotes."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _one_line(text: str) -> str:
    return "".join(one if one.isprintable() else " " for one in " ".join(text.split()))


def as_json(found: Guess) -> dict[str, Any]:
    """Return the guess as JSON can hold it."""
    keys = ("kind", "kind_reason", "design", "design_reason", "design_units", "units", "units_reason", "unsure")
    scan_keys = ("file", "component", "station", "reason", "sure", "error")
    scans = [{key: getattr(one, key) for key in scan_keys} for one in found.scans]
    return {"file": f"{found.folder}/{PROJECT}", "name": found.name} | {
        **{key: getattr(found, key) for key in keys},
        "scans": scans,
    }
