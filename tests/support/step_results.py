"""Results of stitching and of the search for defects, made by hand: all that they say, and no numbers that count."""

import numpy as np

from processor.defects.result import CLASSES
from processor.defects.result import Result as Defects
from processor.model import Scan, Scene, StepRun, StructureDesign
from processor.pipeline import Execution
from processor.stitching.result import Result as Stitching

PROVENANCE = {"input": "site", "input_sha256": "0" * 64, "seed": 0, "software": {}, "parameters": []}
SCAN_MESSAGES = (
    "",
    "much speaks against its pose (31 % of what speaks for it)",
    "it shares little with any other scan (4 %)",
    "another pose speaks for itself as well (97 % of this one's score)",
    "nothing tells how sure its pose is",
    "2.3 % of what it shares with the only scan beside it was looked through, as where a structure "
    "repeats itself or things moved: a third scan, common points or control would tell",
    "7 faces agree that it stands 3.1 mm and 0.086 mrad elsewhere, 5 speak against that: something moved in between, "
    "or the scan is bent",
    "its pose is sure to 25 mm and 1.2e+02 mrad only",
    "shares too little with the others to be placed",
)
STATES = ("ok", "weak", "weak", "ambiguous", "weak", "ambiguous", "weak", "weak", "failed")
PAIR_MESSAGES = (
    "its own pose contradicts the others",
    "by itself it would stand elsewhere",
    "scale 0.0010000: units mixed up (m and mm)?",
    "scale 1.004000: a blunder in the picks",
    "scale -120 ± 80 ppm: temperature (12 ppm a kelvin), instrument or picks",
)


def plate(columns=24, rows=12, side=50.0):
    """A scan of a plate, x along it and z up, and its design of two faces."""
    x, z = (side * np.arange(count) for count in (columns, rows))
    xx, zz = (one.ravel() for one in np.meshgrid(x, z, indexing="ij"))
    points = np.column_stack([xx, 2.0 * np.sin(xx / 200.0), zz])
    corners = np.array([[0.0, 0, 0], [x[-1], 0, 0], [x[-1], 0, z[-1]], [0, 0, z[-1]]])
    return points, StructureDesign("plate", corners, np.array([[0, 1, 2], [0, 2, 3]]))


def scene(names=("S1",), name="site"):
    points, design = plate()
    scans = tuple(Scan(one, points, np.zeros(3), T_project_scan=np.eye(4)) for one in names)
    return Scene(name, "structure", scans, structure=design, units="mm", units_reason="given in project.toml")


def stitching(names=("S1", "S2", "S3", "S4", "S5", "S6", "S7", "S8", "S9")):
    """Nine scans in all states, five pairs with all that is said of pairs, and a loop."""
    k, p = len(names), len(PAIR_MESSAGES)
    pose = np.tile(np.eye(4), (k, 1, 1))
    pose[:, :3, 3] = 1000.0 * np.column_stack([np.arange(k), np.arange(k) % 3, np.zeros(k)])
    pose[-1] = np.nan
    said = [f"{one}: {text}" for one, text in zip(names, SCAN_MESSAGES, strict=True) if text]
    said.append(f"pair {names[0]}, {names[5]} not used: 2 common points, three that span a plane are needed")
    line = "all common points on a line, three that span a plane are needed"
    said.append(f"pair {names[1]}, {names[5]} not used: {line}")
    said += [f"pair {names[0]}, {names[i]}: {text}" for i, text in enumerate(PAIR_MESSAGES[2:], 1)]
    return Stitching(
        "partial", "automatic", "; ".join(said), names[0], names, STATES, SCAN_MESSAGES, pose,
        np.zeros((k, 6, 6)), pose[:, :3, 3], np.full((k, 3), 0.2), np.full((k, 3), 1e-5), np.full(k, 0.5),
        np.full((k, 4, 4), np.nan), (names[0],) * p, names[1 : p + 1], np.linspace(0.2, 0.9, p),
        np.linspace(0.5, 1.0, p), np.array([0, 1, 1, 1, 1], np.uint8), PAIR_MESSAGES, np.tile(np.eye(4), (p, 1, 1)),
        np.zeros((p, 6, 6)), np.full(p, 12), np.ones(p), np.full(p, np.nan),
        (" > ".join([*names[:3], names[0]]),), np.array([0.4]), np.array([0.1]), np.array([1.1]),
    )  # fmt: skip


ALL = len(CLASSES)


def defects(count=ALL, message="1.2 m2 examined of 2.4 m2 of the design's surface", seed=1, places=288):
    """Defects of every class, a picture of two and the curve of one."""
    rng = np.random.default_rng(seed)
    side, shown = 5, min(count, 2)
    kinds = tuple(CLASSES[i % len(CLASSES)] for i in range(count))
    remarks = (
        "rays went through: as deep as the plate is thick",
        "at least so deep: too narrow for a beam to see its ground",
        "the design says no thickness here",
    )
    one = np.full(count, 1.5)
    return Defects(
        "ok", "default", message, np.eye(4), 0.1, 10.0, 0.5, 0.3, 1.2e6, 1.3e6, 288, 280,
        np.array([10.0, 20.0]), np.array([1.0, 0.5]), np.array([1.0, 1.2]),
        np.arange(count), kinds, np.full(count, 0.9), tuple(reversed(kinds)),
        tuple(f"component-{i + 1}" for i in range(count)),
        np.column_stack([rng.uniform(100.0, 1000.0, count), np.zeros(count), rng.uniform(50.0, 500.0, count)]),
        np.tile(np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]), (count, 1, 1)), np.full((count, 2), 120.0),
        9e3 * one, one, 0.2 * one, one, 1e4 * one, 1e3 * one, 50.0 * one, one, 0.2 * one, 9.0 * one, 1e-9 * one,
        tuple(remarks[i % 3] if i % 4 else "" for i in range(count)),
        np.zeros(4, np.int64), np.linspace(-200.0, 200.0, 4), one[:1].repeat(4), 0.1 * one[:1].repeat(4),
        np.arange(shown), np.full((shown, 2), side), np.full((shown, 2), -30.0), np.full(shown, 12.0),
        rng.normal(size=shown * side**2).astype(np.float32), (np.arange(shown * side**2) % 3 == 0).astype(np.int32),
        np.column_stack([rng.uniform(0.0, 1150.0, places), np.zeros(places), rng.uniform(0.0, 550.0, places)]),
        np.sin(np.arange(places)).astype(np.float32), np.where(np.arange(places) % 4, -1, np.arange(places) % count),
    )  # fmt: skip


def execution(*runs, names=("S1",)):
    """An execution of (step, method, result)."""
    return Execution(scene(names), tuple(StepRun(*one) for one in runs), PROVENANCE)
