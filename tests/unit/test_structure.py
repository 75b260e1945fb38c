"""Whole structures: which way their faces look, what is inside of what."""

import numpy as np
import pytest

from designgen import damage, recipes
from designgen.designs import plate_row, stadium_roof, structure, truss_bridge
from designgen.scene import make


def corners_of(patches):
    """Triangles (f, 3, 3) of the nets of patches."""
    found = []
    for patch in patches:
        knots, triangles = patch.net()
        found.append(patch.at(knots[:, 0], knots[:, 1])[triangles])
    return np.concatenate(found)


def signed_volume(patches, about):
    """Volume of a closed net by the divergence theorem: positive where its triangles look outward."""
    a, b, c = (corners_of(patches)[:, i] - about for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def test_boxes_look_outward_in_frames_of_either_hand():
    R, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    for axes in (R, R * [[-1.0], [1.0], [1.0]]):
        box = structure.Box(np.array([100.0, -50.0, 7.0]), axes, np.array([3.0, 5.0, 7.0]))
        assert signed_volume(box.patches(), np.zeros(3)) == pytest.approx(105.0)
        knots = tuple(np.array([0.0, 0.3, 1.0]) for _ in range(3))
        assert signed_volume(box.patches(knots), np.zeros(3)) == pytest.approx(105.0)


@pytest.mark.parametrize(
    "components",
    [truss_bridge.build(truss_bridge.Params()), plate_row.build(plate_row.Params(form="girder", components=("step",)))],
    ids=["truss", "girder"],
)
def test_every_box_of_a_structure_has_its_volume(components):
    for one in components:
        for body in one.bodies:
            assert signed_volume(body.patches(), body.centre) == pytest.approx(float(np.prod(body.size)))
        volume = sum(float(np.prod(body.size)) for body in one.bodies)
        assert signed_volume(one.patches, one.bodies[0].centre) == pytest.approx(volume)


def test_a_hole_takes_its_volume_from_the_plate():
    """The cut faces close the net, and look into the hole."""
    row = plate_row.Params(components=("crack",))
    (place,) = plate_row.places(row)
    for kind in ("crack", "edge-loss", "missing-part"):
        defect = damage.draw(kind, damage.Params(), row, np.random.default_rng(2))
        patches = damage.damaged(place, plate_row.bodies(row, place), defect)
        assert signed_volume(patches, place.origin) == pytest.approx(1000.0 * 1000.0 * 12.0 - defect.volume_mm3)


def test_tubes_and_their_truth_look_away_from_the_axis():
    components = stadium_roof.build(stadium_roof.Params(trusses=4))
    tubes = [body for one in components for body in one.bodies]
    for tube in tubes:
        a, b, c = (corners_of(tube.patches())[:, i] for i in range(3))
        unit = (tube.end - tube.start) / np.linalg.norm(tube.end - tube.start)
        radial = (a + b + c) / 3.0 - tube.start
        radial -= np.outer(radial @ unit, unit)
        assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), radial) > 0.0).all()
    settings = ["structure.trusses=4", "scan.spacing_mm=500"]
    _, truth = make("x", recipes.overridden(recipes.load("stadium-roof")[1], settings))
    at = 0
    for tube in tubes:
        unit = (tube.end - tube.start) / np.linalg.norm(tube.end - tube.start)
        arm = truth.structure.points[at:] - tube.start
        along = arm @ unit
        radial = arm - np.outer(along, unit)
        own = np.abs(np.linalg.norm(radial, axis=1) - tube.radius) < 1e-6
        own &= (along > 0.0) & (along < np.linalg.norm(tube.end - tube.start))
        count = int(np.argmin(own)) if not own.all() else len(own)
        assert count >= 16
        expected = radial[:count] / tube.radius
        np.testing.assert_allclose(truth.structure.normals[at : at + count], expected, atol=1e-6)
        at += count
    assert at == len(truth.structure.points)
