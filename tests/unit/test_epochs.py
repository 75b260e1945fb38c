"""Several runs of one structure over time."""

import dataclasses
import json

import numpy as np
import pytest
from click.testing import CliRunner

from processor.cli.main import commands
from processor.defects.result import Defects, SurfacePlaces, Windows
from processor.defects.result import Result as Defective
from processor.deviation.result import CorePoints, ErrorSource
from processor.deviation.result import Result as Deviation
from processor.epochs import change, compare, defects, deviation, epoch, space_frame
from processor.epochs.change import Finding
from processor.epochs.series import Series
from processor.inspection.result import Characteristics, InspectedComponent
from processor.inspection.result import Result as Inspected
from processor.model import InputError, StepRun
from processor.report.epochs import lines, write
from processor.store import store
from tests.support.ball_results import balls, whole
from tests.support.bridge_results import adjusted
from tests.support.pages import Visible, latin

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


def of_values(value, ci95, **kwargs):
    return Series(component="c", quantity="q", value=np.array(value), ci95=np.array(ci95), **kwargs)


# --- changes -------------------------------------------------------------------------------------------------------


def test_the_interval_of_a_change_is_that_of_both_epochs():
    found = change.of_component("inspect", "c", [of_values([1.0, 2.0], [0.3, 0.4])])
    assert found.leading.value == pytest.approx(1.0)
    assert found.leading.ci95 == pytest.approx(0.5)
    assert found.finding is Finding.CHANGED
    assert found.since == 1


def test_of_components_that_do_not_change_five_percent_are_called_changed():
    """24 values of a joint at three epochs: without the widening 91 % would be called changed by one of them."""
    rng = np.random.default_rng(5)
    called = alone = 0
    trials = 1500
    for _ in range(trials):
        values = rng.normal(0.0, 0.5, (24, 3))
        found = change.of_component("p", "J", [of_values(row, np.full(3, 0.98)) for row in values])
        called += found.finding is Finding.CHANGED
        alone += any(one.beyond for one in found.changes)
    # Bonferroni: at most 5 %, and three binomial standard deviations of the count
    assert called / trials < 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / trials)
    assert called > 0
    assert alone / trials > 0.7


def test_the_strongest_of_many_is_widened_for_their_number():
    one, of_many = (change.of_component("d", "c", [of_values([0.0, 1.2], [0.7, 0.7], chosen_from=n)]) for n in (1, 900))
    assert one.finding is Finding.CHANGED
    assert of_many.finding is Finding.WITHIN
    assert of_many.leading.ci95 > one.leading.ci95


def test_a_doubtful_value_makes_the_change_doubtful():
    found = change.of_component("i", "c", [of_values([0.0, 9.0], [0.1, 0.1], doubtful=np.array([False, True]))])
    assert found.finding is Finding.DOUBTFUL


def test_a_value_at_one_epoch_or_without_interval_says_nothing():
    for value, half in (([1.0, np.nan], [0.1, np.nan]), ([1.0, 2.0], [np.nan, np.nan])):
        assert change.of_component("i", "c", [of_values(value, half)]).finding is Finding.UNKNOWN


# --- steps ---------------------------------------------------------------------------------------------------------


def findings(module, *results):
    by_name = {}
    for one in module.series(results):
        by_name.setdefault(one.component, []).append(one)
    return {name: change.of_component("s", name, of_it) for name, of_it in by_name.items()}


def test_nodes_of_a_design_are_told_by_their_ids():
    first = whole()
    moved = np.array(first.balls.movement)
    moved[0, 0] += 5.0
    later = whole(changed={"movement": moved})
    found = findings(space_frame, first, later)
    assert found["10"].finding is Finding.CHANGED
    assert str(found["10"].leading.series.quantity) == "movement x"
    assert found["10"].leading.ci95 == pytest.approx(1.96 * 0.5 * np.sqrt(2.0), rel=1e-3)
    assert found["13"].finding is Finding.WITHIN
    assert found["12"].finding is Finding.UNKNOWN


def test_balls_without_a_design_are_told_by_their_places():
    first = balls(flag=("ok", "ok", "not-found"))
    order = [1, 0, 2]
    there = first.balls
    swapped = dataclasses.replace(
        there,
        ids=np.array([70, 71, 72]),
        centres=there.centres[order] + [0.0, 0.0, 4.0],
        radii=there.radii[order],
    )
    found = findings(space_frame, first, dataclasses.replace(first, balls=swapped))
    assert set(found) == {"7", "8"}
    assert all(str(one.leading.series.quantity) == "centre z" for one in found.values())
    assert all(one.leading.value == pytest.approx(4.0) for one in found.values())


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


def test_core_points_elsewhere_leave_the_mean():
    found = findings(deviation, surface(np.zeros(20)), surface(np.full(20, 2.0), shift=9.0))
    assert [str(one.series.quantity) for one in found["left"].changes] == ["mean deviation"]
    assert found["left"].leading.value == pytest.approx(2.0)
    assert found["left"].leading.ci95 == pytest.approx(0.5 * np.sqrt(2.0))


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


def test_a_defect_that_grew_is_one_defect():
    found = findings(defects, defect(2.0), defect(5.0, x=130.0))
    assert [one.value for one in found["web"].changes] == [pytest.approx(3.0)]
    assert found["web"].finding is Finding.CHANGED


def test_defects_apart_are_two():
    assert len(list(defects.series([defect(2.0), defect(2.0, x=400.0)]))) == 2


def test_a_new_defect_counts_from_the_least_depth_where_its_place_was_seen():
    found = findings(defects, defect(None), defect(3.0))
    assert found["web"].leading.value == pytest.approx(3.0)
    assert found["web"].leading.ci95 == pytest.approx(np.hypot(0.4, 0.3))
    assert findings(defects, defect(None, seen=False), defect(3.0))["web"].finding is Finding.UNKNOWN


# --- runs ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def site(tmp_path):
    root = tmp_path / "site"
    stored(root, "b", {"inspect": inspected(5000.0)}, **SERIAL, scanned="2026-03-01", scanned_from="[report] scanned")
    stored(root, "a", {"inspect": inspected(5004.0)}, **SERIAL, scanned="2026-11-20 14:30", scanned_from="scan files")
    stored(root, "2026-08-15/c", {"inspect": inspected(5000.1)}, **SERIAL, name="hall")
    return root


def test_runs_stand_in_the_order_of_their_days(site):
    found = epoch.read(site)
    assert [(one.folder, one.day.isoformat()) for one in found] == [
        ("b", "2026-03-01"), ("2026-08-15/c", "2026-08-15"), ("a", "2026-11-20"),
    ]  # fmt: skip
    assert [one.day_from for one in found] == ["[report] scanned", "name of the folder", "scan files"]


def called(*arguments):
    return CliRunner().invoke(commands, list(map(str, arguments)), standalone_mode=False)


def test_the_command_says_what_changed_and_writes_the_folder(site, tmp_path):
    out = tmp_path / "out"
    done = called("history", site, "-o", out)
    assert done.exception is None, done.output
    first, second, *_ = done.output.splitlines()
    assert first.endswith("3 epochs, 2026-03-01 to 2026-11-20: 1 of 1 component changed beyond the interval")
    assert second == ("changed: web, length: 5000.00 to 5004.00 mm, by +4.00 ± 0.28 mm, since 2026-11-20 (inspect)")
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
    names = {"web", "hall", "inspect", "mm", "SN", "phase", "ci95", "report", "scanned", "serial", "changed", "since"}
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
def test_what_cannot_be_compared_is_said_in_one_line(site, facts, digest, said):
    stored(site, "z", {"inspect": inspected(5000.0)}, digest=digest, **facts)
    with pytest.raises(InputError, match=said):
        epoch.read(site)


def test_one_run_is_too_few_and_other_structures_have_nothing_in_common(tmp_path):
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
