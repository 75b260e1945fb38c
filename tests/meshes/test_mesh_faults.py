"""Facets given twice or from both sides, normals, open edges and corners that differ in their last digits."""

import numpy as np
import pytest
import trimesh

from processor.deviation import step as deviation_step
from processor.meshes import faults
from processor.scan_folder import folder

BOX = trimesh.creation.box((400.0, 300.0, 200.0))
VERTICES, SIDES = np.asarray(BOX.vertices), np.asarray(BOX.faces, np.int64)
HOLLOW = trimesh.util.concatenate([trimesh.creation.icosphere(2, 500.0), trimesh.creation.box((90.0, 80.0, 70.0))])
SHEET = SIDES[:2]  # a side of the box
# The box's mirror image in its side x = 200 mm: it touches the box there, facet by facet.
BESIDE, ITS_SIDES = VERTICES * [-1.0, 1.0, 1.0] + [400.0, 0.0, 0.0], SIDES[:, ::-1] + 8


def turned(faces, rows):
    faces = np.array(faces)
    faces[rows] = faces[rows, ::-1]
    return faces


CAVITY = turned(HOLLOW.faces, slice(len(HOLLOW.faces) - 12, None))


def apart(vertices, faces):
    """The mesh with vertices of its own for each facet, as STL has them."""
    return np.asarray(vertices)[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)


def volume(vertices, faces):
    return trimesh.Trimesh(vertices, faces, process=False).volume


@pytest.mark.parametrize("as_stl", [False, True], ids=["shared vertices", "vertices apart"])
@pytest.mark.parametrize(
    ("faces", "count", "open_edges"),
    [
        (SIDES, 0, 0),
        (SIDES[:, ::-1], 12, 0),
        (turned(SIDES, [2, 7]), 2, 0),
        (turned(SIDES, [0, 1, 2, 4, 5, 6, 8, 9, 10]), 9, 0),
        (SIDES[1:], 0, 3),
        (turned(SIDES[1:], [4]), 1, 3),
    ],
    ids=["sound", "inside out", "two", "most", "hole", "hole and one"],
)
def test_facets_are_turned_outward_and_open_edges_counted(faces, count, open_edges, as_stl):
    vertices, faces = apart(VERTICES, faces) if as_stl else (VERTICES, faces)
    mended = faults.mended(vertices, faces)
    assert (mended.turned, mended.open_edges, mended.open_parts) == (count, open_edges, int(open_edges > 0))
    assert mended.repeated == 0
    whole = trimesh.Trimesh(vertices, mended.faces, process=False)
    assert (np.einsum("ni,ni->n", whole.face_normals, whole.triangles_center) > 0.0).all()


@pytest.mark.parametrize(("faces", "count"), [(CAVITY, 0), (CAVITY[:, ::-1], len(CAVITY) - 12)])
def test_a_cavity_belongs_to_the_part_around_it(faces, count):
    mended = faults.mended(np.asarray(HOLLOW.vertices), faces)
    assert mended.turned == count
    assert volume(HOLLOW.vertices, mended.faces[:-12]) > 0.0
    assert len(np.unique(mended.part)) == (1 if count == 0 else 2)


@pytest.mark.parametrize("order", [slice(None), slice(None, None, -1), np.random.default_rng(3).permutation(24)])
@pytest.mark.parametrize(
    "more", [SIDES[:, ::-1], SIDES, turned(SIDES, slice(0, 5))], ids=["two-sided", "twice", "mixed"]
)
def test_a_closed_surface_given_twice_counts_once_and_looks_outward(more, order):
    faces = np.vstack([SIDES, more])[order]
    vertices, faces = apart(VERTICES, faces)
    mended = faults.mended(vertices, faces)
    assert (len(mended.faces), mended.repeated, mended.open_edges) == (12, 12, 0)
    assert volume(vertices, mended.faces) == pytest.approx(400.0 * 300.0 * 200.0)
    np.testing.assert_array_equal(np.sort(mended.faces, axis=1), np.sort(faces[mended.rows], axis=1))


@pytest.mark.parametrize(
    ("faces", "left", "open_edges"),
    [
        (np.vstack([SIDES, SIDES[:3, ::-1]]), 12, 0),  # some facets from both sides
        (np.vstack([SHEET, SHEET[:, ::-1]]), 2, 4),  # a sheet from both sides
        (np.vstack([SHEET[:1], SHEET[:1, ::-1]]), 1, 3),
        (np.vstack([SIDES, SIDES, SIDES[:, ::-1]]), 12, 0),
    ],
)
def test_facets_given_several_times_count_once(faces, left, open_edges):
    mended = faults.mended(VERTICES, faces)
    assert (len(mended.faces), mended.repeated, mended.open_edges) == (left, len(faces) - left, open_edges)


def test_a_sheet_seen_from_both_sides_keeps_the_side_that_comes_first():
    for first in (SHEET, SHEET[:, ::-1]):
        mended = faults.mended(VERTICES, np.vstack([first, first[:, ::-1]]))
        np.testing.assert_array_equal(mended.faces, first)


@pytest.mark.parametrize("inverted", [False, True])
def test_bodies_that_touch_keep_their_faces_there(inverted):
    its = ITS_SIDES[:, ::-1] if inverted else ITS_SIDES
    mended = faults.mended(np.vstack([VERTICES, BESIDE]), np.vstack([SIDES, its]))
    assert (len(mended.faces), mended.repeated) == (24, 0)


def test_equal_facets_of_two_named_bodies_are_no_repetition():
    bodies = np.repeat([0, 1], 12)
    assert faults.mended(VERTICES, np.vstack([SIDES, SIDES]), bodies).repeated == 0
    assert faults.mended(VERTICES, np.vstack([SIDES, SIDES]), 0 * bodies).repeated == 12


@pytest.mark.parametrize("its", [SIDES + 8, SIDES[:, ::-1] + 8], ids=["sound", "inside out"])
def test_bodies_that_touch_at_an_edge_are_turned_one_by_one(its):
    vertices, faces = np.vstack([VERTICES, VERTICES + np.array([400.0, 300.0, 0.0])]), np.vstack([SIDES, its])
    mended = faults.mended(vertices, faces)
    assert volume(vertices, mended.faces) == pytest.approx(2 * 400.0 * 300.0 * 200.0)


@pytest.mark.parametrize(("digits", "joined"), [(np.float64, True), (np.float32, True), (1e-3, False)])
def test_corners_that_differ_in_their_last_digits_are_joined(digits, joined):
    vertices, faces = apart(VERTICES + np.array([100.0, 50.0, 20.0]), SIDES)
    rng = np.random.default_rng(5)
    last = np.spacing(np.abs(vertices).astype(digits)) if isinstance(digits, type) else digits * 400.0
    mended = faults.mended(vertices + last * rng.integers(-1, 2, vertices.shape), faces)
    assert (mended.open_edges == 0) == joined
    assert (len(mended.points) == 8) == joined


def test_corners_of_a_closed_mesh_are_never_joined():
    """A pin of 1 micrometre on a body of 10 m: its corners are nearer than the reach, but no edge is open."""
    pin = trimesh.creation.box((1e-3, 1e-3, 1e-3))
    pin.apply_translation((9e3, 0.0, 0.0))
    body = trimesh.util.concatenate([trimesh.creation.box((1e4, 10.0, 10.0)), pin])
    mended = faults.mended(np.asarray(body.vertices), np.asarray(body.faces, np.int64))
    assert (len(mended.points), mended.open_edges) == (16, 0)


def test_inverted_design_gives_the_same_deviations_with_a_message(tmp_path):
    found = {}
    for name, faces in (("sound", BOX.faces), ("inverted", BOX.faces[:, ::-1])):
        place = tmp_path / name
        place.mkdir()
        trimesh.Trimesh(BOX.vertices, faces, process=False).export(place / "design.ply")
        points = trimesh.sample.sample_surface(BOX, 5_000, seed=1)[0] * [1.0, 1.0, 1.02]
        np.savetxt(place / "scan.xyz", points)
        (place / "project.toml").write_text(
            'kind = "structure"\nunits = "mm"\ndesign = "design.ply"\n[[scan]]\nfile = "scan.xyz"\n'
        )
        scene = folder.read_input(place)
        found[name] = deviation_step.run(scene, deviation_step.Params(register="none"))
    told = [reason for reason in found["inverted"].reasons if reason.code.startswith("design.")]
    assert [(reason.code, reason.values) for reason in told] == [("design.turned", {"turned": 12})]
    assert not [reason for reason in found["sound"].reasons if reason.code.startswith("design.")]
    assert found["sound"].max > 1.5
    assert found["inverted"].max == pytest.approx(found["sound"].max, abs=0.1)  # mm; 5000 points without noise
    assert found["inverted"].mean == pytest.approx(found["sound"].mean, abs=0.02)  # mm
