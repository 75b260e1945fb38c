"""Paper 001: 100 bolt balls by RANSAC on raw crops of a scan, and by least squares on four points of a total station.

A raw crop holds all points about a node, those of sleeves and tubes too. The paper cuts them out by hand. In one ball
one point of the total station misses the ball and lies on what is behind it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from processor.geometry.neighbors import nearest_crops
from processor.geometry.sphere import algebraic, ransac
from processor.language.messages import Text, text
from processor.model import Floats, FrameDesign, Reason, reason
from processor.papers.charts import Chart
from processor.papers.data_sets import DataSet, Found, Measured
from processor.papers.rows import Row, Rule
from processor.scene_cloud import merged
from processor.space_frame import step
from processor.space_frame.params import Params
from processor.store import store

PAPER = "001"
BALLS = "100 balls"
STATION = "total station"
METHODS = (STATION, "least-squares", "ransac", "ray")
PUBLISHED = {("ransac", "radius, mean"), ("ransac", "radius, largest"), (STATION, "radius, median")}
NAN = float("nan")
STATION_SD_MM = 2.0  # of a coordinate of the total station without reflector
FOUR = 4
BLUNDER_ROW, BLUNDER_M = 97, (5.0, 15.0)  # the paper's ball 98; distance to what is behind the ball
LOWER = -0.2  # greatest height of a point that is sighted from below, in radii

# Tables 2 and 3: radii of the eight balls that are printed, m; the true radius is 0.045.
RANSAC_RADII_M = (0.0473, 0.0469, 0.0449, 0.0462, 0.0436, 0.0475, 0.0464, 0.0450)
STATION_RADII_M = (0.0480, 0.0492, 0.0441, 0.0456, 0.0474, 5.8790, 0.0523, 0.0490)
TRUE_RADIUS_M = 0.045


def data_sets(seed: int) -> list[DataSet]:
    """Return the data sets of one seed."""
    return [DataSet(PAPER, BALLS, "balls-100", (), seed)]


def measure(path: Path, data_set: DataSet) -> Measured:
    """Fit all balls of a scene by each method; errors are against the design, as which the balls are built."""
    scene = store.read_scene(path)
    design = scene.frame
    assert design is not None
    params = Params()
    cloud = merged(scene, with_scanner=False)
    crops = nearest_crops(cloud.points, design.centres - cloud.origin, design.radii + params.crop_margin_mm)
    found = {method: np.full((len(design.radii), 4), np.nan) for method in METHODS}
    found[STATION] = _by_total_station(design, np.random.default_rng([data_set.seed, 1]))
    trials, used = [], []
    for i, rows in enumerate(crops):
        crop = cloud.points[rows] + (cloud.origin - design.centres[i])
        if (sphere := algebraic(crop)) is not None:
            found["least-squares"][i] = (*(sphere.centre + design.centres[i]), sphere.radius)
        generator = np.random.default_rng([data_set.seed, 2, i])
        consensus = ransac(crop, generator, params.tau_mm, params.probability, params.max_iterations)
        if consensus is not None:
            found["ransac"][i] = (*(consensus.sphere.centre + design.centres[i]), consensus.sphere.radius)
            trials.append(consensus.trials)
            used.append(float(consensus.inliers.mean()))
    found["ray"] = _by_ray(step.run(scene, Params(seed=data_set.seed)), design)
    figures = {"trials, median": float(np.median(trials)), "trials, most": float(max(trials))}
    figures["points used, share"] = float(np.median(used))
    series = {}
    for method, spheres in found.items():
        errors = spheres[:, 3] - design.radii
        series[method] = np.abs(errors).tolist()
        figures |= _of_errors(method, errors, _lowest(spheres) - (design.centres[:, 2] - design.radii))
    figures["blunder, m"] = float(found[STATION][_wrong(len(crops)), 3]) / 1000.0
    return Measured(data_set, figures, series)


def _by_total_station(design: FrameDesign, rng: np.random.Generator) -> Floats:
    """Return centre and radius (k, 4) fitted to four points per ball, sighted from below; one is a blunder."""
    found = np.full((len(design.radii), 4), np.nan)
    for i, (centre, radius) in enumerate(zip(design.centres, design.radii.tolist(), strict=True)):
        directions = rng.normal(size=(200, 3))
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        points = radius * directions[directions[:, 2] < LOWER][:FOUR] + STATION_SD_MM * rng.normal(size=(FOUR, 3))
        if i == _wrong(len(found)):
            points[0] = 1000.0 * rng.uniform(*BLUNDER_M) * np.array([0.6, 0.0, 0.8])
        if (sphere := algebraic(points)) is not None:
            found[i] = (*(sphere.centre + centre), sphere.radius)
    return found


def _wrong(balls: int) -> int:
    """Row of the ball with the wrong point."""
    return min(BLUNDER_ROW, balls - 1)


def _by_ray(result: step.Result, design: FrameDesign) -> Floats:
    found = np.full((len(design.radii), 4), np.nan)
    row_of = {int(id_): row for row, id_ in enumerate(design.ids)}
    for id_, centre, radius in zip(result.balls.ids.tolist(), result.balls.centres, result.balls.radii, strict=True):
        if id_ in row_of:
            found[row_of[id_]] = (*centre, radius)
    return found


def _lowest(spheres: Floats) -> Floats:
    lowest: Floats = spheres[:, 2] - spheres[:, 3]
    return lowest


def _of_errors(method: str, radius: Floats, lowest: Floats) -> dict[str, float]:
    """Return figures of errors (k,) of radii and of lowest points; the ball of the blunder counts in the largest."""
    size = np.abs(radius[np.isfinite(radius)])
    low = np.abs(lowest[np.isfinite(lowest)])
    return {
        f"{method}: radius, mean": float(np.mean(size[size < 1000.0])),
        f"{method}: radius, median": float(np.median(size)),
        f"{method}: radius, largest": float(size.max()),
        f"{method}: lowest point, median": float(np.median(low)),
        f"{method}: lowest point, largest": float(low.max()),
        f"{method}: found": float(len(size)),
    }


def rows(found: Found) -> list[Row]:
    """Return the rows of tables 2 and 3 and of figures 2 and 4, then ours."""
    printed = 1000.0 * np.abs(np.array(RANSAC_RADII_M) - TRUE_RADIUS_M)
    surveyed = 1000.0 * np.abs(np.array(STATION_RADII_M) - TRUE_RADIUS_M)
    usual = surveyed[surveyed < 1000.0]
    blunder = max(STATION_RADII_M)
    crops, four = reason("papers.balls-raw-crops"), reason("papers.balls-four-points", sd=STATION_SD_MM)
    table_2, table_3 = text("table {number}", number="2"), text("table {number}", number="3")
    figure_2, figure_4 = text("figure {number}", number="2"), text("figure {number}", number="4")
    mean, largest = text("radius error, mean"), text("radius error, largest")
    better, lowest = text("radius error smaller than by the other method"), text("lowest point, error, median")
    over = {name: found.values(BALLS, name) for name in _names(found)}

    def compared(figure: str, than: str) -> tuple[float, ...]:
        pairs = zip(over.get(f"ransac: {figure}", ()), over.get(f"{than}: {figure}", ()), strict=True)
        return tuple(float(ours < other) for ours, other in pairs)

    made = [
        _row(table_2, "ransac", mean, printed.mean(), over.get("ransac: radius, mean"), Rule.AT_MOST, crops),
        _row(table_2, "ransac", largest, printed.max(), over.get("ransac: radius, largest"), Rule.AT_MOST, crops),
        _row(
            table_3, STATION, text("radius error, median"), float(np.median(usual)),
            over.get(f"{STATION}: radius, median"), Rule.NEAR, four,
        ),
        _row(
            table_3, STATION, text("radius of the ball with one wrong point"), blunder, over.get("blunder, m"),
            Rule.MAGNITUDE, reason("papers.balls-blunder", nearest=BLUNDER_M[0], farthest=BLUNDER_M[1]), "m",
        ),
        _row(
            figure_2, f"ransac, {STATION}", better, 1.0, compared("radius, median", STATION), Rule.HOLDS,
            reason("papers.balls-order-station"), "",
        ),
        _row(
            figure_2, "ransac, least-squares", better, 1.0, compared("radius, median", "least-squares"), Rule.HOLDS,
            reason("papers.balls-order-crops"), "",
        ),
        _row(
            figure_4, "ransac", text("balls with a lowest point"), 1040.0, (), Rule.NONE,
            reason("papers.balls-weekend"), "",
        ),
    ]  # fmt: skip
    own = reason("papers.beside")
    for method in METHODS:
        made += [
            _row(figure_2, method, quantity, NAN, over.get(f"{method}: {name}"), Rule.AT_MOST, own)
            for quantity, name in ((mean, "radius, mean"), (largest, "radius, largest"))
            if (method, name) not in PUBLISHED
        ]
        made.append(_row(figure_4, method, lowest, NAN, over.get(f"{method}: lowest point, median"), Rule.AT_MOST, own))
    adaptive = reason("papers.balls-trials", probability=Params().probability, most=Params().max_iterations)
    for quantity, name in ((text("trials, median"), "trials, median"), (text("trials, most"), "trials, most")):
        made.append(
            _row(text("table {number}", number="1"), "ransac", quantity, NAN, over.get(name), Rule.NEAR, adaptive, "")
        )
    return made


def _names(found: Found) -> set[str]:
    return {name for one in found.of(BALLS) for name in one.figures}


def _row(
    place: Text, method: str, quantity: Text, published: float, values: tuple[float, ...] | None, rule: Rule,
    why: Reason, unit: str = "mm",
) -> Row:  # fmt: skip
    return Row(
        paper=PAPER, place=place, data=BALLS, method=method, quantity=quantity, unit=unit, published=float(published),
        values=values or (), rule=rule, reason=why,
    )  # fmt: skip


def charts(found: Found) -> list[Chart]:
    """Return figure 2 in kind: the radius errors of every ball, by method, of the first seed."""
    lines = [(method, found.series(BALLS, method)) for method in METHODS]
    chart = Chart(
        title=text("figure {number} of paper {paper}", number="2", paper=PAPER),
        x=text("ball"), y=text("radius error, mm"), lines=tuple(line for line in lines if line[1]), logarithmic=True,
    )  # fmt: skip
    return [chart] if chart.lines else []
