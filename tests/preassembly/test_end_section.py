"""Sections of ends by the design's surface, and the ends of girders of other sections than a hollow box."""

import numpy as np
import pytest

from designgen.designs import girder_assemblies, prismatic_parts
from designgen.scanning import sampler
from processor.geometry import mesh_distance
from processor.model import Reason
from processor.preassembly.ends import joint_end, outer_faces, section
from processor.preassembly.ends.joint_frame import end_place
from processor.preassembly.ends.section import PlateFace
from tests.support.results import measured_parts

B, H, FLANGE, WEB = 250.0, 500.0, 30.0, 14.0
SIZES = {"width_mm": 2 * B, "height_mm": 2 * H, "flange_mm": FLANGE, "web_mm": WEB, "length_mm": 2500.0, "parts": 2}


def girder(of, errors=None):
    """Return a girder of a section that ends at x = 2500, its design's surface, and its key points there."""
    part = girder_assemblies.build(girder_assemblies.Params(section=of, **SIZES)).parts[0]
    surface = mesh_distance.of_mesh(*part.mesh())
    return part.with_errors([errors]) if errors else part, surface, part.ends[0].key_points()


@pytest.mark.parametrize("of", ["box", "stiffened-box"])
def test_box_section_has_four_faces_with_any_inner_plates(of):
    _, surface, key_points = girder(of)
    place = end_place(key_points, 1.0, surface)
    assert place.section == section.of_box(place.half) or all(face.plate for face in place.section.faces)
    assert [face.name for face in place.section.faces] == list(PlateFace)
    assert place.section.middles == (0, 1, 2, 3)
    assert min(place.section.middles) >= 0
    # float64, as below
    np.testing.assert_allclose(joint_end._design_thickness(surface, place), [FLANGE, WEB, FLANGE, WEB], atol=1e-9)


def test_the_sides_of_an_i_are_the_edges_of_its_flanges():
    _, surface, key_points = girder("i")
    place = end_place(key_points, 1.0, surface)
    found = [(face.name, face.sense * face.offset, face.middle, face.half, face.plate) for face in place.section.faces]
    middle, half = H - 0.5 * FLANGE, 0.5 * FLANGE
    expected = [
        (PlateFace.BOTTOM, -H, 0.0, B, True),
        (PlateFace.RIGHT, -B, -middle, half, False),
        (PlateFace.RIGHT, -B, middle, half, False),
        (PlateFace.TOP, H, 0.0, B, True),
        (PlateFace.LEFT, B, -middle, half, False),
        (PlateFace.LEFT, B, middle, half, False),
    ]
    assert [one[0] for one in found] == [one[0] for one in expected]
    np.testing.assert_allclose([one[1:] for one in found], [one[1:] for one in expected], atol=1e-9)  # float64
    assert [(corner.upright, corner.level) for corner in place.section.corners] == [(4, 0), (1, 0), (2, 3), (5, 3)]
    assert [face >= 0 for face in place.section.middles] == [True, False, True, False]  # on steel
    np.testing.assert_allclose(joint_end._design_thickness(surface, place), [FLANGE, 0, 0, FLANGE, 0, 0], atol=1e-9)


def test_a_hole_in_a_web_at_a_joint_makes_no_i_of_a_box():
    """Nothing of the web within 150 mm of its middle at the end."""
    _, surface, key_points = girder("box")
    centre = surface.vertices[surface.faces].mean(axis=1)
    hole = (np.abs(centre[:, 2]) < 150.0) & (centre[:, 0] > 2400.0) & (centre[:, 1] < 0.0)
    there = mesh_distance.of_mesh(surface.vertices, surface.faces[~hole])
    assert all(face.plate for face in end_place(key_points, 1.0, there).section.faces)


def measured(of, errors, seed, spacing_mm=8.0, sigma_mm=1.0):
    """Return the end of a girder as built, measured from points on it that lie where the design has them."""
    part, surface, key_points = girder(of, errors)
    patches = [(0, patch) for patch in part.built()]
    settings = sampler.Params(spacing_mm=spacing_mm, sigma_mm=sigma_mm)
    points = sampler.scan_patches(patches, settings, np.random.default_rng(seed)).points
    registered = measured_parts.registered(points, surface, outer_faces.outer_faces(surface, [key_points]))
    fitted = joint_end.fit(registered, end_place(key_points, 1.0, surface))
    assert not isinstance(fitted, Reason | joint_end.JointEnd), fitted
    return joint_end.estimate([fitted])[0]


def closed_form(errors):
    """Departures (8, 3) of P1..P8 by the errors of an end, for a section of 2 B by 2 H."""
    (length, about_z, about_y), corners = errors.plane, errors.corners
    at = np.array([[B, -H], [-B, -H], [-B, H], [B, H]])
    own = corners + np.column_stack([length + about_z * at[:, 0] + about_y * at[:, 1], np.zeros(4), np.zeros(4)])
    return np.vstack([own, *([0.5 * (own[a] + own[b])] for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)))])


@pytest.mark.parametrize("of", ["box", pytest.param("stiffened-box", marks=pytest.mark.slow), "i"])
def test_corners_are_where_the_faces_and_the_end_meet(of):
    held, rms = [], []
    for seed in range(2):
        rng = np.random.default_rng([seed, 7])
        errors = prismatic_parts.EndErrors(rng.normal(0.0, [2.0, 1e-3, 1e-3]), rng.normal(0.0, 1.0, (4, 3)))
        end = measured(of, errors, seed)
        off = end.departure - closed_form(errors)
        sd = np.sqrt(np.diag(end.covariance)).reshape(8, 3)
        held.append(np.abs(off) < 1.96 * sd)
        rms.append(np.sqrt(np.mean(off**2)))
        assert (np.abs(off) < 4.5 * np.hypot(sd, 0.05)).all()  # an end by itself learns from no other
    assert np.mean(held) > 0.75  # of some 16 independent coordinates 95 % have a standard deviation of 5.4 %
    assert np.mean(rms) < 0.35  # of ends that are off by 2 mm; points 8 mm apart on plates of 14 mm


@pytest.mark.parametrize("radius_mm", [1_500.0, 3_000.0])
def test_outer_faces_of_a_strongly_curved_part_contain_its_corners(radius_mm):
    """Over the zone of the joint the inner side of the flange lies nearer to the level of the corners."""
    part, joint = curved_box(radius_mm)
    outer = outer_faces.outer_faces(part, [joint])
    for corner in joint[:4]:
        assert np.linalg.norm(outer.vertices[outer.faces].reshape(-1, 3) - corner, axis=1).min() < 1e-9  # float64
    height = np.linalg.norm(outer.vertices[outer.faces].reshape(-1, 3)[:, [0, 2]], axis=1)
    assert not ((height > radius_mm + 1.0) & (height < radius_mm + 799.0)).any()  # nothing of the inner sides


def curved_box(radius_mm):
    """A box of 600 x 800 mm with plates of 20 mm, bent about the y axis over 1.2 rad; P1..P8 of the end at x = 0."""
    angles = np.linspace(0.0, 1.2, 121)
    skins = []
    for depth in (0.0, 20.0):
        section = [(y * (300.0 - depth), z) for z in (depth, 800.0 - depth) for y in (1.0, -1.0)]
        section[2:] = section[:1:-1]  # P1, P2, P3, P4
        ring = np.array(section)
        r = radius_mm + ring[:, 1]
        skins.append(np.stack([np.stack([-r * np.sin(a), ring[:, 0], r * np.cos(a)], axis=1) for a in angles]))
    vertices = np.concatenate([skin.reshape(-1, 3) for skin in skins])
    quads = []
    for skin in range(2):
        first = 4 * len(angles) * skin
        for k in range(len(angles) - 1):
            at = first + 4 * k
            quads += [(at + i, at + (i + 1) % 4, at + 4 + (i + 1) % 4, at + 4 + i) for i in range(4)]
    behind = 4 * len(angles)
    quads += [(i, (i + 1) % 4, behind + (i + 1) % 4, behind + i) for i in range(4)]
    triangles = np.array([t for q in quads for t in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))])
    corners = skins[0][0]
    middles = np.array([0.5 * (corners[a] + corners[b]) for a, b in ((0, 1), (1, 2), (2, 3), (3, 0))])
    return mesh_distance.of_mesh(vertices, triangles), np.vstack([corners, middles])
