"""Poses that two scans may have to each other, each with what speaks for it and against it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.model import Floats
from processor.stitching.coarse import face_index, rotations, translations
from processor.stitching.coarse.free_space import Sight
from processor.stitching.planes.samples import Elements, elements
from processor.stitching.planes.scan_planes import Cloud

SIDES = 48.0  # a view's coarse cubes: so many along the reach of the points
LIKE_COS = float(np.cos(np.radians(15.0)))
FEWEST = 6  # faces
FINE = 0.3  # of the cubes' side


@dataclass(frozen=True)
class Search:
    """How far to look: shifts of a turn, least votes by the most, poses held against the rays, and poses refined."""

    peaks: int
    least_of_best: float
    checked: int
    refined: int


QUICK, WIDE = Search(translations.PEAKS, translations.LEAST_OF_BEST, 60, 8), Search(15, 0.3, 150, 20)
GATES = (0.7, 0.35, 0.2, 0.12)  # of the cubes' side
FEW_ABOVE = 0.3  # of the cubes' side: wider gates ask the faces that vote alone
STEPS = 4
NEAR, MARGIN = 0.15, 0.4  # of the cubes' side: faces closer than that are the same; seen this far beyond is through
FOUND = 0.45  # of the cubes' side: as far as faces are asked for what is near
BEYOND = 0.35  # of the cubes' side: as far beyond a gate as a face may have its middle
SMALL, LARGE = GATES[2] + BEYOND, GATES[0] + BEYOND
SLID, SLIDES = 3, (-1.2, -0.9, -0.6, -0.4, -0.2, 0.2, 0.4, 0.6, 0.9, 1.2)  # poses tried so, by shares of the side
LOOSE = 0.01  # of the strength of the strongest direction
ENOUGH = 0.08  # overlap that two scans should have; less is a weak sign
AGAINST_SHARE = 0.007
SURE = 0.5  # score of a pose that rays do not speak against; right ones have over 0.7, a truss turned round under 0.3
LITTLE_AGAINST = AGAINST_SHARE * math.log(1.0 / SURE)
SAME_MM, SAME_RAD = 0.7, 0.03  # of the cubes' side; poses closer than that are one


def score(agree: float, against: float, total: float) -> float:
    """Weigh agreement and what speaks against it, 0 to 1.

    Beyond an overlap that is enough, more says nothing: a bridge turned end for end may overlap more. What tells is
    the share of faces that speak against a pose, as a right one has next to none.
    """
    if not agree > 0.0:
        return 0.0
    return (1.0 - math.exp(-agree / (ENOUGH * total))) * math.exp(-against / (AGAINST_SHARE * agree))


@dataclass(frozen=True)
class View:
    """A cloud made ready for being placed: coarse and finer elements, their weights, what was looked through."""

    cloud: Cloud
    side_mm: float
    coarse: Elements
    weight: Floats
    voters: tuple[Elements, Floats]
    small: face_index.Near  # of the finer faces, by cells of SMALL and of LARGE
    large: face_index.Near
    modes: tuple[Floats, Floats]
    sight: Sight | None


@dataclass(frozen=True)
class Placing:
    """One pose of scan b in the frame of scan a: the share of b's faces (of those that a could see) that a sees too.

    ``agree`` and ``against`` are weighted counts of both scans' faces: found in the other, and looked through by it.
    """

    T_a_b: Floats
    agree: float
    against: float
    overlap: float

    @property
    def score(self) -> float:
        """Evidence for the pose, 0 to 1; see :func:`score`."""
        return score(self.agree, self.against, self.agree / max(self.overlap, 1e-12))


def side_of(clouds: list[Cloud]) -> float:
    """Side of coarse cubes, mm, for clouds that are to be placed together."""
    reach = [
        float(np.quantile(np.linalg.norm(c.cells.mean - np.median(c.cells.mean, axis=0), axis=1), 0.8))
        for c in clouds
        if len(c.sums)
    ]
    return float(np.median(reach)) / SIDES * 2.0 if reach else 1.0


def view(cloud: Cloud, side_mm: float) -> View:
    """Make a cloud ready."""
    coarse = elements(cloud, side_mm)
    fine = elements(cloud, FINE * side_mm)
    weight = translations.weights(coarse.normals)
    voters = translations.voters(coarse, weight) if len(weight) else (coarse, weight)
    axes = rotations.modes(coarse.normals)
    small, large = (face_index.of_faces(fine, share * side_mm) for share in (SMALL, LARGE))
    return View(cloud, side_mm, coarse, weight, voters, small, large, axes, cloud.sight)


def placings(a: View, b: View, most_tilt_rad: float, most: int = 4) -> list[Placing]:
    """Poses of b to a, the best first; none where nothing is alike.

    Where rays speak against all that a quick look finds, as on a structure that repeats itself, a wider one follows.
    """
    if min(len(a.coarse.points), len(b.coarse.points)) < FEWEST:
        return []
    found = _searched(a, b, most_tilt_rad, most, QUICK)
    return found if found and found[0].score > SURE else _searched(a, b, most_tilt_rad, most, WIDE)


def _searched(a: View, b: View, most_tilt_rad: float, most: int, search: Search) -> list[Placing]:
    tried: list[tuple[float, Floats]] = []
    for R in rotations.turns(a.modes, b.modes, most_tilt_rad):
        found_of_turn = translations.shifts(*a.voters, *b.voters, R, a.side_mm, search.peaks, search.least_of_best)
        for t, score in zip(*found_of_turn, strict=True):
            tried.append((float(score), rigid.transform(R, t)))
    tried = sorted(tried, key=lambda one: -one[0])[: search.checked]
    checked = [held(a, b, T, 0.7 * a.side_mm, a.side_mm, few=True) for _, T in tried]
    checked.sort(key=lambda one: -one.score)
    refined = [
        held(a, b, refine(a, b, one.T_a_b)[0], NEAR * a.side_mm, MARGIN * a.side_mm)
        for one in checked[: search.refined]
    ]
    refined.sort(key=lambda one: (-one.score, -one.agree))
    refined = [slid(a, b, one) for one in refined[:SLID]] + refined[SLID:]
    refined.sort(key=lambda one: (-one.score, -one.agree))
    found: list[Placing] = []
    for one in refined:
        if not any(same(one.T_a_b, other.T_a_b, a.side_mm, b) for other in found):
            found.append(one)
    return found[:most]


def same(T: Floats, S: Floats, side_mm: float, b: View) -> bool:
    """Whether two poses of b differ by less than what tells poses apart."""
    D = rigid.invert(T) @ S
    middle = b.coarse.points.mean(axis=0)
    apart = np.linalg.norm(rigid.apply(D, middle) - middle)
    return bool(rigid.rotation_angle(D[:3, :3]) < SAME_RAD and apart < SAME_MM * side_mm)


def held(a: View, b: View, T_a_b: Floats, near_mm: float, margin_mm: float, few: bool = False) -> Placing:
    """Count what speaks for and against a pose: faces of each in the other, and faces the other looked through.

    ``few`` asks the faces that vote alone.
    """
    agree, against, total = 0.0, 0.0, 0.0
    for one, other, T in ((a, b, rigid.invert(T_a_b)), (b, a, T_a_b)):
        # faces of `one`, in the frame of `other`
        faces, w = one.voters if few else (one.coarse, one.weight)
        found = np.empty(len(w), np.bool_)
        face_index.agreeing(other.small, T, faces.points, faces.normals, FOUND * a.side_mm, near_mm, LIKE_COS, found)
        agree += float(w[found].sum())
        total += float(w.sum())
        if other.sight is not None:
            rest = rigid.apply(T, faces.points[~found])
            against += float(w[~found] @ other.sight.through(rest, margin_mm))
    return Placing(T_a_b, agree, against, agree / max(total, 1e-12))


def slid(a: View, b: View, one: Placing) -> Placing:
    """Move a pose along what the shared faces do not tell, to where most speaks for it."""
    _, loose = refine(a, b, one.T_a_b, GATES[-1:])
    if loose is None:
        return one
    best = one
    for k in SLIDES:
        T = one.T_a_b.copy()
        T[:3, 3] += k * a.side_mm * loose
        other = held(a, b, T, NEAR * a.side_mm, MARGIN * a.side_mm)
        if (other.score, other.agree) > (best.score, best.agree):
            best = other
    return best


def refine(a: View, b: View, T: Floats, gates: tuple[float, ...] = GATES) -> tuple[Floats, Floats | None]:
    """Move b's faces onto a's, gate by gate; along what the faces do not tell, a pose stays as it is.

    Returns the pose, and the unit vector (3,) along which it is loose, if there is one.
    """
    loose = None
    for gate in gates:
        faces, weight = b.voters if gate > FEW_ABOVE else (b.coarse, b.weight)
        for _ in range(STEPS):
            H, g, centre, reach, count = face_index.equations(
                a.small, a.large, T, faces.points, faces.normals, weight,
                (gate + BEYOND) * a.side_mm, gate * a.side_mm, LIKE_COS,
            )  # fmt: skip
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
