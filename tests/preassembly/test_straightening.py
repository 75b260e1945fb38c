"""The bend of parts as scanned, taken out or in their intervals, against finite elements (bent_girders)."""

import dataclasses
from itertools import combinations

import numpy as np
import pytest

from processor.geometry import rigid
from processor.model import InputError, PartSupports, Status, Steel
from processor.preassembly import topology
from processor.preassembly.ends.joint_frame import joint_frame
from processor.preassembly.params import SystematicParams
from processor.preassembly.parts import bending, straightening, supports_seen
from processor.preassembly.parts.measure import MeasuredPart
from processor.preassembly.parts.part_residuals import PartResiduals
from processor.preassembly.parts.supports_seen import Seen
from processor.store import store
from tests.support.results import measured_parts
from tests.support.scenes import bent_girders
from tests.support.scenes.bent_girders import Girder

SD_MM = 0.05  # of the key points as measured
GRADIENT_K = SystematicParams().gradient_K
GIRDERS = [
    *(Girder(length=length) for length in (12_000.0, 18_000.0, 25_000.0)),
    *(Girder(length=length, width=300.0, height=300.0, flange=14.0, web=10.0) for length in (6_000.0, 12_000.0)),
]


def measured(girder, every, rng, weight=1.0, stated=True, plates=True):
    """Parts measured with an error of SD_MM, bent as they lie; and their scene without points."""
    scene, poses, _ = bent_girders.scene(girder, every, 0, stated, spacing=1e5, sigma=0.0, plates=plates)

    def departure(i, end, joint):
        points = scene.arch.joint_points[joint]
        bent = bent_girders.bent(girder, i * girder.length, points, every[i], weight) - points
        return (bent + rng.normal(0.0, SD_MM, (8, 3))) @ joint_frame(points)[:3, :3]

    def edges(i):
        part = scene.arch.parts[i]
        points = np.vstack([part.bottom_edge_left[1::4], part.bottom_edge_right[1::4]])
        axes = np.broadcast_to([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], (len(points), 2, 3))
        bent = bent_girders.bent(girder, i * girder.length, points, every[i], weight) - points
        return measured_parts.edges(points[:, 0] - i * girder.length, points, axes, bent[:, 1:], SD_MM)

    members = measured_parts.members(scene.arch, departure, SD_MM, [edges(i) for i in range(len(every))])
    nothing = PartResiduals(np.empty((0, 3)), np.empty(0))
    parts = [
        MeasuredPart(f"g{i + 1}", (scan,), Status.OK, (), T, member, 1.0, np.full((4, 4), np.nan), nothing)
        for i, (scan, T, member) in enumerate(zip(scene.scans, poses, members, strict=True))
    ]
    return parts, scene


def pulls(parts, scene):
    """Errors of all gaps over their standard deviations, and these: the parts are as designed but for their bend."""
    error, sd = [], []
    for left, right in topology.sides_of(scene.arch.joined):
        ends = [parts[side.part].member.ends[side.end] for side in (left, right)]
        error.append((ends[1].departure - ends[0].departure).ravel())
        sd.append(np.sqrt(np.diag(ends[0].covariance + ends[1].covariance)))
    return np.concatenate(error) / np.concatenate(sd), np.concatenate(sd)


def straightened(girder, every, rng, gradient_K=GRADIENT_K, **options):
    parts, scene = measured(girder, every, rng, **options)
    return straightening.straighten(parts, scene, scene.arch, gradient_K)[0], scene


def codes(part):
    return [one.code for one in part.reasons]


@pytest.mark.parametrize("supports", [2, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("stated", [True, False])
def test_gaps_of_bent_girders_are_inside_their_intervals(supports, stated):
    rng, every, widths = np.random.default_rng([supports, stated]), [], []
    for girder in GIRDERS * 3:
        lying = [bent_girders.drawn(girder, rng, supports) for _ in range(3)]
        parts, scene = straightened(girder, lying, rng, stated=stated)
        pull, sd = pulls(parts, scene)
        every.append(pull)
        assert all(("preassemble.sag" in codes(part)) == stated for part in parts)
        if stated:
            weightless = dataclasses.replace(scene, steel=Steel(density_kg_m3=1e-6))
            unbent = straightening.straighten(measured(girder, lying, rng)[0], weightless, scene.arch, GRADIENT_K)[0]
            widths.append(np.median(sd) / np.median(pulls(unbent, scene)[1]))
    inside = np.mean(np.abs(np.concatenate(every)) < 1.96)
    ratio = np.sqrt(np.mean(np.concatenate(every) ** 2))
    # 48 values of a scene hang on six parts' gradients: of 15 scenes the share has a standard deviation of 2.7 %.
    assert inside > 0.95 - 3.0 * 0.027
    assert ratio < 1.3
    assert max(widths, default=1.0) < 1.3


def test_the_law_of_supports_has_the_tail_that_intervals_take():
    rng = np.random.default_rng(2)

    def end():
        """An end's displacement by a curvature along a part on two trestles, over its standard deviation."""
        low, high = rng.uniform(0.0, 1.0 / 3.0, (2, 1_000_000))
        uneven = rng.uniform(0.0, 10.0, len(low)) * np.cos(rng.uniform(0.0, 2.0 * np.pi, len(low)))
        moved = uneven * low * (1.0 - high)
        return moved / moved.std()

    quantile = np.quantile(np.abs(end() - end()), 0.95) / np.sqrt(2.0)
    assert quantile / 1.96 == pytest.approx(straightening.TAIL, abs=0.01)  # its standard deviation is 0.001


def test_sags_taken_out_are_known_to_their_stated_share():
    rng, every = np.random.default_rng(11), []
    for girder in GIRDERS * 3:
        lying = [bent_girders.drawn(girder, rng, gradient=0.0) for _ in range(3)]
        every.append(pulls(*straightened(girder, lying, rng, gradient_K=0.0, weight=rng.normal(1.0, 0.1)))[0])
    assert np.mean(np.abs(np.concatenate(every)) < 1.96) > 0.92
    assert np.sqrt(np.mean(np.concatenate(every) ** 2)) < 1.25


@pytest.mark.parametrize("count", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_gaps_by_supports_that_are_seen(count, monkeypatch):
    """The sets of three trestles that may carry a part do so as often as each other."""
    rng, every, widths = np.random.default_rng([count, 7]), [], []
    for girder in GIRDERS * 3:
        lying, seen = [], {}
        for name in ("g1", "g2", "g3"):
            one = bent_girders.drawn(girder, rng, count)
            pairs = [some for some in combinations(one.supports, 2) if some[0] < 0.5 * girder.length < some[1]]
            carrying = [one.supports, *pairs][rng.integers(len(pairs) + 1)]
            lying.append(one._replace(carrying=carrying))
            seen[name] = np.array(one.supports)
        monkeypatch.setattr(
            straightening.supports_seen,
            "find",
            lambda _, up, beam, part, seen=seen: Seen(seen[part.name], np.full(count, 30.0)),
        )
        parts, scene = straightened(girder, lying, rng, stated=False)
        pull, sd = pulls(parts, scene)
        every.append(pull)
        assert all("preassemble.supports-seen" in codes(part) for part in parts)
        monkeypatch.setattr(straightening.supports_seen, "find", lambda *_: None)
        widths.append(np.median(sd) / np.median(pulls(*straightened(girder, lying, rng, stated=False))[1]))
    inside = np.mean(np.abs(np.concatenate(every)) < 1.96)
    assert inside > 0.95 - 3.0 * 0.027  # as above
    assert np.sqrt(np.mean(np.concatenate(every) ** 2)) < 1.3
    assert np.median(widths) < 1.0


@pytest.mark.parametrize("quarters", [0, 1])
@pytest.mark.parametrize("trestles", [(1_300.0, 9_100.0), (900.0, 6_200.0, 10_000.0)])
def test_trestles_are_seen_beneath_a_part(quarters, trestles):
    places = seen(GIRDERS[0], trestles, quarters)
    np.testing.assert_allclose(places.places, trestles, atol=30.0)  # cells are 50 mm long
    assert (places.sd < 50.0).all()


@pytest.mark.parametrize(
    "options",
    [
        {"trestles": (6_000.0,)},
        {"lower": 150.0},  # it may touch where no scanner looks
        {"unseen": (4_000.0, 5_000.0)},
        {"sling": True},
        {"floor": False},
    ],
)
def test_supports_that_are_not_surely_seen(options):
    assert seen(GIRDERS[0], options.pop("trestles", (1_300.0, 9_100.0)), 0, **options) is None


def seen(girder, trestles, quarters, *, sling=False, floor=True, **options):
    """Supports seen of a girder on trestles beside which somebody stands."""
    rng = np.random.default_rng(quarters)
    lying = bent_girders.Lying(quarters, (1_300.0, 9_100.0), (0.0, 0.0), 0.7)
    scene, (T,), _ = bent_girders.scene(girder, [lying], 1, spacing=60.0)
    scan = bent_girders.raw(girder, scene.scans[0], T, trestles, rng, **options)
    part = scene.arch.parts[0]
    made = bending.beam(part, np.zeros(3), Steel())
    up = T[:3, 2]
    add = [np.zeros((0, 3))]
    if sling:
        add.append([0.5 * girder.length, 0.0, 0.5 * girder.height] + rng.uniform(500.0, 2_000.0, (2_000, 1)) * up)
    person = rng.uniform([2_000.0, 700.0, -300.0], [2_400.0, 1_000.0, 1_500.0], (3_000, 3))
    points = np.vstack([rigid.apply(T, scan.points), person if quarters == 0 else add[0], *add])
    above = (points - made.origin) @ up
    points = points if floor else points[above > above.min() + 100.0]
    return supports_seen.find([(np.eye(4), 1.0, points)], up, made, part)


def test_what_is_said_of_a_part():
    girder, rng = GIRDERS[2], np.random.default_rng(3)
    lying = [bent_girders.Lying(0, (2_000.0, 20_000.0), (0.0, 0.0), 0.3)] * 3
    parts, scene = measured(girder, lying, rng)
    (part, *_), of_all = straightening.straighten(parts, scene, scene.arch, GRADIENT_K)
    (sag,) = part.reasons
    assert (sag.code, sag.values["places"]) == ("preassemble.sag", ("2.0", "20.0"))
    assert sag.values["mass"] == pytest.approx(1e-3 * girder.area * girder.length * 7850e-9, rel=0.01)  # and the pad
    assert [one.code for one in of_all] == ["preassemble.gradient"]
    unstated = dataclasses.replace(scene, part_supports=None)
    (part, *_), of_all = straightening.straighten(parts, unstated, scene.arch, 0.0)
    assert (codes(part), of_all) == (["preassemble.supports-unknown"], ())
    np.testing.assert_array_equal(part.member.ends[1].departure, parts[0].member.ends[1].departure)
    assert np.trace(part.member.ends[1].covariance) > np.trace(parts[0].member.ends[1].covariance)
    # By chainage from the start, the same; beyond the part, or beside its centre of gravity, it cannot lie.
    for chainages, code in (((2e3, 20e3), "sag"), ((2e3, 27e3), "supports-do-not-carry"),
                            ((1e3, 9e3), "supports-do-not-carry")):  # fmt: skip
        stated = PartSupports(("g2", "g2"), np.full((2, 3), np.nan), np.array(chainages))
        (first, second, _), _ = straightening.straighten(
            parts, dataclasses.replace(scene, part_supports=stated), scene.arch, 0.0
        )
        assert codes(second)[0] == f"preassemble.{code}"
        assert codes(first) == ["preassemble.supports-unknown"]
        if code == "sag":
            found = straightening.straighten(parts, scene, scene.arch, 0.0)[0][1].member.ends[1].departure
            np.testing.assert_allclose(second.member.ends[1].departure, found, atol=1e-6)


def test_a_scan_that_is_not_levelled_bends_in_any_direction():
    girder, rng = GIRDERS[1], np.random.default_rng(5)
    parts, scene = measured(girder, [bent_girders.drawn(girder, rng, gradient=0.0)] * 3, rng, stated=False)
    upright = rigid.rotation_from_vector(np.array([0.0, 0.5 * np.pi, 0.0]))
    turned = [dataclasses.replace(part, T_bridge_scan=rigid.transform(upright, np.zeros(3))) for part in parts]
    (level, *_), _ = straightening.straighten(parts, scene, scene.arch, 0.0)
    (steep, *_), _ = straightening.straighten(turned, scene, scene.arch, 0.0)
    before = parts[0].member.ends[1].covariance
    by_axis = [np.diag(one.member.ends[1].covariance - before).reshape(8, 3).mean(axis=0) for one in (level, steep)]
    assert min(by_axis[0][1:]) < 1e-6 * max(by_axis[0][1:])  # the pad tilts the axis by some 1e-5
    assert min(by_axis[1][1:]) > 0.1 * max(by_axis[1][1:])


def test_supports_are_stored_in_scene_files(tmp_path):
    girder = GIRDERS[0]
    lying = [bent_girders.drawn(girder, np.random.default_rng(1)) for _ in range(2)]
    scene = bent_girders.scene(girder, lying, 1, spacing=300.0)[0]
    store.write_scene(tmp_path / "s.h5", dataclasses.replace(scene, steel=Steel(206_000.0)), None, {})
    back = store.read_scene(tmp_path / "s.h5")
    assert back.steel == Steel(206_000.0)
    assert back.part_supports.component == ("g1", "g1", "g2", "g2")
    np.testing.assert_allclose(back.part_supports.places, scene.part_supports.places)
    one = scene.part_supports.take(slice(0, 1))
    store.write_scene(tmp_path / "one.h5", dataclasses.replace(scene, part_supports=one), None, {})
    with pytest.raises(InputError, match="two or more supports of 'g1', found one"):
        store.read_scene(tmp_path / "one.h5")
