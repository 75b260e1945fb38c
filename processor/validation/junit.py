"""JUnit XML of a night, for CI servers: a test case for every cell, and one for every figure that got worse."""

from __future__ import annotations

import math
from xml.etree import ElementTree as ET

from processor.validation.change_detection import ALARMS
from processor.validation.summary import Summary


def xml(report: Summary) -> bytes:
    """Write cells (failed ones as errors, figures beyond their limits as failures), intervals and regressions."""
    night, cells, intervals, detected = report.night, report.cells, report.coverage, report.detected
    root = ET.Element("testsuites", name="processor validate")
    suite = ET.SubElement(root, "testsuite", name=f"accuracy.{night}")
    failures = errors = 0
    for cell in cells:
        case = _case(suite, "accuracy", cell["title"], cell["seconds"])
        if cell["failed"]:
            errors += 1
            ET.SubElement(case, "error", message=_clean(cell["failed"]))
        beyond = [
            "{step} ({method}), {name}: {shown:g} {unit}, limit {limit:g}".format(
                **one, shown=math.nan if one["value"] is None else one["value"]
            )
            for one in report.missed
            if one["cell"] == cell["cell"]
        ]
        if beyond:
            failures += 1
            ET.SubElement(case, "failure", message=_clean(beyond[0])).text = _clean("\n".join(beyond))
    _counts(suite, len(cells), failures, errors, sum(cell["seconds"] for cell in cells))
    if intervals:
        wrong = report.wrong_intervals
        suite = ET.SubElement(root, "testsuite", name=f"intervals.{night}")
        for one in intervals:
            case = _case(suite, f"intervals.{one.origin}.{one.step}.{one.method}", one.quantity, 0.0)
            if one in wrong:
                text = f"{one.holds}: {one.share:.1f} % of {one.number} errors within, {one.worst:.1f} % in a scene"
                ET.SubElement(case, "failure", message=_clean(text))
        _counts(suite, len(intervals), len(wrong), 0, 0.0)
    suite = ET.SubElement(root, "testsuite", name=f"changes.{night}")
    alarms = detected.of(*ALARMS)
    for change in alarms:
        step, method, name = change.name
        case = _case(suite, f"changes.{step}.{method}", name, 0.0)
        text = f"{change.kind}: {change.message} ({change.test} test, p {change.p:.2g}, {change.cases} cases)"
        ET.SubElement(case, "failure", message=_clean(text))
    if not alarms:
        _case(suite, "changes", f"{detected.figures} figures, none worse", 0.0)
    _counts(suite, max(1, len(alarms)), len(alarms), 0, 0.0)
    ET.indent(root)
    data: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return data + b"\n"


def _case(suite: ET.Element, class_name: str, name: str, seconds: float) -> ET.Element:
    return ET.SubElement(suite, "testcase", classname=_clean(class_name), name=_clean(name), time=f"{seconds:.3f}")


def _counts(suite: ET.Element, tests: int, failures: int, errors: int, seconds: float) -> None:
    counts = {"tests": tests, "failures": failures, "errors": errors, "skipped": 0}
    for key, value in counts.items():
        suite.set(key, str(value))
    suite.set("time", f"{seconds:.3f}")


def _clean(text: str) -> str:
    """Remove characters that XML 1.0 does not allow."""
    return "".join(c for c in text if c in "\t\n\r" or (c.isprintable() and ord(c) < 0xFFFE))
