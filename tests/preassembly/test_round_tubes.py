"""Ends of round tubes against closed forms: key points and their intervals, and what no scan shows, a tube's turn."""

from types import SimpleNamespace

import numpy as np
import pytest

from processor.evaluation import preassembly as evaluation
from processor.geometry import mesh_distance, rigid
from processor.model import NORMAL_95, Statistic, Status
from processor.preassembly import step
from processor.preassembly.chain import joint_measures
from processor.preassembly.ends import section, tube_end
from processor.preassembly.ends.joint_end import JointEnd
from processor.preassembly.ends.joint_frame import end_place, joint_frame
from processor.preassembly.parts import attitude
from processor.registration import pose_search
from tests.support.results import measured_parts
from tests.support.results.reasons import codes
from tests.support.scenes import known_attitudes
from tests.support.solids import round_tubes
from tests.support.solids.round_tubes import AsBuilt, Sizes

STRAIGHT, ARCH = Sizes(parts=2), Sizes(parts=2, bend=20_000.0)


def mesh_of(sizes, part, inside_out=False):
    vertices, faces = round_tubes.mesh(sizes, part)
    return mesh_distance.of_mesh(vertices, faces[:, ::-1] if inside_out else faces)


def fitted(sizes, part, built, rng, sigma=1.0, spacing=12.0, turn_known=True, inside_out=False):
    """The end of a tube at joint J1, registered as designed; part 0 ends there, part 1 starts."""
    design = round_tubes.design(sizes)
    surface = mesh_of(sizes, part, inside_out)
    points = round_tubes.scanned(sizes, part, built, rng, spacing, sigma)
    registered = measured_parts.registered(points, surface, surface)
    place = end_place(design.joint_points[0], 1.0 - 2.0 * part, surface)
    return tube_end.fit(registered, place, turn_known), design.joint_points[0], place.T_bridge_joint[:3, :3]


def errors(sizes, part, built, rng, **options):
    """Errors (8, 3) of the key points and their standard deviations, in the joint's axes."""
    end, points, R = fitted(sizes, part, built, rng, **options)
    found = tube_end.estimate(end)
    assert isinstance(found, JointEnd)
    true = (round_tubes.key_points(sizes, part, 1 - part, built) - points) @ R
    return found.departure - true, np.sqrt(np.diag(found.covariance)).reshape(8, 3)


@pytest.mark.parametrize("sizes", [STRAIGHT, ARCH], ids=["straight", "arch"])
@pytest.mark.parametrize("part", [0, 1])
def test_key_points_of_a_scan_without_noise_are_those_of_the_closed_form(sizes, part):
    """The normals of part 1 point inward, as those of a mesh that is not closed may."""
    built = AsBuilt(np.array([1.7, -2.3]), np.array([[1.5e-3, -2e-3], [-1e-3, 2.5e-3]]), 0.4)
    error, _ = errors(sizes, part, built, np.random.default_rng(0), sigma=0.0, inside_out=part == 1)
    # The mesh's facets lie 0.034 mm inside of the circle; what is left of that after its curvature is put back.
    assert np.abs(error).max() < 0.02


@pytest.mark.slow
def test_intervals_cover_key_points_as_built():
    held, sizes_of = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        for sizes, part in ((STRAIGHT, seed % 2), (ARCH, 1 - seed % 2)):
            error, sd = errors(sizes, part, round_tubes.drawn(rng), rng)
            held.append(np.abs(error) <= NORMAL_95 * sd)
            sizes_of.append(sd)
    # 16 ends of some eight independent coefficients: 128 of 95 % have a standard deviation of 1.9 %, two of which are
    assert 0.91 < np.mean(held) < 0.99  # left on either side.
    assert np.median(sizes_of) < 0.2  # 1 mm by hundreds of points a coefficient, extrapolated to the end


@pytest.mark.parametrize("angle", np.radians([10.0, 130.0, 260.0]))
def test_intervals_contain_any_turn_where_none_is_known(angle):
    rng = np.random.default_rng(3)
    built = AsBuilt(np.zeros(2), np.array([[0.0, 0.0], [4e-3, -3e-3]]))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    # A tube turned by the angle has its tilts turned; its key points are those of before, turned.
    turned = AsBuilt(np.zeros(2), np.array([[0.0, 0.0], turn @ built.tilt[1]]))
    end, points, R = fitted(STRAIGHT, 0, turned, rng, turn_known=False)
    found = tube_end.estimate(end)
    at = (round_tubes.key_points(STRAIGHT, 0, 1, built) - points) @ R
    centre = (points - joint_frame(points)[:3, 3]) @ R
    true = np.column_stack([at[:, 0], (centre[:, 1:] + at[:, 1:]) @ turn.T - centre[:, 1:]])
    sd = np.sqrt(np.diag(found.covariance)).reshape(8, 3)
    assert (np.abs(found.departure - true) <= NORMAL_95 * sd + 0.01).all()  # facets: see above
    # What no turn changes is known as well as ever.
    measured = joint_measures.measure(found.departure, found.covariance, np.eye(4), centre)
    for name in ("groove_gap_mean", "offset_x", "offset_y", "offset_z"):
        value, ci95 = measured.of(name)
        expected = true.mean(axis=0)[["x", "y", "z"].index(name[-1])] if name[-1] in "xyz" else true[:, 0].mean()
        assert abs(value - expected) < 2.0 * ci95  # nearly 4 standard deviations
        assert ci95 < 0.5  # of eight points known to 0.2 mm; the turn alone makes metres
    assert measured.of("rotation_x")[1] > 1000.0


def test_any_turn_is_within_the_bound_of_its_linear_change():
    rng = np.random.default_rng(0)
    for _ in range(200):
        t, q = rng.standard_normal(2)
        r = np.linspace(0.0, 2.0 * np.pi, 721)
        largest = np.abs(np.sin(r) * t + (np.cos(r) - 1.0) * q).max()
        assert largest <= tube_end.TURN_BOUND * np.hypot(t, 2.0 * q) + 1e-12


def test_the_covariance_of_a_wall_is_that_of_least_squares_and_of_errors_that_its_points_share():
    """Noise of 0.02 mm of pairs that cancel, so that no cell is off; one station's error of 0.5 mm is of the radius."""
    x, angle = (np.repeat(v, 2) for v in np.meshgrid(np.linspace(5.0, 495.0, 30), np.arange(-3.1, 3.1, 0.1)))
    x, angle = x.ravel(), angle.ravel()
    residual = 0.02 * (-1.0) ** np.arange(len(x))
    part = SimpleNamespace(station=np.zeros(len(x), np.int64), between_stations=0.25)
    found = tube_end._wall_covariance(part, x, angle, np.arange(len(x)), residual)
    around = np.stack([f(k * angle) for k, f in ((0, np.cos), (1, np.cos), (1, np.sin), (2, np.cos), (2, np.sin))])
    basis = np.vstack([around, x / 500.0 * around, (x / 500.0) ** 2 * around[1:3]])
    expected = 0.02**2 * len(x) / (len(x) - 12) * np.linalg.inv(basis @ basis.T)
    expected[0, 0] += 0.25
    # What is known of coefficients beforehand, 80 mm, is beside 0.01 mm of the least known one as 1 to 1e-7.
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-9)


def test_intervals_of_large_departures_include_what_the_linear_model_leaves_out():
    """A radius 100 mm too large: half a percent of it as a limit, divided by sqrt(3), and a least sd of 0.004 mm."""
    place = end_place(round_tubes.design(STRAIGHT).joint_points[0], 1.0, mesh_of(STRAIGHT, 0))
    end = tube_end.FittedTube(
        coefficients=100.0 * np.eye(17)[0], covariance=np.zeros((17, 17)), pose=np.zeros((6, 6)), place=place,
        turn_known=True, plates=(), ring_noise=0.0,
    )  # fmt: skip
    # Rounding.
    np.testing.assert_allclose(tube_end.estimate(end).covariance, (0.004**2 + 0.5**2 / 3.0) * np.eye(24), rtol=1e-9)


def test_a_section_is_round_by_its_key_points():
    points = round_tubes.design(ARCH).joint_points[0]
    assert section.round_radius(rigid.apply(rigid.invert(joint_frame(points)), points)) == pytest.approx(250.0)
    box = np.vstack([points[:4], 0.5 * (points[:4] + np.roll(points[:4], -1, axis=0))])
    assert section.round_radius(rigid.apply(rigid.invert(joint_frame(box)), box)) == 0.0


def assembled(monkeypatch, **kind):
    """Of two tubes of which the first one's attitude is searched for: the second is another of its kind."""
    sizes = Sizes(parts=2, length=1600.0, radius=200.0, **kind)
    scene, truth = round_tubes.scene(sizes, seed=1, spacing=14.0)
    monkeypatch.setattr(pose_search, "FINE_POINTS", 5_000)  # of the search; all points register what it finds
    monkeypatch.setattr(attitude, "find", known_attitudes.find_by(truth, "tube1"))
    result = step.run(scene, step.Params())
    return scene, truth, result


def test_tubes_with_a_gusset_are_assembled(monkeypatch):
    scene, truth, result = assembled(monkeypatch, gusset=True)
    found = {(one.quantity, one.statistic): one.value for one in evaluation.check(scene, result, truth)}
    assert result.components.status == (Status.OK,) * 2
    assert found["key points", Statistic.COVERAGE] > 80.0  # of 16 that hang together
    # 0.5 mrad of turn by the gusset's few points, at 200 mm, beside ends known to 0.2 mm
    assert found["key points in the scan", Statistic.RMS] < 1.0


def test_a_tube_without_a_mark_is_not_called_sure(monkeypatch):
    _, truth, result = assembled(monkeypatch, collar=True)
    assert result.components.status[0] == Status.AMBIGUOUS
    assert "preassemble.turn-unknown" in codes(result.components.reasons[0])
    off = np.abs(result.components.key_points_scan - truth.arch.key_points_scan)[0, 1]
    assert (off <= NORMAL_95 * result.components.key_points_sd[0, 1]).all()
    assert off.max() > 10.0  # the turn is any
    for name in ("eccentricity", "groove_gap_mean"):  # what no turn changes, by ends known to 0.2 mm
        assert result.adjustment.joints.measures[0].of(name)[1] < 1.0
