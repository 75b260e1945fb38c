"""Write docs/schemas from the declarations of inputs: ``python -m docs.scripts.make_schemas`` from the repository."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from docs.scripts import make_parameters
from processor.limits import standards
from processor.model.inputs import keys_of, text
from processor.scan_folder.design import ArchFile, FrameFile
from processor.scan_folder.project_file import ListedStation, Project, Station
from processor.scan_folder.tolerance import declared_limits

FOLDER = Path(__file__).resolve().parents[1] / "schemas"
DIALECT = "https://json-schema.org/draft/2020-12/schema"
PATH = {
    "description": "path of a file below the folder",
    "type": "string",
    "minLength": 1,
    "not": {"pattern": r"(^/)|(^|/)\.\.(/|$)"},
}
FILES = {
    "project": ("project.toml of a scan folder, as parsed", Project),
    "design-arch": ("design.json of an arch bridge", ArchFile),
    "design-frame": ("design.json of a space frame", FrameFile),
}


def main() -> None:
    """Write the files."""
    for name, content in schemas().items():
        (FOLDER / f"{name}.schema.json").write_text(as_text(content), "utf-8")


def as_text(content: dict[str, Any]) -> str:
    """Return a schema as its file holds it."""
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def schemas() -> dict[str, dict[str, Any]]:
    """Return the schemas by the names of their files."""
    made = {}
    for name, (title, declared) in FILES.items():
        content = {"$schema": DIALECT, "title": title, **of_table(declared)}
        made[name] = content | ({"$defs": {"path": PATH}} if "#/$defs/path" in json.dumps(content) else {})
    by_name = {"type": "object", "additionalProperties": of_table(Station)}
    listed = {"description": "the same as a list; each id is there once", "type": "array"}
    made["stations"] = {
        "$schema": DIALECT,
        "title": "stations.json of a scan folder: scanner positions by station name",
        "oneOf": [by_name, {**listed, "items": of_table(ListedStation)}],
    }
    return made


def of_table(declared: Any) -> dict[str, Any]:
    """Return the schema of a declared table."""
    keys = keys_of(declared)
    required = [name for name, (_, field) in keys.items() if field.default is dataclasses.MISSING]
    comments: dict[str, str] = {}
    for base in reversed(declared.__mro__[:-1]):
        comments |= make_parameters.comments_of(base)
    return {
        "type": "object",
        **({} if getattr(declared, "IGNORES", False) else {"additionalProperties": False}),
        **({"required": required} if required else {}),
        **getattr(declared, "SCHEMA", {}),
        "properties": {
            name: ({"description": about} if (about := field.metadata["about"] or comments.get(name)) else {})
            | resolved(kind.schema)
            for name, (kind, field) in keys.items()
        },
    }


def resolved(schema: Any) -> Any:
    """Return a schema with the tables that it names in their places."""
    if isinstance(schema, list):
        return [resolved(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    if "$table" in schema:
        return of_table(schema["$table"])
    if "$tolerance" in schema:
        limits = of_table(declared_limits(""))
        return limits | {
            "properties": limits["properties"]
            | {"standard": {"description": "a standard of processor/limits", **text(*standards.standards()).schema}}
        }
    return {name: resolved(one) for name, one in schema.items()}


if __name__ == "__main__":
    main()
