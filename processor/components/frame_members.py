"""The balls and tubes of a space frame as a structure: each of nominal size, where step spheres has measured it.

A node that moved, and the members that it moved along, have no defect by that; what is compared is the shape of each
ball and of each tube.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from processor.geometry import rigid
from processor.model import (
    DesignBodies,
    Floats,
    FrameDesign,
    InputError,
    Ints,
    Scan,
    Scene,
    Stations,
    StructureDesign,
    UsageError,
)
from processor.views import views

AROUND, RINGS = 48, 24  # facets around tubes and balls, and from pole to pole; curvature between corners is allowed for
CLEAR_MM, CLEAR_SHARE = 5.0, 1.25  # of a ball about a member's axis, in radii of the tube: its sleeve hides it
TRIM_MM = 10.0  # of a tube at either end, where its cone begins
SEEN = ("ball", "fused")  # evidence of a ball that was seen itself

Mesh = tuple[Floats, Ints]


def of_frame(scene: Scene, found: Any, step: str) -> Scene:
    """Return a frame as a structure in the frame of its scans, by the result of step spheres.

    Raises UsageError where spheres did not run, InputError where it found no ball or tube.
    """
    if found is None:
        raise UsageError(f"{step}: balls and tubes are placed by step spheres; add it to --steps")
    design = scene.frame
    bodies = {} if design is None else {**_balls(design, found), **_tubes(design, found)}
    if not bodies:
        raise InputError(f"{scene.name}: expected balls and tubes of a design, step spheres found none in the scan")
    vertices, faces, of_facet, count = [], [], [], 0
    for row, (corners, facets) in enumerate(bodies.values()):
        vertices.append(corners)
        faces.append(facets + count)
        of_facet.append(np.full(len(facets), row, np.int64))
        count += len(corners)
    names = DesignBodies(names=tuple(bodies), of_facet=np.concatenate(of_facet))
    structure = StructureDesign("frame", np.concatenate(vertices), np.concatenate(faces), names)
    placed = replace(scene, kind="structure", frame=None, structure=structure)
    return _corrected(placed, found)


def _corrected(scene: Scene, found: Any) -> Scene:
    """Move stations and scans as step spheres has corrected them."""
    T_of = dict(zip(found.stations.names, found.stations.T, strict=True))
    if not T_of:
        return scene
    stations = scene.stations
    of_row = {} if stations is None else {row: T_of[id_] for row, id_ in enumerate(stations.ids) if id_ in T_of}
    seen = views(scene)
    names = [seen.names[seen.of_scan(i)] for i in range(len(scene.scans))]
    scans = tuple(
        replace(scan, T_project_scan=T_of[name] @ scan.pose)
        if name in T_of
        else replace(scan, points=_points_corrected(scan, of_row))
        for name, scan in zip(names, scene.scans, strict=True)
    )
    if stations is not None and all(id_ in T_of for id_ in stations.ids):
        moved = np.stack([T_of[id_] for id_ in stations.ids])
        stations = Stations(
            ids=stations.ids,
            positions=np.stack([rigid.apply(T, at) for T, at in zip(moved, stations.positions, strict=True)]),
            T_project_station=moved @ stations.T_project_station
            if len(stations.T_project_station)
            else stations.T_project_station,
        )
    return replace(scene, scans=scans, stations=stations)


def _points_corrected(scan: Scan, of_row: dict[int, Floats]) -> Floats:
    """Return the points (n, 3) of a merged scan where the corrected poses of their stations, by row, have them."""
    points: Floats = scan.points.copy()
    for row, T in of_row.items():
        seen = scan.point_station == row
        if seen.any():
            M = rigid.invert(scan.pose) @ T @ scan.pose
            # Of large coordinates the difference alone is added: they would cost the points digits.
            points[seen] += scan.points[seen] @ (M[:3, :3] - np.eye(3)).T + (rigid.apply(M, scan.origin) - scan.origin)
    return points


def _balls(design: FrameDesign, found: Any) -> dict[str, Mesh]:
    """Return a sphere of nominal radius about each centre that was measured, open where its members leave it."""
    axes: dict[int, list[tuple[Floats, float]]] = {}
    tubes = found.tubes
    for m in range(len(tubes)):
        axis = tubes.end[m] - tubes.start[m]
        axis = axis / np.linalg.norm(axis)
        for node, out in ((int(tubes.a[m]), axis), (int(tubes.b[m]), -axis)):
            axes.setdefault(node, []).append((out, float(tubes.radii[m])))
    radius, name_of = dict(zip(design.ids.tolist(), design.radii.tolist(), strict=True)), design.name_of
    meshes = {}
    for k, node in enumerate(found.balls.ids.tolist()):
        if node not in radius or str(found.balls.evidence[k]) not in SEEN or not found.balls.placed[k]:
            continue
        unit, facets = _unit_sphere()
        middle = unit[facets].mean(axis=1) * radius[node]
        hidden = np.zeros(len(facets), bool)
        for out, tube in axes.get(node, []):
            along = middle @ out
            off = np.linalg.norm(middle - along[:, None] * out, axis=1)
            hidden |= (along > 0.0) & (off < CLEAR_SHARE * tube + CLEAR_MM)
        if not hidden.all():
            meshes[f"node {name_of[node]}"] = unit * radius[node] + found.balls.centres[k], facets[~hidden]
    return meshes


def _tubes(design: FrameDesign, found: Any) -> dict[str, Mesh]:
    """Return a straight tube of nominal diameter along each axis that was measured, as far as the tube was seen."""
    name_of = design.name_of
    diameter = {
        frozenset((int(a), int(b))): (float(d), f"{name_of[int(a)]}-{name_of[int(b)]}")
        for a, b, d in zip(design.member_a, design.member_b, design.tube_diameters, strict=True)
    }
    meshes, tubes = {}, found.tubes
    for m in range(len(tubes)):
        pair = frozenset((int(tubes.a[m]), int(tubes.b[m])))
        axis = tubes.end[m] - tubes.start[m]
        length = float(np.linalg.norm(axis)) - 2.0 * TRIM_MM
        if pair in diameter and length > 0.0:
            size, name = diameter[pair]
            axis = axis / np.linalg.norm(axis)
            meshes[name] = _tube(tubes.start[m] + TRIM_MM * axis, axis, length, 0.5 * size)
    return meshes


def _tube(start: Floats, axis: Floats, length: float, radius: float) -> Mesh:
    """Return the open mesh of a tube's outer surface, facets outward."""
    side, third = rigid.axes_across(axis)
    turn = 2.0 * np.pi * np.arange(AROUND) / AROUND
    ring = radius * (np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * third)
    rows = max(2, 1 + int(np.ceil(length / (4.0 * radius))))  # facets that are not slivers
    along = np.linspace(0.0, length, rows)
    vertices = (start + along[:, None] * axis)[:, None] + ring[None]
    return vertices.reshape(-1, 3), _grid(rows, AROUND)


def _unit_sphere() -> Mesh:
    """Return the mesh of a unit sphere by latitude and longitude, facets outward."""
    polar = np.pi * (np.arange(RINGS - 1) + 1.0) / RINGS
    turn = 2.0 * np.pi * np.arange(AROUND) / AROUND
    ring = np.stack(
        [
            np.sin(polar)[:, None] * np.cos(turn),
            np.sin(polar)[:, None] * np.sin(turn),
            np.repeat(-np.cos(polar)[:, None], AROUND, axis=1),
        ],
        axis=-1,
    )
    vertices = np.concatenate([ring.reshape(-1, 3), [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]])
    low, high, last = len(vertices) - 2, len(vertices) - 1, (RINGS - 2) * AROUND
    k = np.arange(AROUND)
    after = (k + 1) % AROUND
    caps = [
        np.stack([np.full(AROUND, low), after, k], axis=1),
        np.stack([np.full(AROUND, high), last + k, last + after], axis=1),
    ]
    return vertices, np.concatenate([_grid(RINGS - 1, AROUND), *caps])


def _grid(rows: int, columns: int) -> Ints:
    """Return the facets (2 (rows - 1) columns, 3) between rings, outward where they turn left about the way up."""
    i, k = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a, b = (i * columns + k).ravel(), (i * columns + (k + 1) % columns).ravel()
    c, d = a + columns, b + columns
    return np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
