"""Everything found of defects, put into the record that the step answers with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from processor.defects import classes, measures, pictures
from processor.defects import pictures as defects_pictures
from processor.defects.alignment import Alignment
from processor.defects.classes import Named
from processor.defects.component_shapes import ComponentShape, Judged, seen_front
from processor.defects.deviation_field import Field
from processor.defects.measures import Near
from processor.defects.missing_material import Expected
from processor.defects.params import Params
from processor.defects.regions import Region
from processor.defects.result import Result
from processor.defects.scan_statistic import Levels
from processor.defects.surface_charts import DesignSurface
from processor.model import NORMAL_95, Floats, Ints

CHANCE_MM2 = 1e8  # the surface that chance is counted on
CURVE_STRIPS = 40
SMALL_CELLS = 8.0  # of diameter, below which points are fitted and not cells
SHALLOW_SHARE = 0.1  # of a component's shape that a model of it may be wrong by
THROUGH_SHARE = 0.7  # of the points expected on a crack, below which rays went through


@dataclass(frozen=True)
class Found:
    """What the search left behind."""

    surface: DesignSurface
    field: Field
    left: Field  # less the shapes of components
    alignment: Alignment
    levels: Levels
    shaped: list[ComponentShape]
    judged: dict[int, list[Judged]]
    places: list[list[Region]]
    hoped: Expected
    shape_values: Floats
    near: Near


@dataclass(frozen=True)
class Row:
    """One defect, as the record has it, and its cells."""

    named: Named
    component: int
    columns: dict[str, Any]
    cells: Ints
    field: Field
    remark: str = ""
    curve: tuple[Floats, Floats, Floats] | None = None


def result_of(found: Found, params: Params, name: str) -> Result:
    """Put the answer together, the largest defects first."""
    rows = [*_shapes(found), *_places(found)]
    rows.sort(key=lambda row: (-abs(row.columns["volume_mm3"]), row.columns["centres"].tolist()))
    surface, field = found.surface, found.field
    seen = field.seen > 0
    cell = surface.charts.cell_mm
    registration = found.alignment.sd(surface.centres[seen], surface.outward[seen])
    E = float(np.median(registration)) if seen.any() else float("nan")
    noise = float(np.median(field.noise[seen])) if seen.any() else float("nan")
    formal = np.sqrt(field.variance[seen]) * found.levels.inflation[0]
    lod = NORMAL_95 * float(np.median(np.hypot(formal, registration))) if seen.any() else float("nan")
    sides = np.array(found.levels.sides) * cell
    points = float(np.median(field.count[seen])) if seen.any() else float("nan")
    formal_sd = found.levels.inflation * noise / np.sqrt(points) / np.array(found.levels.sides)
    least = found.levels.threshold * np.hypot(formal_sd, found.levels.systematic_mm)
    columns: dict[str, Any] = {key: [row.columns[key] for row in rows] for key in (rows[0].columns if rows else ())}
    curves = [(k, row.curve) for k, row in enumerate(rows) if row.curve is not None]
    examined = float(surface.share[seen].sum()) * cell**2
    expected = float(surface.share[found.hoped.points > 0.0].sum()) * cell**2
    said = f"{examined / 1e6:.1f} m2 examined of {surface.area_mm2 / 1e6:.1f} m2 of the design's surface"
    if not found.alignment.fitted:
        said += "; too few components to fit the whole to the design: its place is taken as it came"
    return Result(
        "ok" if seen.any() else "failed",
        params.method,
        said,
        registration_error_mm=E,
        cell_mm=cell,
        noise_mm=noise,
        lod95_mm=lod,
        examined_mm2=examined,
        expected_mm2=expected,
        scale_mm=sides,
        scale_least_mm=least,
        scale_inflation=found.levels.inflation,
        ids=np.arange(len(rows)),
        classes=tuple(row.named.kind for row in rows),
        confidence=np.array([row.named.confidence for row in rows]),
        second=tuple(row.named.second for row in rows),
        components=tuple(f"component-{row.component + 1}" for row in rows),
        remarks=tuple(row.remark for row in rows),
        **columns,
        curve_defect=np.concatenate([[], *(np.full(len(c[0]), k) for k, c in curves)]),
        curve_at_mm=np.concatenate([[], *(c[0] for _, c in curves)]),
        curve_mm=np.concatenate([[], *(c[1] for _, c in curves)]),
        curve_ci95=np.concatenate([[], *(c[2] for _, c in curves)]),
        **pictures.of_rows(
            [(row.columns["centres"], row.cells, row.field, row.component) for row in rows],
            surface, params.pictures,
        ),
        **pictures.of_surface([row.cells for row in rows], field, surface),
    )  # fmt: skip


def _shapes(found: Found) -> Iterator[Row]:
    """Give a row for every shape of a component."""
    surface = found.surface
    cell = surface.charts.cell_mm
    frames = {one.component: one.frame for one in found.shaped}
    for component, own in sorted(found.judged.items()):
        frame = frames[component]
        rows = seen_front(surface, component, found.field)
        rows = rows[surface.share[rows] > 0.5]
        for judged in own:
            value = judged.shape.values(frame, surface.centres[rows], surface.outward[rows])
            part = np.abs(value) > max(judged.ci95, 0.02 * abs(judged.peak))
            if judged.shape.kind != "step":
                part |= True
            area = surface.share[rows] * cell**2
            both = judged.shape.kind in ("twist", "waviness")
            volume = float((np.abs(value) if both else -value) @ area)
            seen = rows[(found.field.seen[rows] > 0) & part]
            centre = surface.centres[rows[part]].mean(axis=0)
            depth = abs(judged.peak) if both else -judged.peak
            extent = 2.0 * frame.half[:2]
            if judged.shape.kind == "step":  # what lies beyond it, along the axis that it is across
                extent[int(judged.shape.at[0])] *= 0.5 * (1.0 - judged.shape.at[1])
            axes = frame.axes.copy()
            named = classes.of_shape(judged.shape.kind, judged.margin)
            lod = judged.ci95
            curve = None
            if judged.shape.kind == "bend" and len(seen):
                axis = int(judged.shape.at[0])
                along = frame.local(surface.centres[seen])[:, axis]
                others = found.left.deviation[seen] + value[np.searchsorted(rows, seen)]
                curve = defects_pictures.by_strips(along, others, found.field.variance[seen], CURVE_STRIPS)
            columns = {
                "centres": centre, "axes": axes, "extent": extent, "area_mm2": float(area[part].sum()),
                "depth_max": depth, "depth_ci95": judged.ci95, "depth_mean": volume / float(area[part].sum()),
                "volume_mm3": volume, "volume_ci95": judged.ci95 * float(area.sum()) / NORMAL_95,
                "edge_mm": float(frame.half[:2].min()), "curvature_per_m": _curvature(judged, frame.half),
                "lod95": lod, "z": judged.z, "chance": judged.chance * CHANCE_MM2,
            }  # fmt: skip
            yield Row(named, component, columns, rows[part], found.field, curve=curve)


def _curvature(judged: Judged, half: Floats) -> float:
    if judged.shape.kind == "bend":
        axis, order = int(judged.shape.at[0]), judged.shape.at[1]
        high = abs(float(judged.shape.factors[0]))
        return float(1000.0 * high * (2.0 if order == 2.0 else (0.5 * np.pi) ** 2) / half[axis] ** 2)
    if judged.shape.kind == "waviness":
        return 1000.0 * abs(judged.peak) * (2.0 * np.pi / judged.shape.at[1]) ** 2
    return 0.0


def _places(found: Found) -> Iterator[Row]:
    """Give a row for every place that deviates or is missing."""
    surface = found.surface
    peaks = {number: max(abs(one.peak) for one in own) for number, own in found.judged.items()}
    for group in found.places:
        main = group[0]
        component = int(surface.charts.component[main.chart])
        middle = int(main.cells[len(main.cells) // 2])
        thick = measures.thickness_at(surface, surface.centres[middle], surface.outward[middle], component)
        known = thick if np.isfinite(thick) else float(np.sqrt(len(main.cells))) * surface.charts.cell_mm / 10.0
        k = int(np.searchsorted(found.levels.sides, np.sqrt(len(main.cells)), side="right")) - 1
        got = measures.measure(
            main, found.left, surface, found.alignment, float(found.levels.inflation[max(k, 0)]), thick
        )
        length, width = float(got.extent[0]), float(got.extent[1])
        if main.sign == 0:
            named = classes.of_missing(got.borders, length, width, known, main.z)
            depth, remark = got.depth, "" if np.isfinite(thick) else "the design says no thickness here"
        else:
            if abs(got.depth) < SHALLOW_SHARE * peaks.get(component, 0.0):
                continue
            named = classes.of_deviation(main.sign, got.diameter, length, width, known, main.z)
            if got.diameter < SMALL_CELLS * surface.charts.cell_mm and named.kind != "crack":
                got = measures.refined(got, main, found.near, found.field, found.shape_values)
            if not abs(got.depth) > got.lod95:
                continue  # crumbs about a defect, which only its nearness made significant
            depth, remark = _depth_of_crack(found, main, got.depth, thick) if named.kind == "crack" else (got.depth, "")
        columns = {
            "centres": got.centre, "axes": got.axes, "extent": got.extent, "area_mm2": got.area,
            "depth_max": depth, "depth_ci95": got.depth_ci95, "depth_mean": got.mean,
            "volume_mm3": got.volume, "volume_ci95": got.volume_ci95, "edge_mm": got.edge,
            "curvature_per_m": got.curvature, "lod95": got.lod95, "z": main.z, "chance": main.chance * CHANCE_MM2,
        }  # fmt: skip
        yield Row(
            named, component, columns, np.unique(np.concatenate([one.cells for one in group])), found.left, remark
        )


def _depth_of_crack(found: Found, main: Region, depth: float, thick: float) -> tuple[float, str]:
    """Return how deep a crack is, mm, and what that rests on; ``depth`` is what beams saw of it."""
    there = (found.field.count + found.field.stray)[main.cells].sum()
    hoped = found.hoped.points[main.cells].sum()
    if hoped > 0.0 and there < THROUGH_SHARE * hoped and np.isfinite(thick):
        return thick, "rays went through: as deep as the plate is thick"
    return depth, "at least so deep: too narrow for a beam to see its ground"
