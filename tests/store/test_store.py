"""The store: records come back as written, bytes repeat, boxes are cut right, and files are not trusted."""

import dataclasses
import hashlib
import json
import pickle
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest

from processor.language.messages import messages
from processor.model import (
    Checked,
    FrameDesign,
    FrameTruth,
    InputError,
    PointLabels,
    Scan,
    Scene,
    StepRun,
    Truth,
    column,
    names,
    reason,
)
from processor.space_frame import step as space_frame_step
from processor.space_frame.result import Balls
from processor.store import checksums, codec, store, streaming
from processor.store.whole_output import whole_folder
from tests.support.files.old_files import sealed_again
from tests.support.results.records import assert_equal
from tests.support.scenes.store_scenes import a_scene, surface_points

HALF_STEP = 0.5e-4 * (1.0 + 1e-6)  # mm: points are kept to 0.0001 mm; the rest is the rounding of float64 at 20 m


@pytest.fixture
def written(tmp_path):
    path = tmp_path / "scene.h5"
    scene, truth = a_scene()
    store.write_scene(path, scene, truth, {"seed": 1, "α": [1.5, None]})
    return path


def lexicographic(points):
    return points[np.lexsort(points.T)]


def in_box(path, lower, upper):
    """Points of a file's first scan within a box."""
    with streaming.points_of(path) as points:
        whole = (np.full((1, 3), -np.inf), np.full((1, 3), np.inf))
        boxed = points.near([(np.atleast_2d(lower), np.atleast_2d(upper)), *[whole] * (len(points.scans) - 1)])
        pieces = [piece for piece, _ in boxed.read(0)]
        assert boxed.counts()[0] == sum(map(len, pieces))
    found = np.concatenate([np.empty((0, 3)), *pieces])
    return found[((found >= lower) & (found <= upper)).all(axis=1)]


def test_a_scene_comes_back(written):
    scene, truth = a_scene()
    back = store.read_scene(written)
    assert_equal(back.arch, scene.arch)
    assert_equal(back.stations, scene.stations)
    kept = back.name, back.kind, back.units_reason, back.temperature_C
    assert kept == ("桥", "arch-bridge", scene.units_reason, 21.5)
    assert back.frame is None
    given, found = scene.scans[0], back.scans[0]
    columns = {"points": [], "intensity": [], "point_station": []}
    assert_equal(dataclasses.replace(found, **columns), dataclasses.replace(given, **columns))
    # The order of the points changes; sorted by the exact column that travels with each, they match one to one.
    order, given_order = np.argsort(found.intensity), np.argsort(given.intensity)
    assert np.array_equal(found.intensity[order], given.intensity[given_order])
    assert np.abs(found.points[order] - given.points[given_order]).max() <= HALF_STEP
    assert np.array_equal(found.point_station[order], given.point_station[given_order])
    labels = store.read_truth(written).labels[0]
    assert np.array_equal(labels.part[order], truth.labels[0].part[given_order])
    assert np.array_equal(labels.source[order], truth.labels[0].source[given_order])
    assert_equal(store.read_truth(written).arch, truth.arch)
    assert store.read_provenance(written) == {"seed": 1, "α": [1.5, None]}
    assert store.problems(written) == []


def test_a_space_frame_comes_back(tmp_path):
    path = tmp_path / "f.h5"
    frame = FrameDesign([3, 4], np.eye(3)[:2], [1.0, 2.0], [3], [4], [1.5])
    truth = Truth(frame=FrameTruth([3, 4], np.eye(3)[:2], [1.0, 2.0], np.zeros((2, 3))), spacing_mm=5.0)
    scene = Scene("f", "space-frame", (Scan("s", np.eye(3)),), frame=frame)
    store.write_scene(path, scene, truth, {})
    assert_equal(store.read_scene(path).frame, frame)
    assert_equal(store.read_truth(path), truth)


def test_same_content_has_the_same_bytes_also_when_it_comes_back(written, tmp_path):
    again, other = tmp_path / "again.h5", tmp_path / "renamed.h5"
    store.write_scene(again, store.read_scene(written), store.read_truth(written), store.read_provenance(written))
    store.write_scene(other, *a_scene(), {"α": [1.5, None], "seed": 1})
    assert again.read_bytes() == other.read_bytes() == written.read_bytes()


def test_bytes_do_not_depend_on_how_long_objects_live(written, tmp_path, monkeypatch):
    """A debugger or a collector that is off may keep the library's objects of datasets and groups."""
    kept = []
    for name in ("create_dataset", "create_group"):
        create = getattr(h5py.Group, name)

        def keeping(*arguments, create=create, **options):
            kept.append(create(*arguments, **options))
            return kept[-1]

        monkeypatch.setattr(h5py.Group, name, keeping)
    store.write_scene(tmp_path / "kept.h5", *a_scene(), {"seed": 1, "α": [1.5, None]})
    assert len(kept) > 20
    assert (tmp_path / "kept.h5").read_bytes() == written.read_bytes()


def test_order_of_points_changes_only_the_order_within_tiles(written, tmp_path):
    scene, _ = a_scene()
    flipped = dataclasses.replace(scene, scans=(Scan("s1", scene.scans[0].points[::-1]),))
    path = tmp_path / "flipped.h5"
    store.write_scene(path, flipped, None, {})
    with h5py.File(path) as a, h5py.File(written) as b:
        for name in ("cell", "count", "lower", "edge", "offset"):
            here = f"scene/scans/0000/points/{name}"
            assert np.array_equal(a[here][()], b[here][()])


def test_hash_is_of_the_scene_alone(written, tmp_path):
    scene, _ = a_scene()
    bare = tmp_path / "bare.h5"
    store.write_scene(bare, scene, None, {"other": 2})
    first = store.read_scene(written)
    assert store.scene_hash(first) == store.scene_hash(store.read_scene(bare))
    points = first.scans[0].points.copy()
    points[7, 1] = np.nextafter(points[7, 1], np.inf)
    moved = dataclasses.replace(first, scans=(dataclasses.replace(first.scans[0], points=points), first.scans[1]))
    colder = dataclasses.replace(first, temperature_C=21.4)
    renamed = dataclasses.replace(first, scans=(dataclasses.replace(first.scans[0], name="s3"), first.scans[1]))
    assert len({store.scene_hash(one) for one in (first, moved, colder, renamed)}) == 4


def test_hashes_are_pinned():
    """A change of these numbers loses every cached result: it needs a reason.

    The source of a unit was a text once; scenes of that time have the same hash.
    """
    scene = Scene("a", "structure", (Scan("s", [[1.0, 2.0, 3.0]]),))
    assert store.scene_hash(scene) == "7153acca7173970bcf49a09b87d571fa0cec12095625f37881754a2bd46d62f6"
    made = dataclasses.replace(scene, units_reason=(reason("units.made-in-mm"),))
    assert store.scene_hash(made) == "b936a6d120037ebf7fa7805bd6d28a264faa7edf5317ddae59338cc7b10717d9"
    guessed = reason("units.design-guessed")
    for why in (reason(f"units.{code}") for code in ("as-scanners-write", "by-option", "made-in-mm")):
        text = f"{messages('en').text(why)}; {messages('en').text(guessed)}"
        by_code = dataclasses.replace(scene, units_reason=(why, guessed))
        by_text = dataclasses.replace(scene, units_reason=(reason("units.as-stated", text=text),))
        assert store.scene_hash(by_code) == store.scene_hash(by_text)


def with_units_reason(path, data, version):
    """Put another dataset in the place of the reasons for the unit, as another version of the program writes it."""
    with h5py.File(path, "r+") as file:
        del file["scene/units_reason"]
        file["scene"].create_dataset("units_reason", data=data)
        del file.attrs["format_version"]
        file.attrs["format_version"] = np.bytes_(version)
    return sealed_again(path)


def test_the_source_of_a_unit_in_an_earlier_file_is_its_text(written):
    whole = store.read_scene(written)
    text = np.bytes_("given by --units")
    earlier = store.read_scene(with_units_reason(written, text, "1.4"))
    assert earlier.units_reason == (reason("units.as-stated", text="given by --units"),)
    assert store.scene_hash(earlier) == store.scene_hash(whole)


def test_reasons_without_the_values_of_their_text_are_a_fault_of_the_file(written):
    bad = np.array([b'{"code": "units.by-format", "values": {}}'])
    with pytest.raises(InputError, match=r"/scene/units_reason, row 0: expected the values of 'units.by-format'"):
        store.read_scene(with_units_reason(written, bad, store.FORMAT_VERSION))


@pytest.mark.parametrize(
    ("size_mm", "steps"),
    [(400_000.0, 1e-4), (4_000_000.0, 1e-3), (40_000_000.0, 0.0)],
    ids=["0.0001 mm", "0.001 mm", "float64"],
)
def test_precision_follows_the_extent(tmp_path, size_mm, steps):
    points = surface_points(5_000, size=(size_mm, 1_000.0, 1_000.0)) + 12_345.678912345
    path = tmp_path / "wide.h5"
    store.write_scene(path, Scene("w", "structure", (Scan("s", points, intensity=points[:, 0]),)), None, {})
    back = store.read_scene(path).scans[0]
    off = np.abs(back.points[np.argsort(back.intensity)] - points[np.argsort(points[:, 0])]).max()
    assert off <= 0.5 * steps * (1 + 1e-4)  # the rest is the rounding of float64 at 4 km
    lower, upper = points.min(axis=0) + 100.0, points.max(axis=0) - [size_mm / 2, 200.0, 0.0]
    inside = back.points[((back.points >= lower) & (back.points <= upper)).all(axis=1)]
    assert np.array_equal(lexicographic(in_box(path, lower, upper)), lexicographic(inside))


def test_one_point_and_points_in_one_place(tmp_path):
    path = tmp_path / "one.h5"
    scans = (Scan("none"), Scan("one", [[1.0, 2.0, 3.0]]), Scan("same", np.full((100, 3), 7.25)))
    store.write_scene(path, Scene("o", "structure", scans), None, {})
    back = store.read_scene(path)
    assert [scan.points.tolist() for scan in back.scans[:2]] == [[], [[1.0, 2.0, 3.0]]]
    assert (back.scans[2].points == 7.25).all()
    assert len(in_box(path, np.full(3, -1.0), np.ones(3))) == 0


def test_boxes_match_a_plain_cut(written):
    points = store.read_scene(written).scans[0].points
    rng = np.random.default_rng(3)
    for _ in range(10):  # corners in and between some of the tiles of each axis
        lower = rng.uniform([-500, -500, -500], [18_000, 1_500, 2_500])
        upper = lower + rng.uniform(0.0, [9_000, 2_000, 2_000])
        plain = points[((points >= lower) & (points <= upper)).all(axis=1)]
        assert np.array_equal(lexicographic(in_box(written, lower, upper)), lexicographic(plain))
    # Bounds are inclusive: a box of zero size on a point holds that point.
    assert len(in_box(written, points[5], points[5])) >= 1


def test_a_box_reads_only_its_tiles(tmp_path):
    path = tmp_path / "large.h5"
    points = surface_points(150_000)
    store.write_scene(path, Scene("l", "structure", (Scan("s", points),)), None, {})
    with h5py.File(path) as file:
        x = file["scene/scans/0000/points/x"]
        assert x.chunks[0] < len(x) / 2
        last = x.id.get_chunk_info(x.id.get_num_chunks() - 1)
    content = bytearray(path.read_bytes())
    content[last.byte_offset + 100 : last.byte_offset + 200] = bytes(100)
    path.write_bytes(content)
    lower, upper = np.array([100.0, -50.0, -50.0]), np.array([900.0, 2_100.0, 3_100.0])
    plain = points[((points >= lower) & (points <= upper)).all(axis=1)]
    assert abs(len(in_box(path, lower, upper)) - len(plain)) <= 1  # of rounding
    with pytest.raises(InputError, match="damaged"):
        store.read_scene(path)


# --- truth and results ---------------------------------------------------------------------------------------------


def test_truth_is_copied_to_a_file_of_its_own(written, tmp_path):
    alone = tmp_path / "truth.h5"
    assert store.copy_truth(written, alone)
    assert_equal(store.read_truth(alone), store.read_truth(written))
    with pytest.raises(InputError, match="expected format processor-scene, found processor-truth"):
        store.read_scene(alone)
    bare, none = tmp_path / "bare.h5", tmp_path / "none.h5"
    store.write_scene(bare, a_scene(100)[0], None, {})
    assert store.read_truth(bare) is None
    assert not store.copy_truth(bare, none)
    assert not none.exists()


@dataclass(frozen=True)
class Inner(Checked):
    names: tuple[str, ...] = names("k")
    values: np.ndarray = column("k", 2)


@dataclass(frozen=True)
class Outer(Checked):
    status: str
    good: bool = True
    count: int = 3
    inner: Inner | None = None
    absent: Inner | None = None
    several: tuple[Inner, ...] = ()
    rms: float = float("inf")


def test_results_come_back(tmp_path):
    path = tmp_path / "results.h5"
    inner = Inner(("a", "", "长"), [[1, 2], [3, np.nan], [5, 6]])
    outer = Outer("ok", False, -(2**40), inner, None, (inner, Inner()), float("-inf"))
    ball = Balls(
        ids=[1], centres=np.ones((1, 3)), radii=[75.0], evidence=["ball"], flag=["ok"], reasons=[()], verdict=["none"]
    )
    said = (reason("two.lines", text="two lines\nof text"),)
    balls = space_frame_step.Result("partial", "ransac", said, ball)
    runs = (StepRun("outer", "m", json.dumps({"seed": 1}), outer), StepRun("spheres", "ransac", "{}", balls))
    classes = {"spheres": space_frame_step.Result, "outer": Outer}
    store.write_results(path, runs, {})
    assert_equal(store.read_results(path, classes), runs)
    assert store.problems(path) == []
    with pytest.raises(InputError, match="unknown step 'outer'"):
        store.read_results(path, {"spheres": space_frame_step.Result})
    with pytest.raises(InputError, match=r"0001/result.*(missing|unknown)"):
        store.read_results(path, {"spheres": Outer, "outer": Outer})


# --- writing safely ------------------------------------------------------------------------------------------------


def test_an_error_while_writing_leaves_the_old_file(written, monkeypatch):
    before = written.read_bytes()
    monkeypatch.setattr(
        "processor.store.codec.write_array", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left"))
    )
    with pytest.raises(InputError, match=r"cannot be written .*No space left"):
        store.write_scene(written, *a_scene(100), {})
    assert written.read_bytes() == before
    assert list(written.parent.iterdir()) == [written]


def test_an_error_while_writing_leaves_nothing_new(tmp_path):
    with pytest.raises(TypeError):
        store.write_scene(tmp_path / "new.h5", a_scene(100)[0], None, {"not JSON": object()})
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match="cannot be written"):
        store.write_scene(tmp_path / "no" / "folder.h5", a_scene(100)[0], None, {})


def test_scenes_that_are_not_written(tmp_path):
    path = tmp_path / "new.h5"
    twice = Scene("t", "structure", (Scan("s"), Scan("s")))
    nan = Scene("n", "structure", (Scan("s", [[0.0, np.nan, 0.0]]),))
    fine = Scene("f", "structure", (Scan("s", np.eye(3)),))
    for scene, truth, why in [
        (twice, None, "different names, found s, s"),
        (nan, None, "not finite"),
        (fine, Truth((PointLabels("s", (), [0], [0]),)), "expected 3 labels .* found 1"),
        (fine, Truth((PointLabels("t", (), [0], [0]),)), "'t', which is not in the scene"),
    ]:
        with pytest.raises(InputError, match=why):
            store.write_scene(path, scene, truth, {})
    assert not path.exists()


def test_results_of_the_old_format_are_refused_with_advice(tmp_path):
    path = tmp_path / "results.h5"
    store.write_results(path, [], {})
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = np.bytes_("1.3")
    with pytest.raises(
        InputError,
        match=r"expected format_version 2\.0 or 2\.1 or .* or 2\.5, found 1\.3; run processor run again",
    ):
        store.read_results(path, {})


@pytest.mark.parametrize(
    "data",
    [
        np.arange(6.0).reshape(2, 3),
        np.float64(2.5),
        np.empty(0, np.int64),
        np.arange(3, dtype=np.uint8),
        np.array([b"a", b"bc"], h5py.string_dtype("utf-8", 2)),
        np.array(b"abc", h5py.string_dtype("utf-8", 3)),
    ],
)
def test_a_dataset_has_the_bytes_that_h5py_gives_it(tmp_path, data):
    paths = tmp_path / "own.h5", tmp_path / "theirs.h5"
    with h5py.File(paths[0], "w", libver="earliest") as file:
        codec._create(file.create_group("group"), "x", data)
        checksum = file["group/x"].attrs[checksums.ATTRIBUTE]
    with h5py.File(paths[1], "w", libver="earliest") as file:
        dataset = file.create_group("group").create_dataset("x", data=data)
        stated = f"/group/x:{dataset.dtype.str}{dataset.shape};".encode()
        assert checksum == hashlib.sha256(stated + np.asarray(data).tobytes()).hexdigest().encode()
        dataset.attrs.create(checksums.ATTRIBUTE, checksum, dtype=h5py.string_dtype("ascii", 64))
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_an_error_has_its_path_beside_its_problem_in_another_process_as_well():
    error = pickle.loads(pickle.dumps(InputError("a: b; c", path=Path("d: e.h5"))))
    assert (str(error), error.path, error.problem) == ("d: e.h5: a: b; c", Path("d: e.h5"), "a: b; c")
    bare = pickle.loads(pickle.dumps(InputError("a: b")))
    assert (str(bare), bare.path, bare.problem) == ("a: b", None, "a: b")
    assert len(InputError("word " * 10_000, path="f").problem) < 7_000


def test_an_error_of_a_file_in_a_folder_that_is_removed_names_its_place(tmp_path):
    with pytest.raises(InputError) as caught, whole_folder(tmp_path / "out", replaces=True) as making:
        raise InputError("cannot be written", path=making / "a" / "b.csv")
    assert str(caught.value) == f"{tmp_path / 'out' / 'a' / 'b.csv'}: cannot be written"


def test_faults_of_a_file_do_not_repeat_its_name(tmp_path):
    path = tmp_path / "a.h5"
    path.write_bytes(b"x")
    assert all(str(path) not in fault for fault in store.problems(path))
    assert store.damage(path)[1][0].startswith("expected a processor-scene or")
