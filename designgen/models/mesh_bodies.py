"""Bodies of meshes: vertices joined, connected pieces apart, normals outward, and what had to be repaired."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from designgen.cad import faults
from designgen.models.mesh_files import Piece
from designgen.models.mesh_topology import connected_components, count_open_edges, shared_edges
from designgen.models.model import ModelBody, of_mesh, unique_names
from processor.model import Floats, InputError, Ints

JOIN_SHARE = 1e-9  # of the model's size: vertices nearer to each other are one


def bodies_of(path: str, pieces: Sequence[Piece], stem: str) -> tuple[list[ModelBody], list[str]]:
    """Return the bodies of named pieces, mm, and notes on what was found and repaired.

    A piece without a name is as many bodies as it has connected parts. Raises InputError where no triangle has an area.
    """
    size = max(float(np.ptp(vertices[triangles].reshape(-1, 3), axis=0).max()) for _, vertices, triangles in pieces)
    found: list[tuple[str, Floats, Ints]] = []
    notes: list[str] = []
    for name, vertices, triangles in pieces:
        points, faces = _joined(vertices, triangles, JOIN_SHARE * size)
        if not len(faces):
            continue
        parts = _oriented(points, faces, name or stem, notes)
        if name:
            parts = [np.concatenate(parts)]
        for part in parts:
            found.append((name, *_compact(points, part)))
    if not found:
        raise InputError(f"{path}: expected triangles with an area, found none; export it again")
    unnamed = sum(not name for name, _, _ in found)
    names = [name or (f"{stem}-{i + 1}" if len(found) > 1 else stem) for i, (name, _, _) in enumerate(found)]
    if unnamed > 1:
        notes.append(f"{unnamed} connected parts have no names and are numbered as bodies {names[0]} to {names[-1]}")
    notes += faults.repeated(names)
    names = unique_names(names)
    for name, (_, _, faces) in zip(names, found, strict=True):
        if open_edges := count_open_edges(faces):
            notes.append(
                f"{name!r} is not closed ({open_edges} open edges): it is scanned as it is, from both sides; close its "
                "holes if it is a solid"
            )
    return [of_mesh(name, points, faces) for name, (_, points, faces) in zip(names, found, strict=True)], notes


def _joined(vertices: Floats, triangles: Ints, reach: float) -> tuple[Floats, Ints]:
    """Return distinct vertices, and the triangles with three of them and an area."""
    used, inverse = np.unique(triangles, return_inverse=True)
    points = vertices[used]
    _, first, same = np.unique(np.round(points / max(reach, 1e-300)), axis=0, return_index=True, return_inverse=True)
    faces = same.reshape(-1)[inverse.reshape(triangles.shape)]
    points = points[first]
    a, b, c = (points[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return points, faces[area > 0.0].astype(np.int64)


def _compact(vertices: Floats, triangles: Ints) -> tuple[Floats, Ints]:
    used, inverse = np.unique(triangles, return_inverse=True)
    return vertices[used], inverse.reshape(triangles.shape).astype(np.int64)


def _oriented(vertices: Floats, triangles: Ints, name: str, notes: list[str]) -> list[Ints]:
    """Return the triangles of each connected part with outward normals; a cavity is of the part around it."""
    a, b, ends = shared_edges(triangles)
    label = connected_components(len(triangles), a, b)
    directions = [(triangles[rows] == ends[:, :1]).argmax(axis=1) for rows in (a, b)]
    after = [triangles[rows, (k + 1) % 3] == ends[:, 1] for rows, k in zip((a, b), directions, strict=True)]
    against = after[0] == after[1]  # two triangles that use their edge in one direction have opposite normals
    turned = np.zeros(len(triangles), bool)
    if against.any():
        turned = _turned(len(triangles), a, b, against)
        # Of a part that is not closed, the larger share is right.
        share = np.bincount(label, weights=turned) / np.bincount(label)
        turned ^= (share > 0.5)[label]
    faces = np.where(turned[:, None], triangles[:, ::-1], triangles)
    order = np.argsort(label, kind="stable")
    rows = np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
    parts = [faces[part] for part in rows]
    volumes = [faults.volume(vertices, part) for part in parts]
    result, cavities = {}, []
    for i, part in enumerate(parts):
        host = _around(vertices, part, parts, volumes) if volumes[i] < 0.0 else -1
        if host >= 0:
            cavities.append((host, part))
            continue
        inward = volumes[i] < 0.0 and not count_open_edges(part)
        turned[rows[i]] ^= inward
        result[i] = part[:, ::-1] if inward else part
    for host, part in cavities:
        result[host] = np.concatenate([result[host], part])
    if turned.any():
        notes.append(
            f"{name!r}: {int(turned.sum())} of {len(triangles)} triangles were turned so that all normals point outward"
        )
    return list(result.values())


def _turned(count: int, a: Ints, b: Ints, against: np.ndarray) -> np.ndarray:
    """Return which triangles (count,) to turn so that all of a part agree with its first."""
    from scipy.sparse import coo_matrix, csgraph

    # A graph with two nodes for each triangle, as it is and turned; an edge joins the two pairs that agree.
    rows = np.concatenate([a, a + count])
    columns = np.concatenate([np.where(against, b + count, b), np.where(against, b, b + count)])
    graph = coo_matrix((np.ones(len(rows), bool), (rows, columns)), (2 * count, 2 * count))
    label = csgraph.connected_components(graph, directed=False)[1]
    part = connected_components(count, a, b)
    first = np.unique(part, return_index=True)[1]
    result: np.ndarray = label[:count] != label[first][part]
    return result


def _around(vertices: Floats, part: Ints, parts: Sequence[Ints], volumes: Sequence[float]) -> int:
    """Return the number of the smallest part with a positive volume around a part, -1 for none."""
    point = vertices[part[0]].mean(axis=0)
    hosts = [i for i, size in enumerate(volumes) if size > 0.0 and _inside(point, vertices[parts[i]])]
    return min(hosts, key=lambda i: volumes[i], default=-1)


def _inside(point: Floats, corners: Floats) -> bool:
    """Return whether a point (3,) is inside of a closed mesh (f, 3, 3): its winding number is about 1."""
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    volume = np.einsum("ni,ni->n", a, np.cross(b, c))
    below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return bool(np.arctan2(volume, below).sum() > np.pi)
