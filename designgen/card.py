"""The card of a data set: what its scenes are, how many, the law of the noise, labels, splits, versions and hashes.

The card depends on the recipe, the varied values, the seeds and the software alone, as the scenes do; it has no time or
host, so that a set made again has the same card.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from designgen.scanning import scan_settings, scanner
from processor.model import SOURCES, Truth, UsageError

FORMAT, FORMAT_VERSION = "designgen-data-set", "1.0"
CARD_JSON, CARD_PAGE = "card.json", "card.md"
TRAIN, VALIDATION, TEST = "train", "validation", "test"
# By the seed modulo 20: 70, 15 and 15 %, and any eight seeds in a row have all three.
TURN = 20
SPLITS = {**dict.fromkeys((3, 9, 15), VALIDATION), **dict.fromkeys((6, 12, 18), TEST)}  # all other seeds train
SPLIT_RULE = (
    "by the seed modulo 20: validation 3, 9, 15; test 6, 12, 18; train all others. Scenes of one seed are the same "
    "structure under other settings and stay in one split; a larger set later moves no scene."
)
RAYS_LAW = (
    "along the ray: sigma^2 = noise_mm^2 + (noise_ppm R)^2 + (noise_signal_mm signal^signal_power)^2 + "
    "(footprint_share w tan(incidence))^2 at range R, w the radius of the beam; encoder_urad turns the ray; "
    "offset_mm, scale_ppm and tilt_urad are drawn once a station"
)
SURFACE_LAW = (
    "normal, independent, standard deviation sigma_mm of each coordinate; outlier_share of the points are stray"
)
MEANINGS = {
    "part": "row of part_names, -1 = none",
    "source": f"row of {', '.join(SOURCES)}",
    "surface": "row of surface_names, -1 = none",
    "range_error_mm": "measured range less the true one, mm",
    "incidence_cos": "cosine of the angle of incidence",
    "defect": "id in /truth/defects of the defect that displaced the surface, -1 = none",
}


@dataclass(frozen=True)
class Content:
    """A scene file in the index: scans, points, these by source, defects in the truth, and hashes in hex."""

    scans: int
    points: int
    surface: int
    mixed: int
    outlier: int
    defects: int
    scene_hash: str
    sha256: str


def split_of(seed: int) -> str:
    """Return the split of all scenes of a seed."""
    return SPLITS.get(seed % TURN, TRAIN)


def numbers_of(truth: Truth) -> dict[str, int]:
    """Count the points of a scene by their source, and its defects."""
    of_source = Counter[int]()
    for label in truth.labels:
        of_source.update({row: int((label.source == row).sum()) for row in range(len(SOURCES))})
    counts = {name: of_source[row] for row, name in enumerate(SOURCES)}
    return {**counts, "defects": 0 if truth.defects is None else len(truth.defects.ids)}


def labels_of(truth: Truth) -> list[dict[str, Any]]:
    """Describe the labels that the points of a scene have: dataset in each scan's group, type, and meaning."""
    if not truth.labels:
        return []
    first = truth.labels[0]
    found = []
    for name, meaning in MEANINGS.items():
        column = getattr(first, name)
        if not len(column):
            continue
        label: dict[str, Any] = {"dataset": f"/truth/labels/*/{name}", "type": str(column.dtype), "meaning": meaning}
        if name in ("part", "surface"):
            label["names"] = sorted({each for own in truth.labels for each in getattr(own, f"{name}_names")})
        found.append(label)
    return found


def noise_of(recipe: Mapping[str, Any]) -> dict[str, Any]:
    """Return the law of the noise and its numbers; UsageError for a recipe that cannot be scanned."""
    scanning = scan_settings.scan_settings_of(recipe)
    if isinstance(scanning, scan_settings.ByRays):
        return {
            "mode": scanner.MODE,
            "law": RAYS_LAW,
            "scanner": scanning.params.scanner,
            "numbers": asdict(scanning.device),
            "registration_mm": scanning.params.registration_mm,
            "registration_mrad": scanning.params.registration_mrad,
        }
    numbers = {key: getattr(scanning, key) for key in ("sigma_mm", "outlier_share")}
    return {"mode": scanning.mode, "law": SURFACE_LAW, "numbers": numbers}


def of_set(
    name: str,
    recipe: Mapping[str, Any],
    varied: Mapping[str, Sequence[str]],
    software: Mapping[str, str],
    scenes: Sequence[tuple[int, Content]],
    failed: int,
    labels: Sequence[Mapping[str, Any]],
    index_sha256: str,
) -> dict[str, Any]:
    """Return the card of a set of ``scenes``, by their seeds, of a recipe as JSON holds it.

    ``varied`` has the texts of values by key.
    """
    try:
        noise = noise_of(recipe)
    except UsageError as error:  # no scene was made
        noise = {"law": f"none: {error}"}
    seeds, contents = [seed for seed, _ in scenes], [content for _, content in scenes]
    points = [content.points for content in contents]
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "recipe": name,
        "about": recipe.get("about", ""),
        "kind": recipe.get("kind", ""),
        "parameters": dict(recipe),
        "varied": {key: list(values) for key, values in varied.items()},
        "scenes": len(scenes),
        "failed": failed,
        "seeds": sorted(set(seeds)),
        "scans": sum(content.scans for content in contents),
        "points": {"all": sum(points), "least": min(points, default=0), "most": max(points, default=0)},
        "points_by_source": {key: sum(getattr(content, key) for content in contents) for key in SOURCES},
        "defects": sum(content.defects for content in contents),
        "noise": noise,
        "labels": list(labels),
        "splits": {
            "rule": SPLIT_RULE,
            "scenes": {key: sum(split_of(seed) == key for seed in seeds) for key in (TRAIN, VALIDATION, TEST)},
        },
        "software": dict(software),
        "index": {"file": "index.csv", "sha256": index_sha256},
    }


def as_json(card: Mapping[str, Any]) -> str:
    """Write a card as JSON."""
    return json.dumps(card, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def as_markdown(card: Mapping[str, Any]) -> str:
    """Write a card as a page."""
    points, splits = card["points"], card["splits"]
    rows = [
        ("what", f"recipe {card['recipe']} ({card['kind']}): {card['about']}"),
        ("scenes", f"{card['scenes']:,} made, {card['failed']:,} failed; seeds {_ranges(card['seeds'])}"),
        *((f"varied: {key}", ", ".join(values)) for key, values in card["varied"].items()),
        ("scans", f"{card['scans']:,}"),
        ("points", f"{points['all']:,}; {points['least']:,} to {points['most']:,} a scene"),
        ("points by source", ", ".join(f"{key} {number:,}" for key, number in card["points_by_source"].items())),
        ("defects in the truth", f"{card['defects']:,}"),
        ("splits", ", ".join(f"{key} {number:,}" for key, number in splits["scenes"].items()) + " scenes"),
        ("software", ", ".join(f"{key} {version}" for key, version in card["software"].items())),
        ("SHA-256 of index.csv", f"`{card['index']['sha256']}`; it has that of every scene"),
    ]
    noise = [("law", card["noise"]["law"])]
    noise += [(key, card["noise"][key]) for key in ("mode", "scanner") if key in card["noise"]]
    noise += [(key, card["noise"][key]) for key in ("registration_mm", "registration_mrad") if key in card["noise"]]
    noise += list(card["noise"].get("numbers", {}).items())
    labels = [(f"`{one['dataset']}`", f"{one['type']}: {one['meaning']}") for one in card["labels"]]
    parts = [f"# Data set {card['recipe']}", _table(rows), "## Noise", _table(noise), "## Labels of the points"]
    parts += [_table(labels) if labels else "None.", "## Splits", f"Column `split` of index.csv, {splits['rule']}"]
    return "\n\n".join(parts) + "\n"


def _table(rows: Sequence[tuple[str, Any]]) -> str:
    return "\n".join(["| | |", "|---|---|", *(f"| {key} | {_cell(value)} |" for key, value in rows)])


def _cell(value: Any) -> str:
    return " ".join(str(value).replace("|", "\\|").split())


def _ranges(seeds: Sequence[int]) -> str:
    """Write sorted seeds as ranges, "1 to 5, 9"."""
    ranges: list[list[int]] = []
    for seed in seeds:
        if ranges and seed == ranges[-1][1] + 1:
            ranges[-1][1] = seed
        else:
            ranges.append([seed, seed])
    return ", ".join(str(low) if low == high else f"{low} to {high}" for low, high in ranges) or "none"
