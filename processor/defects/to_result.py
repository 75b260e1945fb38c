"""The result of method ``default`` from the state of its search."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from processor.defects import classification, defect_grids, measures, regions
from processor.defects.classification import Classification
from processor.defects.component_deviations import (
    ComponentShape,
    SignificantShape,
    cells_of_shape,
    swept_cells,
    with_corners,
)
from processor.defects.deviation_field import Field
from processor.defects.measures import CellPoints, Measures
from processor.defects.params import Params
from processor.defects.places import other_side, profiles, waves
from processor.defects.places.profiles import Profile
from processor.defects.places.waves import Lobe
from processor.defects.regions import Region
from processor.defects.result import DOUBTFUL, Curve, DefectClass, Defects, Result, Windows
from processor.defects.scan_statistic import Levels, mean_sd
from processor.defects.shape_models import RIGID, Frame
from processor.defects.surface_charts import PLANE, DesignSurface
from processor.model import NORMAL_95, Bools, Floats, Ints, Reason, Status, reason
from processor.robust_statistics import finite_median

CHANCE_MM2 = 1e8  # the area that false alarms are counted on
CURVE_STRIPS = 40  # places of a deflection curve: drawn size
SMALL_CELLS = 8.0  # of diameter, below which a bump is fitted to points instead of cells
SHALLOW_SHARE = 0.1  # of the amplitude of a component's shape, by which the model may be wrong
THROUGH_SHARE = 0.7  # of the points expected on a crack, below which rays went through
SIDE_SHARE = 0.2  # of a plate's half width, that counts as its side
HELD_SHARE = 0.2  # of the largest deviation, up to which a side stayed in place
LEAST_HIDDEN = 0.02  # of what could be examined, that is stated: at edges of the design less is by its cells
MUCH_HIDDEN = 0.2  # of the cells of a component's shape, from which on what hides them may be a part of it
STEP_SHARE = 0.02  # of a step's height, above which a place belongs to it


@dataclass(frozen=True)
class Search:
    """State of the search: ``residuals`` are the deviations less the ``significant`` shapes of components."""

    field: Field
    residuals: Field
    levels: Levels
    shapes: list[ComponentShape]
    significant: dict[int, list[SignificantShape]]
    places: list[list[Region]]
    expected: Floats  # points (cells,)
    hidden: Bools  # (cells,) by what is not of the structure
    shape_values: Floats
    points: CellPoints


@dataclass(frozen=True)
class Defect:
    """One defect: fields of its row in :class:`processor.defects.result.Defects`, and its cells."""

    values: dict[str, Any]
    component: int
    cells: Ints
    field: Field


def result_of(search: Search, params: Params, origin: Floats, doubt: Reason | None = None) -> Result:
    """Return the result, the largest defects first, in the design's frame; ``origin`` (3,) was subtracted from it.

    ``doubt`` is why no defect is sure, as where another pose fits as well.
    """
    defects = [*_shape_defects(search), *_place_defects(search)]
    defects.sort(key=lambda defect: (-abs(defect.values["volume_mm3"]), defect.values["centre"].tolist()))
    field, surface, cell = search.field, search.field.surface, search.field.surface.charts.cell_mm
    seen = field.seen > 0
    of_pose = field.alignment.sd(surface.centres[seen], surface.outward[seen])
    registration = np.sqrt(of_pose**2 + field.stations[seen] + field.views**2)
    noise = finite_median(field.noise[seen])
    formal = np.sqrt(field.variance[seen]) * search.levels.inflation[0]
    examined = float(surface.share[seen].sum()) * cell**2
    reasons = [reason("defects.examined", examined=examined / 1e6, surface=surface.area_mm2 / 1e6)]
    hidden = float(surface.share[search.hidden].sum()) * cell**2
    if hidden > LEAST_HIDDEN * (examined + hidden):
        reasons.append(reason("defects.hidden", hidden=hidden / 1e6, share=100.0 * hidden / (examined + hidden)))
    if not field.alignment.fitted:
        reasons.append(reason("defects.not-fitted"))
    drawn = [(d.values["centre"], d.cells, d.field, d.component) for d in defects[: params.pictures]]
    return Result(
        status=Status.OK if seen.any() else Status.FAILED,
        method=params.method,
        reasons=tuple(reasons),
        registration_error=finite_median(registration),
        cell=cell,
        noise=noise,
        lod95=NORMAL_95 * finite_median(np.hypot(formal, registration)),
        examined_mm2=examined,
        expected_mm2=float(surface.share[search.expected > 0.0].sum()) * cell**2,
        least_depth=_least_depth(search.levels, cell, noise, finite_median(field.count[seen]), field),
        defects=table([defect.values for defect in defects], origin, doubt),
        pictures=defect_grids.of_defects(drawn),
        surface=defect_grids.of_surface([defect.cells for defect in defects], field, origin),
    )


def _least_depth(levels: Levels, cell: float, noise: float, points: float, field: Field) -> Windows:
    """Return the least mean depth that is found, by size of window, for cells of median noise and points."""
    sides = np.array(levels.sides)
    sd = mean_sd(points * (sides / noise) ** 2, levels.inflation, levels.common, field, levels)
    return Windows(side=sides * cell, depth=levels.threshold * sd, noise_inflation=levels.inflation)


def table(rows: Sequence[dict[str, Any]], origin: Floats, doubt: Reason | None = None) -> Defects:
    """Return defects as a table, their centres shifted by ``origin`` (3,); with a ``doubt`` none of them is sure."""
    if not rows:
        return Defects()
    columns: dict[str, Any] = {key: tuple(row[key] for row in rows) for key in rows[0]}
    columns["centre"] = np.array(columns["centre"]) + origin
    beside = [any(one.code == "defects.beside" for one in of_row) for of_row in columns["reasons"]]
    columns["doubtful"] = (np.array(columns["chance"]) > DOUBTFUL) | np.array(beside)
    if doubt is not None:
        columns["doubtful"] = np.ones(len(rows), bool)
        columns["confidence"] = np.minimum(columns["confidence"], classification.COIN)
        columns["reasons"] = tuple((*of_row, doubt) for of_row in columns["reasons"])
    return Defects(id=np.arange(len(rows)), **columns)


def _row(classification: Classification, component: str, **values: Any) -> dict[str, Any]:
    """Return the values of a row of the table of defects."""
    row = {
        "defect_class": classification.defect_class,
        "confidence": classification.confidence,
        "otherwise": classification.otherwise,
        "component": component,
        "reasons": (),
        "deflection": Curve(),
    }
    return row | values


# --- Shapes of components


def _shape_defects(search: Search) -> Iterator[Defect]:
    """Yield a defect for each significant shape of a component."""
    surface = search.field.surface
    fits = {fit.component: fit for fit in search.shapes}
    for component, shapes in sorted(search.significant.items()):
        fit = fits[component]
        front = cells_of_shape(search.field, fit)
        for shape in _of_held_plate(search, front, shapes, fit.frame) if len(front) else ():
            rows = cells_of_shape(search.field, fit, shape.shape)
            judged = shape
            if shape.shape.kind == RIGID:  # a movement has its largest value on the cells of a face or at its corners
                value = shape.shape.values(fit.frame, *with_corners(surface, rows))
                judged = dataclasses.replace(shape, peak=float(value[int(np.argmax(np.abs(value)))]))
            yield _shape_defect(search, fit, rows, judged)


def _of_held_plate(search: Search, rows: Ints, shapes: list[SignificantShape], frame: Frame) -> list[SignificantShape]:
    """Return one shape for a plate that is bent or twisted but stays in place along one side, as it is welded there.

    About the plate's middle this is a sum of shapes; the depth is that of the sum. ``rows`` are cells of its front.
    """
    bent = [judged for judged in shapes if judged.shape.kind in ("bend", "twist")]
    rigid_motion = [judged for judged in shapes if judged.shape.kind == "misalignment"]
    if not (len(bent) == 1 and len(rigid_motion) == 1 and len(shapes) == 2):
        return shapes
    points, outward = with_corners(search.field.surface, rows)
    total = np.sum([judged.shape.values(frame, points, outward) for judged in shapes], axis=0)
    local = frame.local(points) / frame.half
    peak = float(total[int(np.argmax(np.abs(total)))])
    sides = [way * local[:, axis] > 1.0 - SIDE_SHARE for axis in (0, 1) for way in (-1.0, 1.0)]
    held = min(float(np.sqrt(np.mean(total[side] ** 2))) for side in sides if side.any())
    if held > HELD_SHARE * abs(peak):
        return shapes
    ci95, volume_ci95 = (
        float(np.hypot(*of)) for of in zip(*((one.ci95, one.volume_ci95) for one in shapes), strict=True)
    )
    return [dataclasses.replace(bent[0], peak=peak, ci95=ci95, volume_ci95=volume_ci95)]


def _shape_defect(search: Search, fit: ComponentShape, rows: Ints, judged: SignificantShape) -> Defect:
    """Measure a shape of a component on the cells ``rows`` of its largest face."""
    surface, component, frame, kind = search.field.surface, fit.component, fit.frame, judged.shape.kind
    value = judged.shape.values(frame, surface.centres[rows], surface.outward[rows])
    extent = 2.0 * frame.half[:2]
    part = np.ones(len(rows), bool)
    if kind == "step":  # the part beyond the step
        beyond = np.abs(value) > max(judged.ci95, STEP_SHARE * abs(judged.peak))
        part = beyond if beyond.any() else part
        extent[int(judged.shape.at[0])] *= 0.5 * (1.0 - judged.shape.at[1])
    area = surface.cell_areas[rows]
    both_ways = kind in ("twist", "waviness")
    volume = on_face = float((np.abs(value) if both_ways else -value) @ area)
    if kind == RIGID:  # what is swept: a round face goes outward on one side and inward on the other
        inward, outward = (float(np.maximum(way * value, 0.0) @ area) for way in (-1.0, 1.0))
        on_face = inward if inward >= outward else -outward
        cells = swept_cells(search.field, fit, judged.shape)
        moved = np.abs(judged.shape.values(frame, surface.centres[cells], surface.outward[cells]))
        volume = float(np.copysign(moved @ surface.cell_areas[cells], on_face))
    values = _row(
        classification.of_shape(kind, judged.margin),
        surface.names[component],
        centre=surface.centres[rows[part]].mean(axis=0),
        axes=frame.axes,
        extent=extent,
        area_mm2=float(area[part].sum()),
        depth_max=abs(judged.peak) if both_ways else -judged.peak,
        depth_ci95=judged.ci95,
        depth_mean=on_face / float(area[part].sum()),
        volume_mm3=volume,
        volume_ci95=judged.volume_ci95,
        edge_distance=float(frame.half[:2].min()),
        curvature_per_m=_curvature(judged, frame.half),
        lod95=judged.ci95,
        z=judged.z,
        chance=judged.chance * CHANCE_MM2,
    )
    seen, hidden = rows[(search.field.seen[rows] > 0) & part], search.hidden[rows]
    if hidden.sum() > MUCH_HIDDEN * (hidden.sum() + len(seen)):
        values["reasons"] = (reason("defects.beside"),)
    if kind == "bend" and len(seen):
        along = frame.local(surface.centres[seen])[:, int(judged.shape.at[0])]
        bent = search.residuals.deviation[seen] + value[np.searchsorted(rows, seen)]
        values["deflection"] = defect_grids.by_strips(along, bent, search.field.variance[seen], CURVE_STRIPS)
    return Defect(values=values, component=component, cells=rows[part], field=search.field)


def _curvature(judged: SignificantShape, half: Floats) -> float:
    """Return the largest curvature of a shape on a component of half sizes (3,), 1/m."""
    if judged.shape.kind == "bend":
        axis, order = int(judged.shape.at[0]), judged.shape.at[1]
        amplitude = abs(float(judged.shape.factors[0]))
        return float(1000.0 * amplitude * (2.0 if order == 2.0 else (0.5 * np.pi) ** 2) / half[axis] ** 2)
    if judged.shape.kind == "waviness":
        return 1000.0 * abs(judged.peak) * (2.0 * np.pi / judged.shape.at[1]) ** 2
    return 0.0


# --- Places that deviate or are missing


def _place_defects(search: Search) -> Iterator[Defect]:
    """Yield a defect for each place that deviates or is missing; half waves in a row are one."""
    amplitudes = {number: max(abs(shape.peak) for shape in shapes) for number, shapes in search.significant.items()}
    surface, claimed = search.field.surface, np.zeros(len(search.hidden), bool)
    for group in search.places:
        claimed[group[0].cells] = True
    found: list[tuple[Region, Defect]] = []
    for group in search.places:
        component = int(surface.charts.component[group[0].chart])
        values = _place_values(search, group[0], component, amplitudes.get(component, 0.0), claimed)
        if values is not None:
            cells = np.unique(np.concatenate([region.cells for region in group]))
            found.append((group[0], Defect(values=values, component=component, cells=cells, field=search.residuals)))
    pushed = [k for k, of_place in enumerate(found) if _is_pushed(surface, *of_place)]
    behind = _other_sides(surface, found, pushed)
    waving = [k for k in pushed if k not in behind]
    in_wave: set[int] = set()
    for rows in waves.waves([_lobe(surface, *found[k]) for k in waving]):
        lobes = [waving[row] for row in rows]
        in_wave.update(lobes)
        yield _wave([found[k][1] for k in lobes])
    for k, (_, defect) in enumerate(found):
        if k not in in_wave and k not in behind:
            yield defect


def _other_sides(surface: DesignSurface, found: list[tuple[Region, Defect]], pushed: list[int]) -> set[int]:
    """Return those of the places ``pushed``, of steel moved to one side, that are the other side of a larger one."""
    by_size = sorted(pushed, key=lambda k: -len(found[k][0].cells))
    behind: set[int] = set()
    for row, k in enumerate(by_size):
        region = found[k][0]
        for larger in by_size[:row]:
            front, plate = found[larger][0], found[larger][1].component
            against = front.sign == -region.sign and plate == found[k][1].component and larger not in behind
            if against and other_side.is_behind(surface, region.cells, front.cells):
                behind.add(k)
                break
    return behind


def _is_pushed(surface: DesignSurface, region: Region, defect: Defect) -> bool:
    """Return whether steel of a flat face was pushed to one side, and not taken away."""
    kinds = (DefectClass.DENT, DefectClass.BULGE, DefectClass.BEND, DefectClass.UNKNOWN)
    flat = bool(surface.charts.kind[region.chart] == PLANE)
    return flat and region.sign != 0 and defect.values["defect_class"] in kinds


def _lobe(surface: DesignSurface, region: Region, defect: Defect) -> Lobe:
    cells = surface.centres[region.cells]
    return Lobe(
        component=defect.component,
        cells=cells,
        middle=cells.mean(axis=0),
        outward=surface.outward[region.cells[0]],
        height=-float(defect.values["depth_max"]),
        width=float(min(defect.values["extent"])),
    )


def _wave(lobes: list[Defect]) -> Defect:
    """Return one defect of half waves in their order: the depth is the largest amplitude."""
    deepest = max(lobes, key=lambda lobe: abs(lobe.values["depth_max"]))
    centres = np.array([lobe.values["centre"] for lobe in lobes])
    span = centres[-1] - centres[0]
    along = span / np.linalg.norm(span)
    outward = deepest.values["axes"][2]
    half = 0.5 * (np.linalg.norm(span) / (len(lobes) - 1))
    sums = {key: float(sum(abs(lobe.values[key]) for lobe in lobes)) for key in ("area_mm2", "volume_mm3")}
    values = deepest.values | sums | {
        "defect_class": DefectClass.WAVINESS,
        "otherwise": deepest.values["defect_class"],
        "confidence": max(deepest.values["confidence"], classification.BORDER_CONFIDENCE),
        "centre": 0.5 * (centres[0] + centres[-1]),
        "axes": np.stack([along, np.cross(outward, along), outward]),
        "extent": np.array([np.linalg.norm(span) + 2.0 * half, max(max(lobe.values["extent"]) for lobe in lobes)]),
        "depth_max": abs(deepest.values["depth_max"]),
        "depth_mean": sums["volume_mm3"] / sums["area_mm2"],
        "volume_ci95": float(np.sqrt(sum(lobe.values["volume_ci95"] ** 2 for lobe in lobes))),
        "z": max(lobe.values["z"] for lobe in lobes),
        "chance": min(lobe.values["chance"] for lobe in lobes),
    }  # fmt: skip
    cells = np.unique(np.concatenate([lobe.cells for lobe in lobes]))
    return Defect(values=values, component=deepest.component, cells=cells, field=deepest.field)


def _place_values(
    search: Search, region: Region, component: int, amplitude: float, claimed: Bools
) -> dict[str, Any] | None:
    """Measure and classify a place on a component whose shape has an ``amplitude`` in mm; None if it is no defect.

    ``claimed`` (cells,) marks the cells of all places.
    """
    surface, cell = search.field.surface, search.field.surface.charts.cell_mm
    middle = int(region.cells[len(region.cells) // 2])
    thickness = measures.thickness_at(surface, surface.centres[middle], surface.outward[middle], component)
    assumed = thickness if np.isfinite(thickness) else float(np.sqrt(len(region.cells))) * cell / 10.0
    size = int(np.searchsorted(search.levels.sides, np.sqrt(len(region.cells)), side="right")) - 1
    inflation = float(search.levels.inflation[max(size, 0)])
    measured = measures.measure(region, search.residuals, inflation, thickness)
    length, width = float(measured.extent[0]), float(measured.extent[1])
    reasons: tuple[Reason, ...] = ()
    if region.sign == 0:
        chosen = classification.of_missing(measured.borders, length, width, assumed, region.z)
        if not np.isfinite(thickness):
            reasons = (reason("defects.no-thickness"),)
    else:
        if abs(measured.depth_max) < SHALLOW_SHARE * amplitude:
            return None
        stayed = other_side.stayed(search.residuals, region.cells) if region.sign < 0 else np.nan
        chosen = classification.of_deviation(region.sign, measured.diameter, length, width, assumed, region.z, stayed)
        crack = chosen.defect_class is DefectClass.CRACK
        if measured.diameter < SMALL_CELLS * cell and not crack:
            measured = measures.refined(measured, region, search.points, search.shape_values, inflation)
            chosen = classification.of_deviation(
                region.sign, measured.diameter, length, width, assumed, region.z, stayed
            )
        if not abs(measured.depth_max) > measured.lod95:
            return None  # significant only together with the defect beside it
        if crack:
            # The plate's thickness if rays went through, else what was measured as a bound
            reasons = (reason("defects.depth-bound"),)
            points = (search.field.count + search.field.stray)[region.cells].sum()
            expected = search.expected[region.cells].sum()
            if expected > 0.0 and points < THROUGH_SHARE * expected and np.isfinite(thickness):
                measured, reasons = dataclasses.replace(measured, depth_max=thickness), (reason("defects.through"),)
        else:
            chosen, measured, reasons = _by_profile(search, region, measured, chosen, assumed, inflation, claimed)
    if regions.touches(region.cells, search.hidden, surface.charts, region.chart):
        reasons = (*reasons, reason("defects.beside"))
    of_place = {**measured.columns(), "z": region.z, "chance": region.chance * CHANCE_MM2, "reasons": reasons}
    return _row(chosen, surface.names[component], **of_place)


def _by_profile(
    search: Search,
    region: Region,
    measured: Measures,
    chosen: Classification,
    thickness: float,
    inflation: float,
    claimed: Bools,
) -> tuple[Classification, Measures, tuple[Reason, ...]]:
    """Return class, measures and reasons of a place by its profile; unchanged where that is a bump."""
    cells = measures.cells_about(region, search.residuals, claimed)
    fitted = None if cells is None else profiles.fit(cells, region.sign)
    if fitted is None or fitted.profile is Profile.BUMP:
        return chosen, measured, ()
    place, outward = measured.centre, measured.axes[2]
    registration = measures.registration_sd(search.residuals, place, outward, region.cells)
    measured = dataclasses.replace(
        measured, depth_max=-fitted.depth, depth_ci95=NORMAL_95 * float(np.hypot(fitted.sd * inflation, registration))
    )
    by_profile = classification.of_profile(fitted, thickness, chosen)
    is_crack = by_profile.defect_class is DefectClass.CRACK
    return by_profile, measured, (reason("defects.depth-bound"),) if is_crack else ()
