"""A portal of bodies that touch, and plates that are built otherwise than designed, scanned by designgen."""

import dataclasses

import cadquery as cq
import numpy as np

import designgen

THICK = (5, 8, 12, 20)
SIZES = ((300.0, 200.0), (400.0, 150.0), (350.0, 220.0), (450.0, 300.0))


def box(x, y, z, a, b, c):
    """A box of sizes a, b, c, of which a corner lies at x, y, z."""
    return cq.Solid.makeBox(a, b, c, cq.Vector(x, y, z))


def section(width, height, web, flange):
    """A rolled I section, 2 m long: web, and flanges on either side."""
    whole = cq.Workplane().rect(height - 2.0 * flange, web).extrude(2000.0)
    for side in (-1.0, 1.0):
        place = cq.Workplane().center(side * 0.5 * (height - flange), 0.0)
        whole = whole.union(place.rect(flange, width).extrude(2000.0))
    return whole


def portal(gap):
    """Base plate, column, cap, stiffener, beam and tube; they lie ``gap`` mm apart, or overlap."""
    bodies = {
        "base": box(-200, -200, -20, 400, 400, 20),
        "column": section(200, 200, 8, 12).translate((0, 0, gap)).val(),
        "cap": box(-150, -150, 2000 + 2 * gap, 300, 300, 15),
        "stiffener": box(-88 + gap, 4 + gap, 900, 176 - 2 * gap, 90, 12),
        "beam": box(-250, -75, 2015 + 3 * gap, 1500, 150, 200),
        "tube": cq.Solid.makeCylinder(60, 1200, cq.Vector(100 + gap, 0, 1200), cq.Vector(1, 0, 0)),
    }
    whole = cq.Assembly(name="portal")
    for name, shape in bodies.items():
        whole.add(shape, name=name)
    return whole


def portal_scene(gap, settings, seed=1):
    """A scan of the portal from five stations."""
    return designgen.scan(portal(gap), stations=5, seed=seed, settings=settings)[0]


def plates(departures):
    """Plates whose corners lie off their places by ``departures`` (p, 4, 2), lying and standing, above a beam."""
    whole = cq.Assembly(name="plates")
    whole.add(cq.Workplane("XY").box(3000, 200, 300).translate((0, 0, 400)).val(), name="beam")
    for k, (thickness, (length, width)) in enumerate(zip(THICK, SIZES, strict=True)):
        corners = 0.5 * np.array([[-length, -width], [length, -width], [length, width], [-length, width]])
        corners = corners + departures[k]
        made = cq.Workplane("XY").polyline([tuple(map(float, c)) for c in corners]).close().extrude(thickness).val()
        made = made.rotate(cq.Vector(0, 0, 0), cq.Vector(1, 0, 0), 90.0 * (k % 2))
        whole.add(made.translate(cq.Vector(700.0 * k - 1000.0, 0.0, 900.0 + 200.0 * (k % 2))), name=f"plate-{k}")
    return whole


def plate_scene(seed, sd_mm, step_mrad=1.2):
    """A scan of plates whose corners are off by ``sd_mm``, with the design as it should be, and the departures."""
    departures = np.random.default_rng(seed).normal(0.0, sd_mm, (len(THICK), 4, 2))
    built, _ = designgen.scan(plates(departures), stations=6, seed=seed, settings={"scan.step_mrad": step_mrad})
    designed, _ = designgen.scan(plates(0.0 * departures), stations=1, seed=1, settings={"scan.step_mrad": 20.0})
    return dataclasses.replace(built, structure=designed.structure), departures
