"""Defects of plates and girders: the truth of each against the faces as built, integrated here."""

import numpy as np
import pytest

from designgen import recipe_files
from designgen.asbuilt import defects
from designgen.designs import defect_specimens, structure_registry
from designgen.scenes import structure as scenes_structure
from processor.model import UsageError

ROWS = {
    "plate": {"form": "plate"},
    "narrow-plate": {"form": "plate", "length_mm": 930.0, "height_mm": 330.0, "plate_mm": 16.0},
    "girder": {"form": "girder", "length_mm": 3000.0, "height_mm": 600.0, "plate_mm": 10.0},
    "short-girder": {"form": "girder", "length_mm": 450.0, "height_mm": 380.0, "plate_mm": 14.0},
}
WHOLE = ("bend", "twist", "waviness", "misalignment")
OUT = np.array([0.0, -1.0, 0.0])  # of every front


def row_of(row, kinds, sizes, seed=1):
    """Components as designed, faces as built with the component of each, and the truth."""
    structure = {"type": "plate-row", "components": list(kinds), **row}
    recipe = {"kind": "structure", "structure": structure, "asbuilt": sizes}
    components = structure_registry.design(recipe)
    return components, *scenes_structure.built_faces("plate-row", components, recipe, seed)[::2]


def volume(patches):
    """Volume inside of closed nets by the divergence theorem."""
    total = 0.0
    for patch in patches:
        knots, triangles = patch.net()
        a, b, c = (patch.at(knots[:, 0], knots[:, 1])[triangles[:, i]] for i in range(3))
        total += float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)
    return total


def fronts(component, built):
    """Pairs of faces, designed and as built, of a plate or a girder's web."""
    webs = [i for i, body in enumerate(component.bodies) if body.size[2] < body.size[1]]
    designed = {patch.name: patch for patch in component.patches}
    now = {patch.name: patch for patch in built}
    return [(designed[f"{i} +n"], now[f"{i} +n"]) for i in webs]


def by_gauss(knots):
    """Numbers between the knots of a net, which are close where much happens, and the share each stands for."""
    at, share = np.polynomial.legendre.leggauss(4)
    cell = np.diff(knots)[:, None]
    return (knots[:-1, None] + 0.5 * (1.0 + at) * cell).ravel(), (0.5 * share * cell).ravel()


def moved(component, built):
    """Places (n, 3) on the front as designed, how far each moved inward, and the area each stands for."""
    places, inward, areas = [], [], []
    for design, now in fronts(component, built):
        (p, dp), (q, dq) = (by_gauss(knots) for knots in (now.p, now.q))
        pp, qq = (grid.ravel() for grid in np.meshgrid(p, q, indexing="ij"))
        corner, one, two = design.at(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
        places.append(design.at(pp, qq))
        inward.append((now.at(pp, qq) - places[-1]) @ -OUT)
        areas.append(np.outer(dp, dq).ravel() * np.linalg.norm(np.cross(one - corner, two - corner)))
    return np.vstack(places), np.concatenate(inward), np.concatenate(areas)


def missing(component, built):
    """Area missing from the front, its centre (3,), and the volume that the closed faces lack."""
    ((design, now),) = fronts(component, built)
    middle = [0.5 * (k[1:] + k[:-1]) for k in (now.p, now.q)]
    gone = ~now.present
    pp, qq = (grid[gone] for grid in np.meshgrid(*middle, indexing="ij"))
    corner, one, two = design.at(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    area = np.outer(np.diff(now.p), np.diff(now.q))[gone] * np.linalg.norm(np.cross(one - corner, two - corner))
    lost = volume(component.patches) - volume(built)
    return area.sum(), (design.at(pp, qq) * area[:, None]).sum(axis=0) / area.sum(), lost


@pytest.mark.parametrize("seed", [1, 5])
@pytest.mark.parametrize("size", [0.4, 1.5])
@pytest.mark.parametrize("row", ROWS)
def test_the_truth_of_every_defect_is_that_of_the_faces(row, size, seed):
    components, patches, truth = row_of(ROWS[row], defects.CLASSES, {"size": size}, seed)
    assert truth.classes == defects.CLASSES
    assert truth.components == tuple(one.name for one in components)
    for part, kind in enumerate(defects.CLASSES):
        built = [patch for number, patch in patches if number == part]
        component = components[part]
        area, depth, lost = truth.area_mm2[part], truth.depth_max_mm[part], truth.volume_mm3[part]
        if kind in ("edge-loss", "missing-part", "crack"):
            found, centre, gone = missing(component, built)
            assert area == pytest.approx(found, rel=1e-6), kind  # float64: cells of the net
            np.testing.assert_allclose(truth.centres[part], centre, atol=1e-3, err_msg=kind)  # a micrometre
            assert lost == pytest.approx(gone, rel=1e-5), kind  # differences of volumes of 1e7 mm3
            assert depth == ROWS[row].get("plate_mm", 12.0)
            continue
        at, inward, areas = moved(component, built)
        touched = np.abs(inward) > 1e-9
        assert area == pytest.approx(areas[touched].sum(), rel=0.01), kind  # whole cells of a rim
        centre = (at * areas[:, None])[touched].sum(axis=0) / areas[touched].sum()
        np.testing.assert_allclose(truth.centres[part], centre, atol=0.5, err_msg=kind)  # the same
        largest = inward[np.argmax(np.abs(inward))]
        both_ways = kind in ("twist", "waviness")
        # The largest of points beside the middle.
        assert depth == pytest.approx(abs(largest) if both_ways else largest, rel=0.02), kind
        integral = (np.abs(inward) * areas).sum() if both_ways else (inward * areas).sum()
        assert lost == pytest.approx(integral, rel=2e-3), kind  # four points of Gauss in a cell


def test_numbers_by_hand():
    _, _, truth = row_of({"form": "plate"}, ("waviness", "misalignment", "twist", "bend", "bulge"), {"tilt_mrad": 24.0})
    # 1000 mm are 6 half waves of 150 mm and 50 mm at either end: 3 * 500 * (6 * 95.493 + 2 * 23.873) = 931056.
    assert truth.volume_mm3[0] == pytest.approx(931_056.0, abs=50.0)  # five digits by hand
    assert truth.depth_max_mm[0] == 3.0
    # 6 mm in, tilted by 12 mm over half the height: (18^2 + 6^2) / 2 / 24 mm per m = 7.5 mm on average.
    assert truth.volume_mm3[1] == pytest.approx(7.5e6, rel=1e-3)  # tan of 24 mrad
    assert truth.depth_max_mm[1] == pytest.approx(18.0, abs=2e-3)  # the same
    # 6 mrad at either end: 3 mm at the corners, a quarter of it on average.
    assert truth.depth_max_mm[2] == pytest.approx(3.0, abs=1e-4)  # the same of 6 mrad
    assert truth.volume_mm3[2] == pytest.approx(0.75e6, rel=1e-4)  # the same
    assert truth.volume_mm3[3] == pytest.approx(8.0e6 * 2.0 / np.pi)
    assert (truth.depth_max_mm[4], truth.volume_mm3[4]) == pytest.approx((-6.0, -np.pi * 120.0**2 * 2.0))


@pytest.mark.parametrize(
    ("length", "depth"), [(140.0, 3.0 * np.sin(70.0 * np.pi / 150.0)), (160.0, 3.0), (300.0, 3.0), (4000.0, 3.0)]
)
def test_waves_of_any_length(length, depth):
    row = {"form": "plate", "length_mm": length}
    components, patches, truth = row_of(row, ("waviness",), {})
    _, inward, areas = moved(components[0], [patch for _, patch in patches])
    assert truth.depth_max_mm[0] == pytest.approx(depth)
    # Four points of Gauss in a cell.
    assert truth.volume_mm3[0] == pytest.approx((np.abs(inward) * areas).sum(), rel=2e-3)


def test_a_girder_loses_steel_where_its_web_ends():
    """No other part of the girder is there: its flanges lie along the web's upper and lower edges."""
    row = ROWS["girder"]
    for seed in range(5):
        components, patches, truth = row_of(row, ("edge-loss",), {}, seed)
        x, _, z = truth.centres[0]
        assert x == pytest.approx(1500.0 - 30.0)
        middle = 800.0 + 300.0
        assert abs(z - middle) <= 0.2 * 568.0
        end = next(patch for _, patch in patches if patch.name == "0 +a")
        assert not end.present.all()
        web = components[0].bodies[0]
        assert web.centre[0] + 0.5 * web.size[0] == pytest.approx(1500.0)


def test_the_flanges_stay_where_a_web_waves():
    components, patches, _ = row_of(ROWS["girder"], ("waviness",), {"size": 3.0})
    designed = {patch.name: patch for patch in components[0].patches}
    p, q = np.random.default_rng(0).uniform(size=(2, 200))
    for _, patch in patches:
        if patch.name[0] in "12":
            np.testing.assert_allclose(patch.at(p, q), designed[patch.name].at(p, q), atol=1e-9)  # float64


@pytest.mark.parametrize(
    ("row", "kind", "sizes", "said"),
    [
        ({}, "missing-part", {"size": 10.0}, r"loss_mm times asbuilt\.size 10: expected at most 316\.667 .* got 600"),
        ({}, "edge-loss", {"loss_mm": 480.0}, r"loss_mm: expected at most 475 on"),
        ({"height_mm": 250.0}, "crack", {}, r"crack_length_mm: expected at most 237\.5 .* got 300"),
        ({"length_mm": 250.0}, "dent", {}, r"dent_radius_mm: expected at most 118\.75 .* got 120"),
        ({"length_mm": 250.0}, "bulge", {}, r"dent_radius_mm: expected at most 118\.75"),
        ({}, "dent", {"size": 25.0}, r"dent_depth_mm times asbuilt\.size 25: expected at most 120 .* got 150"),
        ({}, "pit", {"pit_depth_mm": 20.0}, r"pit_depth_mm: expected at most 11\.4 .* got 20"),
        ({}, "pit", {"pit_radius_mm": 476.0}, r"pit_radius_mm: expected at most 475"),
        ({}, "crack", {"crack_width_mm": 960.0}, r"crack_width_mm: expected at most 950"),
        ({}, "bend", {"bend_mm": 251.0}, r"bend_mm: expected at most 250"),
        ({}, "twist", {"twist_mrad": 1001.0}, r"twist_mrad: expected at most 1000"),
        ({}, "waviness", {"wave_mm": 76.0}, r"wave_mm: expected at most 75"),
        ({}, "waviness", {"wave_length_mm": 40.0}, r"wave_length_mm: expected at least 48, four times"),
        ({}, "step", {"step_mm": 251.0}, r"step_mm: expected at most 250"),
        ({}, "misalignment", {"shift_mm": 251.0}, r"shift_mm: expected at most 250"),
        ({}, "misalignment", {"tilt_mrad": 501.0}, r"tilt_mrad: expected at most 500"),
        ({"form": "girder", "height_mm": 120.0}, "edge-loss", {}, r"loss_mm: expected at most 41\.8"),
    ],
)
def test_defect_too_large_for_its_plate_is_refused_with_the_limit(row, kind, sizes, said):
    with pytest.raises(UsageError, match=rf"^asbuilt\.{said}") as refused:
        row_of(row, ("none", kind), sizes)
    assert f"{row.get('form', 'plate')}-2-{kind}, " in str(refused.value)


def test_a_dent_near_its_limit_lies_on_the_plate_whole():
    row = {"form": "plate", "length_mm": 300.0}
    for seed in range(6):
        components, patches, truth = row_of(row, ("dent",), {}, seed)
        _, inward, areas = moved(components[0], [patch for _, patch in patches])
        assert truth.area_mm2[0] == pytest.approx(np.pi * 120.0**2)
        assert truth.volume_mm3[0] == pytest.approx((inward * areas).sum(), rel=2e-3)  # four points of Gauss in a cell
        assert abs(truth.centres[0, 0]) <= 30.0


def test_a_pit_leaves_steel_behind_it():
    components, patches, _ = row_of({"form": "plate"}, ("pit",), {"pit_depth_mm": 11.0})
    faces = {patch.name: patch for _, patch in patches}
    assert moved(components[0], [patch for _, patch in patches])[1].max() > 10.0
    p, q = np.random.default_rng(0).uniform(size=(2, 50_000))
    front, back = faces["0 +n"].at(p, q), faces["0 -n"].at(p, q)
    assert (front[:, 1].max()) < back[:, 1].min()


def test_an_unknown_defect_is_refused():
    with pytest.raises(UsageError, match="expected classes of dent, bulge"):
        defects.draw("rust", defects.Params(), defect_specimens.Params(), np.random.default_rng(0))


def test_named_recipes_fit():
    for name in ("plates-defects", "girders-defects"):
        recipe = recipe_files.load(name)[1]
        row = {key: value for key, value in recipe["structure"].items() if key not in ("type", "components")}
        _, _, truth = row_of(row, defects.CLASSES, {})
        assert truth.classes == defects.CLASSES
