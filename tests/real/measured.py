"""Real data: what was measured in real scans and files, against what, how far, inside or not.

``make real`` prints the table and writes it as JSON; a set that is not on the machine is listed as absent. What each
set is, whose, and under which licence: docs/real.md.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import re
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import trimesh

import processor
from processor.model import Scene, Status
from processor.targets import find

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "../shared/data"  # data that may be passed on
OTHERS = Path(os.environ.get("REAL_DATA", ROOT / "../real-data"))  # data that may be measured and not copied
TARGET_MM = 100.0  # side of the search for round targets of 115 mm: docs/scan-folder.md


class Row(NamedTuple):
    """A value measured in a set, the value it is held against, and how far from it is allowed (by a rule or request).

    Without an expected value the figure is for information.
    """

    set: str
    what: str
    value: float
    against: str = ""
    expected: float = float("nan")
    allowed: float = float("nan")
    flagged: bool = False

    @property
    def verdict(self) -> str:
        """Whether the value is as near as allowed, or if not whether the answer says so itself."""
        if np.isnan(self.expected):
            return ""
        if abs(self.value - self.expected) <= self.allowed:
            return "inside"
        return "flagged" if self.flagged else "OUTSIDE"


class AbsentError(Exception):
    """A set is not on this machine."""


def at_hand(*files: Path) -> tuple[Path, ...]:
    """Return the files; AbsentError where one is not on this machine."""
    for file in files:
        if not file.exists():
            raise AbsentError(str(file.name))
    return files


def nist_spheres() -> Iterator[Row]:
    """Yield centres and radii of three balls of 50 mm, against those of a reference algorithm."""
    published = {
        "SPH101": (-5895.833, 3628.939, -1561.255),
        "SPH102": (-4510.108, -6758.343, -1576.506),
        "SPH103": (-3508.773, 5865.925, -1570.917),
    }
    for name, centre in published.items():
        (file,) = at_hand(DATA / "spheres" / f"{name}.xyz")
        points = 1000.0 * np.loadtxt(file)
        held = processor.fit_sphere(points, radius=50.0, scanner=np.zeros(3))
        free = processor.fit_sphere(points, scanner=np.zeros(3))
        off = float(np.linalg.norm(held.centre - centre))
        yield Row(name, "centre, radius held, mm off", off, "reference algorithm", 0.0, 0.1)
        sd = float(np.sqrt(free.covariance[3, 3]))
        yield Row(name, "radius, mm", free.radius, "nominal, 1.96 sd", 50.0, 1.96 * sd)


def column() -> Iterator[Row]:
    """Yield sides, deviation and defects of a welded column of 16 sides, against its labelled facets."""
    (file,) = at_hand(DATA / "steel_column" / "column_mm.csv")
    table = np.loadtxt(file, delimiter=",", skiprows=1)
    results = column_results(table[:, :3])
    widths, flat = labelled_sides(table[:, :3], table[:, 3].astype(int))
    found = results.steps["inspect"].components[0].characteristics
    value = dict(zip(found.id, found.actual, strict=True))
    ours = {what: np.array([value[f"side-{k + 1}-{what}"] for k in range(16)]) for what in ("width", "flatness")}
    # Which side is which facet: the widest tells, and the sense in which sides are counted.
    ways = [np.roll(np.arange(16)[::sense], turn) for sense in (1, -1) for turn in range(16)]
    way = min(ways, key=lambda way: float(np.std(ours["width"] - widths[way])))
    worst = float(np.abs(ours["width"] - widths[way]).max())
    yield Row("steel column", "widths of sides, worst, mm off", worst, "planes of labels", 0.0, 0.3)
    off = np.abs(ours["flatness"] - flat[way])
    yield Row("steel column", "flatness of sides, median, mm off", float(np.median(off)), "planes of labels", 0.0, 0.05)
    yield Row("steel column", "flatness of sides, worst, mm off", float(off.max()))
    yield Row("steel column", "defects", float(len(results.steps["defects"].defects)), "none", 0.0, 0.0)
    yield Row("steel column", "characteristics measured", float(np.isfinite(found.actual).sum()))


def column_results(points: npt.NDArray[np.float64]) -> processor.Results:
    """Return the run of the column's scan against a prism with the mean of its apothems."""
    mesh = trimesh.creation.cylinder(132.40 / np.cos(np.pi / 16.0), 680.0, sections=16)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 16.0, [0.0, 0.0, 1.0]))
    mesh.apply_translation([0.0, 0.0, 340.0])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.savetxt(folder / "column.xyz", points, fmt="%.5f")
        mesh.export(folder / "design.ply")
        (folder / "project.toml").write_text('units = "mm"\ndesign = "design.ply"\n[[scan]]\nfile = "column.xyz"\n')
        return processor.run(folder, steps=["deviation", "inspect", "defects"])


def labelled_sides(
    points: npt.NDArray[np.float64], label: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return width and flatness (16,) of the labelled facets around the column, by least squares planes.

    A width is that between the lines in which neighbouring planes meet at mid-height, flatness the greatest less the
    least mean departure over squares of a quarter of the facet's labelled width.
    """
    planes = []
    for k in range(1, 17):
        own = points[label == k]
        centre = own.mean(axis=0)
        normal = np.linalg.svd(own - centre, full_matrices=False)[2][2]
        planes.append((normal * np.sign(normal[:2] @ centre[:2]), centre, own))
    planes.sort(key=lambda plane: np.arctan2(plane[0][1], plane[0][0]))
    up = np.array([0.0, 0.0, 1.0])
    corners = [
        np.linalg.solve(np.stack([a, b, up]), [a @ at, b @ of, 340.0])
        for (a, at, _), (b, of, _) in zip(planes, planes[1:] + planes[:1], strict=True)
    ]
    widths = np.linalg.norm(np.array(corners) - np.roll(corners, 1, axis=0), axis=1)
    flat = []
    for normal, centre, own in planes:
        place = np.stack([own @ np.cross(up, normal), own[:, 2]], axis=1)
        place -= place.min(axis=0)
        square = np.floor(place / (np.ptp(place[:, 0]) / 3.999)).astype(int) @ [1, 4]
        off = (own - centre) @ normal
        flat.append(np.ptp([off[square == k].mean() for k in np.unique(square) if (square == k).sum() > 20]))
    return widths, np.array(flat)


def planes() -> Iterator[Row]:
    """Yield the distance of two noisy planes that are 0.1 apart, in the unit of the file."""
    first, second = (
        np.loadtxt(file) for file in at_hand(*(DATA / "m3c2" / f"plane_horizontal_t{epoch}.xyz" for epoch in (1, 2)))
    )
    table = processor.m3c2(first, second, normal_diameter=4.0, projection_diameter=4.0, max_depth=2.0)
    inner = np.isfinite(table.lod95)
    yield Row("m3c2 planes", "mean distance", float(table.distance[inner].mean()), "as made", -0.1, 0.002)


def rooms() -> Iterator[Row]:
    """Yield the pose of a room scan on another, against the odometry of the robot that scanned them.

    The odometry is a start of a tutorial and no truth: some centimetres and a degree or two are its own.
    """
    files = at_hand(*(DATA / "pcd" / f"room_scan{k}.pcd" for k in (1, 2)))
    with tempfile.TemporaryDirectory() as name:
        for file in files:
            (Path(name) / file.name).write_bytes(file.read_bytes())
        stitched = processor.run(Path(name), steps="stitch").steps["stitch"]
    T = np.linalg.inv(stitched.scans.T_project_scan[0]) @ stitched.scans.T_project_scan[1]
    flagged = stitched.scans.status[1] is not Status.OK
    for what, value, expected, allowed in (
        ("turn of the second scan, rad", float(np.arctan2(T[1, 0], T[0, 0])), 0.6931, 0.035),
        ("x of the second scan, mm", float(T[0, 3]), 1793.87, 100.0),
        ("y of the second scan, mm", float(T[1, 3]), 720.05, 100.0),
    ):
        yield Row("room scans", what, value, "odometry", expected, allowed, flagged)


def long_range_balls() -> Iterator[Row]:
    """Yield radii and distance of two balls of a long-range scanner, each from two stations."""
    folder = OTHERS / "terrestrial_laserscanning" / "data"
    fits = {}
    for station, ball in itertools.product((1, 2), (2, 3)):
        (file,) = at_hand(folder / f"SP{station}_Scan00{ball}_sphere.txt")
        fits[station, ball] = processor.fit_sphere(1000.0 * np.loadtxt(file, delimiter=","), instrument="long-range")
    for ball in (2, 3):
        one, other = fits[1, ball], fits[2, ball]
        sd = np.sqrt(one.covariance[3, 3] + other.covariance[3, 3])
        off = float(one.radius - other.radius)
        yield Row(f"long-range ball {ball}", "radii from two stations, mm apart", off, "2 sd", 0.0, 2.0 * float(sd))
    apart = [float(np.linalg.norm(fits[station, 2].centre - fits[station, 3].centre)) for station in (1, 2)]
    yield Row("long-range balls", "distances from two stations, mm apart", apart[0] - apart[1], "5 ppm", 0.0, 1.0)


def targets() -> Iterator[Row]:
    """Yield repeats and distances of four round targets from two stations, in units of what is stated of them."""
    folder = OTHERS / "TLS_Ue1" / "data" / "Targets"
    at_hand(folder)
    seen: dict[tuple[str, str], list[tuple[npt.NDArray[np.float64], float]]] = {}
    files = sorted(folder.glob("SP*/T*.txt"))
    for file in files:
        found = find.with_targets(_target_scene(file)).targets
        if found is not None and len(found.sd) == 1:
            key = file.parent.name, re.sub(r"\..*", "", file.stem)
            seen.setdefault(key, []).append((found.places[0], float(found.sd[0])))
    count = sum(map(len, seen.values()))
    yield Row("round targets", "found", float(count), "crops", float(len(files)), 0.0)
    pulls = []
    for key, one in seen.items():
        places = np.array([place for place, _ in one])
        repeats = np.sqrt(np.sum((places - places.mean(axis=0)) ** 2) / max(len(one) - 1, 1) / 3.0)
        yield Row(f"target {key[1]} from {key[0]}", "scatter of repeats, mm an axis", float(repeats))
    for first, second in itertools.combinations(sorted({name for _, name in seen}), 2):
        apart, variance = [], 0.0
        for station in ("SP1", "SP2"):
            ends = [seen[station, name] for name in (first, second)]
            means = [np.mean([place for place, _ in end], axis=0) for end in ends]
            apart.append(float(np.linalg.norm(means[0] - means[1])))
            variance += sum(end[0][1] ** 2 for end in ends)
        pulls.append((apart[0] - apart[1]) / np.sqrt(variance))
        yield Row(f"targets {first}-{second}", "distances from two stations, mm apart", apart[0] - apart[1],
                  "2.5 sd as stated", 0.0, 2.5 * float(np.sqrt(variance)))  # fmt: skip
    yield Row(
        "round targets", "rms of differences of distances by stated sd", float(np.sqrt(np.mean(np.square(pulls))))
    )


def _target_scene(file: Path) -> Scene:
    """Return the crop of a target as a scene that is searched for it."""
    table = np.loadtxt(file, comments="//")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.savetxt(folder / "target.txt", table[:, [0, 1, 2, 6]], header="x y z intensity", comments="", fmt="%.8f")
        (folder / "project.toml").write_text(
            f'units = "m"\n[targets]\ncheckerboard_mm = {TARGET_MM}\n[[scan]]\nfile = "target.txt"\n'
        )
        return processor.read(folder)


def steel_files() -> Iterator[Row]:
    """Yield what is read of real design files: a plate in two STEP dialects, the steelwork of a building as IFC."""
    at_hand(DATA / "design")
    import cadquery  # it takes a second

    for dialect in ("AP203", "AP214"):
        (file,) = at_hand(DATA / "design" / f"base_interface_{dialect}.STEP")
        solid = cadquery.importers.importStep(str(file)).val()
        yield Row(f"plate, {dialect}", "volume, mm3", float(solid.Volume()), "known", 1.25799e6, 5.0)
    (file,) = at_hand(DATA / "design" / "schependomlaan-steel.ifczip")
    with zipfile.ZipFile(file) as archive:
        text = archive.read(archive.namelist()[0]).decode("latin-1")
    products = len(re.findall(r"=\s*IFC(?:BEAM|COLUMN|PLATE|MEMBER|BUILDINGELEMENTPROXY)\(", text))
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / "meshes"
        subprocess.run([sys.executable, "-m", "designgen", "import", str(file), "-o", str(out)], check=True,
                       capture_output=True)  # fmt: skip
        yield Row("steelwork, IFC", "bodies", float(len(list(out.glob("*.ply")))), "products", float(products), 0.0)


SETS: tuple[Callable[[], Iterator[Row]], ...] = (
    nist_spheres, column, planes, rooms, steel_files, long_range_balls, targets,
)  # fmt: skip


def table(sets: tuple[Callable[[], Iterator[Row]], ...] = SETS) -> tuple[list[Row], list[str]]:
    """Return the rows of all sets at hand, and the names of those that are absent."""
    rows: list[Row] = []
    absent: list[str] = []
    for of in sets:
        try:
            rows += list(of())
        except AbsentError as missing:
            absent.append(f"{of.__name__.replace('_', ' ')}: {missing} is not on this machine")
    return rows, absent


def main() -> int:
    """Print the table, and write it if asked; 4 where a value is outside."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output", type=Path, help="write the table as JSON")
    arguments = parser.parse_args()
    rows, absent = table()
    for row in rows:
        bound = "" if np.isnan(row.expected) else f"{row.expected:.10g} +- {row.allowed:.3g} ({row.against})"
        print(f"{row.set:<24} {row.what:<48} {row.value:14.4f}  {bound:<44} {row.verdict}")
    for missing in absent:
        print(f"absent: {missing}")
    if arguments.output is not None:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        lines = [{**row._asdict(), "verdict": row.verdict} for row in rows]
        arguments.output.write_text(json.dumps({"rows": lines, "absent": absent}, indent=1), "utf-8")
    return 4 if any(row.verdict == "OUTSIDE" for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
