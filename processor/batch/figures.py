"""What the summary says of one job's results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

Figures = dict[str, Any]
VERDICTS = ("fail", "indeterminate", "pass")  # the first that is there is the whole's
COLUMNS = {
    "steps": "steps, with the status of those that did not end well",
    "verdict": "the worst of joints, chain and nodes against their limits",
    "joints_pass": "",
    "joints_fail": "",
    "joints_indeterminate": "",
    "splicing_mean_mm": "",
    "splicing_max_mm": "",
    "linear_mean_mm": "",
    "linear_max_mm": "",
    "balls_found": "",
    "balls_flagged": "",
    "scans_stitched": "",
    "scans_not_stitched": "",
    "deviation_min_mm": "",
    "deviation_max_mm": "",
    "deviation_significant_share": "",
    "defects": "",
    "checks_passed": "",
    "checks_missed": "",
}


def of_results(results: Mapping[str, Any]) -> Figures:
    """Figures of a results.json by the names of COLUMNS; what was not run, or was not found, is left out."""
    steps: Mapping[str, Mapping[str, Any]] = results["steps"]
    found: Figures = {"steps": ", ".join(_said(name, step) for name, step in steps.items())}
    verdicts: Counter[str] = Counter()
    if "preassemble" in steps:
        verdicts += _preassembled(steps["preassemble"], found)
    if "spheres" in steps:
        verdicts += _balls(steps["spheres"], found)
    if "stitch" in steps:
        states = [scan.get("status") for scan in steps["stitch"].get("scans", [])]
        found |= {"scans_stitched": states.count("ok"), "scans_not_stitched": len(states) - states.count("ok")}
    if "deviation" in steps:
        keys = ("min", "max", "significant_share")
        names = ("deviation_min_mm", "deviation_max_mm", "deviation_significant_share")
        found |= {name: steps["deviation"].get(key) for name, key in zip(names, keys, strict=True)}
    if "defects" in steps:
        found["defects"] = len(steps["defects"].get("defects", []))
    found["verdict"] = next((verdict for verdict in VERDICTS if verdicts[verdict]), None)
    if results["checks"]:
        passed = sum(bool(check["passed"]) for check in results["checks"])
        found |= {"checks_passed": passed, "checks_missed": len(results["checks"]) - passed}
    return {name: found[name] for name in COLUMNS if found.get(name) is not None}


def _said(name: str, step: Mapping[str, Any]) -> str:
    status = step.get("status", "ok")
    return name if status == "ok" else f"{name} ({status})"


def _preassembled(step: Mapping[str, Any], found: Figures) -> Counter[str]:
    verdicts = Counter(str(joint.get("verdict")) for joint in step.get("joints", []) if joint.get("verdict"))
    found.update({f"joints_{name}": verdicts[name] for name in VERDICTS} if verdicts else {})
    for error in ("splicing", "linear"):
        for figure in ("mean", "max"):
            found[f"{error}_{figure}_mm"] = step.get(f"{error}_error", {}).get(figure)
    return verdicts + _count(chain.get("verdict") for chain in step.get("chain_limits", []))


def _balls(step: Mapping[str, Any], found: Figures) -> Counter[str]:
    flags = [ball.get("flag") for ball in step.get("balls", [])]
    there = len(flags) - flags.count("not-found")
    found |= {"balls_found": there, "balls_flagged": len(flags) - flags.count("ok")}
    return _count((ball.get("movement") or {}).get("verdict") for ball in step.get("balls", []))


def _count(verdicts: Iterable[Any]) -> Counter[str]:
    return Counter(one for one in verdicts if one in VERDICTS)
