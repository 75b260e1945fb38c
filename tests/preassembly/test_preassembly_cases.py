"""Difficult parts and scans: square, half missing, steep, cluttered, unmarked, cut, in two scans, of other plates."""

import dataclasses
from functools import cache
from itertools import product

import numpy as np
import pytest

from designgen import recipe_files
from designgen.designs import arch_bridge, arch_mesh
from designgen.scanning import sampler
from designgen.scenes.make import make
from processor import large_arrays
from processor.adjustment import scanner_class_errors
from processor.geometry import rigid
from processor.geometry.thinning import by_cell
from processor.model import ArchDesign, DesignPart, Scan, Status, reason
from processor.preassembly.ends import bottom_edges
from processor.preassembly.ends.joint_frame import joint_frame
from processor.preassembly.params import SystematicParams
from processor.preassembly.parts import assignment, attitude, identity, measure
from processor.registration import pose_search, principal
from tests.support import arrays_in_files
from tests.support.clouds import arch_clouds
from tests.support.clouds.arch_clouds import random_pose
from tests.support.results.reasons import codes, flat

SMALL = arch_bridge.Params(
    span_mm=24_000.0, rise_mm=6_000.0, width_mm=900.0, height_mm=1_100.0, plate_bottom_mm=24.0, plate_top_mm=24.0,
    plate_web_mm=20.0, base_width_mm=1_300.0, base_height_mm=1_600.0, joints=(0.19, 0.40, 0.60, 0.81), taper=0.6,
)  # fmt: skip
RIB = 2
SEARCHED = 5_000  # points by which an attitude is searched for where all points register what it finds
TURNED_DEG = 0.05  # a surface fit's sd is below 0.01 deg: 1 mm over the root of thousands of points, at metres
# Of some eight independent coordinates an end the rms exceeds 1.8 once in a thousand, one of 24 exceeds 4.1.
PULL_RMS, PULL_MOST = 2.0, 4.5


@cache
def ribs(params=SMALL):
    """The three ribs of a bridge as an assembly of their own, of which the second is to be found; and its design."""
    parts = arch_bridge.build(params)[1:4]
    return parts, design_of(parts)


@cache
def bridge(params=SMALL):
    """The parts of a bridge and its design; not to be changed."""
    parts = arch_bridge.build(params)
    return parts, design_of(parts)


def design_of(parts):
    return ArchDesign(
        tuple(DesignPart(part.name, *arch_mesh.triangulate(part), *part.bottom_edges()) for part in parts),
        tuple(f"J{j + 1}" for j in range(len(parts) - 1)),
        tuple(part.name for part in parts[:-1]),
        tuple(part.name for part in parts[1:]),
        np.array([part.key_points(part.s1) for part in parts[:-1]]),
    )


def shapes_of(design, kept={}):  # noqa: B006  # designs hold arrays, so they are no keys
    """The sampled surfaces of a design's parts, which take as long as finding a scan's pose: made once a design."""
    if id(design) not in kept:
        kept[id(design)] = attitude.Shapes(design)  # holds the design, whose number is not given again
    return kept[id(design)]


def cloud(part, seed=0, spacing_mm=14.0, sigma_mm=1.0):
    """Points of a part in the bridge's frame."""
    params = sampler.Params(spacing_mm=spacing_mm, sigma_mm=sigma_mm)
    return sampler.scan_part(part, 0, params, np.random.default_rng(seed)).points


def scanned(points, seed=1, name="scan", component=""):
    """A scan of points in a frame of its own, and the pose that takes it back."""
    T = random_pose(np.random.default_rng(seed))
    return Scan(name, rigid.apply(T, points), component=component), rigid.invert(T)


def measured(design, index, *scans):
    systematic = SystematicParams()
    return measure.estimate([measure.fit(scans, index, shapes_of(design), 1.0, systematic)], systematic)[0]


def pulls(design, index, part, found, T):
    """Errors of the key points found over their standard deviations, at each end that has an answer."""
    result = {}
    for end, joint, s in (("start", index - 1, part.s0), ("end", index, part.s1)):
        own = found.member.ends[("start", "end").index(end)]
        if own is None or not np.isfinite(own.departure).all():
            continue
        R = joint_frame(design.joint_points[joint])[:3, :3]
        there = design.joint_points[joint] + own.departure @ R.T
        off = (rigid.apply(T @ rigid.invert(found.T_bridge_scan), there) - part.key_points(s)) @ R
        result[end] = off.ravel() / np.sqrt(np.diag(own.covariance))
    return result


def known(monkeypatch, T):
    """The attitude that the search would find: where that is not the claim, it takes most of the time."""
    monkeypatch.setattr(attitude, "find", lambda *_: attitude.Attitude(T, T, "ok"))


def turn_deg(T, T_true):
    return np.degrees(rigid.rotation_angle(T[:3, :3] @ T_true[:3, :3].T))


def assert_right(found, design, index, part, T, ends=("start", "end")):
    assert turn_deg(found.T_bridge_scan, T) < TURNED_DEG
    every = pulls(design, index, part, found, T)
    assert tuple(every) == ends
    for pull in every.values():
        assert np.sqrt((pull**2).mean()) < PULL_RMS
        assert np.abs(pull).max() < PULL_MOST


def test_ends_are_right_despite_stray_points_and_the_same_where_points_lie_in_files(monkeypatch, tmp_path):
    parts, design = ribs()
    points = cloud(parts[1], spacing_mm=32.0)
    low, high = points.min(axis=0) - 300.0, points.max(axis=0) + 300.0
    strays = np.random.default_rng(3).uniform(low, high, (len(points) // 100, 3))
    scan, T = scanned(np.vstack([points, strays]))
    known(monkeypatch, T)
    whole = measured(design, 1, scan)
    assert whole.status == "ok"
    assert_right(whole, design, 1, parts[1], T)
    arrays_in_files.limit(monkeypatch, 4_000, 15_000)
    monkeypatch.setattr(bottom_edges, "PASS_POINTS", 1_500)
    with large_arrays.in_files(tmp_path):
        found = measured(design, 1, scan)
    assert len(scan.points) > 25_000
    same = [(one.T_bridge_scan, one.member.edges.departure, one.member.edges.covariance,
             *(end.departure for end in one.member.ends)) for one in (found, whole)]  # fmt: skip
    for one, other in zip(*same, strict=True):
        # Other orders of sums and a registration that ends within 1e-7 of its minimum.
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_a_square_box_is_not_turned_by_a_quarter(monkeypatch):
    monkeypatch.setattr(pose_search, "FINE_POINTS", SEARCHED)
    parts, design = ribs(dataclasses.replace(SMALL, width_mm=1_000.0, height_mm=1_000.0, plate_web_mm=24.0))
    scan, T = scanned(cloud(parts[1], spacing_mm=24.0))
    found = attitude.find(scan.points, design.parts[1], shapes_of(design)[1])
    assert found.status == "ok"
    assert turn_deg(found.T_surface, T) < 2.0 * TURNED_DEG  # by the few points of the search


def test_erected_foot_is_registered_without_a_turn():
    parts, design = bridge()
    shift = np.array([100.0, -50.0, 20.0])
    found = measure._place(Scan("scan", cloud(parts[0], spacing_mm=30.0) + shift), 0, shapes_of(design), 1.0)
    assert (found.attitude.status, found.rejected, found.doubts) == ("ok", (), ())
    assert turn_deg(found.registration.T_design_scan, np.eye(4)) < TURNED_DEG
    # 1 mm over the root of thousands of points.
    np.testing.assert_allclose(found.registration.T_design_scan[:3, 3], -shift, atol=1.0)


def test_parts_of_one_shape_are_distinguished_by_their_mark(monkeypatch):
    """Rib 3 turned round equals rib 1 but for its mark: it fits rib 1 to the noise."""
    monkeypatch.setattr(pose_search, "FINE_POINTS", SEARCHED)
    parts, design = ribs()
    scan, _ = scanned(cloud(parts[2], spacing_mm=30.0, sigma_mm=2.0))
    found = measured(design, 0, scan)
    assert found.status == "failed"
    assert found.reasons == (
        reason("preassemble.scan-of-other", scan="scan", part="rib3", assigned="rib1"),
        reason("preassemble.mark-of-other", parts=("rib3",)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("came", [3, 4])
def test_parts_of_one_shape_are_right_where_they_belong(came, monkeypatch):
    parts, design = bridge()
    scan, T = scanned(cloud(parts[came], spacing_mm=22.0, sigma_mm=2.0))
    known(monkeypatch, T)
    found = measured(design, came, scan)
    # The plates of a foot's only end show nothing of what views differ by.
    by_class = (reason("preassemble.viewpoints-by-class", sd=scanner_class_errors.known().view_mm),)
    assert (found.status, found.reasons) == ("ok", by_class if came == 4 else ())


def marks_places(part):
    """Where the mark is, and where it is on the part turned round."""
    s, u = part.pad
    return part.point(np.array([s, part.s0 + part.s1 - s]), np.array([u, -u]), np.full(2, SMALL.height_mm))


def test_part_without_its_mark_in_the_scan_names_the_other_candidates(monkeypatch):
    parts, design = bridge()
    points, places = cloud(parts[1], spacing_mm=30.0), marks_places(parts[1])
    scan, T = scanned(points[(np.linalg.norm(points[:, None] - places, axis=2) > 400.0).all(axis=1)])
    known(monkeypatch, T)
    found = measured(design, 1, scan)
    assert (found.status, found.reasons) == ("ok", (reason("preassemble.mark-not-seen", parts=("rib3",)),))


def test_mark_is_identified_on_a_plate_that_bulges_by_its_height():
    parts, design = bridge()
    part, points = parts[1], cloud(parts[1])
    s, u = part.pad
    for place in marks_places(part):  # the mark, and the place of rib 3's mark: 14 mm up over half a metre
        far = np.linalg.norm(points - place, axis=1)
        up = part.point(np.array([s]), np.array([u]), np.array([1.0])) - part.point(np.array([s]), np.array([u]), [0.0])
        points = points + np.where(far < 700.0, 14.0, 0.0)[:, None] * up
    assert identity.identify(points, np.eye(4), 1, shapes_of(design)) == identity.Identity()


def test_neighbours_swapped_are_named(monkeypatch):
    """By its size, and by its name where a mark distinguishes the parts of this size."""
    parts, design = ribs()
    scan, T = scanned(cloud(parts[0], spacing_mm=30.0))
    known(monkeypatch, T)
    found = measured(design, 1, scan)
    assert found.status == "failed"
    assert found.reasons[0] == reason("preassemble.scan-of-other", scan="scan", part="rib1", assigned="rib2")
    assert found.reasons[-1] == reason("preassemble.size-of-other", parts=("rib1", "rib3"))


def along_the_arch(came, to):
    """T (4, 4) that turns the bridge of numpy about the arch's middle until the cut ``came`` is at the cut ``to``."""
    turn = (arch_clouds.CUTS[to] - arch_clouds.CUTS[came]) * arch_clouds.ARC / arch_clouds.RADIUS
    middle = arch_clouds.RADIUS * np.array([np.sin(arch_clouds.HALF_ANGLE), 0.0, -np.cos(arch_clouds.HALF_ANGLE)])
    R = rigid.rotation_from_vector(np.array([0.0, turn, 0.0]))
    return rigid.transform(R, middle - R @ middle)


def shorter_rib(monkeypatch):
    """The bridge, and the points (n, 3) of rib2 in its frame; as a scan of the longer rib1 they are found on that."""
    scene, truth = arch_clouds.bridge(spacing_mm=30.0, sigma_mm=1.0, seed=1)
    points = rigid.apply(truth.arch.T_bridge_scan[2], scene.scans[2].points)
    poses = {"rib1": along_the_arch(2, 1), "rib2": np.eye(4)}
    find = lambda _, part, *__: attitude.Attitude(poses[part.name], poses[part.name], Status.OK)  # noqa: E731
    monkeypatch.setattr(attitude, "find", find)
    return scene, points


def test_scan_of_a_shorter_part_in_a_longer_one_s_place_is_named_by_its_ends(monkeypatch):
    """All of its points lie on the longer part: that has steel where they end, which is not seen."""
    scene, points = shorter_rib(monkeypatch)
    monkeypatch.setattr(assignment, "rather", lambda *_: None)  # as where the underside was not seen: sizes are others
    found = measure._place(Scan("scan", points, component="rib1"), 1, shapes_of(scene.arch), 1.0)
    assert (found.rejected, codes(found.doubts), found.parts) == ((), ["preassemble.ends-of-other"], ("rib2",))
    longer = (arch_clouds.CUTS[2] - arch_clouds.CUTS[1] - arch_clouds.CUTS[3] + arch_clouds.CUTS[2]) * arch_clouds.ARC
    # The outermost points of either end are some mm from it, as points 30 mm apart leave.
    assert found.doubts[0].values["length"] == pytest.approx(longer, abs=10.0)
    own = measure._place(Scan("scan", points, component="rib2"), 2, shapes_of(scene.arch), 1.0)
    assert (own.rejected, own.doubts, own.parts) == ((), (), ("rib2",))


def test_scan_of_a_shorter_part_in_its_own_place_is_no_longer_part_s(monkeypatch):
    """Its points lie on the longer part as well, to what a rough pose shows; only of its own it shows both ends."""
    scene, points = shorter_rib(monkeypatch)
    monkeypatch.setattr(assignment, "rather", lambda _, index, *__: 1 if index == 2 else None)
    own = measure._place(Scan("scan", points, component="rib2"), 2, shapes_of(scene.arch), 1.0)
    assert (own.rejected, own.doubts, own.parts) == ((), (), ("rib2",))
    half = points[points[:, 0] > np.median(points[:, 0])]  # of which no end is shown on the other side
    found = measure._place(Scan("scan", half, component="rib2"), 2, shapes_of(scene.arch), 1.0)
    assert codes(found.rejected)[0] == "preassemble.scan-of-others"


def test_scan_that_covers_half_of_another_part_is_rejected(monkeypatch):
    """A rib turned about the arch's middle until it ends where the foot does: its upper half lies on the foot.

    The rest looks like clutter. A mast is left out.
    """
    scene, truth = arch_clouds.bridge(spacing_mm=30.0, sigma_mm=1.0, seed=1)
    points = rigid.apply(truth.arch.T_bridge_scan[2], scene.scans[2].points)
    points = rigid.apply(along_the_arch(3, 1), points)
    rng, top = np.random.default_rng(1), points[np.argmax(points[:, 2])]
    mast = top + np.column_stack([rng.normal(0.0, 30.0, (900, 2)), rng.uniform(0.0, 5000.0, 900)])
    known(monkeypatch, np.eye(4))
    monkeypatch.setattr(assignment, "rather", lambda *_: None)
    found = measure._place(Scan("scan", np.vstack([points, mast])), 0, shapes_of(scene.arch), 1.0)
    assert 0.5 < found.registration.used_share < 0.7  # a half and some clutter
    assert codes(found.rejected) == ["preassemble.points-away", "preassemble.size-of-other"]
    assert found.rejected[1].values == {"parts": ("rib2",)}


def test_covered_share_of_a_part_equals_the_share_seen():
    parts, design = bridge()
    shape = shapes_of(design)[RIB]
    points = cloud(parts[RIB], spacing_mm=30.0)
    along = points @ shape.axes[:, 0]
    half = along < 0.5 * (along.min() + along.max())
    left = points[:, 1] > 0.5 * SMALL.width_mm - 30.0
    # Of 40 slices of three or four sides each the ones at a border count in halves: 2 of 80.
    for own, share in ((points, 1.0), (points[half], 0.5), (points[~left], 0.75)):
        assert measure._covered(own, np.eye(4), shape) == pytest.approx(share, abs=0.03)


def test_rival_pose_shifted_along_the_part_is_reported_as_a_shift():
    _, design = bridge()
    surface = shapes_of(design)[1]
    along = rigid.transform(np.eye(3), 240.0 * surface.axes[:, 0])
    rival = attitude._rival_reason(np.eye(4), along, surface)
    assert (rival.code, rival.values) == ("preassemble.rival-shift", {"shift": pytest.approx(240.0)})


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("upper", [True, False])
def test_half_a_part_is_found_however_it_lies_in_its_file(upper, seed):
    parts, design = bridge()
    part, own = parts[1], principal.of_mesh(design.parts[1].vertices, design.parts[1].faces)
    points = cloud(part, spacing_mm=24.0)
    down = (points - own.centre) @ own.axes[:, 1] * np.sign(-own.axes[2, 1])
    scan, T = scanned(points[down < 60.0 if upper else down > -60.0], 100 + seed)
    found = attitude.find(scan.points, design.parts[1], shapes_of(design)[1])
    assert found.status in ("ok", "ambiguous")
    turns = [turn_deg(one, T) for one in (found.T_surface, found.T_rival)]
    # Right or half a turn round: a half slides along the arch by some mm in metres.
    assert turns[0] < 0.6 or (found.status == "ambiguous" and turns[1] < 0.6)


@pytest.mark.slow
def test_scan_of_one_end_alone_is_not_ok_and_has_a_reason():
    parts, design = bridge()
    part = parts[RIB]
    points = cloud(part, spacing_mm=16.0)
    cut = part.key_points(part.s0 + 0.6 * (part.s1 - part.s0))[0, 0]
    scan, T = scanned(points[points[:, 0] < cut])
    found = measured(design, RIB, scan)
    assert found.status in ("weak", "ambiguous", "failed")
    assert found.reasons
    if found.status == "weak":
        assert_right(found, design, RIB, part, T, ("start",))


def test_two_scans_of_one_part_are_combined(monkeypatch):
    """One scan shows the left side, the other the right: each constrains the part, only both show whole ends.

    Which part half a scan is of is searched for in test_assignment.
    """
    parts, design = bridge()
    part, points = parts[RIB], cloud(parts[RIB], spacing_mm=24.0)
    sides = {"left": points[:, 1] > -50.0, "right": points[:, 1] < 50.0}
    scans, poses = zip(*(scanned(points[sides[name]], k, name) for k, name in enumerate(sides)), strict=True)
    true = dict(zip(sides, poses, strict=True))
    place, placed = measure._place, {}  # the left scan is asked for twice

    def placed_once(scan, *rest):
        known(monkeypatch, true[scan.name])
        if scan.name not in placed:
            placed[scan.name] = place(scan, *rest)
        return placed[scan.name]

    monkeypatch.setattr(measure, "_place", placed_once)
    monkeypatch.setattr(assignment, "rather", lambda *_: None)
    both = measured(design, RIB, *scans)
    first, further = (one.name for one in both.scans)
    assert {first, further} == {"left", "right"}
    assert both.status == "ok"
    assert_right(both, design, RIB, part, true[first])
    at = rigid.apply(rigid.invert(true[further]), part.key_points(part.s0))
    # The scan alone is weak, about its one web; measured 0.5 to 1.5, another pose of the four is metres off.
    assert np.abs(rigid.apply(both.T_further_scans[0], at) - rigid.apply(true[further], at)).max() < 3.0
    alone = measured(design, RIB, scans[0])
    assert alone.status == "weak"
    assert reason("preassemble.few-points-on-face", face="right") in flat(alone.reasons)


def with_a_floor(points, axes, share, rng):
    """Points of a part and of a floor that makes up a share of all, somewhere beneath it and wider."""
    local = points @ axes
    low, high = local.min(axis=0) - 1_000.0, local.max(axis=0) + 1_000.0
    floor = rng.uniform(low, high, (int(share / (1.0 - share) * len(points)), 3))
    floor[:, 2] = low[2] + 700.0 + rng.normal(0.0, 1.0, len(floor))
    return np.vstack([points, floor @ axes.T])


# The case that is not slow was once placed half a turn round: the right attitude had not been tried.
@pytest.mark.parametrize(
    ("seed", "index", "share"),
    [
        pytest.param(*one, marks=() if one == (3, 2, 0.1) else pytest.mark.slow)
        for one in product(range(1, 7), range(5), (0.1, 0.2))
    ],
)
def test_a_floor_beside_a_part_does_not_turn_it_round(seed, index, share):
    scene, truth = arch_clouds.bridge(spacing_mm=10.0, sigma_mm=1.0, seed=seed)
    T, rng = truth.arch.T_bridge_scan[index], np.random.default_rng(10 * seed + index)
    shape = attitude.sample_surface(scene.arch.parts[index])
    points = with_a_floor(rigid.apply(T, scene.scans[index].points), shape.axes, share, rng)
    found = attitude.find(rigid.apply(rigid.invert(T), points), scene.arch.parts[index], shape)
    assert (found.status, found.reasons) == ("ok", ())
    assert turn_deg(found.T_surface, T) < 2.0 * TURNED_DEG  # by the few points of the search


def on_trestles(points, rng, step=20.0):
    """A part 0.6 m above a floor that reaches 2 m beyond it, on two trestles that touch it and hide its bottom."""
    low, high = points.min(axis=0), points.max(axis=0)
    ground = low[2] - 600.0
    corners = np.array([low[:2] - 2_000.0, high[:2] + 2_000.0])
    flat = rng.uniform(*corners, (int(np.prod(np.ptp(corners, axis=0)) / step**2), 2))
    about = [np.column_stack([flat, rng.normal(ground, 1.5, len(flat))])]
    hidden = np.zeros(len(points), bool)
    for share in (0.2, 0.8):
        x = low[0] + share * (high[0] - low[0])
        above = np.abs(points[:, 0] - x) < 250.0
        top = points[above, 2].min()
        hidden |= above & (points[:, 2] < top + 100.0) & (np.abs(points[:, 1]) < 0.5 * SMALL.width_mm - 5.0)
        for side in (-200.0, 200.0):
            size = np.array([high[1] - low[1] + 300.0, top - ground])
            at = rng.uniform([low[1] - 150.0, ground], [high[1] + 150.0, top], (int(np.prod(size) / step**2), 2))
            about.append(np.column_stack([rng.normal(x + side, 1.0, len(at)), at]))
    return np.vstack([points[~hidden], *about])


def test_a_part_on_trestles_above_a_floor_of_more_points_is_found_right(monkeypatch):
    """That the trestles' points make it no other part is the claim of test_assignment."""
    monkeypatch.setattr(assignment, "rather", lambda *_: None)
    monkeypatch.setattr(pose_search, "FINE_POINTS", SEARCHED)
    parts, design = ribs()
    points = cloud(parts[1], spacing_mm=24.0)
    everything = on_trestles(points, np.random.default_rng(4))
    assert len(everything) > 2.0 * len(points)
    scan, T = scanned(everything)
    found = measured(design, 1, scan)
    assert found.status == "ok"
    assert_right(found, design, 1, parts[1], T)
    # Points of the trestles are at the bottom edges, where they hide the part.
    edges = found.member.edges
    sd = np.sqrt(np.stack([np.diag(one) for one in edges.covariance], axis=1))
    seen = np.isfinite(edges.departure)
    assert seen.mean() > 0.9  # two trestles of 0.5 m hide a tenth of 9 m
    assert np.abs(edges.departure / sd)[seen].max() < PULL_MOST


def test_a_scan_that_is_denser_at_one_end_starts_at_the_parts_place():
    parts, design = ribs()
    points, rng = cloud(parts[1]), np.random.default_rng(5)
    dense = points[:, 0] < np.quantile(points[:, 0], 0.2)
    points = points[dense | (rng.random(len(points)) < 0.1)]
    scan, _ = scanned(points)
    by_axes = pose_search.by_principal_axes(scan.points, shapes_of(design)[1])
    starts = [pose_search.at_extents(scan.points, shapes_of(design)[1], one) for one in by_axes]

    def off(poses):
        return min(np.linalg.norm(rigid.apply(one, scan.points) - points, axis=1).max() for one in poses)

    assert off(by_axes) > 500.0  # the mean of nine tenths of the points at a fifth of 9 m is metres off the middle
    assert off(starts) < 60.0  # by the extents: 0.2 % of the length at either end, and the tilt of the axes
    half = scan.points[points[:, 0] < np.median(points[:, 0])]
    np.testing.assert_array_equal(pose_search.at_extents(half, shapes_of(design)[1], by_axes[0]), by_axes[0])


@pytest.mark.slow
def test_no_random_pose_is_wrong_and_called_ok():
    parts, design = bridge()
    clouds = [cloud(part, 11, spacing_mm=20.0) for part in parts]
    for seed in range(200):
        index = seed % len(parts)
        scan, T = scanned(clouds[index], 1000 + seed)
        found = measured(design, index, scan)
        assert found.status in ("ok", "ambiguous", "weak")
        if found.status == "ok":
            at = parts[index].key_points(parts[index].s0)
            assert turn_deg(found.T_bridge_scan, T) < 2.0 * TURNED_DEG
            assert np.abs(rigid.apply(found.T_bridge_scan @ rigid.invert(T), at) - at).max() < 3.0  # a wrong one: 20


@pytest.mark.slow
def test_a_rib_of_even_curvature_is_not_laid_half_a_turn_round():
    """The right attitude converges 1.8 m off along the arch here, with a larger misfit than the wrong one."""
    recipe = recipe_files.overridden(recipe_files.load("arch-d3")[1], ["scan.sigma_mm=1.0", "scan.spacing_mm=5.0"])
    scene, truth = make("d3", recipe, 1)
    part = scene.arch.parts[2]
    scan = next(scan for scan in scene.scans if scan.component == part.name)
    found = attitude.find(by_cell(scan.points, measure.CELL_MM).points, part)
    assert found.status == "ok"
    assert turn_deg(found.T_surface, truth.arch.T_bridge_scan[2]) < 2.0 * TURNED_DEG
