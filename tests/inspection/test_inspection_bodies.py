"""Bodies of structures inspected: a box built otherwise than designed in closed form, seen by stations with errors."""

import dataclasses

import numpy as np
import pytest
import trimesh

from processor.defects import surface_charts
from processor.deviation import step as deviation_step
from processor.evaluation import inspection as evaluation
from processor.geometry import rigid
from processor.inspection import flat_faces, structure_bodies
from processor.inspection import step as inspection_step
from processor.inspection.flat_faces import Body, Pieces
from processor.inspection.result import Quantity
from processor.limits import standards
from processor.model import InputError, Scene, Status, StructureDesign, StructureTruth, Truth, Verdict
from tests.support.clouds import beam_clouds
from tests.support.clouds.beam_clouds import SIZE, Built

SEEDS, COUNT = 5, 40_000
NOTHING_SEEN = flat_faces.Observed(
    np.empty((0, 3)), np.empty(0, np.int64), np.empty(0), np.empty(0), np.empty(0), side=50.0
)
FEW = 15_000  # points where what is asserted is within an interval, or no figure


def by_id(result, name=None):
    component = next(one for one in result.components if name in (None, one.name))
    found = component.characteristics
    return {id_: (float(found.deviation[k]), float(found.ci95[k])) for k, id_ in enumerate(found.id)}


def inspected(scene, register="none"):
    measured = deviation_step.run(scene, deviation_step.Params(register=register))
    return inspection_step.run(scene, inspection_step.Params(), {"deviation": measured})


def true_values(built):
    return {
        "length": built.longer,
        "width": built.wider,
        "height": 0.0,
        "twist": built.twist * SIZE[2],
        "sweep": built.bow,
        "camber": built.camber,
        "end-squareness-over-width": built.skew * SIZE[1],
        "end-squareness-over-height": 0.0,
        "start-squareness-over-width": 0.0,
        "start-squareness-over-height": 0.0,
    }


def beam(seed, count=COUNT):
    """A scene of a box as built, and how it is built."""
    draws = np.random.default_rng(8).standard_normal((SEEDS, 6))
    built = Built(*(draws[seed] * np.array([2.5, 1.5, 3.0, 2.0, 4e-3, 2e-3])))
    return beam_clouds.beam(built, seed, count=count), built


@pytest.fixture(scope="module")
def measured():
    """A scene, how it is built, and its deviations."""
    scene, built = beam(1, FEW)
    return scene, built, deviation_step.run(scene, deviation_step.Params(register="none"))


@pytest.mark.slow
def test_intervals_cover_the_deviations_as_built():
    """50 intervals: with 95 % each, 44 or more cover in 98 of 100 cases."""
    errors = []
    for scene, built in map(beam, range(SEEDS)):
        result = inspected(scene)
        found = by_id(result)
        for id_, true in true_values(built).items():
            deviation, ci95 = found[id_]
            size = id_ in ("sweep", "camber")
            errors.append(((abs(deviation) - abs(true)) if size else (deviation - true), ci95))
            if size and abs(true) > 2.0 * ci95:
                assert np.sign(deviation) == np.sign(true)
    error, ci95 = np.array(errors).T
    assert (np.abs(error) <= ci95).sum() >= 44
    assert np.median(ci95) < 1.96 * 0.3  # the interval of a place's registration alone: noise is 1 mm, of many points


def test_a_box_that_is_moved_and_turned_as_a_whole_has_no_defect_by_that():
    T = rigid.transform(rigid.rotation_from_vector(np.array([1e-3, -1.5e-3, 2e-3])), np.array([3.0, -4.0, 2.0]))
    found = by_id(inspected(beam_clouds.beam(Built(), 3, sigma=0.3, registration=0.0, count=COUNT, T=T)))
    for id_, (deviation, ci95) in found.items():
        # An interval that is narrow beside what is of second order: 0.04 mm came at most in three draws.
        assert abs(deviation) <= max(ci95, 0.1), id_


def test_an_end_that_was_not_seen_has_no_value():
    scene = beam_clouds.beam(Built(), 4, count=FEW)
    hidden = [
        dataclasses.replace(scan, points=scan.points[scan.points[:, 0] < 0.5 * SIZE[0] - 20.0]) for scan in scene.scans
    ]
    result = inspected(dataclasses.replace(scene, scans=tuple(hidden)))
    found = result.components[0].characteristics
    for id_ in ("length", "end-squareness-over-width"):
        row = found.id.index(id_)
        assert np.isnan(found.actual[row])
        assert found.reasons[row][0].code == "inspect.face-hidden"
    assert np.isfinite(by_id(result)["start-squareness-over-width"][0])


def test_the_truth_is_measured_by_the_same_definitions(measured):
    scene, built, deviation = measured
    result = inspection_step.run(scene, inspection_step.Params(), {"deviation": deviation})
    mesh = trimesh.creation.box(SIZE)
    points, facet = trimesh.sample.sample_surface(mesh, 20_000, seed=2)
    points = np.asarray(points)
    truth = Truth(structure=StructureTruth(points, mesh.face_normals[facet], beam_clouds.moved(points, built) - points))
    (true,) = evaluation._of_bodies(scene.structure, truth.structure).values()
    for id_, value in true_values(built).items():
        assert abs(true[id_]) == pytest.approx(abs(value), abs=0.05), id_  # by 20,000 places; second order
    coverage = {
        one.quantity: one.value for one in evaluation.check(scene, result, truth) if one.statistic == "coverage"
    }
    assert set(coverage) >= {"lengths", "widths and heights", "sweeps and cambers", "twists"}


def test_bodies_of_a_mesh_without_names_are_named_as_the_components_of_defects():
    apart, touching, upon = (
        trimesh.creation.box((400.0, 300.0, 200.0), rigid.transform(np.eye(3), np.array([x, 0.0, z])))
        for x, z in ((5000.0, 0.0), (0.0, 0.0), (100.0, 200.0))
    )
    mesh = trimesh.util.concatenate([apart, touching, upon])
    names = [body.name for body in bodies_of(mesh)]
    assert names == ["component-1", "component-2 body 1", "component-2 body 2"]
    assert surface_charts.of_mesh(mesh.vertices, mesh.faces, 50.0).names == ("component-1", "component-2")


def bodies_of(mesh, shift=(0.0, 0.0, 0.0)):
    """Bodies of a mesh of which nothing was seen."""
    design = StructureDesign("mesh", np.asarray(mesh.vertices) + np.array(shift), np.asarray(mesh.faces))
    return list(flat_faces.bodies(design, NOTHING_SEEN, 60.0))


def flat_plate(wave, noise, seed):
    """Pieces of a plate of 1000 x 800 with a wave of this amplitude along it, each with noise."""
    rng = np.random.default_rng(seed)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(25.0, 1000.0, 50.0), np.arange(25.0, 800.0, 50.0)))
    form = wave * np.cos(2.0 * np.pi * x / 500.0)
    places = np.stack([x, y, np.zeros_like(x)], axis=1)
    value = form + 3.0 + 1e-3 * x + noise * rng.standard_normal(len(x))
    (body,) = bodies_of(trimesh.creation.box((1000.0, 800.0, 12.0)), (500.0, 400.0, -6.0))
    pieces = list(body.pieces)
    top = next(k for k, face in enumerate(body.faces) if face.normal[2] > 0.9)
    pieces[top] = Pieces(places, value, np.full(len(x), noise**2 + 1e-6), 0.0)
    return {one.of: one for one in structure_bodies.measured(Body("plate", body.faces, tuple(pieces)), NOTHING_SEEN)[0]}


@pytest.mark.parametrize(("size", "apart"), [(1000.0, 0.5), (2000.0, 1.0), (8000.0, 1.0)])
def test_quarters_of_a_face_share_less_the_farther_they_lie_apart(size, apart):
    """Halves differ along, across and crosswise by half the shared variance each, from 2 m on; by a square before."""
    x, y = (0.5 * size * np.array(axis) for axis in ([0.6, 0.6, -0.6, -0.6], [0.8, -0.8, 0.8, -0.8]))
    pieces = Pieces(np.stack([x, y, 0.0 * x], axis=1), 0.0 * x, np.full(4, 0.04), 0.3)
    expected = np.full((4, 4), 1.0 - 0.5 * apart**2)  # of the three products of signs two are -1, one is 1
    np.fill_diagonal(expected, 1.0 + 1.5 * apart**2)
    # Rounding.
    np.testing.assert_allclose(pieces.covariance(x, y, 0.01), 0.09 * expected + 0.05 * np.eye(4), rtol=1e-12)


@pytest.mark.parametrize(("wave", "noise"), [(0.0, 0.2), (1.0, 0.2), (2.0, 0.02)])
def test_flatness_is_not_the_spread_of_the_noise(wave, noise):
    """320 pieces of 0.2 mm noise spread over 1.2 mm by noise alone."""
    true, held, values = 2.0 * wave * np.cos(np.pi / 10.0), 0, []  # of the middles of pieces
    for seed in range(30):
        one = flat_plate(wave, noise, seed)["flatness-thickness+"]
        held += one.low <= true <= one.high
        values.append(one.value)
    assert held >= 26  # of 30 with 95 %: in 98 of 100 cases
    assert np.mean(values) == pytest.approx(true, abs=3.0 * noise)  # the two extremes by 20 pieces in a row each


def test_a_plate_has_a_thickness_and_no_height():
    found = flat_plate(0.0, 0.1, 1)
    assert found["thickness"].nominal == pytest.approx(12.0)
    assert {one.what for one in found.values()} >= {Quantity.LENGTH, Quantity.WIDTH, Quantity.FLATNESS}
    assert not any(one.what is Quantity.HEIGHT for one in found.values())


def test_scene_without_design_or_deviation_is_not_inspected_with_a_reason():
    with pytest.raises(InputError, match="needs a design"):
        inspection_step.run(Scene("x", "structure"), inspection_step.Params())
    scene = beam_clouds.beam(Built(), 1, count=2000)
    failed = deviation_step.Result(status="failed", method="default")
    result = inspection_step.run(scene, inspection_step.Params(), {"deviation": failed})
    assert (result.status, result.reasons[0].code) == (Status.FAILED, "inspect.failed")
    assert inspection_step.run(scene, inspection_step.Params()).reasons[0].code == "inspect.no-deviation"


def test_verdicts_are_given_by_the_limits_and_indeterminate_where_another_attitude_fits_as_well(measured):
    scene, _, deviation = measured
    plain = inspection_step.run(scene, inspection_step.Params(), {"deviation": deviation})
    assert set(plain.components[0].characteristics.verdict) == {Verdict.NONE}
    named = dataclasses.replace(scene, tolerance=standards.load("GB 50205-2020"))
    ambiguous = dataclasses.replace(deviation, status=Status.AMBIGUOUS)
    for status, given in ((False, deviation), (True, ambiguous)):
        result = inspection_step.run(named, inspection_step.Params(), {"deviation": given})
        found = result.components[0].characteristics
        assert found.upper[found.id.index("length")] == pytest.approx(3000.0 / 2500.0)
        assert found.verdict[found.id.index("length")] is not Verdict.NONE
        assert (set(found.verdict) - {Verdict.NONE} == {Verdict.INDETERMINATE}) is status
    assert result.status is Status.OK


def test_sizes_of_a_warm_body_are_those_at_the_reference_temperature():
    """A box as designed, 40 K warmer than its design: 12e-6 a kelvin longer (EN 1993-1-1)."""
    longer = 12e-6 * 40.0 * SIZE
    scene = beam_clouds.beam(Built(longer=longer[0], wider=longer[1]), 6, sigma=0.2, registration=0.0, count=FEW)
    warm = by_id(inspected(dataclasses.replace(scene, temperature_C=60.0)))
    plain = by_id(inspected(scene))
    for name, size in (("length", longer[0]), ("width", longer[1])):
        assert plain[name][0] - warm[name][0] == pytest.approx(size, rel=2e-3)  # the expansion itself: 5e-4 of a size
        assert abs(warm[name][0]) <= warm[name][1]


def test_the_step_is_partial_if_a_body_was_not_seen_and_failed_if_none_was():
    scene, _ = beam(0, FEW)
    mesh = scene.structure
    two = StructureDesign(
        "two",
        np.concatenate([mesh.vertices, mesh.vertices + np.array([0.0, 0.0, 9000.0])]),
        np.concatenate([mesh.faces, mesh.faces + len(mesh.vertices)]),
    )
    both = dataclasses.replace(scene, structure=two)
    measured = deviation_step.run(both, deviation_step.Params(register="none"))
    core = dataclasses.replace(measured.core, distance=np.full(len(measured.core), np.nan))
    for given, status in ((measured, Status.PARTIAL), (dataclasses.replace(measured, core=core), Status.FAILED)):
        result = inspection_step.run(both, inspection_step.Params(), {"deviation": given})
        assert result.status is status


def test_twist_interval_of_a_half_hidden_flange_covers():
    """Three stations see one strip each, with a shift and a turn of .35 mm over half the length."""
    (body,), none = bodies_of(trimesh.creation.box((6000.0, 300.0, 20.0))), np.empty(0)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-2975.0, 3000.0, 50.0), np.arange(-125.0, 150.0, 50.0)))
    shared, noise = 0.35, 0.05
    held = 0
    for seed in range(24):
        rng = np.random.default_rng(seed)
        pieces = []
        for face in body.faces:
            if abs(face.normal[2]) < 0.9:
                pieces.append(Pieces(np.empty((0, 3)), none, none, 0.0))
                continue
            strip = (y > 0.0) * (face.normal[2] < 0.0)  # the outer side is seen by one station
            level, slope = shared * rng.standard_normal(2), shared / 3000.0 * rng.standard_normal(2)
            value = level[1 * strip] + slope[1 * strip] * x + noise * rng.standard_normal(len(x))
            places = np.stack([x, y, np.full(len(x), 10.0 * face.normal[2])], axis=1)
            pieces.append(Pieces(places, value, np.full(len(x), noise**2), shared))
        measured = structure_bodies.measured(Body("flange", body.faces, tuple(pieces)), NOTHING_SEEN)[0]
        (twist,) = (one for one in measured if one.what is Quantity.TWIST)
        held += twist.low <= 0.0 <= twist.high
    assert held >= 20  # of 24 with 95 %: in 99 of 100 cases
