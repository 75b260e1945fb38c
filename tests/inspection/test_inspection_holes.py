"""Holes: found in designs by CadQuery's solids, measured in points of bores that are made with numpy alone."""

import tracemalloc
from functools import cache

import cadquery as cq
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import binom

from processor.inspection import bore_fit, design_holes, flat_faces, holes, points_in_design_frame
from processor.inspection.bore_fit import BorePoints
from processor.inspection.design_holes import Hole
from processor.model import StructureDesign
from tests.support.best_fit import without_motion

RADIUS, DEPTH = 12.0, 16.0
PITCH = np.array([80.0, 70.0])
GRID = np.array([[(i - 1) * PITCH[0], (j - 0.5) * PITCH[1]] for j in range(2) for i in range(3)])
OFFSET_SD, SHIFT_SD = 0.5, 0.2  # of a station's ranges and place, mm


def mesh_of(solid, tolerance=0.02):
    vertices, faces = solid.tessellate(tolerance, 0.1)
    return np.array([v.toTuple() for v in vertices]), np.array(faces, np.int64)


def plate(points):
    top = cq.Workplane().box(400.0, 300.0, DEPTH).faces(">Z").workplane(origin=(0.0, 0.0, 0.0))
    return top.pushPoints([tuple(p) for p in points]).hole(2.0 * RADIUS)


def holes_of(solid):
    vertices, faces = mesh_of(solid)
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = cross / np.linalg.norm(cross, axis=1)[:, None]
    plane = flat_faces._planes(corners, normals, np.zeros(len(faces), np.int64))
    return design_holes.of_body(vertices, faces, normals, plane)


def test_holes_of_a_solid_are_found_with_their_sizes():
    turn = Rotation.from_rotvec([0.3, -0.5, 0.8])
    axis, angle = turn.as_rotvec() / turn.magnitude(), np.degrees(turn.magnitude())
    solid = plate(GRID).val().rotate(cq.Vector(), cq.Vector(*axis), angle)
    found = holes_of(solid)
    assert len(found) == len(GRID)
    places = np.array([turn.inv().apply(hole.middle) for hole in found])
    places = places[np.lexsort((places[:, 0], np.round(places[:, 1])))]
    sizes = [[hole.radius, hole.depth] for hole in found]
    # Vertices lie on the circle: float64.
    np.testing.assert_allclose(places, np.column_stack([GRID, np.zeros(len(GRID))]), atol=1e-6)
    np.testing.assert_allclose(sizes, [[RADIUS, DEPTH]] * len(GRID), atol=1e-6)


@pytest.mark.parametrize(
    ("what", "count"),
    [
        (lambda b: b.rect(60.0, 40.0).cutThruAll(), 0),  # a window with corners
        (lambda b: b.slot2D(80.0, 24.0).cutThruAll(), 0),
        (lambda b: b.faces(">Z").workplane().hole(24.0, 8.0), 0),  # blind
        (lambda b: b.faces(">Z").workplane().cboreHole(20.0, 36.0, 6.0), 1),  # its narrower bore
        (lambda b: b.faces(">Z").workplane().circle(30.0).extrude(20.0), 0),  # a boss
        (lambda b: b.faces(">Z").workplane().pushPoints([(-90.0, 0.0), (90.0, 40.0)]).hole(26.0), 2),
    ],
)
def test_only_round_holes_through_a_plate_are_holes(what, count):
    body = what(cq.Workplane().box(400.0, 300.0, DEPTH))
    assert len(holes_of(body.findSolid())) == count


def test_bore_of_a_tube_is_not_a_hole():
    assert holes_of(cq.Workplane().circle(60.0).circle(52.0).extrude(2000.0).val()) == []


RAYS = np.array([[0.6, 0.2, -0.77], [-0.5, 0.4, -0.77], [0.1, -0.6, 0.79]])  # of three stations, into the bores


def bore_cloud(rng, departure, radius=0.0, sigma=0.35, spacing=2.0, mixed=0.0, known=True):
    """Points of bores and faces of the plate at GRID + departure (h, 2), seen from three stations in z."""
    points, source, scanners = [], [], []
    for s, direction in enumerate(RAYS):
        direction = direction / np.linalg.norm(direction)
        scanners.append(-1e7 * direction if known else np.full(3, np.nan))
        error = direction * OFFSET_SD * rng.normal() + [*(SHIFT_SD * rng.normal(size=2)), 0.0]
        for centre in GRID + departure:
            toward = np.arctan2(direction[1], direction[0])
            count = int(np.pi * RADIUS * DEPTH * np.hypot(*direction[:2]) / spacing**2)
            turn, height = toward + rng.uniform(-1.2, 1.2, count), rng.uniform(-0.5, 0.5, count) * DEPTH
            wall = np.column_stack([centre + (RADIUS + radius) * np.column_stack([np.cos(turn), np.sin(turn)]), height])
            wall = wall + sigma * rng.normal(size=count)[:, None] * direction
            short = rng.uniform(size=count) < mixed  # the range is between that of the bore and of the rim before it
            wall = wall - np.where(short, rng.uniform(0.5, 15.0, count), 0.0)[:, None] * direction
            far = rng.uniform(-40.0, 40.0, (1500, 2))
            far = far[np.linalg.norm(far, axis=1) > RADIUS + radius] + centre
            face = np.column_stack([far, np.full(len(far), -0.5 * np.sign(direction[2]) * DEPTH)])
            face = face + sigma * rng.normal(size=len(face))[:, None] * direction
            both = np.concatenate([wall, face]) + error
            points.append(both)
            source.append(np.full(len(both), s))
    return np.concatenate(points), np.concatenate(source), np.array(scanners)


@cache
def group():
    return next(holes.groups(holes_of(plate(GRID).val()), [np.array([1.0, 0.0, 0.0])]))


def measured(points, source, scanners):
    cloud = points_in_design_frame.of_points(points, source, scanners)
    return {one.of: one for one in holes.characteristics(group(), holes.fitted(cloud, group()), 1)}


@pytest.mark.parametrize("known", [pytest.param(True, marks=pytest.mark.slow), False])
def test_intervals_cover_drilled_places_pitches_and_diameters(known):
    held: dict[str, list[bool]] = {"along": [], "across": [], "pitch": [], "diameter": []}
    for seed in range(10 if known else 6):
        rng = np.random.default_rng(seed)
        departure, radius = rng.normal(0.0, 0.7, GRID.shape), 0.2 * rng.normal()
        found = measured(*bore_cloud(rng, departure, radius, known=known))
        true = without_motion(GRID + departure, GRID)
        for k in range(len(GRID)):
            for a, name in enumerate(("along", "across")):
                one = found[f"hole-{k + 1}-{name}"]
                held[name].append(one.low <= true[k, a] <= one.high)
                assert one.nominal == pytest.approx(GRID[k, a], abs=1e-6)  # float64
            one = found[f"hole-{k + 1}-diameter"]
            held["diameter"].append(one.low <= 2.0 * radius <= one.high)
        for one in (one for id_, one in found.items() if id_.startswith("pitch")):
            a, b = (int(n) - 1 for n in one.of.split("-")[1:])
            apart = np.linalg.norm((GRID + departure)[b] - (GRID + departure)[a])
            held["pitch"].append(one.low <= apart - one.nominal <= one.high)
    for name, of_name in held.items():
        # Fewer than this is rarer than one in 1000 for intervals that hold 95 %, errors of one plate being related.
        least = binom.ppf(0.001, len(of_name) // 3, 0.95) / (len(of_name) // 3)
        assert np.mean(of_name) >= least, name
        assert known is False or name != "along" or np.mean(of_name) <= 0.995  # they are not wide for safety


def test_a_plate_that_is_moved_and_turned_keeps_its_holes():
    rng = np.random.default_rng(3)
    departure = rng.normal(0.0, 0.7, GRID.shape)
    points, source, scanners = bore_cloud(rng, departure)
    before = measured(points, source, scanners)
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(1.0)])
    moved = turn.apply(points) + np.array([14.0, -9.0, 3.0])
    after = measured(moved, source, turn.apply(scanners))
    for id_, one in before.items():
        # Motions are linearised: a degree turns departures of 1 mm by 0.02 mm.
        assert after[id_].value == pytest.approx(one.value, abs=0.05), id_


@pytest.mark.parametrize(("off", "share"), [(0.0, 1.0), (0.8, 1.0), (3.0, 5.0 / 6.0)])
def test_a_gauge_pin_passes_holes_that_are_less_than_its_play_off(off, share):
    """A pin 1 mm thinner than two holes passes them if they are less than 1 mm off each other."""
    # The best fit of the group takes a sixth of it, and turns with none as it is in the middle.
    departure = np.zeros(GRID.shape)
    departure[1] = [0.0, off]
    one = measured(*bore_cloud(np.random.default_rng(1), departure, sigma=0.1))["holes-1-6-pass-through"]
    assert 1.0 + one.value == pytest.approx(share, abs=0.02)  # an eighth of a hole of six: none is unsure
    assert one.low <= share - 1.0 <= one.high
    assert one.unit == "1"


def test_the_share_that_a_pin_passes_is_unsure_where_the_play_is_used_up():
    found = []
    for off in (0.9, 1.15, 1.25, 1.6):  # five sixths of it are left by the best fit
        departure = np.zeros(GRID.shape)
        departure[1] = [0.0, off]
        found.append(measured(*bore_cloud(np.random.default_rng(1), departure))["holes-1-6-pass-through"])
    shares, widths = np.array([(one.value, one.high - one.low) for one in found]).T
    assert (np.diff(shares) <= 1e-6).all()  # rounding
    np.testing.assert_allclose(shares[[0, -1]], [0.0, -1.0 / 6.0], atol=1e-3)  # chances beyond three sds
    assert widths[[0, -1]].max() < 1e-6 < 0.1 < widths.max()  # no chances but beside the play: rounding


def test_mixed_pixels_in_the_bore_do_not_move_it():
    errors = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        departure = rng.normal(0.0, 0.7, GRID.shape)
        found = measured(*bore_cloud(rng, departure, mixed=0.15))
        true = without_motion(GRID + departure, GRID)
        errors += [found[f"hole-{k + 1}-along"].value - true[k, 0] for k in range(len(GRID))]
    assert np.sqrt(np.mean(np.square(errors))) < 0.1  # as hole centres are asked for


def test_a_hole_that_was_not_seen_has_no_value():
    rng = np.random.default_rng(4)
    points, source, scanners = bore_cloud(rng, np.zeros(GRID.shape))
    hidden = np.linalg.norm(points[:, :2] - GRID[0], axis=1) < 30.0
    found = measured(points[~hidden], source[~hidden], scanners)
    assert np.isnan(found["hole-1-along"].value)
    assert np.isnan(found["hole-1-diameter"].value)
    assert [one.code for one in found["hole-1-along"].reasons] == ["inspect.hole-not-seen"]
    assert np.isfinite(found["hole-2-along"].value)


def test_few_points_on_one_side_of_a_bore_are_no_hole():
    turn = np.linspace(0.0, 0.9, 30)
    places = RADIUS * np.column_stack([np.cos(turn), np.sin(turn)])
    bore = BorePoints(places, np.zeros(30, np.int64), np.full((30, 2), np.nan))
    found = bore_fit.fit([bore], np.array([RADIUS]), np.array([10.0]), 1)
    assert np.isnan(found.departure).all()


def test_bodies_of_a_design_have_their_holes():
    none = np.empty(0)
    seen = flat_faces.Observed(np.empty((0, 3)), np.empty(0, np.int64), none, none, none, side=50.0)
    (body,) = flat_faces.bodies(StructureDesign("plate", *mesh_of(plate(GRID).val())), seen, 60.0)
    assert len(body.holes) == len(GRID)


# --- what was not seen, rows, temperature, scale, views -------------------------------------------------------------


def drilled(seen, sd=0.05, places=GRID, temperature_C=float("nan"), departure=0.0):
    """Characteristics of holes at ``places``, of which the rows ``seen`` were found with errors of ``sd``."""
    count = len(places)
    off = np.full((count, 3), np.nan)
    off[seen] = departure
    covariance = np.full((3 * count, 3 * count), np.nan)
    rows = (3 * np.array(seen, np.int64)[:, None] + np.arange(3)).ravel()
    covariance[np.ix_(rows, rows)] = sd**2 * np.eye(len(rows))
    radius = np.full(count, RADIUS)
    x, y, up = np.eye(3)
    designed = holes.Group(tuple(Hole(a * x + b * y, up, RADIUS, DEPTH) for a, b in places), np.array([x, y]))
    fitted = holes._referred(bore_fit.Fitted(off, covariance, np.zeros(count, np.int64)), places, radius, temperature_C)
    return {one.of: one for one in holes.characteristics(designed, fitted, 1)}


def test_holes_not_seen_may_pass_or_not():
    """Of six holes three were seen, all of them as designed: between three and six pass."""
    some = drilled([0, 1, 2])["holes-1-6-pass-through"]
    assert (1.0 + some.low, 1.0 + some.high) == pytest.approx((0.5, 1.0))
    assert some.low <= some.value <= some.high
    assert [one.code for one in some.reasons] == ["inspect.holes-unseen"]
    whole = drilled(list(range(6)))["holes-1-6-pass-through"]
    assert (whole.low, whole.high, whole.reasons) == (0.0, 0.0, ())


def test_places_of_a_group_of_which_two_holes_were_seen_are_absent_with_a_reason():
    found = drilled([1, 4])
    assert np.isnan([found["hole-2-along"].value, found["holes-1-6-pass-through"].value]).all()
    assert [one.code for one in found["hole-2-along"].reasons] == ["inspect.few-holes-seen"]
    assert [one.code for one in found["hole-1-along"].reasons] == ["inspect.hole-not-seen"]
    assert [one.code for one in found["holes-1-6-pass-through"].reasons] == ["inspect.few-holes-seen"]
    assert np.isfinite(found["hole-2-diameter"].value)
    assert "hole-1-along" not in drilled([0, 1], places=GRID[:2])  # of two holes none has a place in the group


def test_rows_do_not_depend_on_the_last_digit_of_a_coordinate():
    """Three holes in a row whose coordinate lies between two whole numbers, up to rounding."""
    across = np.array([12.5 + 1e-9, 12.5 - 1e-9, 12.5 + 1e-9, 82.5])
    middle = np.column_stack([[140.0, 70.0, 0.0, 0.0], across, np.zeros(4)])
    made = [design_holes.Hole(place, np.array([0.0, 0.0, 1.0]), RADIUS, DEPTH) for place in middle]
    (group,) = holes.groups(made, [np.array([1.0, 0.0, 0.0])])
    assert [hole.middle[0] for hole in group.holes] == [0.0, 70.0, 140.0, 0.0]
    found = drilled([0, 1, 2, 3], places=np.array([hole.middle[:2] for hole in group.holes]))
    assert {id_ for id_ in found if "pitch" in id_} == {"pitch-1-2", "pitch-2-3", "pitch-1-4"}


def test_lengths_of_warm_steel_are_those_at_the_reference_temperature():
    """30 K warmer, steel is longer by 12e-6 a kelvin (EN 1993-1-1): a plate drilled as designed has no deviation."""
    larger = 12e-6 * 30.0 * np.column_stack([GRID - GRID.mean(axis=0), np.full(len(GRID), RADIUS)])
    every = list(range(len(GRID)))
    for one in drilled(every, departure=larger, temperature_C=50.0).values():
        assert one.value == pytest.approx(0.0, abs=1e-4)  # of second order: 3.6e-4 of 0.05 mm
    assert drilled(every, departure=larger)["pitch-1-2"].value == pytest.approx(12e-6 * 30.0 * PITCH[0])


def test_places_and_pitches_have_the_scale_of_the_scanner():
    places = 50.0 * GRID
    found = drilled(list(range(6)), sd=0.0, places=places)
    assert found["pitch-1-2"].wider_side == pytest.approx(1.96 * 5e-6 * 50.0 * PITCH[0], rel=1e-3)  # 1.96 for 1.95996
    assert found["hole-1-along"].wider_side == pytest.approx(1.96 * 5e-6 * 50.0 * PITCH[0], rel=1e-3)


def test_a_hole_lies_between_two_stations_by_the_variances_of_their_shifts_and_offsets():
    """Walls seen from either side are 0.3 mm farther apart than the diameter; one station looks across the axis, one
    by 0.6 of its rays. Quiet points leave the errors of the stations alone, whose variances share the difference."""
    turn, apart = np.linspace(-0.9, 0.9, 1000), 0.3
    wall = RADIUS * np.column_stack([np.cos(turn), np.sin(turn)])
    places, source = np.concatenate([wall + np.array([apart, 0.0]), -wall]), np.repeat([0, 1], 1000)
    ray = np.where(source[:, None] == 0, [1.0, 0.0], [-0.6, 0.0])
    radius = np.array([RADIUS])
    solved, *_ = bore_fit._adjusted(places, ray, source, np.zeros(2000, int), radius, np.zeros((1, 3)), 2)
    first, second = (OFFSET_SD * np.array([1.0, 0.6])) ** 2 + SHIFT_SD**2
    # The noise of 0.02 mm that is assumed at least has a thousandth of the weight, by a thousand points.
    np.testing.assert_allclose(solved, [[apart * second / (first + second), 0.0, 0.0]], atol=2e-3)


def test_the_adjustment_of_many_holes_needs_no_matrix_of_all_points():
    rng = np.random.default_rng(2)
    count, points = 100, 1000
    turn = rng.uniform(0.0, 2.0 * np.pi, count * points)
    places = RADIUS * np.column_stack([np.cos(turn), np.sin(turn)]) + rng.normal(0.0, 0.3, (count * points, 2))
    hole, source = np.repeat(np.arange(count), points), rng.integers(0, 3, count * points)
    tracemalloc.start()
    solved, *_ = bore_fit._adjusted(
        places, np.full(places.shape, np.nan), source, hole, np.full(count, RADIUS), np.zeros((count, 3)), 3
    )
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.abs(solved).max() < 0.07  # five sds of a thousand points of 0.3 mm, each along one direction
    assert most < 8 * len(places) * 3 * (count + 3)  # bytes of a number for each point and unknown
