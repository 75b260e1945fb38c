"""Pages as a reader sees them, and what they are made of: the index of a batch, nights, a search for defects."""

import re
from html.parser import HTMLParser

from processor.batch import summary, summary_values
from processor.batch.job import Job
from processor.batch.record import JobStatus, Record
from processor.defects.result import DefectClass
from processor.deviation.result import Registration
from processor.evaluation.evaluate import ErrorReport
from processor.model import Status, reason
from processor.validation import night
from tests.support.results import step_results, validation_nights
from tests.support.results.metrics import metric

# --- what a reader sees ---

UNITS = {"mm", "km", "mrad", "ci", "ci95"}
METHODS = {"adjustment", "corner", "line", "design", "aided", "ray", "ransac", "least", "squares"}
STANDARDS = {"GB", "Cram", "rao"}  # Cramér-Rao, the name of a bound
IN_FILES = {
    "design_frame",
    "project",
    "own",
    "foot1",
    "rib1",
    "foot2",
    "bridge",
    "frame",
    "toml",
    "balls",
    "results",
    "csv",
    "json",
    "plausible",
    "candidates",
    "SHA",
    "processor",
}
SYMBOLS = {"dx", "dy", "dz", "lambda", "node_place_mm", "bow_mm", "max_balls"}
STAYS = UNITS | METHODS | STANDARDS | IN_FILES | SYMBOLS


class Visible(HTMLParser):
    """Text of a page that a reader sees: no scripts, no style, no provenance; what stands for a picture too."""

    def __init__(self, page):
        super().__init__()
        self.texts, self.lang, self._hidden = [], "", 0
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self._hidden += tag in ("script", "style", "pre")
        self.texts += [value for name, value in attrs if name in ("alt", "title")]
        self.lang = dict(attrs).get("lang", self.lang)

    def handle_endtag(self, tag):
        self._hidden -= tag in ("script", "style", "pre")

    def handle_data(self, data):
        if not self._hidden:
            self.texts.append(data)


def latin(texts, stays=STAYS):
    """Texts with words that are not Chinese and are no names."""
    return [one for one in texts if set(re.findall(r"[A-Za-z]{2}[A-Za-z0-9_]*", one)) - stays]


NAMES = {
    *(f"S{i}" for i in range(9)),
    *("site", "scan", "made", "component", "ply", "summary", "timings"),
    *("automatic", "default", "paper", "three", "point", "stitch", "deviation", "spheres", "defects", "pdf"),
    *("PRCS", "SOCS", "GLCS", "T_PRCS_SOCS", "GLCS_PRCS", "LOD95", "lod95", "ppm", "rms"),
}


def left_in_english(text, *more):
    seen = Visible(re.sub(r"T_(PR|GL)CS_SOCS\(.*?\)", "", text))
    assert seen.lang == "zh"
    assert len(seen.texts) > 20
    return latin(seen.texts, STAYS | NAMES | set(more))


# --- steps ---


def checks_of(step, *names):
    return tuple(metric(name, 1.0, 0.0 if i % 2 else float("nan"), step=step) for i, name in enumerate(names))


STITCH_CHECKS = (
    "scans not placed", "station positions after datum fit, max", "station positions after datum fit, rms",
    "rotations after datum fit, max", "scans called ok, over 50 mm off", "pose components within their 95 % intervals",
    "station positions by control points, max",
)  # fmt: skip
DEFECT_CHECKS = (
    *(f"missed: {kind}" for kind in DefectClass), "false alarms", "surface examined",
    "class wrong", "depths off by more than a tenth and 2 LOD95", "depth error, median", "depth error, max",
    "depths that are bounds alone",
)  # fmt: skip


PAPER = (
    reason("defects.paper-clusters", points=2000, spacing=4.5),
    reason("defects.paper-fit", rms=1.2, share=87.0),
    reason("defects.paper-threshold", threshold=3.1),
)


def searched():
    placed = reason("defects.placed-by-deviation", registration=Registration.AS_GIVEN)
    first = step_results.defects(reasons=(placed, *step_results.EXAMINED))
    paper = step_results.defects(3, PAPER, method="paper")
    made = step_results.execution(("defects", "default", "{}", first), ("defects", "paper", "{}", paper))
    of_paper = metric("missed: step", 1.0, step="defects", method="paper")
    return made, ErrorReport((*checks_of("defects", *DEFECT_CHECKS), of_paper))


# --- a batch ---

REASONS = (
    reason("batch.stopped"),
    reason("batch.timeout", limit=3.5),
    reason("batch.memory", limit=200),
    reason("batch.killed"),
    reason("batch.crashed", signal="SIGSEGV", number=11),
    reason("batch.crashed-unnamed", number=70),
    reason("batch.no-results", exit_code=9),
    reason("batch.no-results-but", exit_code=9, last="坏"),
    reason("batch.input-changed"),
    reason("batch.not-shared"),
    reason("batch.workers-died"),
    reason("batch.worker-failed", error="坏"),
    reason("batch.other-software", difference="numpy 1.0, not 2.0"),
)
LEFT_OUT = (
    reason("batch.unreadable", error="Permission denied"),
    reason("batch.holds-results"),
    reason("batch.link"),
    reason("batch.no-coordinates"),
    reason("batch.in-scan-folder", folder="桥"),
    reason("batch.reserved-name"),
)


LEFT = dict(zip("一二三四五六", LEFT_OUT, strict=True))


def job(out, name):
    (out / f"{name}.log").touch()
    return Job(name, out, out, out, out / name, out / f"{name}.log", out, out, out, "", (), {}, {}, 1.0, 1, 1)


def indexed(out, lang, reasons=REASONS):
    everything = dict.fromkeys(summary_values.COLUMNS, 3)
    steps = dict(zip(("preassemble", "spheres", "stitch", "deviation", "defects"), map(str, Status), strict=True))
    done = [
        Record(f"扫描 {i}", "", JobStatus(status), figures={**everything, "verdict": verdict}, steps=steps)
        for i, (status, verdict) in enumerate(
            [("done", "pass"), ("in-part", "indeterminate"), ("limit-missed", "fail"), ("done", None)]
        )
    ]
    done += [Record(f"坏 {i}", "", JobStatus.FAILED, why) for i, why in enumerate(reasons)]
    found = summary.write(out, [(job(out, one.input), one) for one in done], LEFT, lang)
    return found.page.read_text("utf-8")


# --- nights ---


def two_nights(out, lang):
    stored = {figure["name"] for case in validation_nights.Simulated(1).cases for figure in case["figures"]}
    figures_of = {name: (0.5, 0.2 if "bias" in name else None, "mm") for name in stored}
    figures_of |= dict.fromkeys((*STITCH_CHECKS, *DEFECT_CHECKS), (1.0, None, "mm"))
    rays = '[scan]\nmode = "rays"\nscanner = "phase"\nstep_mrad = 1.5\n'
    cases = (
        validation_nights.case(),
        validation_nights.case("scan", text=rays),
        validation_nights.case(steps=("defects",), methods=("default",)),
    )
    asked = validation_nights.matrix(*cases)
    for day in ("2026-11-20", "2026-11-21"):
        runner = validation_nights.runner(lambda cell: dict(figures_of))
        night.run(asked, out, day, runner, made_by=validation_nights.SOFTWARE, lang=lang)
