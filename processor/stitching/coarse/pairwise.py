"""Candidate poses of two scans relative to each other, scored by matching patches and by free space."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from processor.geometry import rigid
from processor.model import Bools, Floats
from processor.stitching.coarse import candidate_rotations, candidate_translations, face_index
from processor.stitching.coarse.candidate_translations import WeightedPatches
from processor.stitching.coarse.face_index import FaceIndex
from processor.stitching.planes.sampled_patches import Patches, sample
from processor.stitching.planes.scan_planes import Cloud


@dataclass(frozen=True)
class Effort:
    """Size of a search: translations for each rotation, their least votes by the best, poses scored, poses refined."""

    peaks: int
    least_of_best: float
    scored: int
    refined: int


# Lengths are in sides of the coarse cubes unless stated.
SIDES = 48.0  # along the reach of the points
LIKE_COS = float(np.cos(np.radians(15.0)))  # of matching patches: patches of coarse cubes may hold an edge, and lean
FEWEST = 6  # patches
MOST = 4  # candidate poses of two scans
FINE = 0.3  # side of the cubes of indexed patches
QUICK = Effort(peaks=6, least_of_best=0.5, scored=60, refined=8)  # work: enough if SURE
WIDE = Effort(peaks=15, least_of_best=0.3, scored=150, refined=20)  # work: two to three times as much
# In halls of unequal bays right poses were the 414th by votes at worst, and by their rough scores the ninth.
DEEP = Effort(peaks=100, least_of_best=0.05, scored=1000, refined=30)
# Of a start: near it every peak of the votes is tried; a few are left by the bound on the distance.
BESIDE = Effort(peaks=100, least_of_best=0.05, scored=20, refined=6)
# Two scans whose poses are wrong by 0.3 m and 1 degree, over 30 m: 0.8 m and 1.4 degrees; with room for twice that.
START_MM, START_RAD = 2000.0, 0.06
GATES = (0.7, 0.35, 0.2, 0.12)  # distance across of matches, from refinement to refinement
FEW_ABOVE = 0.3  # wider gates use the voters only
STEPS = 4  # Gauss-Newton steps for each gate
NEAR, MARGIN = 0.15, 0.4  # distance across of matching patches; margin of free space
ROUGH_NEAR, ROUGH_MARGIN = 0.7, 1.0  # the same before a pose is refined
MATCH_RADIUS = 0.45  # distance of the centres of matching patches
BEYOND = 0.35  # by which the centre of a patch may be farther away than the gate
SMALL, LARGE = GATES[2] + BEYOND, GATES[0] + BEYOND  # cells of the indexes
SLID, SLIDES = 3, (-1.2, -0.9, -0.6, -0.4, -0.2, 0.2, 0.4, 0.6, 0.9, 1.2)  # poses that are slid, and how far
LOOSE = 0.01  # eigenvalue of an undetermined direction by the largest one
ENOUGH = 0.08  # overlap that two scans should have; less is a weak sign
AGAINST_SHARE = 0.007  # contradiction by support that lowers a score by 1 / e
SURE = 0.5  # a score not lowered by free space: right poses have over 0.7, a truss turned end for end under 0.3
LITTLE_AGAINST = AGAINST_SHARE * math.log(1.0 / SURE)
SAME_SHIFT, SAME_RAD = 0.7, 0.03  # poses closer than that are the same


@dataclass(frozen=True)
class ScanPatches:
    """A cloud with its patches on coarse cubes of side ``side_mm``, and its finer patches indexed."""

    cloud: Cloud
    side_mm: float
    patches: WeightedPatches
    voters: WeightedPatches  # fewer of them, for voting and rough scores
    small: FaceIndex  # of the finer patches, in cells of SMALL and of LARGE
    large: FaceIndex
    modes: tuple[Floats, Floats]


@dataclass(frozen=True)
class ScoredPose:
    """A pose of scan b in the frame of scan a with its support (``agree``) and contradiction (``against``).

    These are weighted counts of both scans' patches: matching one of the other, and lying in its free space.
    ``overlap`` is the matching share of all patches' weight, ``moved`` the contradiction by patches that are left out
    as of what moved.
    """

    T_a_b: Floats
    agree: float
    against: float
    overlap: float
    moved: float = 0.0

    @property
    def score(self) -> float:
        """Evidence for the pose, 0 to 1; see :func:`score`."""
        return score(self.agree, self.against, self.agree / max(self.overlap, 1e-12))


def score(agree: float, against: float, total: float) -> float:
    """Combine support, contradiction and the total weight of the patches to a score of 0 to 1.

    Overlap beyond ENOUGH adds nothing: a bridge turned end for end may overlap more than in its right pose. Decisive is
    the ratio of contradiction to support, which is almost 0 for a right pose.
    """
    if not agree > 0.0:
        return 0.0
    return (1.0 - math.exp(-agree / (ENOUGH * total))) * math.exp(-against / (AGAINST_SHARE * agree))


def cube_side(clouds: list[Cloud]) -> float:
    """Return the side of coarse cubes, mm, common to clouds that are registered together."""
    reach = [
        float(np.quantile(np.linalg.norm(cloud.mean - np.median(cloud.mean, axis=0), axis=1), 0.8))
        for cloud in clouds
        if len(cloud.sums)
    ]
    return float(np.median(reach)) / SIDES * 2.0 if reach else 1.0


def prepare(cloud: Cloud, side_mm: float) -> ScanPatches:
    """Sample and index the patches of a cloud."""
    patches = candidate_translations.weighted(sample(cloud, side_mm))
    fine = sample(cloud, FINE * side_mm)
    return ScanPatches(
        cloud=cloud,
        side_mm=side_mm,
        patches=patches,
        voters=candidate_translations.thinned(patches),
        small=face_index.build(fine, SMALL * side_mm),
        large=face_index.build(fine, LARGE * side_mm),
        modes=candidate_rotations.normal_modes(patches.patches.normals),
    )


def reduced(scan: ScanPatches, keep: Bools) -> ScanPatches:
    """Keep some (n,) of the patches of a scan as evidence; the indexed ones, which those of others match, stay."""
    (points, normals), weight = scan.patches
    patches = WeightedPatches(Patches(points[keep], normals[keep]), weight[keep])
    return replace(scan, patches=patches, voters=candidate_translations.thinned(patches))


def candidate_poses(
    a: ScanPatches,
    b: ScanPatches,
    most_tilt_rad: float,
    efforts: Sequence[Effort] = (QUICK, WIDE),
    start: Floats | None = None,
) -> list[ScoredPose]:
    """Return at most MOST poses of b in a, the best first; none if the scans have nothing alike.

    If free space contradicts all poses of a search, as on a repetitive structure, the next effort follows. A ``start``
    (4, 4) limits the search to what is near it.
    """
    poses: list[ScoredPose] = []
    if min(len(a.patches.weight), len(b.patches.weight)) < FEWEST:
        return poses
    for effort in efforts:
        poses = _search(a, b, most_tilt_rad, effort, start)[:MOST]
        if poses and poses[0].score > SURE:
            break
    return poses


def _search(
    a: ScanPatches, b: ScanPatches, most_tilt_rad: float, effort: Effort, start: Floats | None
) -> list[ScoredPose]:
    """Vote, score roughly, refine, slide; returns the distinct poses, the best first."""
    voted: list[tuple[float, Floats]] = [] if start is None else [(0.0, start)]
    for R in candidate_rotations.candidate_rotations(a.modes, b.modes, most_tilt_rad):
        if start is not None and rigid.rotation_angle(start[:3, :3].T @ R) > START_RAD:
            continue
        shifts, votes = candidate_translations.candidate_translations(
            a.voters, b.voters, R, a.side_mm, effort.peaks, effort.least_of_best
        )
        found = [(float(v), rigid.transform(R, t)) for t, v in zip(shifts, votes, strict=True)]
        voted += [one for one in found if start is None or is_beside(start, one[1], b)]
    voted = sorted(voted, key=lambda pair: -pair[0])[: effort.scored]
    scored = [score_pose(a, b, T, rough=True) for _, T in voted]
    scored.sort(key=lambda pose: -pose.score)
    refined = [score_pose(a, b, refine(a, b, pose.T_a_b)[0]) for pose in scored[: effort.refined]]
    refined.sort(key=lambda pose: (-pose.score, -pose.agree))
    refined = [slide(a, b, pose) for pose in refined[:SLID]] + refined[SLID:]
    refined.sort(key=lambda pose: (-pose.score, -pose.agree))
    distinct: list[ScoredPose] = []
    for pose in refined:
        if not any(same(pose.T_a_b, other.T_a_b, a.side_mm, b) for other in distinct):
            distinct.append(pose)
    return distinct


def same(T: Floats, S: Floats, side_mm: float, b: ScanPatches) -> bool:
    """Return whether two poses of b are the same within SAME_RAD and SAME_SHIFT cubes at the centre of its patches."""
    return _within(T, S, b, SAME_RAD, SAME_SHIFT * side_mm)


def is_beside(start: Floats, T: Floats, b: ScanPatches) -> bool:
    """Return whether a pose of b is as near to a start as starts are taken to be wrong."""
    return _within(start, T, b, START_RAD, START_MM)


def _within(T: Floats, S: Floats, b: ScanPatches, most_rad: float, most_mm: float) -> bool:
    D = rigid.invert(T) @ S
    centre = b.patches.patches.points.mean(axis=0)
    shift = np.linalg.norm(rigid.apply(D, centre) - centre)
    return bool(rigid.rotation_angle(D[:3, :3]) < most_rad and shift < most_mm)


def score_pose(a: ScanPatches, b: ScanPatches, T_a_b: Floats, rough: bool = False) -> ScoredPose:
    """Score a relative pose: weighted counts of matching patches and of patches lying in the other scan's free space.

    ``rough`` uses the voters only, with wider tolerances.
    """
    weights = [(scan.voters if rough else scan.patches).weight for scan in (a, b)]
    return summed(T_a_b, weights, (compare(a, b, rigid.invert(T_a_b), rough), compare(b, a, T_a_b, rough)))


def summed(
    T_a_b: Floats,
    weights: Sequence[Floats],
    compared: Sequence[tuple[Bools, Floats]],
    still: Sequence[Bools | slice] = (slice(None), slice(None)),
) -> ScoredPose:
    """Sum what :func:`compare` says of the patches of scans a and b, of ``weights`` (n,) each, that are ``still``."""
    agree, against, total, moved = 0.0, 0.0, 0.0, 0.0
    for weight, (match, looked_through), some in zip(weights, compared, still, strict=True):
        agree += float(weight[some][match[some]].sum())
        against += float(looked_through[some].sum())
        total += float(weight[some].sum())
        moved += float(looked_through.sum())
    return ScoredPose(T_a_b, agree, against, agree / max(total, 1e-12), moved - against)


def compare(scan: ScanPatches, other: ScanPatches, T_other_scan: Floats, rough: bool = False) -> tuple[Bools, Floats]:
    """Mark the patches (n,) of a scan that match the other's, and weigh (n,) those that the other looked through."""
    near_mm, margin_mm = (x * scan.side_mm for x in ((ROUGH_NEAR, ROUGH_MARGIN) if rough else (NEAR, MARGIN)))
    patches, weight = scan.voters if rough else scan.patches
    match, looked_through = np.empty(len(weight), np.bool_), np.zeros(len(weight))
    face_index.mark_matches(other.small, T_other_scan, patches, MATCH_RADIUS * scan.side_mm, near_mm, LIKE_COS, match)
    if other.cloud.free_space is not None:
        rest, normals = (
            rigid.apply(T_other_scan, patches.points[~match]),
            patches.normals[~match] @ T_other_scan[:3, :3].T,
        )
        sure = weight[~match] * other.cloud.free_space.resolved(rest, normals, scan.side_mm)
        looked_through[~match] = sure * other.cloud.free_space.contains(rest, margin_mm)
    return match, looked_through


def slide(a: ScanPatches, b: ScanPatches, pose: ScoredPose) -> ScoredPose:
    """Shift a pose along the direction that the matches do not determine, to the best score."""
    _, loose = refine(a, b, pose.T_a_b, GATES[-1:])
    if loose is None:
        return pose
    best = pose
    for step in SLIDES:
        T = pose.T_a_b.copy()
        T[:3, 3] += step * a.side_mm * loose
        candidate = score_pose(a, b, T)
        if (candidate.score, candidate.agree) > (best.score, best.agree):
            best = candidate
    return best


def refine(a: ScanPatches, b: ScanPatches, T: Floats, gates: tuple[float, ...] = GATES) -> tuple[Floats, Floats | None]:
    """Refine a pose by point-to-plane ICP with decreasing gates; damping keeps undetermined components as they are.

    Returns the pose, and the unit vector (3,) of a direction that the matches do not determine, if there is one.
    """
    loose = None
    for gate in gates:
        patches, weight = b.voters if gate > FEW_ABOVE else b.patches
        for _ in range(STEPS):
            H, g, centre, reach, count = face_index.normal_equations(
                a.small, a.large, T, patches, weight, (gate + BEYOND) * a.side_mm, gate * a.side_mm, LIKE_COS
            )
            if count < FEWEST:
                return T, None
            step = -np.linalg.solve(H + 1e-3 * np.trace(H) / 6.0 * np.eye(6), g)
            R = rigid.rotation_from_vector(step[:3] / reach)
            T = rigid.transform(R, centre + step[3:] - R @ centre) @ T
            value, vector = np.linalg.eigh(H[3:, 3:])
            loose = vector[:, 0] if value[0] < LOOSE * value[2] else None
            if np.abs(step).max() < 1e-3 * a.side_mm:
                break
    return T, loose
