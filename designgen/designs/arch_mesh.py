"""The mesh of an arch part from its closed form: watertight, vertices on the surface, facets within microns of it.

The CAD kernel's mesher exceeds its tolerance on long ruled faces. The design mesh is the reference for residuals of
hundredths of a millimetre, so it is made here instead.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from designgen.designs.arch_part import PAD_HEIGHT_MM, PAD_SIZE_MM, ArchPart, pad_frame
from processor.model import Floats, Ints

MESH_ERROR_MM = 0.002  # along the curve; the twisted webs of a widening foot are up to twice as far off
# Corners of a section in order: bottom left and right, top right, two on the edges of the pad, top left.
OUTER, INNER = 6, 4
# Strips of facets by the corner that they begin at; those of webs are twisted where the foot widens.
PADDED_STRIP, OUTER_WEBS, INNER_WEBS = 3, (1, 5), (1, 3)


def triangulate(part: ArchPart) -> tuple[Floats, Ints]:
    """Return vertices (v, 3), mm, and triangles (f, 3) of a part as designed; normals point outward."""
    s, u = part.pad
    half = 0.5 * PAD_SIZE_MM
    lines = np.array([u - half, u + half])
    step = _step(part)
    first_s, last_s = (_under_pad(part, s, x) for x in (-half, half))
    cuts = [part.s0, first_s, last_s, part.s1]
    outer = np.unique(np.concatenate([part.chainages(a, z, step) for a, z in pairwise(cuts)]))
    inner = part.chainages(*part.cavity, step)
    out = _sections(part, outer, lines)
    ins = _sections(part, inner, None)
    vertices, faces = [out.reshape(-1, 3), ins.reshape(-1, 3)], []
    first_inner = out.shape[0] * OUTER
    padded = np.flatnonzero((outer >= first_s) & (outer <= last_s))
    o = np.arange(len(outer) * OUTER).reshape(-1, OUTER)
    n = first_inner + np.arange(len(inner) * INNER).reshape(-1, INNER)
    for k in range(OUTER):
        rows = np.arange(len(outer) - 1)
        if k == PADDED_STRIP:
            rows = np.setdiff1d(rows, padded[:-1])
        after = (k + 1) % OUTER
        corners = (o[rows, k], o[rows, after], o[rows + 1, after], o[rows + 1, k])
        faces.append(_quads(*corners) if k not in OUTER_WEBS else _twisted(corners, vertices))
    for k in range(INNER):
        after = (k + 1) % INNER
        corners = (n[:-1, k], n[1:, k], n[1:, after], n[:-1, after])
        faces.append(_quads(*corners) if k not in INNER_WEBS else _twisted(corners, vertices))
    for end, a, b, forward in (("start", o[0], n[0], False), ("end", o[-1], n[-1], True)):
        if part.closed == end:
            faces += [_oriented(_fan(a), forward), _oriented(_fan(b), not forward)]
        else:
            faces.append(_oriented(_ring(a, b), forward))
    under = slice(PADDED_STRIP, PADDED_STRIP + 2)
    top, pad_faces = _pad(part, out[padded][:, under], o[padded][:, under], sum(map(len, vertices)))
    # In the order above all normals point inward.
    return np.vstack([*vertices, top]), np.vstack([*faces, pad_faces]).astype(np.int64)[:, ::-1]


def _step(part: ArchPart) -> float:
    """Return the longest step along the soffit whose chord is within MESH_ERROR_MM of soffit and top face."""
    s = np.linspace(part.s0, part.s1, 200)
    bend = part.curve.curvature(s) * (1.0 + part.curve.curvature(s) * part.h(s))
    return float(np.sqrt(8.0 * MESH_ERROR_MM / bend.max()))


def _under_pad(part: ArchPart, s: float, x: float) -> float:
    """Return the arc length at which the top face is ``x`` along the pad from its middle at ``s``, mm."""
    from scipy.optimize import brentq

    origin, along, _, _ = pad_frame(part)

    def error(at: float) -> float:
        top = part.curve.point(np.array([at]), np.zeros(1), part.h(np.array([at])))[0]
        return float((top - origin) @ along) - x

    return float(brentq(error, s + 2.0 * min(x, 0.0), s + 2.0 * max(x, 0.0), xtol=1e-10))


def _sections(part: ArchPart, s: Floats, lines: Floats | None) -> Floats:
    """Return the corners (n, 6, 3) of outer sections, with ``lines`` at the pad's edges, or (n, 4, 3) of inner ones."""
    b, h = part.b(s), part.h(s)
    low = np.zeros_like(s)
    if lines is not None:
        u = [b, -b, -b, np.full_like(s, lines[0]), np.full_like(s, lines[1]), b]
        v = [low, low, h, h, h, h]
    else:
        t = part.plates
        b, low, h = b - t.web, low + t.bottom, h - t.top
        u, v = [b, -b, -b, b], [low, low, h, h]
    return np.stack([part.curve.point(s, u_k, v_k) for u_k, v_k in zip(u, v, strict=True)], axis=1)


def _quads(a: Ints, b: Ints, c: Ints, d: Ints) -> Ints:
    quads = np.stack([a, b, c, d], axis=-1).reshape(-1, 4)
    triangles: Ints = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    return triangles


def _twisted(corners: tuple[Ints, Ints, Ints, Ints], vertices: list[Floats]) -> Ints:
    """Return four triangles a quad, about its mean, which is added to the vertices: a twisted quad is not plane."""
    points = np.vstack(vertices)
    centre = sum(map(len, vertices)) + np.arange(len(corners[0]))
    vertices.append(np.mean([points[corner] for corner in corners], axis=0))
    around = [(corners[i], corners[(i + 1) % 4]) for i in range(4)]
    triangles: Ints = np.stack([np.stack([a, b, centre], axis=-1) for a, b in around], axis=1).reshape(-1, 3)
    return triangles


def _fan(loop: Ints) -> Ints:
    return np.array([[loop[0], loop[k], loop[k + 1]] for k in range(1, len(loop) - 1)])


def _oriented(triangles: Ints, forward: bool) -> Ints:
    return triangles if forward else triangles[:, ::-1]


def _ring(o: Ints, n: Ints) -> Ints:
    """Return the triangles between an outer and an inner loop, oriented as the outer loop."""
    bottom, right, left = ([o[0], o[1], n[1], n[0]], [o[1], o[2], n[2], n[1]], [o[5], o[0], n[0], n[3]])
    plain = [_quads(*(np.array([i]) for i in quad)) for quad in (bottom, right, left)]
    return np.vstack([*plain, _fan(np.array([n[2], o[2], o[3], o[4], o[5], n[3]]))])


def _pad(part: ArchPart, foot: Floats, index: Ints, first: int) -> tuple[Floats, Ints]:
    """Return the top vertices (2 m, 3) and triangles of the pad above points ``foot`` (m, 2, 3) with rows ``index``."""
    origin, along, left, up = pad_frame(part)
    x, y = (foot - origin) @ along, (foot - origin) @ left
    top = origin + x[..., None] * along + y[..., None] * left + PAD_HEIGHT_MM * up
    t = first + np.arange(top.shape[0] * 2).reshape(-1, 2)
    faces = [
        _quads(t[:-1, 0], t[:-1, 1], t[1:, 1], t[1:, 0]),
        _quads(index[:-1, 0], t[:-1, 0], t[1:, 0], index[1:, 0]),
        _quads(t[:-1, 1], index[:-1, 1], index[1:, 1], t[1:, 1]),
        _quads(*(np.array([i]) for i in (index[0, 0], index[0, 1], t[0, 1], t[0, 0]))),
        _quads(*(np.array([i]) for i in (t[-1, 0], t[-1, 1], index[-1, 1], index[-1, 0]))),
    ]
    return top.reshape(-1, 3), np.vstack(faces)
