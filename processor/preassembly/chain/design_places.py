"""Where the design places the pieces of an assembly that no measured joint ties together, and how sure that is.

A joint of which one end was not measured is no observation: what is beyond it may stand anywhere near its place in the
design. Two things are not known then. A piece as a whole may be off its place by what fabrication and erection allow,
a standard deviation that is stated. And in a piece, the joints move each part away from its own place: the design
supports that place, the joints the other. The second moment of both about the pose given is its covariance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processor.geometry import rigid
from processor.model import Floats, Ints
from processor.preassembly.parts.part_in_chain import Member
from processor.preassembly.topology import Sides


def places(members: Sequence[Member], part: int, sides: Sides, joint_points: Floats) -> Floats:
    """Return the points (n, 3) that stand for a part: key points and bottom edges of the design, also mirrored.

    A part with one joint has no key points at its other end: there are those of its joint, mirrored at its centre.
    """
    joints = [j for j, both in enumerate(sides) if part in (both[0].part, both[1].part)]
    centre = members[part].centre
    points = np.vstack([joint_points[joints].reshape(-1, 3), members[part].edges.points, centre])
    return np.vstack([points, 2.0 * centre - points])


def covariances(
    motions: Floats, of_parts: Sequence[Floats], members: Sequence[Member], piece: Ints, sd_mm: float
) -> Floats:
    """Covariance (c, 6, 6), about the parts' centres, of where the design places each part.

    ``motions`` (c, 6) are those of the parts away from there, ``of_parts`` their :func:`places`. A piece is off as one
    body by ``sd_mm`` along each axis, and by as much at its radius of gyration where it is turned.
    """
    found: Floats = np.einsum("ci,cj->cij", motions, motions)
    for number in np.unique(piece):
        of_piece = np.flatnonzero(piece == number).tolist()
        points = np.vstack([of_parts[i] for i in of_piece])
        middle = points.mean(axis=0)
        radius = np.sqrt(((points - middle) ** 2).sum(axis=1).mean())
        whole = sd_mm**2 * np.diag([radius**-2.0] * 3 + [1.0] * 3)
        for i in of_piece:
            found[i] += rigid.about_origin(whole, middle - members[i].centre)
    return found
