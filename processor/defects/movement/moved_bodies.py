"""Components that moved as a whole: the design with them where they are, for the search of everything else.

Against the design as it was meant, a component that moved by some millimetres has faces where beams should have met
others: strips beside it appear bulged, dented or missing, and round faces deviate by more than a linear movement gives.
The search is therefore repeated on the design with the component moved, and what is left of its movement is added.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from processor.defects import component_deviations
from processor.defects.component_deviations import ComponentShape, SignificantShape
from processor.defects.shape_models import RIGID
from processor.defects.surface_charts import DesignSurface
from processor.defects.to_result import Search
from processor.geometry import rigid
from processor.model import DesignBodies, StructureDesign

LEAST_MM = 1.0  # movement from which on the design is changed: less is within a cell's own scatter of faces
OTHERS_SHARE = 0.25  # of the movement, up to which other shapes of a component may be of its fit

Significant = dict[int, list[SignificantShape]]


def moved(shapes: list[ComponentShape], significant: Significant) -> dict[int, tuple[ComponentShape, SignificantShape]]:
    """Return the components that moved as a whole by LEAST_MM or more, other shapes of which are small beside it.

    Such shapes are what the linear fit of a movement leaves; the search on the changed design shows which are real.
    """
    fits, found = {fit.component: fit for fit in shapes}, {}
    for number, of_one in significant.items():
        movements = [one for one in of_one if one.shape.kind == RIGID]
        others = max((abs(one.peak) for one in of_one if one.shape.kind != RIGID), default=0.0)
        if movements and abs(movements[0].peak) >= max(LEAST_MM, others / OTHERS_SHARE):
            found[number] = (fits[number], movements[0])
    return found


def design(
    name: str, surface: DesignSurface, movements: dict[int, tuple[ComponentShape, SignificantShape]]
) -> StructureDesign:
    """Return the design with components moved; each component is a body of its own."""
    vertices = surface.vertices.copy()
    for number, (fit, judged) in movements.items():
        rows = np.unique(surface.faces[surface.component_of == number])
        # The factors of the shape are of its frame, those of the turn in units of the largest half size.
        frame, shift, turn = fit.frame, judged.shape.factors[:3], judged.shape.factors[3:]
        R = rigid.rotation_from_vector(turn / float(frame.half.max()) @ frame.axes)
        vertices[rows] = (surface.vertices[rows] - frame.origin) @ R.T + (frame.origin + shift @ frame.axes)
    return StructureDesign(name, vertices, surface.faces, DesignBodies(surface.names, surface.component_of))


def together(before: dict[int, tuple[ComponentShape, SignificantShape]], search: Search) -> Search:
    """Return the search on the changed design, with the movements ``before`` added to what it found of them."""
    fits = {fit.component: fit for fit in search.shapes}
    total = dict(search.significant)
    for number, (fit, judged) in before.items():
        own = fits.setdefault(number, fit)
        rest = [shape for shape in own.fitted.shapes if shape.kind == RIGID and own is not fit]
        shape = dataclasses.replace(judged.shape, factors=sum((one.factors for one in rest), judged.shape.factors))
        whole = component_deviations.judged(own, shape, search.field, search.levels)
        others = [one for one in total.get(number, []) if one.shape.kind != RIGID]
        total[number] = [dataclasses.replace(whole, chance=judged.chance, margin=judged.margin), *others]
    return dataclasses.replace(search, shapes=[fits[number] for number in sorted(fits)], significant=total)
