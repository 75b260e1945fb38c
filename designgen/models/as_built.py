"""Models built otherwise than designed: the bodies as built, and the truth of their deviations."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from designgen.asbuilt.imperfections import Ledger
from designgen.designs.parametric_face import Surface
from designgen.models.body_deviations import Defect, Deviation, Params, deviation_of, missing_part
from designgen.models.model import Model, ModelBody
from designgen.models.subdivision import Spacing, subdivided
from designgen.models.surface_samples import sample_surface, triangle_areas
from designgen.scanning.facets import Facets
from processor.model import AsBuilt, BodyTruth, DefectTruth, Floats, StructureTruth

TRUTH_POINTS, LEAST_TRUTH_POINTS = 20_000, 60  # of the whole model, by area; of a body, at least
DENT_TRUTH_POINTS = 400  # in addition, in and about a dent


@dataclass(frozen=True)
class Built:
    """Bodies as built, None for one left out, and the truth in the model's frame."""

    bodies: tuple[ModelBody | None, ...]
    movement: StructureTruth
    defects: DefectTruth
    ledger: AsBuilt | None


def build(model: Model, params: Mapping[str, Params], seed: int) -> Built:
    """Return a model as built, and its truth; bodies without ``params`` are as designed."""
    ledger, defects = Ledger(), list[Defect]()
    built: list[ModelBody | None] = []
    sampled = list[_SampledBody]()
    areas = np.array([triangle_areas(body).sum() for body in model.bodies])
    facets = Facets.of(np.take(*model.mesh(), axis=0)) if params else None
    for row, (body, share) in enumerate(zip(model.bodies, areas / areas.sum(), strict=True)):
        count = max(LEAST_TRUTH_POINTS, int(TRUTH_POINTS * share))
        points, normals = sample_surface(body.vertices[body.triangles], count)
        of_body = params.get(body.name)
        if of_body is None:
            built.append(body)
            sampled.append(_SampledBody(row, points, normals, np.zeros_like(points)))
            continue
        if of_body.missing:
            built.append(None)
            ledger.note("left out", body.name, 1.0, "count")
            defects.append(missing_part(body))
            continue
        assert facets is not None
        deviation = deviation_of(body, of_body, facets, seed)
        built.append(_displaced(body, deviation))
        near = _sampled_about_dent(body, deviation)
        points, normals = np.concatenate([points, near[0]]), np.concatenate([normals, near[1]])
        sampled.append(_SampledBody(row, points, normals, deviation.displacement(points)))
        defects += deviation.defects
        for what, value, unit in deviation.notes:
            ledger.note(what, body.name, value, unit)
    movement = _structure_truth(model, params, sampled)
    return Built(tuple(built), movement, defect_truth(defects), ledger.record() if params else None)


class _SampledBody(NamedTuple):
    """Points (n, 3) on the design of the body in ``row`` of the model, mm, unit normals, and displacements, mm."""

    row: int
    points: Floats
    normals: Floats
    displacement: Floats


def _structure_truth(model: Model, params: Mapping[str, Params], of_bodies: Sequence[_SampledBody]) -> StructureTruth:
    """Return the movement of all bodies, and of each as a whole."""
    left_out = np.full(3, np.nan)
    as_wholes = [params.get(body.name, Params()) for body in model.bodies]
    bodies = BodyTruth(
        names=tuple(body.name for body in model.bodies),
        of_point=np.repeat([one.row for one in of_bodies], [len(one.points) for one in of_bodies]).astype(np.int32),
        shift=np.array([left_out if one.missing else one.move_mm for one in as_wholes]),
        turn=np.array([left_out if one.missing else np.radians(one.turn_deg) for one in as_wholes]),
    )
    empty = [np.empty((0, 3))]
    return StructureTruth(
        points=np.concatenate([one.points for one in of_bodies] or empty),
        normals=np.concatenate([one.normals for one in of_bodies] or empty),
        displacement=np.concatenate([one.displacement for one in of_bodies] or empty),
        bodies=bodies,
    )


def defect_truth(defects: Sequence[Defect]) -> DefectTruth:
    """Return defects as the truth of a scene."""
    return DefectTruth(
        ids=np.arange(len(defects)),
        classes=tuple(defect.kind for defect in defects),
        components=tuple(defect.body for defect in defects),
        centres=np.array([defect.centre for defect in defects]).reshape(-1, 3),
        area_mm2=np.array([defect.area for defect in defects]),
        depth_max_mm=np.array([defect.depth for defect in defects]),
        volume_mm3=np.array([defect.volume for defect in defects]),
    )


def _sampled_about_dent(body: ModelBody, deviation: Deviation) -> tuple[Floats, Floats]:
    """Return points (n, 3) and normals (n, 3) on the design in and about a dent; none without a dent."""
    if deviation.dent is None:
        return np.empty((0, 3)), np.empty((0, 3))
    centre, radius = deviation.dent
    whole = subdivided(body, [Spacing(centre, 1.5 * radius, 0.2 * radius)])
    corners = whole.vertices[whole.triangles]
    near = np.linalg.norm(corners.mean(axis=1) - centre, axis=1) < 1.4 * radius
    return sample_surface(corners[near], DENT_TRUTH_POINTS) if near.any() else (np.empty((0, 3)), np.empty((0, 3)))


def _displaced(body: ModelBody, deviation: Deviation) -> ModelBody:
    """Return a body whose points are displaced; triangles are divided where the displacement is not rigid."""
    finer = subdivided(body, deviation.spacings) if deviation.spacings else body

    def moved(at: Surface) -> Surface:
        def displaced_at(p: Floats, q: Floats) -> Floats:
            points = at(p, q)
            result: Floats = points + deviation.displacement(points)
            return result

        return displaced_at

    return dataclasses.replace(
        finer,
        vertices=finer.vertices + deviation.displacement(finer.vertices),
        surfaces=tuple(None if at is None else moved(at) for at in finer.surfaces),
        flat=tuple(
            flat and (deviation.rigid or at is None) for flat, at in zip(finer.flat, finer.surfaces, strict=True)
        ),
    )
