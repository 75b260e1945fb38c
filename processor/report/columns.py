"""The columns of all tables: name, heading and unit of each, the same wherever the name is used."""

from __future__ import annotations

from collections.abc import Mapping
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

    @property
    def decimals(self) -> int:
        """How many a number without an interval has: of metres tenths of a millimetre, of lengths a hundredth."""
        return {"mm": 2, "mm2": 0, "mm3": 0, "m": 4, "mrad": 2, "%": 1, "°C": 1, "ppm": 1}.get(self.unit, 3)


def columns(*names: str) -> tuple[Column, ...]:
    """Return columns by their names, of COLUMNS."""
    return tuple(COLUMNS[name] for name in names)


def under(group: str | Message, *names: str) -> tuple[Column, ...]:
    """Return columns by their names, with a heading above them that they share."""
    return tuple(replace(COLUMNS[name], group=group) for name in names)


def given(*names: str) -> tuple[Column, ...]:
    """Return columns that the data name: methods, days."""
    return tuple(Column(name, name) for name in names)


def named(name: str, headings: Mapping[str, str] | None = None) -> Column:
    """Return the column of a name: its unit by the ending, as of UNITS, its heading the words before it, or given."""
    ending = next((ending for ending in UNITS if name.endswith(ending)), "")
    heading = (headings or {}).get(name, name.removesuffix(ending).replace("_", " ").strip())
    return Column(name, heading, UNITS.get(ending, ""), are_names=name in OF_INPUT)


UNITS = {
    "mm": "mm", "mm2": "mm2", "mm3": "mm3", "_per_m": "1/m", "_m": "m", "mrad": "mrad", "_deg": "deg",
    "_percent": "%", "_ppm": "ppm", "_C": "°C", "_mb": "MB", "seconds": "s",
}  # fmt: skip
# Headings that are not the words of the name: under a heading of their group, or beside another column of the kind
SHORT = {
    "input_sha256": "input SHA-256", "peak_mb": "peak memory", "seconds": "time",
    "allowed": "limits", "risk_accept": "risk if accepted", "risk_reject": "risk if rejected",
    "probability_now": "now", "probability_after": "after", "rotation_about": "about", "rotation_ci95_mrad": "ci95",
    "misalignment_ci95_mm": "ci95", "least_groove_gap_mm": "gap", "least_groove_gap_ci95_mm": "ci95",
    "greatest_groove_gap_mm": "gap", "greatest_groove_gap_ci95_mm": "ci95",
    **{f"{kind}_{figure}_mm": figure for figure in ("mean", "max")
       for kind in ("splicing", "linear", "foot1_best_fit_linear")},
    **{f"{half}{gauge}_d{axis}_mm": f"{half}d{axis} {words}".replace("_", " ") for axis in XYZ for half in ("", "ci95_")
       for gauge, words in (("design", "by design coordinates"), ("best_fit", "by best fit"))},
}  # fmt: skip
OF_INPUT = (
    "method", "joint", "component", "characteristic", "station", "point", "scan", "a", "b", "loop", "matrix", "key",
    "of", "id", "left_part", "right_part",
)  # fmt: skip
_FURTHER = """
actual allowed along_mm area_mm2 at axes ball_a ball_b balls beyond beyond_its_interval beyond_widened
bound_sd_lowest_z_mm bound_sd_radius_mm bow_mm by_chance_on_100_m2 candidate ceiling_z_mm chainage_mm change check ci95
ci95_along_mm ci95_axis_mm ci95_left_mm ci95_lowest_z_mm ci95_mm ci95_movement_mm ci95_radius_mm ci95_up_mm ci95_widened
class clause code confidence control_point curvature_per_m day day_from departure depth_ci95_mm depth_max_mm
depth_mean_mm depth_mm deviation deviation_mm difference_mm displacement_mm distance doubtful edge edge_mm edition
efficiency_centre efficiency_lowest_z efficiency_radius evidence figure finding fit fitted flag folder follows
foot1_best_fit_ci95_mm foot1_best_fit_deviation_mm formal_ci95_lowest_z_mm formal_ci95_radius_mm from further_joints
gauge greatest greatest_mm high95 input kept kind lambda largest_mm least least_mm left_mm length_mm limit limit_from
limit_mm lod95 lod95_mm log low95 lower lowest_z_m lowest_z_mm mean_mm measure median_mm message misalignment_mm mm
movement_mm mrad n1 n2 name noise note nominal nominal_radius_mm nx ny nz off_mm otherwise outcome overlap_percent
points points_used probability proposal quantile_95_mm quantity radius_error_mm radius_mm ratio reason remark report
residual_mm risk rivalry rms_mm rotation_mrad scale_ci95_ppm scale_ppm scanner sd_mm serial share_percent shared
shift_mm side_mm sideways_ci95_mm sideways_mm significant since size_mm source statement stations status std1 std2 step
steps subject temperature_C to true_radius_mm tube turned_deg unit up_ci95_mm up_mm upper used value value_from value_mm
value_to verdict visible_fraction volume_ci95_mm3 volume_mm3 what what_would_decide width_mm
"""
COLUMNS: Mapping[str, Column] = {
    name: named(name, SHORT)
    for name in [
        *SHORT, *OF_INPUT, *_FURTHER.split(),
        *(f"m{row}{place}" for row in range(4) for place in range(4)), *(a + b for a in XYZ for b in XYZ),
        *(pattern.format(axis) for axis in XYZ for pattern in (
            "{}", "{}_m", "{}_mm", "{}t_mm", "d{}_mm", "ci95_{}_mm", "ci95_d{}_mm", "sd_{}_mm", "bound_sd_{}_mm",
            "start_{}_mm", "end_{}_mm", "ci95_about_{}_mrad", "turn_{}_mrad",
        )),
    ]
}  # fmt: skip
