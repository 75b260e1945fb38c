"""Units of length of the input, and checks that a unit is plausible."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from processor import large_arrays, unit_ratio
from processor.column_names import UNIT_WORDS
from processor.geometry import mesh_distance
from processor.model import Floats, InputError, Ints, Reason, UsageError, reason
from processor.registration import located_part, main_body, pose_search, principal

# By definition; the foot of the US survey is 1200 / 3937 m (NIST SP 811, appendix B).
MM_PER_UNIT = {
    "mm": 1.0,
    "cm": 10.0,
    "dm": 100.0,
    "m": 1000.0,
    "km": 1_000_000.0,
    "inch": 25.4,
    "ft": 304.8,
    "us-ft": 1_200_000.0 / 3937.0,
}
VERTICAL = "/"  # before the unit of heights
LARGEST_KM = 10.0  # no structure is larger; a scan in mm read as metres is, and would exhaust the memory
STRAY = 0.01  # share of a scan's points at either end of an axis that may be outliers
# Ratios of a scan's size to the design's that a mistaken unit causes. Of frames and whole structures often only a piece
# is scanned, or the hall around them, so fewer ratios are certain.
PART_RATIOS: tuple[float, ...] = (
    1000.0, 304.8, 100.0, 1 / 0.0254, 25.4, 10.0, 1 / 0.3048, 0.1, 1 / 25.4, 0.0254, 0.01, 1 / 304.8, 0.001,
)  # fmt: skip
FRAME_RATIOS: tuple[float, ...] = (1000.0, 304.8, 25.4, 1 / 304.8, 0.001)  # frames are also drawn in inches
STRUCTURE_RATIOS: tuple[float, ...] = (1000.0, 304.8, 1 / 304.8, 0.001)  # metre, foot and millimetre
RATIO_TOLERANCE = 0.25  # relative: what a piece or the surroundings change; ratios of units are farther apart
CERTAIN_RATIO = 100.0  # and its inverse: ratios that no surroundings of a part and no piece of one cause
SHAPE_TOLERANCE = 2.0  # ratio of extents along the principal axes, of which a part seen from one side lacks some
THIN = 0.05  # of the largest extent: such an extent is not compared
SAMPLE = 100_000  # points
LOCATED = 400_000  # points, among which a part is located
# In metres no scan of a structure is larger, and none has points farther apart.
LARGEST_M, WIDEST_SPACING_M = 2000.0, 0.5
FEWEST_FOR_SPACING, SPACING_POINTS = 1000, 2000  # the median of 2000 is known to 2 %
RANK_MARGIN = 0.01  # of all points: a sample of SAMPLE points misses a rank by far less


def known_unit(text: str) -> str:
    """Return a unit by its name in MM_PER_UNIT. Raises UsageError, which lists the known units, for any other."""
    unit = UNIT_WORDS.get(text.strip().lower(), text.strip().lower())
    if unit not in MM_PER_UNIT:
        raise UsageError(f"unknown unit {text!r}; expected one of {', '.join(MM_PER_UNIT)}")
    return unit


class FileUnit(NamedTuple):
    """Units of the coordinates of a file along x and y, and along z."""

    horizontal: str
    vertical: str

    @property
    def factors(self) -> Floats:
        """The factors (3,) to mm of x, y and z."""
        return np.array([MM_PER_UNIT[unit] for unit in (self.horizontal, self.horizontal, self.vertical)])

    def __str__(self) -> str:
        return self.horizontal if self.vertical == self.horizontal else VERTICAL.join(self)


def file_unit(text: str) -> FileUnit:
    """Return the units that ``m``, or with a unit of the heights ``m/us-ft``, states. Raises UsageError for others."""
    horizontal, slash, vertical = text.partition(VERTICAL)
    if slash and not vertical.strip():
        raise UsageError(f"expected a unit of the heights after the slash, as in m/us-ft, found {text!r}")
    return FileUnit(known_unit(horizontal), known_unit(vertical or horizontal))


def radius(points: Floats) -> float:
    """Return the largest distance of points (n, 3) from the middle of their box: a size that hardly depends on pose."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    return float(np.linalg.norm(points - middle, axis=1).max())


def not_metres(points: Floats) -> Reason | None:
    """Return why points (n, 3) of a format without a unit are taken as mm, None where they may be metres.

    As metres the scan would be larger than any structure, or its points too far apart to show one. Points nearer to
    each other than half a millimetre in a scan below 2 m are not told from metres.
    """
    sample = large_arrays.every(points, max(1, len(points) // SAMPLE))
    if not len(sample):
        return None
    low, high = np.quantile(sample, [STRAY, 1.0 - STRAY], axis=0)
    extent = float((high - low).max())
    if extent > LARGEST_M:
        return reason("units.too-large-in-metres", extent_km=extent / 1000.0)
    spacing = _spacing(points, int(np.argmax(high - low))) if len(points) >= FEWEST_FOR_SPACING else 0.0
    if spacing > WIDEST_SPACING_M:
        return reason("units.too-sparse-in-metres", spacing_m=spacing)
    return None


def _spacing(points: Floats, axis: int) -> float:
    """Median distance of points (n, 3) from the nearest other one, in a slab of SAMPLE points across an axis."""
    first = max((len(points) - SAMPLE) // 2, 0)
    last = min(first + SAMPLE, len(points)) - 1
    low, high = _ordered(points, axis, (first, last))
    parts = []
    for rows in large_arrays.blocks(len(points)):
        along = points[rows, axis]
        parts.append(points[rows][(along >= low) & (along <= high)])
    slab = np.concatenate(parts)
    chosen = slab[:: max(1, len(slab) // SPACING_POINTS)]
    distance, _ = cKDTree(slab).query(chosen, k=2)
    return float(np.median(distance[:, 1]))


def _ordered(points: Floats, axis: int, ranks: tuple[int, int]) -> tuple[float, float]:
    """Return the coordinates along an axis of points (n, 3) that have two ranks by size.

    Of many points those between bounds are sorted that a sample gives; all of them where the sample misses a rank.
    """
    along = points[:, axis]
    low, high = -np.inf, np.inf
    if len(points) > large_arrays.BLOCK_ROWS:
        sample = np.sort(large_arrays.every(along, len(points) // SAMPLE))
        share = np.array(ranks) / len(points) + [-RANK_MARGIN, RANK_MARGIN]
        low, high = sample[np.clip((share * len(sample)).astype(np.int64), 0, len(sample) - 1)]
    below, parts = 0, []
    for rows in large_arrays.blocks(len(points)):
        part = along[rows]
        below += int(np.count_nonzero(part < low))
        parts.append(part[(part >= low) & (part <= high)])
    between = np.concatenate(parts)
    first, last = ranks[0] - below, ranks[1] - below
    if first < 0 or last >= len(between):
        between, first, last = np.array(along), *ranks
    return float(np.partition(between, first)[first]), float(np.partition(between, last)[last])


def check_extent(what: str, points: Floats, unit: str, source: str, advice: str, stray: float = 0.0) -> None:
    """Raise InputError if points (n, 3) in mm, read in ``unit``, extend farther than any structure.

    Their position on the map does not matter. ``what`` names file and object, ``source`` how the unit was found;
    ``stray`` is the share of points at either end of an axis that do not count.
    """
    sample = large_arrays.every(points, max(1, len(points) // SAMPLE))
    if not len(sample):
        return
    low, high = np.quantile(sample, [stray, 1.0 - stray], axis=0) if stray else (points.min(axis=0), points.max(axis=0))
    extent_mm = float((high - low).max())
    if extent_mm <= LARGEST_KM * MM_PER_UNIT["km"]:
        return
    extent = extent_mm / MM_PER_UNIT[unit]
    others = [f"{extent * MM_PER_UNIT[u] / 1000.0:.3g} m if it were {u}" for u in ("m", "mm") if u != unit]
    raise InputError(
        f"{what}: expected at most {LARGEST_KM:g} km across, found {extent_mm / MM_PER_UNIT['km']:.3g} km with its "
        f"unit read as {unit} ({source}); it would be {' and '.join(others)}: {advice}"
    )


def check_ratio(
    what: str,
    points: Floats,
    nominal: Floats,
    ratios: tuple[float, ...],
    unit: str,
    source: str,
    advice: str,
    faces: Ints | None = None,
) -> None:
    """Raise InputError if the size of a scan's points (n, 3), mm, differs from its design's by a ratio of units.

    A mistaken unit scales all extents alike, a floor around a small part does not. ``nominal`` (m, 3) are the
    vertices of the design, or none; sizes are distances from the middle. ``what`` names file and scan, ``source``
    how ``unit`` was found. With the ``faces`` (k, 3) of a part's design, its unit is doubted only if the design's
    surface is shown better by the points in the other unit.
    """
    size = radius(nominal) if len(nominal) else 0.0
    if not size > 0.0:
        return
    sample = large_arrays.every(points, max(1, len(points) // SAMPLE))
    centre = np.quantile(sample, [STRAY, 1.0 - STRAY], axis=0).mean(axis=0)
    ratio = float(np.quantile(np.linalg.norm(sample - centre, axis=1), 0.99)) / size
    factor = unit_ratio.nearest_factor(ratio, ratios, RATIO_TOLERANCE)
    if factor is None or not (
        (not 1.0 / CERTAIN_RATIO < factor < CERTAIN_RATIO) or _scaled_alike(sample, nominal, factor)
    ):
        return
    if faces is not None and 1.0 / CERTAIN_RATIO < factor < CERTAIN_RATIO:
        design = pose_search.prepared(mesh_distance.of_mesh(nominal, faces))
        few = large_arrays.every(points, max(1, len(points) // LOCATED))
        as_read, otherwise = (
            located_part.most_shown(located_part.locate(few / scale, [design])) for scale in (1.0, factor)
        )
        if as_read >= max(otherwise, located_part.LEAST_SHOWN) or (
            otherwise < located_part.LEAST_SHOWN
            and main_body.holds_more(few / factor, [principal.sizes(design.points)])
        ):
            return
    likely = [name for name, mm in MM_PER_UNIT.items() if abs(MM_PER_UNIT[unit] / mm / factor - 1.0) < 0.01]
    raise InputError(
        f"{what} is {ratio:.4g} times as large as the design, close to {factor:.4g}: its unit was read as {unit} "
        f"({source}), which seems wrong{f' (is it {likely[0]}?)' if likely else ''}; {advice}"
    )


def _scaled_alike(points: Floats, nominal: Floats, factor: float) -> bool:
    """Whether the extents of points (n, 3) are those of nominal (m, 3) times the factor along all principal axes."""
    scanned, designed = _extents(points, STRAY), _extents(nominal, 0.0)
    compared = designed > THIN * designed[0]
    ratios = scanned[compared] / (factor * designed[compared])
    return bool((ratios < SHAPE_TOLERANCE).all() and (ratios > 1.0 / SHAPE_TOLERANCE).all())


def _extents(points: Floats, stray: float) -> Floats:
    """Return the extents (3,) of points (n, 3) along their principal axes, the largest first."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1]
    low, high = np.quantile(centred @ axes, [stray, 1.0 - stray], axis=0)
    extents: Floats = np.sort(high - low)[::-1]
    return extents
