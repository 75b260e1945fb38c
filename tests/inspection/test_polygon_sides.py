"""Sides of polygonal sections: built with moved and turned planes, against the polygon that half-planes cut out."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import HalfspaceIntersection

from processor.inspection import flat_faces, polygon_sides
from processor.inspection.flat_faces import Observed
from processor.inspection.result import Quantity
from processor.model import StructureDesign

COUNT, RADIUS, LENGTH, APART = 8, 100.0, 900.0, 5.0
AXIS = np.array([0.0, 0.0, 1.0])


def prism(sections=COUNT, radius=RADIUS):
    mesh = trimesh.creation.cylinder(radius, LENGTH, sections=sections)
    return StructureDesign("prism", np.asarray(mesh.vertices), np.asarray(mesh.faces))


def nothing_seen():
    none = np.empty(0)
    return Observed(np.empty((0, 3)), np.empty(0, np.int64), none, none, none, side=10.0)


def body_of(design):
    (body,) = flat_faces.bodies(design, nothing_seen(), 1.0)
    return body


def observed(body, section, level, slope, sigma=0.0, seed=0):
    """Core points 5 mm apart on all sides, each moved outward by a level and a slope across the side."""
    rng = np.random.default_rng(seed)
    places, facets, deviation = [], [], []
    for side, up, turn in zip(section, level, slope, strict=True):
        y, z = np.meshgrid(np.arange(*side.rims, APART), np.arange(-0.5 * LENGTH, 0.5 * LENGTH, APART))
        y, z = y.ravel(), z.ravel()
        places.append(side.distance * side.face.normal + y[:, None] * side.along + z[:, None] * AXIS)
        facets.append(np.full(len(y), side.face.facets[0]))
        deviation.append(up + turn * (y - side.rims.mean()) + sigma * rng.standard_normal(len(y)))
    noise = np.full(sum(map(len, facets)), sigma**2)
    return Observed(
        np.concatenate(places), np.concatenate(facets), np.concatenate(deviation), noise, 0.0 * noise, side=10.0
    )


def true_widths(section, level, slope):
    """Widths of the polygon that the moved half-planes leave, in the order of the sides."""
    rows = []
    for side, up, turn in zip(section, level, slope, strict=True):
        normal = side.face.normal - turn * side.along
        rows.append([*normal[:2], -(side.distance + up)])
    corners = HalfspaceIntersection(np.array(rows), np.zeros(2)).intersections
    corners = corners[np.argsort(np.arctan2(corners[:, 1], corners[:, 0]))]
    widths, middles = np.linalg.norm(np.roll(corners, -1, 0) - corners, axis=1), np.roll(corners, -1, 0) + corners
    return [widths[np.argmax(middles @ side.face.normal[:2] / np.linalg.norm(middles, axis=1))] for side in section]


def found(body, seen):
    values = polygon_sides.characteristics(body, AXIS, seen, float("nan"))
    return {one.of: one for one in values}


def test_widths_and_angles_are_those_of_the_polygon_cut_out_by_the_planes():
    body = body_of(prism())
    section = polygon_sides.of_section(body, AXIS)
    rng = np.random.default_rng(4)
    level, slope = rng.normal(0.0, 1.0, COUNT), rng.normal(0.0, 0.01, COUNT)
    of = found(body, observed(body, section, level, slope))
    turned = np.degrees(np.arctan(slope))
    for k, width in enumerate(true_widths(section, level, slope)):
        side = of[f"side-{k + 1}-width"]
        assert side.nominal == pytest.approx(2.0 * RADIUS * np.sin(np.pi / COUNT))
        assert side.nominal + side.value == pytest.approx(width, abs=1e-6)  # both exact
        angle = of[f"side-{k + 1}-angle"]
        assert angle.nominal == pytest.approx(360.0 / COUNT)
        assert (angle.value, angle.unit) == (pytest.approx(turned[k] - turned[(k + 1) % COUNT], abs=1e-6), "deg")
        assert of[f"side-{k + 1}-flatness"].value == pytest.approx(0.0, abs=1e-3)  # FLOOR_MM is taken for noise


def test_intervals_of_widths_and_angles_are_those_of_the_noise():
    """Ratio of the errors' rms and stated deviations: 320 values each, of which it scatters by 4 %, correlated by 8."""
    body = body_of(prism())
    section = polygon_sides.of_section(body, AXIS)
    still = np.zeros(COUNT)
    pulls = {Quantity.WIDTH: [], Quantity.ANGLE: []}
    for seed in range(40):
        for one in found(body, observed(body, section, still, still, sigma=0.5, seed=seed)).values():
            if one.what in pulls:
                pulls[one.what].append(1.96 * one.value / one.wider_side)
    for values in pulls.values():
        assert np.sqrt(np.mean(np.square(values))) == pytest.approx(1.0, abs=0.25)


def test_round_corners_belong_to_no_side():
    """A side's core points fall off within 3 mm of its rims, as where a plate is bent: the circle of 3.3 mm is out."""
    body = body_of(prism())
    section = polygon_sides.of_section(body, AXIS)
    still = np.zeros(COUNT)
    seen = observed(body, section, still, still)
    off = np.min([np.abs(seen.places @ side.along - rim)
                  + 1e3 * (seen.places @ side.face.normal < side.distance - 1e-6)
                  for side in section for rim in side.rims], axis=0)  # fmt: skip
    bent = seen._replace(deviation=np.where(off < 1.6, -2.0, 0.0))
    for one in found(body, bent).values():
        assert one.value == pytest.approx(0.0, abs=2e-3), one.of  # FLOOR_MM


def test_a_side_not_seen_leaves_three_widths_and_two_angles_unknown():
    body = body_of(prism())
    section = polygon_sides.of_section(body, AXIS)
    seen = observed(body, section, np.zeros(COUNT), np.zeros(COUNT))
    hidden = seen._replace(deviation=np.where(np.isin(seen.facet, section[2].face.facets), np.nan, seen.deviation))
    of = found(body, hidden)
    unknown = {id_ for id_, one in of.items() if np.isnan(one.value)}
    assert unknown == {"side-2-width", "side-3-width", "side-4-width", "side-2-angle", "side-3-angle"}
    assert {of[id_].reasons[0].code for id_ in unknown} == {"inspect.face-not-seen"}


def test_boxes_wedges_and_plates_have_no_polygonal_section():
    box = trimesh.creation.box((80.0, 60.0, 900.0))
    for mesh in (box, trimesh.creation.cylinder(50.0, 900.0, sections=3)):
        body = body_of(StructureDesign("", np.asarray(mesh.vertices), np.asarray(mesh.faces)))
        assert polygon_sides.of_section(body, AXIS) == []
        assert not found(body, nothing_seen())


def test_inner_sides_of_a_hollow_section_are_no_sides():
    outer, inner = prism(6), prism(6, 90.0)
    design = StructureDesign(
        "tube",
        np.concatenate([outer.vertices, inner.vertices]),
        np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)]),
    )
    sides = [polygon_sides.of_section(body, AXIS) for body in flat_faces.bodies(design, nothing_seen(), 1.0)]
    assert [len(one) for one in sides if one] == [6]
