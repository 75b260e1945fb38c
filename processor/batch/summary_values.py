"""The values of one job's results in the summary."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from processor.model import WORST_FIRST, Status
from processor.report.columns import Column, named

SummaryValues = dict[str, Any]
COLUMNS: Mapping[str, Column] = {
    name: named(name)
    for name in (
        "steps",  # with the status of those that did not end well
        "verdict",  # the worst of all steps, against the limits
        *(f"joints_{verdict}" for verdict in ("pass", "fail", "indeterminate")),
        *(f"{error}_{figure}_mm" for error in ("splicing", "linear") for figure in ("mean", "max")),
        "balls_found", "balls_flagged", "scans_stitched", "scans_not_stitched", "deviation_min_mm", "deviation_max_mm",
        "deviation_significant_share", "defects", "checks_passed", "checks_missed",
    )
}  # fmt: skip


def summary_values(results: Mapping[str, Any]) -> SummaryValues:
    """Return the values of a results.json by the names of COLUMNS; absent are those of steps not run and of nulls."""
    steps: Mapping[str, Mapping[str, Any]] = results["steps"]
    ended = step_status(results).items()
    values: SummaryValues = {
        "steps": ", ".join(name if status == Status.OK else f"{name} ({status})" for name, status in ended)
    }
    if "preassemble" in steps:
        step = steps["preassemble"]
        verdicts = Counter(str(joint.get("verdict")) for joint in step.get("joints", []) if joint.get("verdict"))
        values.update({f"joints_{name}": verdicts[name] for name in WORST_FIRST} if verdicts else {})
        for error in ("splicing", "linear"):
            for statistic in ("mean", "max"):
                values[f"{error}_{statistic}_mm"] = step.get(f"{error}_error", {}).get(statistic)
    if "spheres" in steps:
        flags = [ball.get("flag") for ball in steps["spheres"].get("balls", [])]
        present = len(flags) - flags.count("not-found")
        values |= {"balls_found": present, "balls_flagged": len(flags) - flags.count("ok")}
    if "stitch" in steps:
        states = [scan.get("status") for scan in steps["stitch"].get("scans", [])]
        values |= {"scans_stitched": states.count("ok"), "scans_not_stitched": len(states) - states.count("ok")}
    if "deviation" in steps:
        keys = ("min", "max", "significant_share")
        names = ("deviation_min_mm", "deviation_max_mm", "deviation_significant_share")
        values |= {name: steps["deviation"].get(key) for name, key in zip(names, keys, strict=True)}
    if "defects" in steps:
        values["defects"] = len(steps["defects"].get("defects", []))
    values["verdict"] = results.get("verdict") if results.get("verdict") in WORST_FIRST else None
    if results["checks"]:
        passed = sum(bool(check["passed"]) for check in results["checks"])
        values |= {"checks_passed": passed, "checks_missed": len(results["checks"]) - passed}
    return {name: values[name] for name in COLUMNS if values.get(name) is not None}


def step_status(results: Mapping[str, Any]) -> dict[str, str]:
    """Return the status of each step of a results.json."""
    return {name: step.get("status", Status.OK.value) for name, step in results["steps"].items()}
