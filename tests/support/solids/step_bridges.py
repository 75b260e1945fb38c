"""STEP files: ribs and a frame of ours, lofted parts of nobody's, girders with splice plates and bolts."""

import tempfile
from pathlib import Path

import cadquery as cq
import numpy as np

from designgen.curves import make as make_curve
from designgen.designs import arch_rib, space_frame
from designgen.designs.arch_part import Plates, solid
from designgen.export import step_files
from tests.support.solids import bridge_parts

WIDTH, HEIGHT, FLANGE, WEB, PLATE = 300.0, 600.0, 20.0, 12.0, 12.0  # mm
LENGTHS = (1500.0, 1800.0, 1300.0)
HOLES = [(x, y) for x in (-80.0, 80.0) for y in (-100.0, 100.0)]  # of a flange, from the joint


def box(x, y, z):
    """A box over three intervals."""
    (x0, x1), (y0, y1), (z0, z1) = x, y, z
    return cq.Solid.makeBox(x1 - x0, y1 - y0, z1 - z0, cq.Vector(x0, y0, z0))


def _girders(gap):
    """Solids by name, and the places x of the joints' middles; the girders are ``gap`` mm apart, all along X."""
    half, shapes, joints, x = 0.5 * HEIGHT, {}, [], 0.0
    for k, length in enumerate(LENGTHS):
        flanges = [
            box((x, x + length), (-WIDTH / 2, WIDTH / 2), sorted((s * half, s * (half - FLANGE)))) for s in (-1, 1)
        ]
        web = box((x, x + length), (-WEB / 2, WEB / 2), (FLANGE - half, half - FLANGE))
        shapes[f"G{k + 1}"] = web.fuse(*flanges)
        x += length + gap
        joints += [x - 0.5 * gap] if k < len(LENGTHS) - 1 else []
    for number, at in enumerate(joints, 1):
        drills = [cq.Solid.makeCylinder(12.0, HEIGHT + 100.0, cq.Vector(at + dx, dy, -half - 50.0)) for dx, dy in HOLES]
        for name in (f"G{number}", f"G{number + 1}"):
            shapes[name] = shapes[name].cut(*drills)
        span = (at - 180.0, at + 180.0)
        for side, way in (("top", 1.0), ("bottom", -1.0)):
            z = sorted((way * half, way * (half + PLATE)))
            shapes[f"plate {side} {number}"] = box(span, (-WIDTH / 2, WIDTH / 2), z).cut(*drills)
            for k, (dx, dy) in enumerate(HOLES):
                shapes[f"bolt {side} {number}.{k}"] = _bolt(at + dx, dy, way * (half + PLATE), way)
        for side, way in (("left", 1.0), ("right", -1.0)):
            y = sorted((way * WEB / 2, way * (WEB / 2 + PLATE)))
            shapes[f"plate {side} {number}"] = box(span, y, (-220.0, 220.0))
    return shapes, joints


def _bolt(x, y, z, way):
    """A bolt with its head on a plate at z, and a nut on the other side of the flange."""
    depth = FLANGE + PLATE

    def at(off):
        return cq.Plane(origin=(x, y, z + way * off), normal=(0.0, 0.0, way))

    head, nut = (cq.Workplane(at(off)).polygon(6, 40.0).extrude(14.0).val() for off in (0.0, -depth - 14.0))
    shank = cq.Workplane(at(-depth)).circle(11.0).extrude(depth).val()
    return head.fuse(shank, nut)


RIBS = [f"拱肋{k + 1}" for k in range(4)]
CURVE = make_curve("parabola", 9000.0, 2000.0)
CUTS = CURVE.length * np.array([0.0, 0.29, 0.56, 0.7, 1.0])


def _bytes(shapes):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.step"
        step_files.write_step(path, shapes)
        return path.read_bytes()


def spliced_girders(gap):
    """Return a file of the girders, and the places x of their joints."""
    shapes, joints = _girders(gap)
    return _bytes(shapes), joints


def ribs_in_one_file():
    """Return a file of four ribs, the last one first."""
    plates = Plates(16.0, 14.0, 12.0)
    parts = [arch_rib.build(RIBS[k], CURVE, tuple(CUTS[k : k + 2]), 500.0, 600.0, plates) for k in range(4)]
    return _bytes({part.name: solid(part) for part in reversed(parts)})


def corners_of_ribs():
    """Return P1 to P4 of each joint (3, 4, 3)."""
    u, v = np.array([250.0, -250.0, -250.0, 250.0]), np.array([0.0, 0.0, 600.0, 600.0])
    return np.array([CURVE.point(np.full(4, cut), u, v) for cut in CUTS[1:-1]])


def lofted_parts(seed):
    """Return a file a part, by name, and P1 to P4 of each joint (4, 4, 3).

    Flat faces between sections that lean and are skew: a tapered box with a tapered hole, closed nowhere.
    """
    planes = bridge_parts.cutting_planes(5, seed)
    cuts = [
        [
            np.array([bridge_parts.edge(c, bridge_parts.crossing(c, *plane, inner), inner) for c in range(4)])
            for inner in (False, True)
        ]
        for plane in planes
    ]
    files = {}
    for name, start, end in zip(bridge_parts.names(5), cuts, cuts[1:], strict=False):
        outer, inner = (
            cq.Solid.makeLoft([cq.Wire.makePolygon([cq.Vector(*p) for p in cut], close=True) for cut in pair], True)
            for pair in zip(start, end, strict=True)
        )
        files[name] = _bytes({name: outer.cut(inner)})
    return files, np.array([outer for outer, _ in cuts[1:-1]])


def our_frame():
    """Return a file of a frame of two nodes by two, and its design."""
    params = space_frame.Params(
        nodes_x=2, nodes_y=2, layers=1, spacing_mm=1200.0, depth_mm=900.0, radii_mm=(45.0, 60.0)
    )
    design = space_frame.build(params)
    return _bytes({"frame": space_frame.solid(design)}), design
