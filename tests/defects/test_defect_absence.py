"""Missing material in clouds merged from unknown stations; points and shadows in closed form."""

import numpy as np
import pytest
from scipy.stats import poisson

from processor.defects import regions
from processor.defects import step as defects_step
from processor.model import Scan, Scene, StructureDesign
from tests.support.scenes.at_design import AT_DESIGN

BOX_FACES = np.array(
    [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4],
     [2, 3, 7], [2, 7, 6], [1, 2, 6], [1, 6, 5], [0, 4, 7], [0, 7, 3]]
)  # fmt: skip
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


def corners(box):
    (x0, y0, z0), (x1, y1, z1) = box
    low = [[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]]
    return np.array([*low, *([x, y, z1] for x, y, _ in low)])


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


def pressed(points, radius, sides):
    """Points with a rib's far side pressed in by 4 mm within ``radius``, or both of its ``sides``."""
    (near, y, z), (far, *_) = RIBS[3]
    share = np.exp(-((np.hypot(points[:, 1] - y - 85.0, points[:, 2] - z - 320.0) / radius) ** 8))
    on = points[:, 0] == far
    if sides == 2:
        on |= points[:, 0] == near
    points[:, 0] -= 4.0 * share * on
    return points


def cloud_of(boxes, seed, cut=None, shades=(), stations=STATIONS, press=None):
    """A scene with one cloud of all stations, less what lies within ``cut``; ``shades`` are boxes not of the design.

    ``press`` are radius and sides for :func:`pressed`.
    """
    rng = np.random.default_rng(seed)
    parts = []
    for station in stations:
        points, normals = on_boxes([*boxes, *shades], rng)
        keep = seen(points, normals, [*boxes, *shades], station)
        if cut is not None:
            keep &= ~((points > cut[0]) & (points < cut[1])).all(axis=1)
        points = points[keep] if press is None else pressed(points[keep], *press)
        ray = (points - station) / np.linalg.norm(points - station, axis=1)[:, None]
        parts.append(points + rng.normal(0.0, 0.5, len(points))[:, None] * ray)
    design = StructureDesign(
        "girder", np.vstack([corners(box) for box in BOXES]), np.vstack([BOX_FACES + 8 * k for k in range(len(BOXES))])
    )
    return Scene("girder", "structure", (Scan("merged", np.vstack(parts)),), structure=design)


def run(scene, earlier=AT_DESIGN):
    """Return the classes of what is found, sorted, and their centres."""
    result = defects_step.run(scene, defects_step.Params(align=False, registration_error_mm=0.05), earlier)
    return sorted(str(kind) for kind in result.defects.defect_class), result.defects.centre


@pytest.mark.parametrize(("seed", "earlier"), [(1, {}), (2, AT_DESIGN)])
def test_steel_as_designed_has_no_missing_parts(seed, earlier):
    """Of the first cloud the step itself finds that it lies at the design."""
    assert run(cloud_of(BOXES, seed), earlier)[0] == []


def test_a_rib_that_is_gone_and_a_corner_are_missing():
    """The rib by points on the web where it should stand, the corner by the steel around it on both sides."""
    kinds, centre = run(cloud_of([box for box in BOXES if box != RIBS[2]], 3, cut=NOTCH))
    assert kinds == ["missing-part", "missing-part"]
    expected = np.array([np.mean(RIBS[2], axis=0), [407.0, 270.0, 660.0]])
    for place in expected:
        assert np.linalg.norm(centre - place, axis=1).min() < 40.0


def test_a_long_bite_out_of_an_edge_is_edge_loss():
    """Four times as long as deep, and more without the cells at the border; a strip that a filter removes is none."""
    kinds, centre = run(cloud_of(BOXES, 8, cut=((1195.0, 235.0, 300.0), (1220.0, 320.0, 640.0))))
    assert kinds == ["edge-loss"]
    assert np.linalg.norm(centre[0] - [1207.0, 273.0, 470.0]) < 40.0


@pytest.mark.parametrize(("seed", "deep"), [(11, 24.0), pytest.param(12, 24.0, marks=pytest.mark.slow), (13, 34.0)])
def test_a_bite_no_deeper_than_the_cells_at_the_border_is_edge_loss(seed, deep):
    """Away from the border no cell is empty; along it there is steel at either end."""
    kinds, centre = run(cloud_of(BOXES, seed, cut=((1195.0, 310.0 - deep, 400.0), (1220.0, 320.0, 500.0))))
    assert kinds == ["edge-loss"]
    assert np.linalg.norm(centre[0] - [1207.0, 310.0 - deep / 2, 450.0]) < 30.0


def test_edges_that_a_filter_removed_are_not_missing():
    cut = ((395.0, 296.0, 30.0), (420.0, 320.0, 720.0))
    assert run(cloud_of(BOXES, 9, cut=cut))[0] == []


@pytest.mark.parametrize(("sides", "kinds"), [(1, ["pit"]), (2, ["bulge"])])
@pytest.mark.parametrize("radius", [28.0, 55.0])
def test_a_pit_is_on_one_side_of_a_plate_and_a_dent_on_both_whatever_their_size(sides, kinds, radius):
    """By their size alone, 56 and 110 mm on 14 mm of steel, the small one is a pit and the large one a dent.

    A plate that was pushed is one defect: here a bulge of the side of which more was seen.
    """
    assert run(cloud_of(BOXES, 10, press=(radius, sides)))[0] == kinds


def test_a_corner_in_the_shadow_of_something_is_not_missing():
    """A board before one side of the corner: the other side is seen."""
    shade = ((520.0, 230.0, 560.0), (525.0, 400.0, 800.0))
    scene = cloud_of(BOXES, 4, shades=[shade])
    scan = scene.scans[0]
    off = ((scan.points > np.array(shade[0]) - 3.0) & (scan.points < np.array(shade[1]) + 3.0)).all(axis=1)
    assert off.sum() > 500
    assert run(scene)[0] == []


def test_a_body_that_no_station_sees_is_not_missing():
    """Stations on one side alone: ribs and box behind the web have no points, and no point lies at their feet."""
    assert run(cloud_of(BOXES, 5, stations=STATIONS[:3]))[0] == []


def test_cropped_region_of_a_cloud_is_not_missing():
    assert run(cloud_of(BOXES, 6, cut=((1100.0, -1e4, -1e4), (1e4, 1e4, 1e4))))[0] == []
    assert run(cloud_of(BOXES, 7, cut=((-1e4, -1e4, 560.0), (1e4, 1e4, 1e4))))[0] == []


def test_the_bound_of_a_poisson_number_is_above_its_tail():
    for mean, number, tail in ((12.0, 2, poisson.cdf(2, 12.0)), (2.0, 11, poisson.sf(10, 2.0))):
        bound = np.exp(-regions.chernoff(mean, number, more=number > mean))
        assert tail <= bound < 10.0 * tail
    assert regions.chernoff(3.0, 4.0, more=False) == regions.chernoff(3.0, 2.0, more=True) == 0.0
    assert regions.chernoff(5.0, 0.0, more=False) == 5.0
