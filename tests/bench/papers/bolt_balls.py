"""Paper 001: 100 bolt balls by RANSAC on raw crops of a scan, and by least squares on four points of a total station.

A raw crop holds all points about a node, those of sleeves and tubes too. The paper cuts them out by hand. In one ball
one point of the total station misses the ball and lies on what is behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from processor import diagnostics
from processor.geometry import rigid
from processor.geometry.nearest_neighbours import nearest_crops
from processor.geometry.sphere import algebraic, ransac
from processor.language.messages import Text, text
from processor.model import Floats, FrameDesign, Ints, Reason, reason
from processor.report.charts.line_chart import Chart
from processor.scene_cloud import MergedCloud, merged
from processor.space_frame import step
from processor.space_frame.params import Params
from processor.store import store
from tests.bench.papers.data_sets import DataSet, Found, Measured
from tests.bench.papers.rows import Row, Rule, is_smaller, median

PAPER = "001"
BALLS = "100 balls"
STATION = "total station"
METHODS = (STATION, "least-squares", "ransac", "ray")
PUBLISHED = {("ransac", "radius, mean"), ("ransac", "radius, largest"), (STATION, "radius, median")}
NAN = float("nan")
STATION_SD_MM = 2.0  # of a coordinate of the total station without reflector
FOUR = 4
BLUNDER_ROW, BLUNDER_M = 97, (5.0, 15.0)  # the paper's ball 98; distance to what is behind the ball
BLUNDER_MM = 1000.0  # an error of a radius that is one
ROOF, ROOF_BALLS, ROOF_SPACING_MM = "1040 balls", 1040.0, 6.0
LOWEST_MM = 5.0  # error of a lowest point beyond which it is of no use for a ceiling
LOWER = -0.2  # greatest height of a point that is sighted from below, in radii

# Tables 2 and 3: radii of the eight balls that are printed, m; the true radius is 0.045.
RANSAC_RADII_M = (0.0473, 0.0469, 0.0449, 0.0462, 0.0436, 0.0475, 0.0464, 0.0450)
STATION_RADII_M = (0.0480, 0.0492, 0.0441, 0.0456, 0.0474, 5.8790, 0.0523, 0.0490)
TRUE_RADIUS_M = 0.045
PRINTED = (1, 2, 3, 4, 97, 98, 99, 100)  # numbers of these balls
# Their centres, m.
RANSAC_CENTRES_M = (
    (12.2826, 11.3622, 3.07601), (12.4765, 9.6414, 3.04382), (11.6625, 9.0698, 3.19912), (9.8151, 11.9422, 2.92174),
    (10.1226, 14.9541, 3.16862), (9.89898, 15.6271, 3.20319), (10.8444, 14.4996, 3.21283), (10.9091, 12.6175, 3.08354),
)  # fmt: skip
STATION_CENTRES_M = (
    (12.2901, 11.3583, 3.0700), (12.4731, 9.6490, 3.0418), (11.6672, 9.0700, 3.2000), (9.8200, 11.9475, 2.9272),
    (10.1298, 14.9571, 3.1613), (9.8913, 15.6212, 3.2082), (10.8412, 14.4915, 3.2198), (10.9012, 12.6112, 3.0888),
)  # fmt: skip


def data_sets(seed: int) -> list[DataSet]:
    """Return the data sets of one seed: the balls of tables 2 and 3, and as many balls as in figure 4.

    These are scanned near the nodes alone, at a lower density than the paper's 12.2 million points.
    """
    near = ("frame.nodes_x=26", "frame.nodes_y=40", f"scan.spacing_mm={ROOF_SPACING_MM}")
    return [DataSet(PAPER, BALLS, "balls-100", (), seed), DataSet(PAPER, ROOF, "balls-100", near, seed)]


def measure(path: Path, data_set: DataSet) -> Measured:
    """Fit all balls of a scene by each method; errors are against the design, as which the balls are built."""
    scene = store.read_scene(path)
    design = scene.frame
    assert design is not None
    params = Params()
    cloud = merged(scene, with_scanner=False)
    crops = nearest_crops(cloud.points, design.centres - cloud.origin, design.radii + params.crop_margin_mm)
    if data_set.name == ROOF:
        return Measured(data_set, _of_roof(cloud, crops, design, params, data_set.seed))
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
            with (
                diagnostics.at(f"ball {design.ids[i]}"),
                diagnostics.placed(rigid.transform(np.eye(3), design.centres[i]), "project"),
            ):
                diagnostics.note("consensus", trials=trials[-1], points=len(rows), inliers_share=used[-1])
                diagnostics.keep("consensus", crop[consensus.inliers])
    found["ray"] = _by_ray(step.run(scene, Params(seed=data_set.seed)), design)
    figures = {"trials, median": float(np.median(trials)), "trials, most": float(max(trials))}
    figures["points used, share"] = float(np.median(used))
    series = {}
    for method, spheres in found.items():
        errors = spheres[:, 3] - design.radii
        series[method] = np.abs(errors).tolist()
        figures |= _of_errors(method, errors, _lowest(spheres) - (design.centres[:, 2] - design.radii))
    apart = np.linalg.norm(found["ransac"][:, :3] - found[STATION][:, :3], axis=1)
    figures["centres apart"] = float(np.nanmedian(apart))
    figures["centres apart, blunder"] = float(apart[_wrong(len(apart))])
    for ball in PRINTED:
        for method in ("ransac", STATION):
            if ball <= len(design.radii):
                figures[f"{method}: ball {ball}"] = abs(float(found[method][ball - 1, 3] - design.radii[ball - 1]))
    figures["blunder, m"] = float(found[STATION][_wrong(len(crops)), 3]) / 1000.0
    return Measured(data_set, figures, series)


def _of_roof(
    cloud: MergedCloud, crops: Sequence[Ints], design: FrameDesign, params: Params, seed: int
) -> dict[str, float]:
    """Return how many balls of a roof get a lowest point by RANSAC within LOWEST_MM of the true one, and the errors."""
    errors = np.full(len(crops), np.nan)
    for i, rows in enumerate(crops):
        crop = cloud.points[rows] + (cloud.origin - design.centres[i])
        generator = np.random.default_rng([seed, 2, i])
        consensus = ransac(crop, generator, params.tau_mm, params.probability, params.max_iterations)
        if consensus is not None:
            sphere = consensus.sphere
            errors[i] = abs(float(sphere.centre[2] - sphere.radius + design.radii[i]))
    return {"balls": float((errors <= LOWEST_MM).sum()), "lowest point, median": float(np.nanmedian(errors))}


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
        f"{method}: radius, mean": float(np.mean(size[size < BLUNDER_MM])),
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
    usual = surveyed[surveyed < BLUNDER_MM]
    blunder = max(STATION_RADII_M)
    crops, four = reason("papers.balls-raw-crops"), reason("papers.balls-four-points", sd=STATION_SD_MM)
    table_2, table_3 = text("table {number}", number="2"), text("table {number}", number="3")
    figure_2, figure_4 = text("figure {number}", number="2"), text("figure {number}", number="4")
    mean, largest = text("radius error, mean"), text("radius error, largest")
    better = text("radius error smaller than by the other method")
    over = {name: found.values(BALLS, name) for name in _names(found)}

    def compared(figure: str, than: str) -> tuple[float, ...]:
        return is_smaller(found.values(BALLS, f"ransac: {figure}"), found.values(BALLS, f"{than}: {figure}"))

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
            figure_4, "ransac", text("balls with a lowest point"), ROOF_BALLS, found.values(ROOF, "balls"), Rule.NEAR,
            reason("papers.balls-roof", error=LOWEST_MM, spacing=ROOF_SPACING_MM), "", ROOF,
        ),
        _row(
            figure_4, "ransac", text("lowest point, error, median"), NAN, found.values(ROOF, "lowest point, median"),
            Rule.AT_MOST, reason("papers.beside"), "mm", ROOF,
        ),
    ]  # fmt: skip
    made += _by_ball(table_2, table_3, over)
    between = 1000.0 * np.linalg.norm(np.array(RANSAC_CENTRES_M) - np.array(STATION_CENTRES_M), axis=1)
    made += [
        _row(
            table_3, f"ransac, {STATION}", text("distance of the centres of both methods, median"),
            float(np.median(between)), over.get("centres apart"), Rule.NEAR,
            reason("papers.balls-centres", sd=STATION_SD_MM),
        ),
        _row(
            table_3, f"ransac, {STATION}", text("distance of the centres of the ball with one wrong point"),
            float(between[np.argmax(STATION_RADII_M)]), over.get("centres apart, blunder"), Rule.AT_MOST,
            reason("papers.balls-blunder-centre"),
        ),
    ]  # fmt: skip
    return [*made, *_beside(over)]


def _beside(over: dict[str, tuple[float, ...]]) -> list[Row]:
    """Rows of numbers that the paper does not state: other methods, lowest points, trials."""
    figure_2, figure_4 = text("figure {number}", number="2"), text("figure {number}", number="4")
    mean, largest = text("radius error, mean"), text("radius error, largest")
    lowest = text("lowest point, error, median")
    made: list[Row] = []
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


def _by_ball(table_2: Text, table_3: Text, over: dict[str, tuple[float, ...]]) -> list[Row]:
    """Rows of the balls that are printed in tables 2 and 3; the ball of the blunder has a row of its own."""
    made = []
    for place, method, radii in ((table_2, "ransac", RANSAC_RADII_M), (table_3, STATION, STATION_RADII_M)):
        usual = median(over.get(f"{method}: radius, median", ()))
        single, four = reason("papers.balls-single", median=usual), reason("papers.balls-single-four", median=usual)
        why = single if method == "ransac" else four
        for ball, radius in zip(PRINTED, radii, strict=True):
            error = 1000.0 * abs(radius - TRUE_RADIUS_M)
            if error < BLUNDER_MM:
                quantity, values = text("radius error of ball {ball}", ball=ball), over.get(f"{method}: ball {ball}")
                made.append(_row(place, method, quantity, error, values, Rule.AT_MOST, why))
    return made


def _names(found: Found) -> set[str]:
    return {name for one in found.of(BALLS) for name in one.figures}


def _row(
    place: Text, method: str, quantity: Text, published: float, values: tuple[float, ...] | None, rule: Rule,
    why: Reason, unit: str = "mm", data: str = BALLS,
) -> Row:  # fmt: skip
    return Row(
        paper=PAPER, place=place, data=data, method=method, quantity=quantity, unit=unit, published=float(published),
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
