"""What contradicts the noise model of a part: residuals of faces and of bottom edges, and the two sides of plates.

An interval is worth what its model of the errors is worth. Each face at a joint, each bottom edge, and the thickness of
the plates at each end is tested; all tests of a bridge together fail by chance with a small stated probability, see
:mod:`processor.adjustment.global_test`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import compress
from typing import NamedTuple

import numpy as np

from processor.adjustment import global_test, kriging
from processor.model import Reason, reason
from processor.preassembly.ends import view_variance
from processor.preassembly.ends.bottom_edges import EdgeDepartures
from processor.preassembly.ends.joint_end import FittedEnd
from processor.preassembly.ends.section import PlateFace

# The faces of a part that give the departures of its left and right edge, sideways and up.
OF_EDGES = ((PlateFace.LEFT, PlateFace.BOTTOM), (PlateFace.RIGHT, PlateFace.BOTTOM))


class Examined(NamedTuple):
    """The ends of a part by the names of their joints, and its edges."""

    ends: tuple[tuple[str, FittedEnd], ...]
    edges: EdgeDepartures


def find(parts: Sequence[Examined]) -> list[tuple[Reason, ...]]:
    """Return what contradicts the noise model, part by part; all parts of a bridge are tested together."""
    ends = [end for part in parts for _, end in part.ends]
    every = [face for end in ends for face in end.faces]
    weights = kriging.learned_weights(every) if every else np.empty((0, 0))
    faces = np.array([kriging.tail(*face) for face in zip(every, weights, strict=True)])
    plates = view_variance.tails([[plate for plate in end.plates if plate is not None] for end in ends])
    edges = [part.edges.tails.ravel() for part in parts]
    failed = global_test.contradicted(np.concatenate([faces, plates, *edges]))
    of_faces = np.split(failed[: len(faces)], np.cumsum([len(end.faces) for end in ends])[:-1])
    of_plates = failed[len(faces) : len(faces) + len(plates)] | np.array(
        [_of_no_other(end, ends) for end in ends], bool
    )
    of_edges = failed[len(faces) + len(plates) :].reshape(len(parts), *np.shape(OF_EDGES))
    found, number = [], 0
    for part, beyond in zip(parts, of_edges, strict=True):
        reasons = []
        for joint, end in part.ends:
            names = _in_order(face.name for face in compress(end.place.section.faces, of_faces[number]))
            why = (
                *((reason("preassemble.face-contradicts-noise", faces=names),) if names else ()),
                *((reason("preassemble.plates-contradict-views"),) if of_plates[number] else ()),
            )
            reasons += [reason("preassemble.at", place=joint, reasons=why)] if why else []
            number += 1
        names = _in_order(OF_EDGES[edge][axis] for edge, axis in np.argwhere(beyond))
        found.append((*reasons, *((reason("preassemble.edge-contradicts-noise", faces=names),) if names else ())))
    return found


def _of_no_other(end: FittedEnd, ends: Sequence[FittedEnd]) -> bool:
    """Whether a plate of an end has a thickness that neither the design nor a plate of another end has."""
    others = [plate.value[0] for other in ends if other is not end for plate in other.plates if plate is not None]
    for thickness, plate in zip(end.thickness, end.plates or (None,) * len(end.faces), strict=True):
        if plate is not None:
            known = np.array([*others, thickness])
            if thickness > 0.0 and np.abs(known - plate.value[0]).min() > view_variance.ALIKE_MM:
                return True
    return False


def _in_order(names: Iterable[PlateFace]) -> tuple[PlateFace, ...]:
    """Return the names, each once, in the order of PlateFace."""
    given = set(names)
    return tuple(name for name in PlateFace if name in given)
