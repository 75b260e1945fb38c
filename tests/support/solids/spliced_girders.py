"""I girders in a row with splice plates and bolts at their joints, as CadQuery solids."""

import cadquery as cq

WIDTH, HEIGHT, FLANGE, WEB, PLATE = 300.0, 600.0, 20.0, 12.0, 12.0  # mm
LENGTHS = (1500.0, 1800.0, 1300.0)
HOLES = [(x, y) for x in (-120.0, -50.0, 50.0, 120.0) for y in (-100.0, 100.0)]  # of a flange, from the joint


def box(x, y, z):
    """A box over three intervals."""
    (x0, x1), (y0, y1), (z0, z1) = x, y, z
    return cq.Solid.makeBox(x1 - x0, y1 - y0, z1 - z0, cq.Vector(x0, y0, z0))


def bodies(gap):
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
