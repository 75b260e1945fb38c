"""Missing material in clouds merged from unknown stations; points and shadows in closed form."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.stats import poisson

from processor.defects import regions, surface_charts
from processor.defects import step as defects_step
from processor.model import Scan, Scene, StructureDesign
from tests.support.clouds.plate_rows import box
from tests.support.scenes.at_design import AT_DESIGN

# A web with two ribs on either side; the last is a box that stands on the floor by itself.
WEB = ((0.0, -150.0, 0.0), (1700.0, 150.0, 800.0))
RIBS = [((x, y, 60.0), (x + 14.0, y + 160.0, 700.0)) for x in (400.0, 1200.0) for y in (-310.0, 150.0)]
BOXES = [WEB, *RIBS, ((0.0, 700.0, 0.0), (400.0, 900.0, 500.0))]
STATIONS = np.array(
    [[-2500.0, -3000, 2500], [4200, -2800, 2600], [850, -3500, -800], [-2400, 3000, 2400], [4100, 3100, -700],
     [-300, 3600, 2700]]
)  # fmt: skip
NOTCH = ((300.0, 230.0, 620.0), (500.0, 320.0, 710.0))  # the outer corner of a rib
SPACING = 9.0


def on_boxes(boxes, rng):
    """Points (n, 3) spread over the sides of boxes, and their normals (n, 3)."""
    points, normals = [], []
    for low, high in np.array(boxes):
        for axis in range(3):
            others = [k for k in range(3) if k != axis]
            for way, end in ((-1.0, low), (1.0, high)):
                count = int(np.prod((high - low)[others]) / SPACING**2)
                place = rng.uniform(low, high, (count, 3))
                place[:, axis] = end[axis]
                points.append(place)
                normals.append(np.tile(way * np.eye(3)[axis], (count, 1)))
    return np.vstack(points), np.vstack(normals)


def seen(points, normals, boxes, station):
    """Whether a station sees points (n, 3): steep enough, and no box before them (slabs)."""
    ray = station - points
    visible = np.einsum("ni,ni->n", ray, normals) > 0.15 * np.linalg.norm(ray, axis=1)
    rows = np.flatnonzero(visible)
    # Axis by axis: sums over rows of three are slow.
    start, ray = (points[rows] + 0.1 * normals[rows]).T.copy(), ray[rows].T.copy()
    with np.errstate(divide="ignore"):
        for low, high in np.array(boxes):
            enter, leave = np.full(len(rows), -np.inf), np.full(len(rows), np.inf)
            for k in range(3):
                a, b = (low[k] - start[k]) / ray[k], (high[k] - start[k]) / ray[k]
                enter, leave = np.maximum(enter, np.minimum(a, b)), np.minimum(leave, np.maximum(a, b))
            visible[rows] &= ~((enter < leave) & (leave > 0.0) & (enter < 1.0))
    return visible


def pressed(points, presses):
    """Points of which those of a rib's far side, or of both ``sides``, within ``radius`` are pressed in by 4 mm."""
    for rib, radius, sides in presses:
        (near, low, z), (far, high, _) = RIBS[rib]
        share = np.exp(-((np.hypot(points[:, 1] - 0.5 * (low + high), points[:, 2] - z - 320.0) / radius) ** 8))
        share *= (points[:, 1] > low) & (points[:, 1] < high)
        points[:, 0] -= 4.0 * share * ((points[:, 0] == far) | ((points[:, 0] == near) & (sides == 2)))
    return points


def cloud_of(boxes, seed, cuts=(), shades=(), stations=STATIONS, presses=()):
    """A scene with one cloud of all stations, less what lies within ``cuts``; ``shades`` are boxes not of the design.

    ``presses`` are rib, radius and sides for :func:`pressed`.
    """
    rng = np.random.default_rng(seed)
    parts = []
    for station in stations:
        points, normals = on_boxes([*boxes, *shades], rng)
        keep = seen(points, normals, [*boxes, *shades], station)
        for low, high in np.array(cuts, float).reshape(-1, 2, 3):
            keep &= ~((points > low) & (points < high)).all(axis=1)
        points = pressed(points[keep], presses)
        ray = (points - station) / np.linalg.norm(points - station, axis=1)[:, None]
        parts.append(points + rng.normal(0.0, 0.5, len(points))[:, None] * ray)
    solids = [box(*corners) for corners in BOXES]
    design = StructureDesign(
        "girder", np.vstack([one for one, _ in solids]), np.vstack([own + 8 * k for k, (_, own) in enumerate(solids)])
    )
    return Scene("girder", "structure", (Scan("merged", np.vstack(parts)),), structure=design)


def run(scene, earlier=AT_DESIGN):
    """Return what is found, by class and place: (class, centre) in the order of the classes."""
    result = defects_step.run(scene, defects_step.Params(align=False, registration_error_mm=0.05), earlier)
    rows = zip(result.defects.defect_class, result.defects.centre.tolist(), strict=True)
    return sorted((str(kind), centre) for kind, centre in rows)


def assert_found(found, expected):
    """As many as expected, each of its class and within two cells of its place."""
    assert [kind for kind, _ in found] == sorted(kind for kind, _ in expected)
    for kind, place in expected:
        away = [np.linalg.norm(np.array(centre) - place) for other, centre in found if other == kind]
        assert min(away) < 40.0, (kind, place)


def test_a_rib_that_is_gone_and_a_corner_are_missing_and_a_long_bite_is_edge_loss():
    """The rib by points on the web where it should stand, the corner by the steel around it on both sides.

    The bite is four times as long as deep, and more without the cells at the border.
    """
    bite = ((1195.0, 235.0, 300.0), (1220.0, 320.0, 640.0))
    found = run(cloud_of([one for one in BOXES if one != RIBS[2]], 3, cuts=[NOTCH, bite]))
    rib, corner = np.mean(RIBS[2], axis=0), [407.0, 270.0, 660.0]
    assert_found(found, [("missing-part", rib), ("missing-part", corner), ("edge-loss", [1207.0, 273.0, 470.0])])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [11, 12])
def test_bites_no_deeper_than_the_cells_at_the_border_are_edge_loss(seed):
    """Away from the border no cell is empty; along it there is steel at either end."""
    cuts = [((1195.0, 310.0 - 24.0, 400.0), (1220.0, 320.0, 500.0)), ((395.0, -320.0, 400.0), (420.0, -276.0, 500.0))]
    found = run(cloud_of(BOXES, seed, cuts=cuts))
    assert_found(found, [("edge-loss", [1207.0, 298.0, 450.0]), ("edge-loss", [407.0, -293.0, 450.0])])


def test_a_pit_is_on_one_side_of_a_plate_and_a_dent_on_both_whatever_their_size():
    """By their size alone, 56 and 110 mm on 14 mm of steel, the small one is a pit and the large one a dent.

    A plate that was pushed is one defect: a dent or a bulge, of the side of which more was seen.
    """
    presses = [(3, 28.0, 1), (1, 55.0, 1), (2, 28.0, 2), (0, 55.0, 2)]
    expected = []
    for rib, _, sides in presses:
        low, high = RIBS[rib]
        expected.append(("pit" if sides == 1 else "dent", [low[0] + 7.0, 0.5 * (low[1] + high[1]), low[2] + 320.0]))
    found = run(cloud_of(BOXES, 10, presses=presses))
    assert_found(sorted(("dent" if kind == "bulge" else kind, centre) for kind, centre in found), expected)


def test_edges_that_a_filter_removed_and_a_corner_in_the_shadow_of_something_are_not_missing():
    """A board before one side of the corner: the other side is seen."""
    shade = ((1320.0, 230.0, 560.0), (1325.0, 400.0, 800.0))
    scene = cloud_of(BOXES, 4, cuts=[((395.0, 296.0, 30.0), (420.0, 320.0, 720.0))], shades=[shade])
    points = scene.scans[0].points
    assert ((points > np.array(shade[0]) - 3.0) & (points < np.array(shade[1]) + 3.0)).all(axis=1).sum() > 500
    assert run(scene) == []


def test_a_body_that_no_station_sees_is_not_missing():
    """Stations on one side alone: ribs and box behind the web have no points, and no point lies at their feet."""
    assert run(cloud_of(BOXES, 5, stations=STATIONS[:3])) == []


def test_cropped_region_of_a_cloud_is_not_missing():
    far = 1e4
    crops = [((1100.0, -far, -far), (far, far, far)), ((-far, -far, 560.0), (far, far, far))]
    assert run(cloud_of(BOXES, 6, cuts=crops)) == []


def test_the_bound_of_a_poisson_number_is_above_its_tail():
    for mean, number, tail in ((12.0, 2, poisson.cdf(2, 12.0)), (2.0, 11, poisson.sf(10, 2.0))):
        bound = np.exp(-regions.chernoff(mean, number, more=number > mean))
        assert tail <= bound < 10.0 * tail
    assert regions.chernoff(3.0, 4.0, more=False) == regions.chernoff(3.0, 2.0, more=True) == 0.0
    assert regions.chernoff(5.0, 0.0, more=False) == 5.0


@pytest.mark.parametrize(("expected", "wide"), [(12.0, 1), (0.7, 3)])
def test_empty_cells_are_missing_where_they_are_rarer_than_the_alarms_that_are_allowed(expected, wide):
    """Of the points expected on a cell half are counted on: none of them come by chance with exp(-expected / 2).

    Where less than 6 points are expected on a cell, it is judged with those about it: of 0.7 with 3 by 3.
    """
    plate = trimesh.creation.box([200.0, 100.0, 20.0])
    surface = surface_charts.of_mesh(np.array(plate.vertices), np.array(plate.faces, np.int64), 20.0)
    off = np.abs(surface.centres - [10.0, 0.0, 10.0])
    cell = int(np.argmin(off.sum(axis=1)))
    count = np.where((off.max(axis=1) < 10.0 * wide) & (surface.outward[:, 2] > 0.5), 0.0, expected)
    assert (count == 0.0).sum() == wide**2
    field = SimpleNamespace(surface=surface, count=count, stray=0, inner=np.ones(len(count)))
    chance = np.exp(-0.5 * expected) / 20.0**2  # of one mm2
    for alarms, found in ((0.99 * chance, 0), (1.01 * chance, 1)):
        missing = regions.missing(field, np.full(len(count), expected), alarms)
        one = [(0, [cell], pytest.approx(np.sqrt(expected)), pytest.approx(chance))]  # z^2 / 2 = expected / 2
        assert [(region.sign, list(region.cells), region.z, region.chance) for region in missing] == one[:found]
