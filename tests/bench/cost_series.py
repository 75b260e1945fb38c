"""What the bench of the costs varies: scenes of growing size for every step, and for ``compare``."""

from __future__ import annotations

from dataclasses import dataclass

POINTS, PER_SCAN, SCANS, PARTS, BALLS, CELLS = "points", "points a scan", "scans", "parts", "balls", "cells"
COMPARE = "compare"


@dataclass(frozen=True)
class Size:
    """A scene by its settings, the parameters of its run (TOML), and its size where nothing else tells it."""

    settings: tuple[str, ...]
    parameters: str = ""
    count: int = 0


@dataclass(frozen=True)
class Series:
    """Runs of a step on scenes of one recipe, of which one number grows; ``held`` says what stays, or grows along."""

    step: str
    over: str
    recipe: str
    held: str
    sizes: tuple[Size, ...]
    settings: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Step and what varies, as ``--only`` takes it."""
        return f"{self.step}/{self.over.replace(' ', '-')}"


def varied(key: str, *values: float) -> tuple[Size, ...]:
    """Sizes by one key of the recipe."""
    return tuple(Size((f"{key}={value}",)) for value in values)


def roof(nodes_x: int, nodes_y: int, stations: str) -> Size:
    """A double-layer roof of the density of frame-1040."""
    balls = nodes_x * nodes_y + (nodes_x - 1) * (nodes_y - 1)
    settings = (f"frame.nodes_x={nodes_x}", f"frame.nodes_y={nodes_y}", f"scan.stations={stations}")
    return Size(settings, count=balls)


def cells(side_mm: float) -> Size:
    """The same points by cells of another side."""
    return Size((), f"[defects]\ncell_mm = {side_mm}\n")


# The smallest scene of each step: the rest of its run is the start of the program and the report.
SMALLEST = {
    "spheres": ("bolt-ball", ("scan.step_mrad=2.0",)),
    "preassemble": (
        "arch-s7",
        ("bridge.parts=2", "bridge.span_mm=12000.0", "bridge.rise_mm=3000.0", "scan.spacing_mm=25"),
    ),
    "stitch": ("truss-bridge", ("scan.step_mrad=10", "scan.stations=3", "scan.repeated=0")),
    "deviation": ("stadium-roof", ("structure.trusses=4", "structure.bays=1", "scan.spacing_mm=120")),
    "defects": ("plates-defects", ('structure.components=["none", "dent"]', "scan.step_mrad=6")),
    COMPARE: ("", ()),
}
# Steps that the step measured needs; their time is in its run, and in that of the smallest scene.
STEPS = {"defects": "deviation,defects"}
PLATES = ('structure.components=["none", "dent", "bulge", "pit"]',)
ROOF = ("frame.nodes_x=6", "frame.nodes_y=6", "scan.stations=[2,3]", "scan.clutter=8")
SERIES = (
    Series(
        "spheres", POINTS, "frame-1040", "61 balls, 6 stations", varied("scan.step_mrad", 2.4, 1.7, 1.2, 0.85), ROOF
    ),
    Series(
        "spheres", BALLS, "frame-1040", "balls a station and step of the scans: points grow along",
        (roof(8, 8, "[2,2]"), roof(8, 16, "[2,4]"), roof(16, 16, "[4,4]"), roof(16, 32, "[4,8]")),
        ("scan.step_mrad=2.4", "scan.clutter=20"),
    ),
    Series("preassemble", POINTS, "arch-s7", "7 parts", varied("scan.spacing_mm", 20.0, 14.0, 10.0, 7.0)),
    Series(
        "preassemble", PARTS, "arch-s7", "one bridge, cut into more parts",
        tuple(Size((f"bridge.parts={parts}",), count=parts) for parts in (4, 8, 16)),
        ("scan.spacing_mm=14",),
    ),
    Series("stitch", PER_SCAN, "truss-bridge", "9 scans", varied("scan.step_mrad", 7.4, 5.2, 3.7)),
    Series(
        "stitch", SCANS, "truss-bridge", "step of the scans: points grow along",
        tuple(Size((f"scan.stations={stations}",)) for stations in (3, 6, 12)),
        ("scan.repeated=0", "scan.step_mrad=5.2"),
    ),
    Series("deviation", POINTS, "stadium-roof", "the roof", varied("scan.spacing_mm", 44.0, 31.0, 22.0, 15.5)),
    Series("defects", POINTS, "plates-defects", "4 plates", varied("scan.step_mrad", 2.0, 1.4, 1.0, 0.7), PLATES),
    Series(
        "defects", CELLS, "plates-defects", "4 plates and their points",
        (cells(16.0), cells(11.3), cells(8.0), cells(5.7)), (*PLATES, "scan.step_mrad=1.0"),
    ),
    Series(
        COMPARE, POINTS, "", "points per area; each point of the first cloud a core point",
        tuple(Size((), count=count) for count in (250_000, 500_000, 1_000_000, 2_000_000)),
    ),
)  # fmt: skip
