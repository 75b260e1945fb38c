"""Ends of a straight box with displaced corners, by points made with numpy, against closed forms."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from processor.adjustment import kriging, model_averaging
from processor.geometry import mesh_distance, rigid
from processor.model import reason
from processor.preassembly.chain import adjustment, span_and_closure
from processor.preassembly.ends import end_ring, joint_end, plate_sides
from processor.preassembly.ends import outer_faces as ends_faces
from processor.preassembly.ends.joint_frame import end_place
from processor.preassembly.parts.part_in_chain import Member
from tests.support.results import measured_parts

# A corner is known to some 0.2 mm by thousands of points with noise of 1 mm on each of its faces; beside that the
# movement made here, a cubic that fades out along the part, departs from the model's polynomials by some hundredths.
ROUGH_MM = 0.05
LENGTH, B, H, T = 1600.0, 600.0, 800.0, 26.0  # the end at x = 0, the part towards -x; half width, height; plates


def box(b, low, high):
    """Vertices and faces of an open tube of four walls."""
    corners = [(b, low), (-b, low), (-b, high), (b, high)]
    vertices = np.array([[x, y, z] for x in (-LENGTH, 0.0) for y, z in corners])
    quads = [(k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k) for k in range(4)]
    return vertices, np.array([face for q in quads for face in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))])


@cache
def design():
    """The mesh of the box and its joint; not to be changed."""
    outer, faces = box(B, 0.0, H)
    inner, same = box(B - T, T, H - T)
    ring = [(4 + k, 4 + (k + 1) % 4, 12 + (k + 1) % 4, 12 + k) for k in range(4)]
    ends = [face for q in ring for face in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))]
    corners = np.array([[0.0, y, z] for y, z in ((B, 0.0), (-B, 0.0), (-B, H), (B, H))])
    middles = [0.5 * (corners[a] + corners[b]) for a, b in ((0, 1), (1, 2), (2, 3), (3, 0))]
    joint = np.vstack([corners, middles])
    return mesh_distance.of_mesh(np.vstack([outer, inner]), np.vstack([faces, same + 8, np.array(ends)])), joint


@cache
def outer_faces():
    surface, joint = design()
    return ends_faces.outer_faces(surface, [joint])


def cloud(rng, spacing, shares=(1.0, 1.0, 1.0, 1.0), inner=1.0):
    """Points (n, 3) on the outer walls (bottom, right, top, left), the inner ones and the ring."""

    def spread(area):
        count = int(area / spacing**2)
        return rng.uniform(size=count), rng.uniform(size=count)

    found = []
    for depth, how_many in ((0.0, shares), (T, (inner,) * 4)):
        b, low, high = B - depth, depth, H - depth
        for side, share in enumerate(how_many):
            p, q = spread(share * 800.0 * 2.0 * (b if side % 2 == 0 else 0.5 * (high - low)))
            y = (2.0 * q - 1.0) * b if side % 2 == 0 else np.full(len(p), -b if side == 1 else b)
            z = np.full(len(p), low if side == 0 else high) if side % 2 == 0 else low + q * (high - low)
            found.append(np.stack([-800.0 * p, y, z], axis=1))
    p, q = spread(2.0 * B * H)
    ring = np.stack([np.zeros(len(p)), (2.0 * p - 1.0) * B, q * H], axis=1)
    hollow = (np.abs(ring[:, 1]) < B - T) & (ring[:, 2] > T) & (ring[:, 2] < H - T)
    return np.vstack([*found, ring[~hollow]])


def built(points, corners):
    """Move points by the movements of the end's corners P1..P4 (4, 3), fading out within 1.5 m."""
    a, c = points[:, 1] / B, 2.0 * points[:, 2] / H - 1.0
    shares = 0.25 * np.stack([(1 + a) * (1 - c), (1 - a) * (1 - c), (1 - a) * (1 + c), (1 + a) * (1 + c)])
    fade = np.clip(1.0 + points[:, 0] / 1500.0, 0.0, 1.0)
    return points + ((corners.T @ shares) * fade**2 * (3.0 - 2.0 * fade)).T


def fitted(points, rng, sigma=1.0):
    surface, joint = design()
    noisy = points + sigma * rng.standard_normal(points.shape)
    place = end_place(joint, 1.0)
    assert np.allclose(place.T_bridge_joint[:3, :3], np.eye(3))
    part = measured_parts.registered(noisy, surface, outer_faces(), 1e-12)
    end = joint_end.fit(part, place)
    return end if isinstance(end, joint_end.JointEnd) else joint_end.estimate([end])[0]


def sds(end):
    return np.sqrt(np.diag(end.covariance)).reshape(8, 3)


def test_the_outer_faces_are_those_that_the_corners_lie_on():
    surface, joint = design()
    outer = ends_faces.outer_faces(surface, [joint])
    assert len(outer.faces) == 8
    assert np.isin(np.abs(outer.vertices[outer.faces][:, :, 1]), [B]).all()


def test_corners_centimetres_off_are_found_within_their_intervals():
    rng = np.random.default_rng(0)
    corners = rng.uniform(-20.0, 20.0, (4, 3))
    end = fitted(built(cloud(rng, 8.0), corners), rng)
    assert end.doubts == ()
    truth = np.vstack([corners, *(0.5 * (corners[a] + corners[b]) for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)))])
    assert sds(end).max() < 0.4  # twice the 0.2 mm
    assert (np.abs(end.departure - truth) < 4.0 * np.hypot(sds(end), ROUGH_MM)).all()  # four sds


@pytest.mark.parametrize("through", ["webs", "flanges", "mitred"])
def test_the_thickness_of_plates_by_the_facets_of_the_end_face(through):
    """Webs of 12 mm, flanges of 18 mm, joined in either way; a plate is two facets."""
    web, flange = 12.0, 18.0
    outer = np.array([[0.0, B, 0], [0, -B, 0], [0, -B, H], [0, B, H]])
    inner = outer - np.array([0.0, web, flange]) * np.sign(outer - [0.0, 0.0, 0.5 * H])
    corners = []
    for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)):
        runs_through = through == ("webs" if a % 2 else "flanges")
        axis = 2 if a % 2 else 1  # along the plate
        plate = np.array([outer[a], outer[b], inner[b], inner[a]])
        if through != "mitred":
            plate[:, axis] = (outer if runs_through else inner)[[a, b, b, a], axis]
        corners.append(plate)
    facets = np.array([4 * k + np.array(three) for k in range(4) for three in ((0, 1, 2), (0, 2, 3))])
    surface = mesh_distance.of_mesh(np.vstack(corners), facets)
    place = end_place(design()[1], 1.0)
    # Rounding of float64.
    np.testing.assert_allclose(joint_end._design_thickness(surface, place), [flange, web, flange, web], atol=1e-9)


@pytest.mark.parametrize("side", [1, 2])  # a web, and a flange
def test_a_face_a_plate_further_in_is_not_taken_for_its_inner_side(side):
    """The outer side then lies where the design has the inner one, and has a fifth of the points."""
    rng = np.random.default_rng(side)
    inward = np.array([[0.0, 0, 1], [0, 1, 0], [0, 0, -1], [0, -1, 0]])[side]
    on_side = ((0, 1), (1, 2), (2, 3), (3, 0))[side]
    corners = np.zeros((4, 3))
    corners[list(on_side)] = 0.9 * T * inward
    shares = np.ones(4)
    shares[side] = 0.2
    end = fitted(built(cloud(rng, 8.0, shares), corners), rng)
    assert end.doubts == ()
    assert np.abs(end.departure[list(on_side)] - corners[list(on_side)]).max() < 1.0  # not 26 mm


def test_a_face_seen_as_one_strip_is_within_its_interval_where_it_was_not_seen():
    rng = np.random.default_rng(0)
    points = cloud(rng, 12.0, inner=0.3)
    on_top = np.abs(points[:, 2] - H) < 0.1
    seen = ~on_top | (np.abs(points[:, 1] - 300.0) < 20.0)
    shift = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 9.0], [0.0, 0.0, -7.0]])
    end = fitted(built(points[seen], shift), rng)
    sd = sds(end)[[2, 3], 2]
    assert (np.abs(end.departure[[2, 3], 2] - shift[2:, 2]) < 2.5 * sd).all()  # 2.5 sds
    assert (sd > 1.0).all()  # 40 of 1200 mm were seen


def test_an_end_with_fewer_than_300_points_is_not_measured():
    """60 for each of the faces and for the ring."""
    rng = np.random.default_rng(1)
    points = rng.permutation(cloud(rng, 12.0))
    end = fitted(points[points[:, 0] > -700.0][:299], rng, 0.0)
    assert end.doubts == (reason("preassemble.few-points-at-joint"),)
    assert np.isnan(end.departure).all()


def test_the_points_of_a_ring_lie_between_the_two_sides_of_its_plates():
    """Two standard deviations of 1 mm within plates of 26 mm: none of the inner walls, which end at the ring."""
    rng = np.random.default_rng(3)
    surface, joint = design()
    points = cloud(rng, 12.0)
    points += rng.standard_normal(points.shape)
    place = end_place(joint, 1.0)
    part = measured_parts.registered(points, surface, outer_faces(), 1e-12)
    local, thickness = rigid.apply(rigid.invert(place.T_bridge_joint), points), np.full(4, T)
    faces = ends_faces.fit(part, local, place, thickness)
    _, used = joint_end._fit_ring(local, part.station, faces, place, thickness, 1.0)
    depth = np.minimum(B * (1.0 - np.abs(used.basis[:, 1])), 0.5 * H * (1.0 - np.abs(used.basis[:, 2])))
    assert len(depth) > 300
    assert 1.5 < depth.min() < 3.0  # faces are known to 0.2 mm
    assert T - 3.0 < depth.max() < T - 1.5


def test_an_end_is_as_likely_as_its_noise_its_pose_and_the_sizes_of_its_departures_allow():
    """Log likelihoods of hypotheses of the sizes, up to one constant, by SciPy's normal distribution."""
    rng = np.random.default_rng(2)
    A, motion, value = rng.normal(size=(4, 4)), rng.normal(size=(4, 6)), rng.normal(size=4)
    sizes = np.array([[0.0, 0.0, 0.0, 0.0], [2.0, 0.5, 3.0, 1.0]])
    block = joint_end._block(
        SimpleNamespace(motion=motion, pose=0.3 * np.eye(6)), kriging.Kriged(value, A @ A.T), slice(None), sizes
    )
    logs = model_averaging.log_likelihoods(*block)
    noise = A @ A.T + 0.3 * motion @ motion.T
    exact = [multivariate_normal(cov=noise + np.diag(size**2)).logpdf(value) for size in sizes]
    assert logs[1] - logs[0] == pytest.approx(exact[1] - exact[0], rel=1e-3)  # 0.004 mm are added to the noise


def without_the_outside(side):
    """Points of a box as designed, none on the outside of one wall (bottom, right, top, left)."""
    rng = np.random.default_rng(5 + side)
    shares = np.ones(4)
    shares[side] = 0.0
    return cloud(rng, 8.0, shares), rng


@pytest.mark.parametrize("side", [1, 2])  # a web, and a flange
def test_a_face_seen_from_its_inner_side_is_placed_by_the_thickness(side):
    """The points of the end face lie outside of the layer seen, so it is the inner side."""
    end = fitted(*without_the_outside(side))
    assert end.doubts == ()
    assert [one.code for one in end.remarks] == ["preassemble.by-inner-side"]
    assert np.abs(end.departure).max() < 0.5  # the plate is 26 mm thick
    assert (np.abs(end.departure) < 1.96 * sds(end) + ROUGH_MM).all()


@pytest.mark.parametrize("further_in", [0.0, 1.0])
def test_a_face_of_which_one_side_alone_was_seen_may_be_either(further_in):
    """Without points of the end face there, both the plate as designed and the plate further in are in the interval."""
    points, rng = without_the_outside(2)
    bare = points[~((points[:, 0] > -1.0) & (points[:, 2] > H - T - 1.0))]
    end = fitted(bare, rng)
    assert end.doubts == (reason("preassemble.inner-side", faces=("top",)),)
    sd = sds(end)
    off = np.abs(end.departure + np.array([0.0, 0.0, further_in * T]))[[2, 3, 6], 2]  # P3, P4 and P7 are on the top
    assert (off < 1.96 * sd[[2, 3, 6], 2] + 0.2).all()  # and the 0.2 mm that ends are known to
    assert sd[[0, 1, 4], 2].max() < 0.2  # as above, seen on both sides: 0.02 came


def test_waves_of_the_plates_are_in_the_middles_of_the_edges():
    """Waves of 1 mm that no polynomial of the zone follows, zero at the corners."""
    rng = np.random.default_rng(7)
    points = cloud(rng, 8.0)
    waves = 1.0 * np.sin(2.0 * np.pi * points[:, 0] / 650.0 + 1.2) * np.cos(0.5 * np.pi * points[:, 1] / B)
    points[:, 2] += np.where(points[:, 2] < T + 1.0, waves, 0.0)  # both sides of the bottom
    end = fitted(points, rng)
    off = end.departure[4, 2] - np.sin(1.2)
    sd = sds(end)
    assert abs(off) < 0.25  # without the waves in the model it is -0.93
    assert (np.abs(np.append(off, end.departure[:2, 2])) < 3.0 * np.append(sd[4, 2], sd[:2, 2])).all()  # three sds


def test_densities_of_points_near_an_end_face_integrate_to_their_mass():
    """Over the window, 6 mm about a plate of 20 mm and about where the ring was before it moved by 0.5 mm."""
    off, e = (0.05 * (np.arange(int(20 * size)) + 0.5) - 6.0 for size in (12.0, 32.0))
    off, e = (grid.ravel() for grid in np.meshgrid(off - 0.5, e))
    rho = end_ring._Densities(3.0, 2.0, 1.0)
    ring, wall, outlier, mass = end_ring._mixture(off, e, np.full(len(e), 20.0), 1.0, rho, 6.0, np.full(len(e), 0.5))
    # Beyond the window are 1e-7 of a normal distribution; a sum of steps of 0.05 sd is exact but for that.
    assert (ring + wall).sum() * 0.05**2 == pytest.approx(mass[0], rel=1e-6)
    assert outlier.sum() * 0.05**2 == pytest.approx(0.005 * mass[0], rel=1e-9)


def test_the_outermost_layer_of_a_tilted_plate():
    rng = np.random.default_rng(1)
    x, w = rng.uniform(size=4000), rng.uniform(-1.0, 1.0, 4000)
    basis = np.stack([np.ones(4000), x, w, x * w], axis=1)
    level = basis @ np.array([3.0, -12.0, 18.0, 5.0])  # across the plate it changes by more than the thickness
    inner = np.arange(4000) % 3 > 0
    out = level - 24.0 * inner + rng.standard_normal(4000)
    cell = (np.floor(5 * x) * 6 + np.floor(3.0 * (w + 1.0))).astype(np.int64)
    kept = plate_sides.outer_surface(out, basis, cell)
    assert kept[~inner].mean() > 0.99  # but those beyond 2.6 standard deviations
    assert not kept[inner].any()


def test_a_part_without_a_joint_stays_where_it_was_registered_along_its_chord():
    """The edges of a shallow arch hardly constrain it along its chord: noise of 0.02 mm would move it by decimetres."""
    rng = np.random.default_rng(3)
    arc = np.linspace(-6000.0, 6000.0, 60)
    angle = arc / 60_000.0
    points, axes = [], []
    for side in (700.0, -700.0):
        points.append(np.stack([60_000.0 * np.sin(angle), np.full(60, side), 60_000.0 * np.cos(angle)], axis=1))
        up = np.stack([np.sin(angle), np.zeros(60), np.cos(angle)], axis=1)
        axes.append(np.stack([np.broadcast_to([0.0, 1.0, 0.0], up.shape), up], axis=1))
    noise = 0.02 * rng.standard_normal((120, 2))
    edges = measured_parts.edges(np.tile(arc, 2), np.vstack(points), np.vstack(axes), noise, 0.02)
    member = Member((None, None), edges, np.array([0.0, 0.0, 60_000.0]), np.zeros((6, 6)))
    adjusted = adjustment.adjust([member], np.empty((0, 8, 3)), np.empty((0, 4, 4)), 0.1)
    assert np.abs(adjusted.motions[0][:3, 3]).max() < 1.0 + 60_000.0 * 2e-5  # its turn is about the middle
    moved = adjusted.motions[0] @ np.array([0.0, 0.0, 60_000.0, 1.0])
    assert abs(moved[0]) < 0.01  # noise alone would make decimetres; 0.0002 came


def test_registration_error_is_common_to_both_ends_of_a_part():
    """Intervals of gaps and movements against 400 draws, with the registrations' errors included."""
    rng = np.random.default_rng(8)
    corners = np.array([[0.0, y, z] for y, z in ((700, -900), (-700, -900), (-700, 900), (700, 900))], float)
    joints = np.array([np.vstack([corners, 0.5 * (corners + np.roll(corners, -1, axis=0))])])
    along = np.linspace(100.0, 5900.0, 12)
    axes = np.tile(np.eye(3)[1:], (24, 1, 1))
    turned, shifted, noise = 2e-5, 0.1, 0.003
    pose = np.diag([turned**2] * 3 + [shifted**2] * 3)
    parts = []
    for sense in (-1.0, 1.0):
        points = np.array([[sense * x, y, -900.0] for y in (700.0, -700.0) for x in along])
        moves = np.einsum("kai,kij->kaj", axes, rigid.motion(points))
        edges = measured_parts.edges(np.tile(along, 2), points, axes, np.zeros((24, 2)), noise, moves)
        at_joint = rigid.motion(joints[0]).reshape(24, 6)
        covariance = at_joint @ pose @ at_joint.T + noise**2 * np.eye(24)
        end = joint_end.JointEnd(np.zeros((8, 3)), covariance, at_joint, "")
        middle = np.array([3000.0 * sense, 0.0, 0.0])
        parts.append(Member((None, end) if sense < 0.0 else (end, None), edges, middle, pose))
    stated = adjustment.adjust(parts, joints, np.eye(4)[None], 0.1)
    for end in (parts[0].ends[1], parts[1].ends[0]):
        left = np.sqrt(np.diag(end.without_pose(pose)))
        # The error of the registration cancels in the gap: (0.1 / 0.003)^2 of it, by inverses in float64
        np.testing.assert_allclose(left, noise, rtol=1e-9)
    gaps, moved, at_rest, largest = [], [], [], []
    for _ in range(400):
        wrong = np.sqrt(np.diag(pose)) * rng.standard_normal((2, 6))
        drawn = []
        for part, own in zip(parts, wrong, strict=True):
            departure = -part.edges.by_pose @ own + noise * rng.standard_normal((24, 2))
            ends = tuple(
                one and replace(one, departure=(-one.by_pose @ own + noise * rng.standard_normal(24)).reshape(8, 3))
                for one in part.ends
            )
            drawn.append(replace(part, ends=ends, edges=replace(part.edges, departure=departure)))
        found = adjustment.adjust(drawn, joints, np.eye(4)[None], 0.1)
        # The true ends are on the design, at the poses found the true gap is that of the motions.
        there = [rigid.apply(T, joints[0]) for T in found.motions]
        gaps.append((found.gaps[0] - (there[1] - there[0])).ravel())
        # With the first part on its design, all edges have the error of its registration.
        back = rigid.invert(found.motions[0])
        for edges, departure in zip((one.edges for one in drawn), found.departures, strict=True):
            there = edges.points + np.einsum("ka,kai->ki", departure, edges.axes)
            at_rest.append(np.einsum("kai,ki->ka", edges.axes, rigid.apply(back, there) - edges.points))
        largest.append([np.abs(found.gaps).mean(), np.abs(found.gaps).max()])
        # Error of the last part's outer end: by its movement and by its registration.
        at = np.array([[6000.0, 0.0, 0.0]])
        moved.append((rigid.apply(found.motions[1], at) - at)[0] - rigid.motion(at)[0] @ wrong[1])
    # A standard deviation of 400 draws is known to 3.5 %: four of these, for the largest of dozens.
    pulls = np.array(gaps) / np.sqrt(np.diag(stated.gap_covariance[0]))
    np.testing.assert_allclose(np.sqrt(np.mean(pulls**2, axis=0)), 1.0, atol=0.15)  # of the gap at the poses found
    drawn_sd = np.std(np.array(at_rest).reshape(400, 48, 2), axis=0)
    np.testing.assert_allclose(drawn_sd, np.sqrt(np.vstack(stated.at_rest_variance)), rtol=0.15)
    halves = span_and_closure.mean_max_ci95(stated.gaps.reshape(-1, 1), np.diag(stated.gap_covariance[0])[:, None])
    assert (np.quantile(largest, 0.95, axis=0) <= halves).all()  # the true gaps are zero
    J, own = rigid.motion(at - parts[1].centre)[0], rigid.motion(at)[0]
    both = J @ stated.motion_with_pose[6:, 6:] @ own.T
    covariance = J @ stated.motion_covariance[6:, 6:] @ J.T + both + both.T + own @ pose @ own.T
    # As above.
    np.testing.assert_allclose(np.std(moved, axis=0), np.sqrt(np.diag(covariance)), rtol=0.15)


def test_a_face_seen_as_a_strip_and_one_outlier_keeps_its_corners():
    """The bottom was seen within 60 mm of the end, but for one point 40 mm off at 480 mm; the end is as designed."""
    rng = np.random.default_rng(5)
    points = cloud(rng, 12.0)
    bottom = (points[:, 2] < T + 1.0) & (points[:, 0] < -0.5)
    strip = (points[:, 2] == 0.0) & (points[:, 0] > -60.0)
    points = np.vstack([points[~bottom | strip], [[-480.0, 0.6 * B, -40.0]]])
    end = fitted(points, rng)
    assert (np.abs(end.departure) < 4.0 * np.hypot(sds(end), ROUGH_MM)).all()  # four sds


@pytest.mark.parametrize("thickness", [16.0, 24.0])
def test_inner_side_is_separated_from_a_strip_of_the_outer_face(thickness):
    """The outer side was seen within 100 mm of the end, the inner one beyond; the plate is tilted by 4 mm a metre."""
    rng = np.random.default_rng(7)
    x, w = -rng.uniform(0.0, 500.0, 400), rng.uniform(-1.0, 1.0, 400)
    beyond = x < -100.0
    out = 1.0 + 0.004 * x + 0.5 * w + 0.5 * rng.standard_normal(400) - thickness * beyond
    terms = np.stack([np.ones_like(x), x / 500.0, w, w * x / 500.0], axis=1)
    assert (plate_sides.inner_of_two(out, terms, thickness) == beyond).all()
    one_side = out + thickness * beyond
    assert not plate_sides.inner_of_two(one_side, terms, thickness).any()
    assert not plate_sides.inner_of_two(one_side + 8.0 * (x / 500.0) ** 2, terms, thickness).any()
