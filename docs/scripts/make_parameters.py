"""Write docs/parameters.md from the code: ``python -m docs.scripts.make_parameters`` from the root of the repository.

The default of a parameter is that of its field. Its meaning is the comment beside the field, else the sentence of the
record's docstring that names it, else MEANINGS. What every step has, ``method`` and ``seed``, stands at the head.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import json
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

from processor import pipeline

PAGE = Path(__file__).resolve().parents[1] / "parameters.md"
HEAD = """\
# Parameters

Generated from the code by `make docs`.

Parameters are given in a TOML file, one table per step:

```toml
[preassemble.adjust]
weight = 0.1
[spheres]
radii_mm = [45.0, 50.0, 60.0]
```

```console
processor run my-frame -o results --params mine.toml
```

An unknown name, a wrong type or a number outside its range ends the run with exit code 2. A value has the type of its
default: text, true or false, whole number, number (`1.0`, `nan` = not given), list of numbers. Names end in their unit:
`_mm`, `_mrad`, `_deg`, `_ppm`, `_C`. Every step also has `method` (the first that is named, unless `--method` says
otherwise) and `seed` (0; the command line's comes first).
"""
OF_ALL_STEPS = ("method", "seed")
# Of fields that neither a comment nor the docstring explains.
MEANINGS = {
    "deviation.projection_diameter_mm": "diameter of the M3C2 cylinder; 0 = from the density",
    "deviation.max_depth_mm": "half length of the M3C2 cylinder; 0 = from the scan's extent",
    "deviation.core_spacing_mm": "distance between core points; 0 = from the density",
    "stitch.weak_mrad": "likewise for its attitude",
    "scale_ppm": "scale of the scanner's ranges",
    "line_probability": "probability that one sample of the RANSAC line was free of outliers",
    "line_iterations": "most samples of the RANSAC line",
    "denoise_neighbours": "neighbours K of the removal of outliers",
    "denoise_ratio": "standard deviations of the mean distance to K neighbours beyond which a point is an outlier",
    "filter_neighbours": "fewest neighbours that the radius filter keeps a point for",
    "pfh_bins": "bins of each angle of a point feature histogram",
    "pfh_radius_mm": "neighbourhood of a point feature histogram",
    "pfh_tolerance_mm": "distance within which a pair agrees with a coarse pose",
    "pfh_iterations": "most samples of the coarse pose",
    "icp_max_distance_mm": "farthest neighbour that iterative closest point pairs",
    "icp_iterations": "most iterations of iterative closest point",
    "icp_tolerance": "relative change of the mean square distance at which it ends",
    "per_voxel": "points a voxel that are aimed at",
    "voxel_mm": "side of the voxels",
    "least_in_voxel": "fewest points of a voxel that is used",
    "least_linearity": "linearity (0 to 1) from which a voxel counts as part of a line",
    "eccentricity_floor_mm": "least standard deviation of the axes about a node",
    "defects.edge_mm": "border of every face that is left out",
    "defects.pictures": "most defects that a small map is kept of",
    "paper.cluster_radius_mm": "radius of the density clusters; 0 = from the spacing",
    "paper.cluster_points": "fewest neighbours of a core point of a cluster",
    "paper.smallest_cluster_share": "share of the largest cluster below which one is noise",
    "paper.feature_points": "points that feature histograms are computed of",
    "paper.trials": "samples of the coarse pose",
    "paper.huber_mm": "limit of Huber's function; 0 = from the spacing",
    "deviation.paper.voxel_mm": "side of the density-adaptive voxels",
    "deviation.paper.voxel_points": "points a voxel",
    "deviation.paper.voxel_growth": "factor by which a voxel with fewer points grows",
    "deviation.paper.normal_diameter_mm": "diameter of the sphere of a normal",
    "deviation.paper.projection_diameter_mm": "diameter of the cylinder",
    "deviation.paper.max_depth_mm": "half length of the cylinder",
}


def main() -> None:
    """Write the page."""
    PAGE.write_text(page(), "utf-8")


def page() -> str:
    """Return the text of docs/parameters.md."""
    lines = [HEAD]
    for step, module in pipeline.step_modules().items():
        lines.append(f"\n## Step `{step}`\n\nMethods: {', '.join(f'`{name}`' for name in module.METHODS)}.\n")
        for name, record in records(step, type(module.Params())):
            lines.append(f"\n### `[{name}]`\n\n{first_paragraph(record)}\n")
            lines += ["- {} ({}): {}".format(*row) for row in rows(name, record)]
            lines.append("")
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).rstrip() + "\n"


def records(name: str, record: type) -> Iterator[tuple[str, type]]:
    """Yield a record and those within it, each with the name of its table."""
    yield name, record
    default = record()
    for field in dataclasses.fields(record):
        value = getattr(default, field.name)
        if dataclasses.is_dataclass(value):
            yield from records(f"{name}.{field.name}", type(value))


def rows(table: str, record: type) -> list[tuple[str, str, str]]:
    """Return name, default and meaning of every field that is no record and that not every step has."""
    default, comments = record(), comments_of(record)
    found = []
    for field in dataclasses.fields(record):
        value = getattr(default, field.name)
        if dataclasses.is_dataclass(value) or field.name in OF_ALL_STEPS:
            continue
        shown = "nan" if value != value else json.dumps(value, ensure_ascii=False)
        meaning = comments.get(field.name) or sentence(record, field.name) or known(table, field.name)
        found.append((f"`{field.name}`", f"`{shown}`", escaped(meaning)))
    return found


def known(table: str, name: str) -> str:
    """Return the meaning in MEANINGS, by the longest name that fits. Raises KeyError where there is none."""
    whole = f"{table}.{name}".split(".")
    for first in range(len(whole)):
        key = ".".join(whole[first:])
        if key in MEANINGS:
            return MEANINGS[key]
    raise KeyError(f"{table}.{name}: no comment beside it, no sentence in the docstring, no entry in MEANINGS")


def comments_of(record: type) -> dict[str, str]:
    """Return the comment on the line of each field, or above it where there is none, by the field's name."""
    try:
        source = textwrap.dedent(inspect.getsource(record))
    except OSError:  # made by a function
        return {}
    lines = source.splitlines()
    (body,) = ast.parse(source).body
    assert isinstance(body, ast.ClassDef)
    found = {}
    for node in body.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.end_lineno is not None:
            _, mark, comment = lines[node.end_lineno - 1][node.end_col_offset :].partition("#")
            before = list(itertools.takewhile(lambda line: line.strip().startswith("#"), lines[node.lineno - 2 :: -1]))
            if mark:
                found[node.target.id] = comment.strip()
            elif before:
                found[node.target.id] = " ".join(line.strip(" #") for line in reversed(before))
    return found


def sentence(record: type, name: str) -> str:
    """Return the sentences of a record's docstring that name a field."""
    text = " ".join((inspect.getdoc(record) or "").split())
    found = [part for part in re.split(r"(?<=\.)\s+", text) if f"``{name}``" in part]
    return " ".join(found)


def first_paragraph(record: type) -> str:
    """Return the first paragraph of a record's docstring."""
    return escaped(" ".join((inspect.getdoc(record) or "").split("\n\n")[0].split()))


def escaped(text: str) -> str:
    """Return a docstring's text in the marks of Markdown."""
    return text.replace("``", "`")


if __name__ == "__main__":
    main()
