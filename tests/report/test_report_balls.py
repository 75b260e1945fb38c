"""Balls of a whole frame as reported: results.json, tables, drawing and figures, from a result written by hand."""

import dataclasses
import hashlib
import io
import json
import math
import os
import re
import subprocess
import sys

import ezdxf
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from processor.evaluation.evaluate import ErrorReport
from processor.model import FrameDesign, RecordError, Scan, Scene, Stations, StepRun, Verdict, reason
from processor.pipeline import Execution
from processor.report import all_figures, all_tables, page, write_results
from processor.report.columns import columns
from processor.report.space_frame import ball_picture, dxf, flagged_ball_figures, interactive_view, section
from processor.report.space_frame import tables as space_frame_tables
from processor.report.style import COLOURS, DPI, Drawn
from processor.results import to_json
from processor.space_frame import step
from processor.space_frame.result import ControlDeviations, MovementReference, StationCorrections, Tubes
from processor.store import store
from tests.support.pages.report_pages import TablesOfPage, by_file
from tests.support.results.ball_results import (
    NAN,
    NOMINAL,
    TURN,
    balls,
    of_frame,
    pose,
    repeated,
    scene,
    whole,
    with_truth,
    without_design,
)
from tests.support.results.bridge_results import PROVENANCE

Z95 = 1e-4  # 1.96 here is 1.95996 in the program
CSV = 1e-4  # of a half-width of 0.2 mm written with six decimals, and 1.96 for 1.95996


def of_file(file, *args):
    return by_file(file, *of_frame(*args))


# --- verdicts ------------------------------------------------------------------------------------------------------


def test_verdicts_by_hand():
    found = whole().balls
    # 3-4-0: along (0.6, 0.8, 0) the variance is 0.36 * 0.25 + 0.64 * 1 = 0.73; 12 down: 4; 0.3-0-0.4: 0.36/4 + 0.64 * 4
    np.testing.assert_allclose(found.movement_size[[0, 1, 3]], [5.0, 12.0, 0.5])
    np.testing.assert_allclose(found.movement_size_ci95[[0, 1, 3]], 1.96 * np.sqrt([0.73, 4.0, 2.65]), rtol=Z95)
    assert np.isnan(found.movement_size[[2, 4]]).all()
    assert found.verdict == ("pass", "indeterminate", "none", "pass", "none")
    assert whole(limit=8.0).balls.verdict[1] == "fail"
    assert whole(limit=5.5).balls.verdict[0] == "indeterminate"
    assert whole(limit=2.0).balls.verdict == ("fail", "fail", "none", "indeterminate", "none")
    assert whole(limit=NAN).balls.verdict == ("none",) * 5


def test_the_worst_verdict_is_that_of_the_result_and_none_passes_while_the_matching_is_uncertain():
    limits = {10.0: Verdict.INDETERMINATE, 8.0: Verdict.FAIL, NAN: Verdict.NONE}
    assert [whole(limit=limit).overall for limit in limits] == list(limits.values())
    for matching in ("ambiguous", "failed"):
        assert set(whole(matching=matching).balls.verdict) == {"indeterminate", "none"}


def test_a_ball_that_was_not_seen_neither_passes_nor_fails():
    for limit in (100.0, 0.001):
        unseen = whole(limit=limit, changed={"evidence": ("axes", "ball", "axes", "axes", "fused")}).balls
        assert unseen.verdict[0] == unseen.verdict[3] == "indeterminate"
    assert whole(limit=NAN, changed={"evidence": ("axes",) * 5}).balls.verdict[0] == "none"


def test_a_node_that_did_not_move_has_no_direction_but_a_verdict():
    still = whole(changed={"movement": np.zeros((5, 3))}).balls
    assert still.verdict[0] == "pass"
    assert still.movement_size[0] == 0.0


# --- results.json --------------------------------------------------------------------------------------------------


def written(result):
    made = to_json.results_json(*of_frame(result))
    return json.loads(json.dumps(made, allow_nan=False))["steps"]["spheres"]


def test_results_json_of_a_whole_frame():
    step = written(whole())
    first, second, lost, _, extra = step["balls"]
    assert first["size"] == 45.0
    assert (first["axes"], first["stations"]) == (3, 2)
    assert first["bound_sd"] == {"x": 0.08, "y": 0.16, "z": 0.24, "radius": 0.04, "lowest": 0.09}
    assert first["efficiency"] == {"centre": 0.8, "radius": 0.9, "lowest": 0.95}
    assert first["movement"]["vector"] == [3.0, 4.0, 0.0]
    assert first["movement"]["ci95"] == pytest.approx([0.98, 1.96, 3.92])
    assert first["movement"]["verdict"] == "pass"
    assert second["movement"]["size"] == 12.0
    assert "movement" not in lost
    assert "movement" not in extra
    assert step["gauge"] == "design-coordinates"
    assert [first["movement"][key] for key in ("gauge", "dx", "dy", "dz")] == ["design-coordinates", 3.0, 4.0, 0.0]
    assert set(first["movements"]) == {"design-coordinates", "best-fit"}
    assert [first["movements"]["best-fit"][key] for key in ("dx", "dy", "dz")] == [3.0, 4.0, 2.0]
    assert first["movements"]["design-coordinates"]["ci95"] == first["movement"]["ci95"]
    assert "movements" not in lost
    movements = step["movements"]
    assert (movements["gauge"], movements["basis"]) == ("design-coordinates", "stations")
    assert (movements["difference"], movements["largest_difference"]) == ([0.0, 0.0, -2.0], 2.0)
    assert movements["best-fit"]["largest"] == 10.0
    assert step["movement_limit"] == {"mm": 10.0, "source": "project.toml"}
    assert step["matching"]["status"] == "ok"
    assert step["matching"]["T_design_scan"] == np.eye(4).tolist()
    assert np.shape(step["matching"]["covariance"]) == (6, 6)
    assert step["matching"]["rivals"] == []
    assert [(one["a"], one["b"], one["bow"]) for one in step["tubes"]] == [(10, 11, 0.5), (13, -1, 1.5)]
    assert step["tubes"][0]["start"] == [100.0, 0.0, 6000.0]
    assert [one["name"] for one in step["stations"]] == ["S1", "=S2"]
    assert step["stations"][0]["reasons"] == []
    assert step["stations"][1]["reasons"][0]["code"] == "spheres.weak-motions"
    assert first["reasons"] == []
    values = {"size": 60.0, "nominal": 50.0}
    (why,) = second["reasons"]
    assert why == {"code": "spheres.other-size", "values": values, "text": "size 60 mm instead of 50 mm"}
    assert [one["code"] for one in step["reasons"]] == ["spheres.ranges"]
    assert np.shape(step["stations"][1]["T"]) == (4, 4)


def test_results_json_has_no_keys_of_absent_results():
    paper = balls()
    execution = Execution(scene(whole()), (StepRun("spheres", "ransac", "{}", paper),), PROVENANCE)
    step = to_json.results_json(execution, ErrorReport())["steps"]["spheres"]
    assert set(step) == {"status", "method", "reasons", "balls", "verdict"}
    assert "size" not in step["balls"][0]
    blind = written(without_design(whole()))
    assert not {"gauge", "matching", "movement_limit", "movements"} & set(blind)
    assert "tubes" in blind
    assert "movement" not in blind["balls"][0]


def test_ids_that_are_texts_stand_in_results_tables_and_drawing():
    design = FrameDesign(np.arange(1, 5), NOMINAL[:4], np.full(4, 50.0), labels=("N001", "=N2", "extra-1", "N004"))
    made = whole(changed={"ids": np.array([1, 2, 3, 4, 5])})
    made = dataclasses.replace(made, tubes=dataclasses.replace(made.tubes, a=np.array([1, 4]), b=np.array([2, -1])))
    made = step.labelled(made, design)
    names = ["N001", "=N2", "extra-1", "N004", "extra-2"]
    assert made.balls.names == names
    result = written(made)
    assert [ball["id"] for ball in result["balls"]] == names
    assert [(tube["a"], tube["b"]) for tube in result["tubes"]] == [("N001", "=N2"), ("N004", "")]
    safe = [name if name != "=N2" else "'=N2" for name in names]
    for file in ("balls", "nodes", "lowest"):
        assert [row["id"] for row in of_file(file, made)] == safe
    assert [(row["ball_a"], row["ball_b"]) for row in of_file("tubes", made)] == [("N001", "'=N2"), ("N004", "")]
    drawing = ezdxf.read(io.StringIO(dxf.drawing(made).decode()))
    texts = [one.dxf.text for one in drawing.modelspace().query('TEXT[layer=="IDS"]')]
    assert texts == [name for name, there in zip(names, made.balls.placed, strict=True) if there]
    assert "(node =N2)" in str(section.REPORT.summary(made)[0])
    assert step.labelled(whole(), dataclasses.replace(design, labels=())).balls.names == [10, 11, 12, 13, 14]


def test_results_of_earlier_versions_are_read_with_the_gauge_that_they_have():
    assert MovementReference(gauge="design frame").gauge == "design-coordinates"
    assert MovementReference(gauge="best fit").gauge == "best-fit"
    with pytest.raises(RecordError, match="'other' is no MovementGauge"):
        MovementReference(gauge="other")


def test_the_headline_says_which_gauge_the_movements_are_by_and_how_far_the_other_is():
    made = whole()
    english = str(section.REPORT.summary(made)[0])
    assert "movements of nodes as differences of coordinates: up to 12.0 mm (node 11)" in english
    assert "a best fit differs by up to 2.0 mm" in english
    assumed = dataclasses.replace(made, gauges=dataclasses.replace(made.gauges, basis="agreement"))
    assert "differences of coordinates (assumed)" in str(section.REPORT.summary(assumed)[0])


# --- tables --------------------------------------------------------------------------------------------------------


def test_csv_of_balls_and_of_lowest_points():
    first, second, lost, *_ = of_file("balls", None, with_truth()[0])
    assert float(first["ci95_x_mm"]) == pytest.approx(0.196, abs=CSV)
    assert float(first["ci95_radius_mm"]) == pytest.approx(0.098, abs=CSV)
    assert (first["size_mm"], first["nominal_radius_mm"], first["radius_error_mm"]) == ("45.0", "45.0", "0.1")
    assert (first["bound_sd_z_mm"], first["efficiency_lowest_z"], first["evidence"]) == ("0.24", "0.95", "fused")
    assert (second["flag"], second["remark"]) == ("wrong-size", "size 60 mm instead of 50 mm")
    assert not [name for name in first if "formal" in name]
    assert lost["x_mm"] == lost["radius_mm"] == ""
    crew = of_file("lowest")
    assert list(crew[0]) == ["id", "x_mm", "y_mm", "z_mm", "ci95_z_mm", "radius_mm", "flag"]
    assert (crew[0]["x_mm"], crew[0]["z_mm"], crew[0]["radius_mm"]) == ("3.0", "5954.9", "45.1")
    assert float(crew[1]["ci95_z_mm"]) == pytest.approx(0.392, abs=CSV)
    assert (crew[2]["z_mm"], crew[2]["flag"]) == ("", "not-found")


def test_csv_of_nodes_tubes_and_stations():
    nodes = of_file("nodes")
    assert (nodes[0]["dx_mm"], nodes[0]["dy_mm"], nodes[0]["movement_mm"]) == ("3.0", "4.0", "5.0")
    assert (nodes[0]["gauge"], nodes[0]["design_dz_mm"], nodes[0]["best_fit_dz_mm"]) == (
        "design-coordinates", "0.0", "2.0",
    )  # fmt: skip
    assert [row["verdict"] for row in nodes] == ["pass", "indeterminate", "", "pass", ""]
    assert {row["limit_mm"] for row in nodes} == {"10.0"}
    one, open_end = of_file("tubes")
    assert (one["ball_a"], one["ball_b"], one["length_mm"], one["bow_mm"]) == ("10", "11", "2800.0", "0.5")
    assert (open_end["ball_b"], open_end["start_y_mm"]) == ("", "3900.0")
    still, moved = of_file("stations")
    assert (still["dx_mm"], still["turn_z_mrad"]) == ("0.0", "0.0")
    assert (moved["station"], moved["dx_mm"], moved["dy_mm"], moved["dz_mm"]) == ("'=S2", "1.0", "-2.0", "3.0")


def test_shift_of_a_station_is_stated_at_the_middle_of_the_balls():
    # Half a milliradian about z through a point 500 km away: the transform's translation is 250 m, the shift is none.
    far = np.array([5e8, 4e9, 0.0])
    R = np.array([[math.cos(5e-4), -math.sin(5e-4), 0.0], [math.sin(5e-4), math.cos(5e-4), 0.0], [0.0, 0.0, 1.0]])
    made = whole()
    centres = made.balls.centres + far
    middle = np.nanmean(centres, axis=0)
    T = np.array([pose(), pose(R, middle - R @ middle + [0.0, 0.0, 2.0])])
    balls, stations = dataclasses.replace(made.balls, centres=centres), dataclasses.replace(made.stations, T=T)
    _, moved = of_file("stations", dataclasses.replace(made, balls=balls, stations=stations))
    # Rounding of float64 at 4e9 mm is 1e-6, of a turned frame some times that.
    assert [float(moved[name]) for name in ("dx_mm", "dy_mm", "dz_mm")] == pytest.approx([0.0, 0.0, 2.0], abs=2e-5)
    assert float(moved["turn_z_mrad"]) == pytest.approx(0.5, abs=1e-6)  # written with six decimals


def test_table_of_nodes_states_a_missing_or_uncertain_limit():
    (table,) = [one for one in all_tables.tables_of_run(*of_frame(whole(limit=NAN))) if one.file == "nodes"]
    assert "node_place_mm" in str(table.note)
    (table,) = [one for one in all_tables.tables_of_run(*of_frame(whole(matching="ambiguous"))) if one.file == "nodes"]
    assert "10 mm by project.toml" in str(table.note)
    assert "not certain" in str(table.note)


def test_terminal_shows_summary_flagged_balls_and_stations():
    shown = [one for one in all_tables.tables_of_run(*of_frame()) if one.on_terminal]
    assert [str(one.title).split(",")[0] for one in shown] == [
        "Balls in short", "Flagged balls", "Stations against each other"
    ]  # fmt: skip
    values = {str(row[0]): row[1] for row in shown[0].rows}
    assert (values["balls"], values["flag ok"], values["flag not-found"]) == (5, 2, 1)
    assert values["95 % half-width of the radius, median"] == pytest.approx(0.098, abs=CSV)
    assert (values["movement of a node, largest"], values["nodes, verdict pass"]) == (12.0, 2)
    assert [row[0] for row in shown[1].rows] == [11, 12, 13]


# --- drawing -------------------------------------------------------------------------------------------------------


def opened(data):
    return ezdxf.read(io.StringIO(data.decode("utf-8")))


@pytest.mark.parametrize("T", [pose(), pose(TURN, (7e5, -2e5, 100.0))], ids=["same frame", "turned"])
def test_a_drawing_read_back(T):
    document = opened(dxf.drawing(whole(T=T)))
    assert not document.audit().has_errors
    assert document.header["$INSUNITS"] == 4  # millimetres
    space = document.modelspace()
    count = {
        (kind, layer): len(space.query(f'{kind}[layer=="{layer}"]'))
        for kind, layer in (
            ("CIRCLE", "NODES"), ("POINT", "NODES"), ("LINE", "AXES"), ("LINE", "MOVEMENTS"), ("TEXT", "IDS"),
            ("POINT", "LOWEST"),
        )
    }  # fmt: skip
    assert list(count.values()) == [4, 4, 2, 3, 4, 4]
    assert len(space) == sum(count.values())
    assert {text.dxf.text for text in space.query("TEXT")} == {"10", "11", "13", "14"}
    assert sorted(round(c.dxf.radius, 6) for c in space.query("CIRCLE")) == [45.0, 45.1, 50.0, 60.2]
    moved = {
        tuple(np.round(T[:3, :3] @ line.dxf.start + T[:3, 3], 4)) for line in space.query('LINE[layer=="MOVEMENTS"]')
    }
    assert moved == {tuple(NOMINAL[i]) for i in (0, 1, 3)}


def test_entities_are_written_as_the_library_writes_them():
    data = dxf.drawing(whole())
    again = io.StringIO(newline="\n")
    opened(data).write(again)
    entities = [text.partition("ENTITIES\n")[2].partition("ENDSEC")[0] for text in (data.decode(), again.getvalue())]
    assert entities[0].count("AcDbEntity") > 10
    assert entities[0] == entities[1]


def test_a_drawing_is_the_same_bytes_again_and_holds_no_names():
    data = dxf.drawing(whole())
    assert data == dxf.drawing(whole())
    assert not ezdxf.options.write_fixed_meta_data_for_testing
    assert b"S2" not in data
    assert b"determined" not in data


@pytest.mark.slow
def test_a_drawing_is_the_same_bytes_in_another_process():
    """The order of sets differs there."""
    code = (
        "import hashlib; from processor.report.space_frame import dxf;"
        "from tests.support.results.ball_results import whole;"
        "print(hashlib.sha256(dxf.drawing(whole())).hexdigest())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True,
        env={**os.environ, "PYTHONHASHSEED": "7"},
    )  # fmt: skip
    assert done.stdout.strip() == hashlib.sha256(dxf.drawing(whole())).hexdigest()


def test_the_folder_holds_the_drawing_and_can_be_replaced(tmp_path):
    execution, report = of_frame()
    write_results.write_results(tmp_path / "out", execution, report)
    tables = {f"{name}.csv" for name in ("balls", "lowest", "nodes", "tubes", "stations")}
    assert tables | {"nodes.dxf", "flagged-balls.pdf"} <= {path.name for path in (tmp_path / "out").iterdir()}
    write_results.check_output(tmp_path / "out", tmp_path / "b.h5")
    other = Execution(execution.scene, (StepRun("spheres", "ransac", "{}", balls()),), PROVENANCE)
    write_results.write_results(tmp_path / "out", other, report)
    assert not {"nodes.dxf", "lowest.csv", "nodes.csv"} & {path.name for path in (tmp_path / "out").iterdir()}


# --- figures and page ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def compared():
    """A run compared with truth, its report, and all its figures."""
    report, result = with_truth()
    execution, report = of_frame(result, report)
    return execution, report, all_figures.draw_figures(execution, report)


def test_figures_of_a_frame_and_those_of_balls_to_look_at(compared):
    found = compared[2]["spheres"].figures
    assert set(found) == {
        "radius-errors.png", "flagged-ball-11.png", "flagged-ball-12.png", "flagged-ball-13.png",
    }  # fmt: skip
    assert str(found["flagged-ball-11.png"][0]).startswith("Ball 11, wrong-size")


def test_points_that_are_not_at_hand_leave_the_pictures_of_balls_out():
    found = all_figures.draw_figures(*of_frame(points=np.empty((0, 3))))["spheres"].figures
    assert found == {}


def test_few_balls_have_a_picture_worst_first_and_all_a_page(monkeypatch):
    assert flagged_ball_figures.MOST_BALLS == 12
    monkeypatch.setattr(flagged_ball_figures, "MOST_BALLS", 2)
    made = repeated(whole(), 3)
    few = flagged_ball_figures.draw(scene(made), made)
    monkeypatch.setattr(flagged_ball_figures, "MOST_BALLS", 12)
    every = flagged_ball_figures.draw(scene(made), made)
    captions = [[str(caption) for caption, _ in drawn.figures.values()] for drawn in (few, every)]
    flags = [[caption.split(",")[1].split(":")[0].strip() for caption in of_one] for of_one in captions]
    assert flags == [["wrong-size"] * 2, ["wrong-size"] * 3 + ["not-found"] + ["low-confidence"] * 3]
    assert "the first 2 of 7" in captions[0][0]
    assert pages_of(few.documents[flagged_ball_figures.DOCUMENT]) == len(flags[1])


def test_balls_are_drawn_as_the_same_bytes_and_pages_share_the_pixels_of_their_frames(drawn_pictures, monkeypatch):
    """Two balls of one size and one of another, the second of which has not been found: the design's place is drawn."""
    monkeypatch.setattr(flagged_ball_figures, "MOST_BALLS", 2)
    made = whole(changed={"radii": np.array([45.1, 50.2, NAN, 45.0, 50.0])})
    drawn = flagged_ball_figures.draw(scene(made), made)
    document = drawn.documents[flagged_ball_figures.DOCUMENT]
    monkeypatch.setattr(flagged_ball_figures, "MOST_BALLS", 0)
    assert flagged_ball_figures.draw(scene(made), made).documents == drawn.documents
    wide = round(ball_picture.PAGE_DPI * ball_picture.SIZE_IN[0])
    assert (pages_of(document), len(re.findall(rb"/Width %d\b" % wide, document))) == (3, 2)
    png = drawn.figures["flagged-ball-12.png"][1]
    assert made.balls.flag[2] == "not-found"
    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
    left, bottom, wide, high = (DPI * inches for inches in ball_picture.VIEWS_IN[0])
    column, row = round(left + 0.5 * wide), round(len(pixels) - bottom - 0.5 * high)
    nominal = np.array(to_rgb(COLOURS[1])) * 255.0
    near = pixels[row - 3 : row + 4, column - 3 : column + 4]
    assert (np.abs(near - nominal).max(axis=2) < 10.0).any()  # anti-aliasing mixes in up to 4 % of another colour


def pages_of(pdf):
    assert pdf.startswith(b"%PDF-")
    return len(re.findall(rb"/Type /Page\b", pdf))


def test_a_ball_to_look_at_has_a_page_with_its_numbers(compared):
    made = whole()
    i = made.balls.flag.index("wrong-size")
    said = dict(ball_picture.numbers(made.balls, i, np.array([1.0, -2.0, 0.5])))
    half = 1.96 * np.sqrt(made.balls.covariance[i, 3, 3])
    assert said["radius"] == f"{made.balls.radii[i]:.2f} ± {half:.2f}"
    assert said["off the design's place, y"] == "2.00"  # found less designed
    first = compared[2]["spheres"].documents[flagged_ball_figures.DOCUMENT]
    assert pages_of(first) == 3
    fine = whole(changed={"flag": ("ok",) * 5})
    assert flagged_ball_figures.draw(scene(fine), fine) == Drawn({})


def test_crops_hold_the_points_about_each_place_of_every_scan_and_pose():
    rng = np.random.default_rng(3)
    points = rng.uniform(-500.0, 500.0, (5000, 3))
    origin = np.array([4e8, 3e9, 0.0])
    T = pose(TURN, (100.0, 0.0, 0.0))
    scans = (
        Scan("a", points[:2000], origin),
        Scan("b", (points[2000:] + origin - T[:3, 3]) @ T[:3, :3], T_project_scan=T),
    )
    made = Scene("s", "space-frame", scans, stations=Stations())
    centres = origin + np.array([[0.0, 0.0, 0.0], [200.0, -100.0, 300.0]])
    for crop, centre, far in zip(
        flagged_ball_figures.crops_about(made, centres, np.array([90.0, 150.0])), centres, (90.0, 150.0), strict=True
    ):
        away = np.linalg.norm(points + origin - centre, axis=1)
        assert len(crop) == (away <= far).sum() > 0
        # At 3e9 mm.
        np.testing.assert_allclose(np.sort(np.linalg.norm(crop, axis=1)), np.sort(away[away <= far]), atol=1e-5)


def test_balls_of_a_file_are_drawn_as_those_in_memory(tmp_path, monkeypatch):
    """The same points about each, though of the file only the tiles about it are read."""
    shown, show = [], ball_picture.BallPicture.show

    def kept(picture, *args):
        shown.append(args[4])
        show(picture, *args)

    monkeypatch.setattr(ball_picture.BallPicture, "show", kept)
    rng = np.random.default_rng(4)
    made = whole()
    T = pose(TURN, (100.0, 0.0, 0.0))
    near = np.repeat(made.balls.centres[made.balls.placed], 300, axis=0)
    far = rng.uniform(-5e3, 5e3, (60_000, 3)) + near.mean(axis=0)
    points = np.vstack([near + rng.uniform(-150.0, 150.0, near.shape), far])
    origin = np.array([500.0, -300.0, 0.0])
    scans = (
        Scan("a", (points - T[:3, 3]) @ T[:3, :3] - origin, origin, T_project_scan=T),
        Scan("b", points[:5000], point_station=np.zeros(5000, np.int32)),
    )
    one = dataclasses.replace(scene(made), scans=scans, stations=Stations(("S1",), np.zeros((1, 3))))
    store.write_scene(tmp_path / "s.h5", one, None, {})
    in_memory = flagged_ball_figures.draw(store.read_scene(tmp_path / "s.h5"), made)
    alone = store.read_scene(tmp_path / "s.h5", points=False)
    assert len(in_memory.figures) > 1
    assert flagged_ball_figures.draw(alone, made) == Drawn({})
    assert flagged_ball_figures.draw(alone, made, tmp_path / "s.h5") == in_memory
    half = len(shown) // 2
    assert max(map(len, shown)) > 100
    for one, other in zip(shown[:half], shown[half:], strict=True):
        np.testing.assert_array_equal(one, other)


def test_control_points_have_a_table_and_their_place_in_results_json():
    off = [[0.3, 0.0, -0.4], [30.0, 0.0, 0.0]]
    control = ControlDeviations(points=("T1", "T2"), off=off, used=[True, False], scans=("S1", "S2"))
    made = whole(datum=(reason("spheres.datum-control", points=2),), control=control)
    (table,) = (one for one in space_frame_tables.step_tables([StepRun("spheres", "ray", "{}", made)], ErrorReport())
                if one.file == "control")  # fmt: skip
    assert table.columns[0].name == "control_point"
    name, *off, used, scan = table.rows[0]
    assert (name, off, str(used), scan) == ("T1", [0.3, 0.0, -0.4, pytest.approx(0.5)], "yes", "S1")
    assert table.columns[-1].name == "scan"
    assert str(table.rows[1][-2]).startswith("no, ")
    step = written(made)
    assert [one["text"] for one in step["datum"]] == ["2 control points"]
    rows = [(one["name"], one["scan"], one["used"]) for one in step["control"]]
    assert rows == [("T1", "S1", True), ("T2", "S2", False)]
    assert not {"datum", "control"} & set(written(whole()))


def test_targets_without_members_have_lowest_points_and_bounds():
    changed = {"sizes": np.full(5, NAN), "axes": np.zeros(5, int), "nominal_radii": np.full(5, NAN)}
    made = without_design(whole(changed=changed, tubes=Tubes(), stations=StationCorrections()))
    found = {
        one.file: one for one in space_frame_tables.step_tables([StepRun("spheres", "ray", "{}", made)], ErrorReport())
    }
    assert {"balls", "lowest"} <= set(found)
    assert {*columns("bound_sd_lowest_z_mm", "efficiency_radius")} <= set(found["balls"].columns)
    assert any(one.on_terminal and columns("radius_mm")[0] in one.columns for one in found.values())


def test_designed_places_are_transformed_into_the_scan():
    T = pose(TURN, (7e5, -2e5, 100.0))
    made = whole(T=T)
    found = flagged_ball_figures.designed_places(scene(made), made)
    np.testing.assert_allclose(found[:4] @ T[:3, :3].T + T[:3, 3], NOMINAL[:4], atol=1e-6)  # float64 at 1 km: 1e-10
    assert np.isnan(found[4]).all()


def test_the_page_of_a_frame(compared):
    execution, report, drawn = compared
    text = page.html(execution, report, drawn)
    found = TablesOfPage(text)
    assert {"Nodes against the design (mm)", "Flagged balls, method ray (mm)", "Balls, method ray (mm)"} <= set(
        found.tables
    )
    assert found.tables["Nodes against the design (mm)"][1][-3] == "pass"
    assert len([one for one in found.addresses if one.startswith("data:image/png")]) == 1 + len(
        drawn["spheres"].figures
    )
    assert "Nodes against the design" in text[text.index('class="appendix"') :]
    head, first, *_ = found.tables["Balls: coordinates, lowest points, movements"]
    assert head[:9] == ["id", "x (m)", "y (m)", "z (m)", "± (mm)", "radius (mm)", "±", "lowest z (m)",
                        "± (mm)"]  # fmt: skip
    ball = execution.runs[0].result.balls
    assert first[:4] == [str(ball.names[0]), *(f"{value / 1000.0:.4f}" for value in ball.centres[0])]


@pytest.mark.parametrize("times", [500, pytest.param(6000, marks=pytest.mark.slow)])
def test_a_roof_of_many_balls_keeps_the_page_small(times, monkeypatch):
    """12 MB for 30,000 balls are a third of a kilobyte a ball, and 2 MB of tables of 2,000 rows each."""
    assert interactive_view.MOST_BALLS == 5000
    monkeypatch.setattr(interactive_view, "MOST_BALLS", 5 * times // 6)
    execution, report = of_frame(repeated(whole(), times))
    marks = interactive_view.interactive_data(execution.scene, execution.runs)["marks"]
    assert len(marks) == 2 * times + 1  # all that are flagged and placed, which are more than enough, and one other
    text = page.html(execution, report, {})
    assert len(text) < 2_000_000 + 5 * times * 1_000 / 3
    assert f"The first 2000 of {5 * times} rows" in text


def test_points_of_the_slice_are_painted_over_the_others():
    pixel = 2.0 * 100.0 / ball_picture.PIXELS
    points = np.array([[0.1, 50.1], [pixel + 0.1, 50.1], [-99.9, -99.9], [101.0, 0.0], [0.0, -1000.0]])
    image = ball_picture.painted(points, np.array([0.0, 20.0, -20.0, 0.0, 0.0]), 100.0)
    middle, row = ball_picture.PIXELS // 2, 3 * ball_picture.PIXELS // 4
    expected = np.zeros_like(image)
    expected[row - 1 : row + 2, middle : middle + 3] = ball_picture.BESIDE
    expected[row - 1 : row + 2, middle - 1 : middle + 2] = ball_picture.WITHIN
    expected[:2, :2] = ball_picture.BESIDE
    np.testing.assert_array_equal(image, expected)
