"""Several runs of one structure over time."""

import dataclasses
import json

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.special import ndtri

from processor.cli.main import commands
from processor.defects.result import Defects, SurfacePlaces, Windows
from processor.defects.result import Result as Defective
from processor.deviation.result import CorePoints, ErrorSource
from processor.deviation.result import Result as Deviation
from processor.epochs import change, compare, defects, deviation, epoch, inspection, preassembly, space_frame
from processor.epochs.change import Finding
from processor.epochs.quantity_series import Series
from processor.inspection.result import AxisDepartures, Characteristics, InspectedComponent
from processor.inspection.result import Result as Inspected
from processor.model import InputError, StepRun
from processor.report.epochs import lines, write
from processor.store import store
from tests.support.pages.pages import Visible, latin
from tests.support.results.ball_results import balls, whole, without_design
from tests.support.results.bridge_results import adjusted

SOFTWARE = {"processor": "0"}
SERIAL = {"serial": "SN 1", "scanner": "phase", "temperature_C": 20.0, "design": "d", "kind": "structure"}


def stored(root, name, runs, /, digest=None, **facts):
    folder = root / name
    folder.mkdir(parents=True)
    runs = tuple(StepRun(step, "m", "{}", result) for step, result in runs.items())
    made = {"input": "x", "input_sha256": digest or name, "seed": 0, "software": SOFTWARE, "epoch": facts}
    store.write_results(folder / "results.h5", runs, made)


def inspected(length, ci95=0.2, name="web"):
    one = np.array([length])
    nothing = np.array([np.nan])
    table = Characteristics(
        id=("length",), quantity=("length",), nominal=[5000.0], actual=one, deviation=one - 5000.0, ci95=[ci95],
        lower=nothing, upper=nothing, unit=("mm",), verdict=("none",), limit=("",), clause=("",), verified=[False],
        reasons=((),),
    )  # fmt: skip
    return Inspected(status="ok", method="default", components=(InspectedComponent(name, characteristics=table),))


def doubled(table, **columns):
    """The table of one characteristic twice, with other columns."""
    both = {field.name: getattr(table, field.name) for field in dataclasses.fields(table)}
    for name, value in both.items():
        both[name] = np.append(value, value) if isinstance(value, np.ndarray) else (*value, *value)
    return dataclasses.replace(table, **both | columns)


def of_values(value, ci95, **kwargs):
    return Series(component="c", kind="part", quantity="q", value=np.array(value), ci95=np.array(ci95), **kwargs)


# --- changes -------------------------------------------------------------------------------------------------------


def test_the_interval_of_a_change_is_that_of_both_epochs():
    found = change.of_component("inspect", "c", [of_values([1.0, 2.0], [0.3, 0.4])])
    assert (found.leading.value, found.leading.ci95) == pytest.approx((1.0, 0.5))
    assert (found.finding, found.since) == (Finding.CHANGED, 1)


NAN = np.nan
UNSURE = {"doubtful": np.array([False, True])}


@pytest.mark.parametrize(
    ("value", "ci95", "more", "finding"),
    [
        ([0.0, 9.0], [0.1, 0.1], UNSURE, Finding.DOUBTFUL), ([1.0, NAN], [0.1, NAN], {}, Finding.UNKNOWN),
        ([1.0, 2.0], [NAN, NAN], {}, Finding.UNKNOWN),
    ],
)  # fmt: skip
def test_a_doubtful_value_makes_the_change_doubtful_and_one_without_interval_unknown(value, ci95, more, finding):
    assert change.of_component("i", "c", [of_values(value, ci95, **more)]).finding is finding


def test_of_components_that_do_not_change_five_percent_are_called_changed():
    """24 values of a joint at three epochs: without the widening 91 % would be called changed by one of them."""
    rng = np.random.default_rng(5)
    called = alone = 0
    trials = 500
    for _ in range(trials):
        values = rng.normal(0.0, 0.5, (24, 3))
        found = change.of_component("p", "J", [of_values(row, np.full(3, 0.98)) for row in values])
        called += found.finding is Finding.CHANGED
        alone += any(one.beyond for one in found.changes)
    # Bonferroni: at most 5 %, and three binomial standard deviations of the count
    assert 0 < called / trials < 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / trials)
    assert alone / trials > 0.7


def test_an_epoch_without_an_interval_does_not_hide_the_others():
    found = change.of_component("i", "c", [of_values([7.0, 1.0, 9.0], [np.nan, 0.1, 0.1])])
    assert found.finding is Finding.CHANGED
    assert (found.leading.first, found.leading.last) == (1, 2)
    assert found.leading.value == pytest.approx(8.0)


def test_widening_of_a_value_does_not_depend_on_the_number_behind_another():
    """The levels of all values of a component add up to 5 %, whatever each was chosen from."""
    one = of_values([0.0, 1.2], [0.7, 0.7])
    of_many = of_values([0.0, 0.0], [0.7, 0.7], chosen_from=900)
    pair = change.of_component("d", "c", [one, of_many])
    # Digits of 1.959964.
    assert pair.changes[0].widened == pytest.approx(ndtri(1.0 - 0.025 / 2) / 1.959964 * 0.7 * np.sqrt(2.0), rel=1e-5)
    rng = np.random.default_rng(3)
    called, trials, n = 0, 1000, 50
    for _ in range(trials):
        values = rng.normal(0.0, 0.5, (n, 2))
        k = np.abs(values[:, 1] - values[:, 0]).argmax()
        both = [of_values(values[0], np.full(2, 0.98)), of_values(values[k], np.full(2, 0.98), chosen_from=n)]
        called += change.of_component("d", "c", both).finding is Finding.CHANGED
    assert 0 < called / trials < 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / trials)


# --- steps ---------------------------------------------------------------------------------------------------------


def codes(module, *results):
    return [one.code for one in module.remarks(results)]


def findings(module, *results):
    by_name = {}
    for one in module.series(results):
        by_name.setdefault(one.component, []).append(one)
    return {name: change.of_component("s", name, of_it) for name, of_it in by_name.items()}


def test_nodes_of_a_design_are_matched_by_their_ids():
    first = whole()
    moved = np.array(first.balls.movement)
    moved[0, 0] += 5.0
    later = whole(changed={"movement": moved})
    found = findings(space_frame, first, later)
    assert found["10"].finding is Finding.CHANGED
    assert str(found["10"].leading.series.quantity) == "movement x"
    assert found["10"].leading.ci95 == pytest.approx(1.96 * 0.5 * np.sqrt(2.0), rel=1e-3)  # 1.96 for 1.95996
    assert found["13"].finding is Finding.WITHIN
    assert found["12"].finding is Finding.UNKNOWN


def test_balls_without_a_design_are_matched_by_position():
    first = balls(flag=("ok", "ok", "not-found"))
    order = [1, 0, 2]
    there = first.balls
    swapped = dataclasses.replace(
        there, ids=np.array([70, 71, 72]), centres=there.centres[order] + [0.0, 0.0, 4.0], radii=there.radii[order]
    )
    found = findings(space_frame, first, dataclasses.replace(first, balls=swapped))
    assert set(found) == {"7", "8"}
    assert all(str(one.leading.series.quantity) == "centre z" for one in found.values())
    assert all(one.leading.value == pytest.approx(4.0) for one in found.values())


def test_movements_against_different_datums_are_doubtful_unless_all_epochs_have_the_best_fit_too():
    one_gauge = {"best_fit_movement": np.empty(0), "best_fit_ci95": np.empty(0)}  # as of an earlier version
    for more, finding, code in (
        (one_gauge, Finding.DOUBTFUL, "epochs.gauges-differ"), ({}, Finding.WITHIN, "epochs.gauges-differ-fitted"),
    ):  # fmt: skip
        first, later = whole(changed=more), whole(changed={"movement": whole().balls.movement + 9.0, **more})
        reference = dataclasses.replace(later.movement_reference, gauge="best-fit")
        fitted = dataclasses.replace(later, movement_reference=reference)
        assert findings(space_frame, first, later)["10"].finding is Finding.CHANGED
        assert findings(space_frame, first, fitted)["10"].finding is finding
        assert codes(space_frame, first, fitted) == [code]


def test_balls_of_epochs_without_movements_are_matched_by_position():
    """Centres are in each scan's own frame: by ids alone a shift of the frame by metres would be a movement."""
    first, later = whole(), without_design(whole())
    far = dataclasses.replace(later, balls=dataclasses.replace(later.balls, centres=later.balls.centres + 5000.0))
    matched = dataclasses.replace(far, matching=first.matching)
    found = findings(space_frame, first, matched)
    assert {one.finding for one in found.values()} == {Finding.UNKNOWN}
    assert "epochs.balls-by-place" in codes(space_frame, first, matched)
    assert {one.finding for one in findings(space_frame, first, later).values()} == {Finding.WITHIN}


def test_movements_by_an_ambiguous_pose_are_doubtful():
    later = whole(matching="ambiguous", changed={"movement": whole().balls.movement + 9.0})
    assert findings(space_frame, whole(), later)["10"].finding is Finding.DOUBTFUL


def test_balls_that_are_first_seen_later_are_followed_and_those_without_a_partner_are_counted():
    all_three = balls(radii=(45.5, 60.0, 50.0), flag=("ok",) * 3)
    first = balls(flag=("ok", "ok", "not-found"))
    moved = all_three.balls.centres + np.array([[0.0, 0, 0], [200.0, 0, 0], [0, 0, 8.0]])
    third = dataclasses.replace(all_three, balls=dataclasses.replace(all_three.balls, centres=moved))
    found = findings(space_frame, first, all_three, third)
    assert found["9"].finding is Finding.CHANGED  # not seen at the first epoch
    assert found["9"].leading.value == pytest.approx(8.0)
    assert found["7"].finding is Finding.WITHIN
    assert found["8"].finding is Finding.WITHIN  # until it moved farther than its radius
    assert found["8 (3)"].finding is Finding.UNKNOWN
    (alone,) = [one for one in space_frame.remarks([first, all_three, third]) if "everywhere" in one.code]
    assert alone.values == {"count": 3, "total": 4}


def surface(distance, shift=0.0):
    x = np.arange(0.0, 1000.0, 50.0)
    points = np.column_stack([x, np.zeros(20), np.full(20, shift)])
    n = np.full(20, 40)
    core = CorePoints(
        points=points, normals=np.tile([0.0, 0, 1], (20, 1)), distance=distance, lod95=np.full(20, 0.5), n1=n, n2=n,
        std1=np.zeros(20), std2=np.ones(20), body=(x >= 500.0).astype(np.int32),
    )  # fmt: skip
    return Deviation(
        status="ok", method="default", core=core, bodies=("left", "right"), registration_error_from=ErrorSource.GIVEN
    )


def test_surfaces_by_component_and_the_place_that_moved_most():
    later = np.zeros(20)
    later[3] = 4.0
    found = findings(deviation, surface(np.zeros(20)), surface(later))
    assert found["left"].finding is Finding.CHANGED
    assert str(found["left"].leading.series.quantity) == "deviation at 150, 0, 0"
    assert found["right"].finding is Finding.WITHIN


def test_means_are_compared_although_core_points_differ():
    found = findings(deviation, surface(np.zeros(20)), surface(np.full(20, 2.0), shift=9.0))
    assert [str(one.series.quantity) for one in found["left"].changes] == ["mean deviation", "movement z"]
    assert found["left"].leading.value == pytest.approx(2.0)
    assert found["left"].leading.ci95 == pytest.approx(0.5 * np.sqrt(2.0))


def test_different_core_points_are_reported():
    first, later = surface(np.zeros(20)), surface(np.zeros(20), shift=9.0)
    assert codes(deviation, first, first) == ["epochs.registered-to-design"]
    assert codes(deviation, first, later) == ["epochs.registered-to-design", "epochs.core-points-elsewhere"]


def test_core_points_shared_by_chance_do_not_limit_the_comparison():
    """A third epoch of another spacing has a few core points of the first: they must not be all that is compared."""
    later = np.zeros(20)
    later[3] = 4.0
    third = surface(np.zeros(20), shift=9.0)
    points = np.array(third.core.points)
    points[5, 2] = 0.0
    third = dataclasses.replace(third, core=dataclasses.replace(third.core, points=points))
    found = findings(deviation, surface(np.zeros(20)), surface(later), third)["left"]
    assert "deviation at 150, 0, 0" in {str(one.series.quantity) for one in found.changes if one.surely}
    (said,) = [one for one in deviation.remarks([surface(np.zeros(20)), third]) if "elsewhere" in one.code]
    assert said.values == {"count": 2, "total": 2}


def test_the_mean_is_over_what_both_epochs_saw():
    """An unchanged surface, of which the second epoch saw the half that lies deeper: means of all would differ."""
    distance = np.where(np.arange(20) % 10 < 5, 5.0, 0.0)
    half_seen = np.where(np.arange(20) % 10 < 5, np.nan, distance)
    found = findings(deviation, surface(distance), surface(half_seen))
    assert {one.finding for one in found.values()} == {Finding.WITHIN}
    means = [one for one in found["left"].changes if str(one.series.quantity) == "mean deviation"]
    assert means[0].value == pytest.approx(0.0, abs=1e-12)  # float64


def test_surfaces_that_no_two_epochs_saw_are_unknown():
    even = np.where(np.arange(20) % 10 < 5, 0.0, np.nan)
    odd = np.where(np.arange(20) % 10 < 5, np.nan, 9.0)
    assert {one.finding for one in findings(deviation, surface(even), surface(odd)).values()} == {Finding.UNKNOWN}
    third = findings(deviation, surface(even), surface(odd), surface(even))["left"]
    assert third.finding is Finding.WITHIN  # the second says nothing, and does not take the third with it


def test_the_other_side_of_a_thin_plate_is_another_place():
    first, below = surface(np.zeros(20)), surface(np.full(20, 9.0), shift=-9.0)
    turned = dataclasses.replace(below, core=dataclasses.replace(below.core, normals=-below.core.normals))
    assert {one.finding for one in findings(deviation, first, turned).values()} == {Finding.UNKNOWN}


def box(shift, sides, n=200, seed=4, lod95=0.4):
    """A body of 2 x 0.2 x 0.4 m moved by ``shift``, of which the faces ``sides`` (axis, sign) are seen."""
    rng = np.random.default_rng(seed)
    size = np.array([2000.0, 200.0, 400.0])
    points, normals = [], []
    for axis, sign in sides:
        face = rng.uniform(-0.5, 0.5, (n, 3)) * size
        face[:, axis] = 0.5 * sign * size[axis]
        points.append(face)
        normals.append(np.tile(sign * np.eye(3)[axis], (n, 1)))
    points, normals = np.vstack(points), np.vstack(normals)
    many = np.full(len(points), 40)
    core = CorePoints(
        points=points, normals=normals, distance=normals @ shift, lod95=np.full(len(points), lod95), n1=many, n2=many,
        std1=np.zeros(len(points)), std2=np.ones(len(points)), body=np.zeros(len(points), np.int32),
    )  # fmt: skip
    return Deviation(
        status="ok", method="default", core=core, bodies=("beam",), registration_error_from=ErrorSource.GIVEN
    )


ALL_SIDES = tuple((axis, sign) for axis in range(3) for sign in (-1.0, 1.0))


def test_a_body_that_moved_has_a_movement_though_its_mean_deviation_stays():
    shift = np.array([1.0, -3.0, 0.5])
    found = findings(deviation, box(np.zeros(3), ALL_SIDES), box(shift, ALL_SIDES))["beam"]
    by_name = {str(one.series.quantity): one for one in found.changes}
    assert abs(by_name["mean deviation"].value) < 1e-9
    for axis, along in zip("xyz", shift, strict=True):
        assert by_name[f"movement {axis}"].value == pytest.approx(along, abs=1e-9)  # float64
        # Errors that are the same at all core points of a face pair, with the worst sign: no less than one level
        assert by_name[f"movement {axis}"].series.ci95.min() >= 0.4 - 1e-9
    assert str(found.leading.series.quantity) == "movement y"


def test_directions_that_the_faces_seen_do_not_determine_have_no_movement():
    sides = ((1, 1.0), (2, 1.0))  # not the ends
    found = findings(deviation, box(np.zeros(3), sides), box(np.array([9.0, 3.0, 0.0]), sides))["beam"]
    names = [str(one.series.quantity) for one in found.changes]
    assert [name for name in names if name.startswith("movement")] == ["movement y", "movement z"]


def defect(depth, x=100.0, seen=True):
    """A dent of 200 by 100 mm at ``x``; none for depth None; the surface is seen at x below 1 m or nowhere near."""
    windows = Windows(side=[50.0, 100.0], depth=[0.8, 0.4], noise_inflation=[1.0, 1.0])
    along = np.arange(0.0, 1000.0, 20.0) + (0.0 if seen else 1e5)
    places = np.column_stack([along, np.zeros(50), np.zeros(50)])
    table = Defects()
    if depth is not None:
        one = np.ones(1)
        table = Defects(
            id=[0], defect_class=("dent",), confidence=one, otherwise=("bend",), component=("web",),
            centre=[[x, 0.0, 0.0]], area_mm2=one, depth_max=[depth], depth_ci95=[0.3], depth_mean=[depth],
            volume_mm3=one, volume_ci95=one, axes=[np.eye(3)], extent=[[200.0, 100.0]], edge_distance=one,
            curvature_per_m=one, lod95=one, z=one, chance=[0.0], doubtful=[False], reasons=((),),
        )  # fmt: skip
    return Defective(
        status="ok", method="default", examined_mm2=1000.0, least_depth=windows, defects=table,
        surface=SurfacePlaces(points=places, deviation=np.zeros(50), defect=np.full(50, -1)),
    )  # fmt: skip


def test_a_defect_that_grew_is_one_defect_and_distant_ones_are_two():
    found = findings(defects, defect(2.0), defect(5.0, x=130.0))["web"]
    assert [one.value for one in found.changes] == [pytest.approx(3.0)]
    assert found.finding is Finding.CHANGED
    assert len(list(defects.series([defect(2.0), defect(2.0, x=400.0)]))) == 2


def test_a_new_defect_counts_from_the_least_depth_where_its_place_was_seen():
    found = findings(defects, defect(None), defect(3.0))
    assert found["web"].leading.value == pytest.approx(3.0)
    assert found["web"].leading.ci95 == pytest.approx(np.hypot(0.4, 0.3))
    assert findings(defects, defect(None, seen=False), defect(3.0))["web"].finding is Finding.UNKNOWN


def pieces(*places):
    """Dents, each at x with an extent along x."""
    one = defect(3.0)
    table, k = one.defects, len(places)
    columns = {
        field.name: np.repeat(value, k, axis=0) if isinstance(value := getattr(table, field.name), np.ndarray)
        else value * k
        for field in dataclasses.fields(table)
    }  # fmt: skip
    columns["id"] = np.arange(k)
    columns["centre"] = np.array([[x, 0.0, 0.0] for x, _ in places])
    columns["extent"] = np.array([[along, 80.0] for _, along in places])
    return dataclasses.replace(one, defects=dataclasses.replace(table, **columns))


@pytest.mark.parametrize("turned", [False, True])
def test_a_defect_in_two_pieces_did_not_change(turned):
    whole_one, split = pieces((300.0, 400.0)), pieces((200.0, 150.0), (400.0, 150.0))
    found = findings(defects, *((split, whole_one) if turned else (whole_one, split)))["web"]
    assert found.finding is Finding.DOUBTFUL


def test_defects_are_matched_to_the_nearest():
    first = pieces((100.0, 300.0), (240.0, 300.0))
    found = list(defects.series([first, pieces((245.0, 300.0), (105.0, 300.0))]))
    assert len(found) == 2
    assert all(np.isfinite(one.value).all() and not one.doubtful.any() for one in found)
    # The second of the first epoch, with the first row of the second
    middle = list(defects.series([pieces((100.0, 300.0)), pieces((220.0, 300.0), (110.0, 300.0))]))
    assert [str(one.quantity) for one in middle if one.value[0] > 0.0] == ["dent at 110, 0, 0, depth inward"]


def of_axis(sideways, sweep, chainage=None, status="ok"):
    """A part with a length, the greatest sweep with its sign, and departures along its axis."""
    (part,) = inspected(5000.0).components
    names = ("length", "sweep")
    table = doubled(
        part.characteristics, id=names, quantity=names, nominal=np.array([5000.0, 0.0]),
        actual=np.array([5000.0, sweep]), deviation=np.array([0.0, sweep]), ci95=np.array([0.2, 0.5]),
    )  # fmt: skip
    axis = AxisDepartures()
    if sideways is not None:
        chainage = np.linspace(0.0, 5000.0, len(sideways)) if chainage is None else chainage
        half, zero = np.full(len(chainage), 0.5), np.zeros(len(chainage))
        axis = AxisDepartures(chainage=chainage, sideways=sideways, sideways_ci95=half, up=zero, up_ci95=half)
    part = dataclasses.replace(part, status=status, characteristics=table, axis=axis)
    return Inspected(status="ok", method="default", components=(part,))


def test_greatest_departures_are_compared_by_size():
    """The greatest departure of a wave lies on its one side at one epoch, and on the other at the next."""
    found = findings(inspection, of_axis(None, 2.0), of_axis(None, -2.1))["web"]
    assert found.finding is Finding.WITHIN
    (sweep,) = [one for one in found.changes if str(one.series.quantity) == "size of sweep"]
    assert sweep.value == pytest.approx(0.1)


def test_departures_along_the_axis_are_compared_place_by_place():
    x = np.linspace(0.0, 1.0, 11)
    bow = np.sin(np.pi * x)
    found = findings(inspection, of_axis(3.0 * bow, 3.0), of_axis(-3.0 * bow, -3.0))["web"]
    assert found.finding is Finding.CHANGED
    assert str(found.leading.series.quantity) == "sweep at 2500 mm"
    assert found.leading.value == pytest.approx(-6.0)


def test_departures_seen_over_less_of_the_axis_are_against_the_same_chord():
    x = np.linspace(0.0, 5000.0, 51)
    bow = 6.0 * np.sin(np.pi * x / 5000.0)
    part = slice(10, 41)  # departures are stated from the chord between the first and the last place seen
    chord = np.interp(x[part], x[part][[0, -1]], bow[part][[0, -1]])
    shorter = of_axis(bow[part] - chord, 2.0, x[part])
    found = findings(inspection, of_axis(bow, 6.0), shorter)["web"]
    (along,) = [one for one in found.changes if str(one.series.quantity).startswith("sweep at")]
    assert along.value == pytest.approx(0.0, abs=1e-9)  # float64


def test_the_span_over_a_weak_part_is_doubtful():
    first = adjusted()
    weak = dataclasses.replace(first.components, status=("ok", "ok", "weak"))
    moved = dataclasses.replace(first.adjustment, span_departure=first.adjustment.span_departure + 500.0)
    later = dataclasses.replace(first, adjustment=moved)
    assert findings(preassembly, first, later)["span"].finding is Finding.CHANGED
    later = dataclasses.replace(later, components=weak)
    assert findings(preassembly, first, later)["span"].finding is Finding.DOUBTFUL


# --- runs ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def site(tmp_path):
    root = tmp_path / "site"
    stored(root, "b", {"inspect": inspected(5000.0)}, **SERIAL, scanned="2026-03-01", scanned_from="[report] scanned")
    stored(root, "a", {"inspect": inspected(5004.0)}, **SERIAL, scanned="2026-11-20 14:30", scanned_from="scan files")
    stored(root, "2026-08-15/c", {"inspect": inspected(5000.1)}, **SERIAL, name="hall")
    return root


def test_runs_are_sorted_by_date(site):
    found = epoch.read(site)
    assert [(one.folder, one.day.isoformat()) for one in found] == [
        ("b", "2026-03-01"), ("2026-08-15/c", "2026-08-15"), ("a", "2026-11-20"),
    ]  # fmt: skip
    assert [one.day_from for one in found] == ["[report] scanned", "name of the folder", "scan files"]


def test_day_of_a_run_is_the_last_date_in_its_path(tmp_path):
    for name in ("2026-11-20/run-12345678", "2026-11-21"):
        stored(tmp_path, name, {"inspect": inspected(5000.0)})
    assert [one.day.isoformat() for one in epoch.read(tmp_path)] == ["2026-11-20", "2026-11-21"]


def test_sizes_of_another_design_are_doubtful(tmp_path):
    for day, length, design in (("2026-11-20", 5000.0, "d"), ("2026-11-21", 5009.0, "e")):
        stored(tmp_path, day, {"inspect": inspected(length)}, design=design)
    assert [one.finding for one in compare.compare(epoch.read(tmp_path)).components] == [Finding.DOUBTFUL]


def member(length, diameter=60.0):
    """Member 10-11 of a frame."""
    (part,) = inspected(length, name="10-11").components
    names = ("length", "diameter")
    table = doubled(part.characteristics, id=names, quantity=names, actual=np.array([length, diameter]))
    return Inspected(status="ok", method="default", components=(dataclasses.replace(part, characteristics=table),))


@pytest.mark.parametrize("diameter", [60.0, 58.0])
def test_length_changed_by_moved_balls_is_not_counted_as_a_second_change(tmp_path, diameter):
    moved = np.array(whole().balls.movement)
    moved[0, 0] += 9.0
    later = whole(changed={"movement": moved})
    stored(tmp_path, "2026-01-01", {"spheres": whole(), "inspect": member(3000.0)})
    stored(tmp_path, "2026-02-01", {"spheres": later, "inspect": member(2991.0, diameter)})
    history = compare.compare(epoch.read(tmp_path))
    (found,) = [one for one in history.components if one.name == "10-11"]
    said = [str(line) for line in lines.lines(history, "page")]
    assert found.finding is Finding.CHANGED
    if diameter == 60.0:
        assert found.follows == ("10",)
        assert "1 of 5 balls, 0 of 1 member changed beyond the interval, 1 more member by its balls" in said[0]
        assert not any("10-11" in line for line in said)
    else:
        assert found.follows == ()
        assert "1 of 5 balls, 1 of 1 member changed" in said[0]
        assert any("member 10-11, diameter" in line for line in said)


def test_page_has_changes_before_the_picture_and_the_rest_after_it(tmp_path):
    parts = [
        (inspected(5000.0), inspected(5000.0, name="flange")),
        (inspected(5009.0), inspected(5000.1, name="flange")),
    ]
    for month, (web, flange) in enumerate(parts, start=1):
        both = dataclasses.replace(web, components=(*flange.components, *web.components))
        stored(tmp_path, f"2026-0{month}-01", {"inspect": both})
    write.write(tmp_path / "out", compare.compare(epoch.read(tmp_path)))
    page = (tmp_path / "out/report.html").read_text("utf-8")
    page = page[page.index("<body") :]
    assert page.index(">web<") < page.index("data:image/png") < page.index(">flange<")
    names = [line.split(",")[0] for line in (tmp_path / "out/history.csv").read_text("utf-8").splitlines()]
    assert names == ["component", "web", "flange"]


def called(*arguments):
    return CliRunner().invoke(commands, list(map(str, arguments)), standalone_mode=False)


def test_history_command_prints_the_changes_and_writes_the_folder(site, tmp_path):
    out = tmp_path / "out"
    done = called("history", site, "-o", out)
    assert done.exception is None, done.output
    first, second, *_ = done.output.splitlines()
    assert first.endswith("3 epochs, 2026-03-01 to 2026-11-20: 1 of 1 part changed beyond the interval")
    assert second == (
        "changed: part web, length: 5000.00 to 5004.00 mm, by +4.00 ± 0.28 mm, since 2026-11-20 (inspect)"
    )
    assert len(done.output.splitlines()) <= lines.MOST_LINES
    record = json.loads((out / "history.json").read_text("utf-8"))
    assert record["components"][0]["values"][0]["value"] == [5000.0, 5000.1, 5004.0]
    assert record["components"][0]["values"][0]["changes"][1]["change"] == pytest.approx(4.0)
    assert "epochs.same-scanner" in {one["code"] for one in record["remarks"]}
    assert (out / "history.csv").read_text("utf-8").splitlines()[0].startswith("component,finding,quantity,2026-03-01")
    assert "5004" in (out / "report.html").read_text("utf-8")
    assert called("history", site, "-o", out, "--quiet").output.count("\n") == 1
    assert json.loads(called("history", site, "-o", out, "--json").output) == record


def test_the_page_in_chinese_has_no_english_left(site, tmp_path):
    found = compare.compare(epoch.read(site))
    write.write(tmp_path / "out", found, "zh")
    seen = Visible((tmp_path / "out/report.html").read_text("utf-8"))
    names = {"web", "hall", "inspect", "mm", "SN", "phase", "ci95", "report", "scanned", "serial", "changed", "since",
             "follows"}  # fmt: skip
    assert latin(seen.texts, names) == []


@pytest.mark.parametrize(
    ("facts", "digest", "said"),
    [
        ({"scanned": "20 Nov"}, "z", "expected a day such as 2026-11-20"),
        ({}, "z", "has no day"),
        ({"scanned": "2026-12-01"}, "a", "runs of the same scans"),
        ({"scanned": "2026-12-01", "kind": "space-frame"}, "z", "expected runs of one structure"),
    ],
)
def test_runs_that_cannot_be_compared_are_refused_in_one_line(site, facts, digest, said):
    stored(site, "z", {"inspect": inspected(5000.0)}, digest=digest, **facts)
    with pytest.raises(InputError, match=said):
        epoch.read(site)


def test_single_run_and_runs_of_other_structures_are_refused(tmp_path):
    stored(tmp_path / "one", "2026-01-01", {"inspect": inspected(1.0)})
    with pytest.raises(InputError, match="two folders of results or more"):
        epoch.read(tmp_path / "one")
    stored(tmp_path / "one", "2026-02-01", {"preassemble": adjusted()})
    with pytest.raises(InputError, match="no step has results"):
        compare.compare(epoch.read(tmp_path / "one"))


def test_another_design_makes_what_is_measured_from_it_doubtful(tmp_path):
    first = adjusted()
    components = dataclasses.replace(first.components, status=("ok", "ok", "weak"))
    gaps, half = first.joints.gaps, np.full((2, 8, 3), 0.2)
    joints = [dataclasses.replace(first.joints, gaps=gaps + by, gap_ci95=half) for by in (0.0, 9.0)]
    runs = [dataclasses.replace(first, joints=one, components=components) for one in joints]
    for design in ("d", "e"):
        root = tmp_path / design
        stored(root, "2026-01-01", {"preassemble": runs[0]}, design="d")
        stored(root, "2026-02-01", {"preassemble": runs[1]}, design=design)
    same, other = (compare.compare(epoch.read(tmp_path / design)) for design in ("d", "e"))
    of_joint = {one.name: one.finding for one in same.components}
    assert of_joint == {"J1": Finding.CHANGED, "J2": Finding.DOUBTFUL, "span": Finding.WITHIN}  # a part of J2 is weak
    assert {one.name: one.finding for one in other.components}["J1"] is Finding.DOUBTFUL
    assert "epochs.other-design" in {one.code for one in other.remarks}
