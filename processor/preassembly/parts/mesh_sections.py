"""Integrals over plane cross-sections of a mesh along an axis.

A facet that crosses a plane square to the axis leaves a segment there, directed so that the solid of an outward
oriented mesh is on its left. Integrals over the area follow by Green's theorem from the segments of a closed outline;
those along the outline, of its line elements, need neither closure nor orientation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.model import Columns, Floats, Ints


@dataclass(frozen=True)
class Sections(Columns):
    """Integrals of n sections in the two axes across, mm; zeros where no facet crosses a section.

    ``area`` (n,) with its ``centroid`` (n, 2) and its ``second_moment`` (n, 2, 2) about that, the integral of the outer
    product of places; the same of the outline's ``length`` (n,). ``direction`` (n, 2, 2) is the integral along the
    outline of the outer product of its unit tangents, ``extent`` (n, 2) the outline's size. ``open`` (n,) is the length
    of the sum of all segments: 0 of a closed outline.
    """

    area: Floats
    centroid: Floats
    second_moment: Floats
    length: Floats
    line_centroid: Floats
    line_moment: Floats
    direction: Floats
    extent: Floats
    open: Floats


def sections(vertices: Floats, faces: Ints, origin: Floats, axes: Floats, stations: Floats) -> Sections:
    """Cut a mesh by planes square to its axis.

    ``vertices`` (v, 3) in mm, ``faces`` (f, 3). ``axes`` (3, 3) are right-handed unit row vectors: along, and two
    across; ``stations`` (n,) are distances of the planes along from ``origin`` (3,), in mm.
    """
    corners = ((vertices - origin) @ axes.T)[faces]
    low, high = corners[:, :, 0].min(axis=1), corners[:, :, 0].max(axis=1)
    # A corner on the plane counts as above it, so that neighbouring facets agree on where the outline runs.
    return Sections.concat([_section(corners[(low < s) & (high >= s)], s) for s in stations])


def _section(corners: Floats, station: float) -> Sections:
    """Integrals of the section of facets (f, 3, 3), all of which cross the plane at ``station``."""
    above = corners[:, :, 0] >= station
    alone = np.argmax(above == (above.sum(axis=1) == 1)[:, None], axis=1)  # the corner on a side by itself
    rows = np.arange(len(corners))
    apex = corners[rows, alone]
    ends = []
    for k in (1, 2):
        other = corners[rows, (alone + k) % 3]
        share = (station - apex[:, 0]) / (other[:, 0] - apex[:, 0])
        ends.append(apex[:, 1:] + share[:, None] * (other[:, 1:] - apex[:, 1:]))
    upward = above[rows, alone][:, None]
    p, q = np.where(upward, ends[0], ends[1]), np.where(upward, ends[1], ends[0])
    d = q - p
    length = np.linalg.norm(d, axis=1)
    twice = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]  # twice the area to the origin
    products = _outer(p, p) + _outer(q, q) + 0.5 * (_outer(p, q) + _outer(q, p))
    area, line = 0.5 * float(twice.sum()), float(length.sum())
    first, line_first = (p + q).T @ twice / 6.0, 0.5 * (p + q).T @ length
    second, line_second = np.einsum("s,sij->ij", twice, products) / 12.0, np.einsum("s,sij->ij", length, products) / 3.0
    tangents = np.einsum("si,sj->ij", d, d / np.where(length > 0.0, length, 1.0)[:, None])
    centroid, line_centroid = first / (area or 1.0), line_first / (line or 1.0)
    return Sections(
        area=np.array([area]),
        centroid=centroid[None],
        second_moment=(second - area * np.outer(centroid, centroid))[None],
        length=np.array([line]),
        line_centroid=line_centroid[None],
        line_moment=(line_second - line * np.outer(line_centroid, line_centroid))[None],
        direction=tangents[None],
        extent=(np.ptp(p, axis=0) if len(p) else np.zeros(2))[None],
        open=np.array([float(np.linalg.norm(d.sum(axis=0)))]),
    )


def _outer(a: Floats, b: Floats) -> Floats:
    product: Floats = a[:, :, None] * b[:, None, :]
    return product
