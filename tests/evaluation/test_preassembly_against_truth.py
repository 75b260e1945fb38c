"""Gaps compared with those of the truth, with members made by hand: exact ends and edges, no points."""

import functools

import numpy as np
import pytest

from processor.evaluation import preassembly
from processor.geometry import rigid
from processor.geometry.lines_and_polylines import Polyline
from processor.model import ArchTruth, Scene, Truth
from processor.preassembly.chain import adjustment
from processor.preassembly.ends import bottom_edges
from processor.preassembly.result import Adjustment, Components, Joints, Linear, Result
from tests.support.clouds import arch_clouds
from tests.support.results import measured_parts

DESIGN = arch_clouds.design()
FRAMES = measured_parts.frames(DESIGN)
WEIGHT = 0.1


def as_built(seed=5):
    """True key points (c, 2, 8, 3) some millimetres off the design's in each part's own way, and its bottom edges."""
    rng = np.random.default_rng(seed)
    ends, edges = [], []
    for i, part in enumerate(DESIGN.parts):
        turn = rigid.transform(rigid.rotation_from_vector(rng.normal(0.0, 2e-4, 3)), rng.normal(0.0, 1.0, 3))
        there = [
            DESIGN.joint_points[j] + rng.normal(0.0, 4.0, (8, 3)) if 0 <= j < 4 else np.full((8, 3), np.nan)
            for j in (i - 1, i)
        ]
        middle = part.vertices.mean(axis=0)
        ends.append([rigid.apply(turn, end - middle) + middle for end in there])
        both = (part.bottom_edge_left, part.bottom_edge_right)
        edges.append([rigid.apply(turn, edge - middle) + middle for edge in both])
    return np.array(ends), np.array(edges)


def as_designed():
    """Key points and bottom edges of perfect parts."""
    joints = [np.full((8, 3), np.nan), *DESIGN.joint_points, np.full((8, 3), np.nan)]
    edges = [[part.bottom_edge_left, part.bottom_edge_right] for part in DESIGN.parts]
    return np.array([joints[i : i + 2] for i in range(5)]), np.array(edges)


def members_of(ends, edges, unseen, without):
    """Members as of scans without noise, but for the ends (part, 0 or 1) ``unseen`` and the parts ``without``."""
    of_edges = []
    for i, part in enumerate(DESIGN.parts):
        lines = (Polyline.through(part.bottom_edge_left), Polyline.through(part.bottom_edge_right))
        stations = bottom_edges.unknown(*lines)
        if i not in without:
            at = np.vstack([preassembly._at_chainages(edges[i, k], lines[k]) for k in range(2)])
            departure = np.einsum("kai,ki->ka", stations.axes, at - stations.points)
            stations = measured_parts.edges(stations.chainage, stations.points, stations.axes, departure, 0.01)
        of_edges.append(stations)

    def departure(part, end, joint):
        if (part, end) in unseen or part in without:
            return ()
        return (ends[part, end] - DESIGN.joint_points[joint]) @ FRAMES[joint][:3, :3]

    return measured_parts.members(DESIGN, departure, 0.01, of_edges)


def stated(members, adjusted, edges, off):
    """The span, edges and closure that an adjustment of exact members states, each off by ``off`` of its interval."""
    middle = [rigid.apply(adjusted.motions[i], edges[i].mean(axis=0)[[i and -1]])[0] for i in (0, -1)]
    at = [np.mean([part.bottom_edge_left[i], part.bottom_edge_right[i]], axis=0) for i, part in
          ((0, DESIGN.parts[0]), (-1, DESIGN.parts[-1]))]  # fmt: skip
    span = np.linalg.norm(middle[1] - middle[0]) - np.linalg.norm(at[1] - at[0])
    departures = np.vstack(adjusted.departures)
    return Adjustment(
        weight=WEIGHT,
        span_departure=span + 0.2 * off,
        span_ci95=0.2,
        linear_offset=departures + 0.1 * off,
        linear_offset_ci95=np.full(departures.shape, 0.1),
        closure=np.full((2, 3), 0.3 * off),
        closure_ci95=np.full((2, 3), 0.3),
    )


@functools.cache
def adjusted_members(unseen, without, built):
    ends, edges = built()
    members = members_of(ends, edges, unseen, without)
    return ends, edges, members, adjustment.adjust(members, DESIGN.joint_points, FRAMES, WEIGHT)


def checked(unseen, without, off=0.0, built=as_built):
    """Checks of the answer from exact members; ``without`` are parts that were not placed."""
    ends, edges, members, adjusted = adjusted_members(unseen, without, built)
    pose = np.array(adjusted.motions)  # the scans lie in the bridge's frame
    pose[list(without)] = np.nan
    lengths = np.cumsum([[0.0, 0.0], *([Polyline.through(e).length for e in (part.bottom_edge_left,
                         part.bottom_edge_right)] for part in DESIGN.parts)], axis=0)  # fmt: skip
    chainage = np.concatenate([
        one.edges.chainage + np.array([lengths[i][("left", "right").index(side)] for side in one.edges.side])
        for i, one in enumerate(members)
    ])  # fmt: skip
    result = Result(
        "ok", "adjustment",
        components=Components(
            name=arch_clouds.NAMES, status=("ok",) * 5, reasons=((),) * 5, scans=arch_clouds.NAMES, T_bridge_scan=pose,
            covariance=np.zeros((5, 6, 6)), key_points_scan=ends, key_points_sd=np.full(ends.shape, 0.1),
        ),
        joints=Joints(
            name=DESIGN.joint_names, left=DESIGN.joint_left, right=DESIGN.joint_right, gaps=adjusted.gaps,
            gap_ci95=np.where(np.isfinite(adjusted.gaps), 0.05, np.nan), verdict=("indeterminate",) * 4,
        ),
        linear=Linear(chainage=chainage, edge=[side for one in members for side in one.edges.side]),
        adjustment=stated(members, adjusted, edges, off),
    )  # fmt: skip
    truth = ArchTruth(arch_clouds.NAMES, np.tile(np.eye(4), (5, 1, 1)), ends, ends, edges)
    scene = Scene("b", "arch-bridge", arch=DESIGN)
    return {one.name: one.value for one in preassembly.check(scene, result, Truth(arch=truth, spacing_mm=10.0))}


@pytest.mark.parametrize(("unseen", "without", "joints"), [(((4, 0),), (), 3), ((), (2,), 2)])
def test_gaps_are_evaluated_without_the_pull_of_unmeasured_joints(unseen, without, joints):
    """A joint without a result has no pull: the other gaps are not those of a chain closed by it."""
    found = checked(unseen, without)
    assert found["gaps, number"] == 24 * joints
    assert found["gaps against the truth's, rms"] < 0.03  # to second order: turns of 4 mm over metres
    assert found["gaps within their 95 % intervals"] > 95.0


@pytest.mark.parametrize(("off", "share"), [(0.5, 100.0), (1.5, 0.0)])
def test_every_interval_of_a_chain_has_its_coverage(off, share):
    """Quantities off by half of their intervals are within them, by one and a half they are not."""
    found = checked((), (), off)
    assert found["spans within their 95 % intervals"] == share
    assert found["edges within their 95 % intervals"] == pytest.approx(share, abs=1.0)  # 1 % at the ends of parts
    assert found["edges, number"] > 100
    assert "closures within their 95 % intervals" not in found  # of parts as built it has no truth
    perfect = checked((), (), off, as_designed)
    assert perfect["closures within their 95 % intervals"] == share
    assert perfect["spans within their 95 % intervals"] == share
