"""The columns of all tables: name, heading and unit of each, the same wherever the name is used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from processor.language.messages import Message

XYZ = ("x", "y", "z")
MM = ("mm",)  # units of a table


@dataclass(frozen=True)
class Column:
    """A column of a table.

    ``name`` stands in CSV files. ``heading`` is for display, in English, and translated by the catalogue of another
    language; it is "" where the unit is the heading. ``unit`` is "" for none, and where the table states it elsewhere.
    Equal neighbours have one ``group`` above them, "" for none. Cells that ``are_names`` come from the input, and no
    language translates them.
    """

    name: str
    heading: str
    unit: str = ""
    group: str | Message = ""
    are_names: bool = False


def columns(*names: str) -> tuple[Column, ...]:
    """Return columns by their names, of COLUMNS."""
    return tuple(COLUMNS[name] for name in names)


def under(group: str | Message, *names: str) -> tuple[Column, ...]:
    """Return columns by their names, with a heading above them that they share."""
    return tuple(replace(COLUMNS[name], group=group) for name in names)


def given(*names: str) -> tuple[Column, ...]:
    """Return columns that the data name: methods, days."""
    return tuple(Column(name, name) for name in names)


# --- by their units: words that are name and heading, and names with their headings -----------------------------------

_NAMES = (  # of what the input holds
    (
        "method", "joint", "component", "characteristic", "station", "point", "scan", "a", "b", "loop", "matrix",
        "key", "of", "id",
    ),
    {"left_part": "left part", "right_part": "right part"},
)  # fmt: skip
_WITHOUT_UNIT = (
    (
        "at", "axes", "balls", "beyond", "candidate", "check", "class", "clause", "code", "confidence", "day",
        "doubtful", "edge", "edition", "evidence", "figure", "finding", "fit", "fitted", "flag", "folder", "follows",
        "from", "input", "kept", "kind", "lambda", "limit", "log", "measure", "message", "n1", "n2", "name", "noise",
        "nx", "ny", "nz", "otherwise", "outcome", "points", "probability", "proposal", "quantity", "ratio", "reason",
        "remark", "report", "rivalry", "scanner", "serial", "shared", "significant", "since", "source", "statement",
        "stations", "status", "step", "steps", "subject", "to", "tube", "unit", "used", "verdict", "what", "m00",
        "m01", "m02", "m03", "m10", "m11", "m12", "m13", "m20", "m21", "m22", "m23", "m30", "m31", "m32", "m33", "xx",
        "xy", "xz", "yx", "yy", "yz", "zx", "zy", "zz",
    ),
    {
        "ball_a": "ball a",
        "ball_b": "ball b",
        "beyond_its_interval": "beyond its interval",
        "beyond_widened": "beyond widened",
        "by_chance_on_100_m2": "by chance on 100 m2",
        "control_point": "control point",
        "day_from": "day from",
        "efficiency_centre": "efficiency centre",
        "efficiency_lowest_z": "efficiency lowest z",
        "efficiency_radius": "efficiency radius",
        "further_joints": "further joints",
        "gauge": "gauge",
        "input_sha256": "input SHA-256",
        "limit_from": "limit from",
        "points_used": "points used",
        "probability_after": "after",
        "probability_now": "now",
        "rotation_about": "about",
        "visible_fraction": "visible fraction",
        "what_would_decide": "what would decide",
    },
)  # fmt: skip
_UNIT_STATED_ELSEWHERE = (  # in a column of its own, or it is that of the clouds compared
    (
        "actual", "change", "ci95", "departure", "deviation", "distance", "greatest", "high95", "least", "lod95",
        "low95", "lower", "nominal", "std1", "std2", "upper", "value", "x", "y", "z",
    ),
    {"ci95_widened": "ci95 widened", "value_from": "value from", "value_to": "value to"},
)  # fmt: skip
_MM = {
    "along_mm": "along",
    "bound_sd_lowest_z_mm": "bound sd lowest z",
    "bound_sd_radius_mm": "bound sd radius",
    "bow_mm": "bow",
    "ceiling_z_mm": "ceiling z",
    "chainage_mm": "chainage",
    "ci95_along_mm": "ci95 along",
    "ci95_axis_mm": "ci95 axis",
    "ci95_left_mm": "ci95 left",
    "ci95_lowest_z_mm": "ci95 lowest z",
    "ci95_mm": "ci95",
    "ci95_movement_mm": "ci95 movement",
    "ci95_radius_mm": "ci95 radius",
    "ci95_up_mm": "ci95 up",
    "depth_ci95_mm": "depth ci95",
    "depth_max_mm": "depth max",
    "depth_mean_mm": "depth mean",
    "depth_mm": "depth",
    "deviation_mm": "deviation",
    "difference_mm": "difference",
    "displacement_mm": "displacement",
    "edge_mm": "edge",
    "foot1_best_fit_ci95_mm": "foot1 best fit ci95",
    "foot1_best_fit_deviation_mm": "foot1 best fit deviation",
    "foot1_best_fit_linear_max_mm": "max",
    "foot1_best_fit_linear_mean_mm": "mean",
    "formal_ci95_lowest_z_mm": "formal ci95 lowest z",
    "formal_ci95_radius_mm": "formal ci95 radius",
    "greatest_groove_gap_ci95_mm": "ci95",
    "greatest_groove_gap_mm": "gap",
    "greatest_mm": "greatest",
    "largest_mm": "largest",
    "least_groove_gap_ci95_mm": "ci95",
    "least_groove_gap_mm": "gap",
    "least_mm": "least",
    "left_mm": "left",
    "length_mm": "length",
    "limit_mm": "limit",
    "linear_max_mm": "max",
    "linear_mean_mm": "mean",
    "lod95_mm": "lod95",
    "lowest_z_mm": "lowest z",
    "mean_mm": "mean",
    "median_mm": "median",
    "misalignment_ci95_mm": "ci95",
    "misalignment_mm": "misalignment",
    "mm": "",
    "movement_mm": "movement",
    "nominal_radius_mm": "nominal radius",
    "off_mm": "off",
    "quantile_95_mm": "quantile 95",
    "radius_error_mm": "radius error",
    "radius_mm": "radius",
    "residual_mm": "residual",
    "rms_mm": "rms",
    "sd_mm": "sd",
    "shift_mm": "shift",
    "side_mm": "side",
    "sideways_ci95_mm": "sideways ci95",
    "sideways_mm": "sideways",
    "size_mm": "size",
    "splicing_max_mm": "max",
    "splicing_mean_mm": "mean",
    "true_radius_mm": "true radius",
    "up_ci95_mm": "up ci95",
    "up_mm": "up",
    "value_mm": "value",
    "width_mm": "width",
    **{
        name.format(axis): heading.format(axis)
        for name, heading in (
            ("{}_mm", "{}"),
            ("{}t_mm", "{}t"),
            ("d{}_mm", "d{}"),
            ("ci95_{}_mm", "ci95 {}"),
            ("ci95_d{}_mm", "ci95 d{}"),
            ("design_d{}_mm", "d{} by design coordinates"),
            ("ci95_design_d{}_mm", "ci95 d{} by design coordinates"),
            ("best_fit_d{}_mm", "d{} by best fit"),
            ("ci95_best_fit_d{}_mm", "ci95 d{} by best fit"),
            ("sd_{}_mm", "sd {}"),
            ("bound_sd_{}_mm", "bound sd {}"),
            ("start_{}_mm", "start {}"),
            ("end_{}_mm", "end {}"),
        )
        for axis in XYZ
    },
}
_FURTHER_UNITS = {
    "m": {"x_m": "x", "y_m": "y", "z_m": "z"},
    "mm2": {"area_mm2": "area"},
    "mm3": {"volume_mm3": "volume", "volume_ci95_mm3": "volume ci95"},
    "1/m": {"curvature_per_m": "curvature"},
    "mrad": {
        "mrad": "",
        "rotation_mrad": "rotation",
        "rotation_ci95_mrad": "ci95",
        **{f"ci95_about_{axis}_mrad": f"ci95 about {axis}" for axis in XYZ},
        **{f"turn_{axis}_mrad": f"turn {axis}" for axis in XYZ},
    },
    "deg": {"turned_deg": "turned"},
    "%": {"overlap_percent": "overlap", "share_percent": "share"},
    "ppm": {"scale_ppm": "scale", "scale_ci95_ppm": "scale ci95"},
    "°C": {"temperature_C": "temperature"},
    "s": {"seconds": "time"},
    "MB": {"peak_mb": "peak memory"},
}


def _all() -> Iterator[Column]:
    for words, further in (_NAMES, _WITHOUT_UNIT, _UNIT_STATED_ELSEWHERE):
        headings = {**{word: word for word in words}, **further}
        yield from (Column(name, heading, are_names=words is _NAMES[0]) for name, heading in headings.items())
    for unit, headings in {"mm": _MM, **_FURTHER_UNITS}.items():
        yield from (Column(name, heading, unit) for name, heading in headings.items())


COLUMNS: Mapping[str, Column] = {column.name: column for column in _all()}
