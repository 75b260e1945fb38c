"""Girders with bolt holes: scanned surfaces against their CadQuery solids, meshes, and where holes were drilled."""

from types import SimpleNamespace

import cadquery as cq
import numpy as np
import pytest

from designgen.designs import bolt_holes, girder_assemblies, prismatic_solids
from designgen.scenes import make as scenes
from processor.inspection import bridge_holes, splices
from processor.model import Status, UsageError
from processor.preassembly.result import Components

SIZES = girder_assemblies.Params(
    type="row", section="i", parts=2, length_mm=1400.0, width_mm=420.0, height_mm=600.0, flange_mm=20.0, web_mm=12.0
)
BOLTS = bolt_holes.Params()
HOLES = 12  # of a girder's end: 24 a joint
TOLERANCE_MM = 0.01


def shells(shape):
    return cq.Compound.makeCompound([shell for solid in shape.Solids() for shell in solid.Shells()])


def test_a_joint_has_24_holes():
    for part in girder_assemblies.build(SIZES, BOLTS).parts:
        assert len(part.girder.bores) == HOLES


def test_the_mesh_of_a_girder_encloses_the_volume_of_its_solid():
    for part in girder_assemblies.build(SIZES, BOLTS).parts:
        vertices, faces = part.mesh()
        corners = (vertices - vertices.mean(axis=0))[faces]
        volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
        # Bores are polygons in the mesh: of 64 corners, smaller than the circle by 1.6 parts in a thousand.
        bores = sum(np.pi * b.radius**2 * np.linalg.norm(b.end - b.start) for b in part.girder.bores)
        solid = prismatic_solids.solid(part.made_of).Volume()
        # Differences of volumes of 1e8 mm3 in float64.
        assert volume - solid == pytest.approx(bores * (1.0 - np.sin(2 * np.pi / 64) * 64 / (2 * np.pi)), rel=1e-8)


@pytest.mark.parametrize("mode", ["surface", "rays"])
def test_scanned_points_of_a_girder_lie_on_its_drilled_solid(mode):
    settings = {"surface": {"spacing_mm": 12.0, "sigma_mm": 0.0}, "rays": QUIET}[mode]
    scene, truth, shifts = made(seed=2, scan=settings, mode=mode)
    drilled = girder_assemblies.build(SIZES, BOLTS, shifts)
    rng = np.random.default_rng(0)
    for part, scan, T in zip(drilled.parts, scene.scans, truth.arch.T_bridge_scan, strict=True):
        solid = shells(prismatic_solids.solid(part.made_of))
        points = scan.points @ T[:3, :3].T + T[:3, 3]
        in_bore = np.zeros(len(points), bool)
        for bore in part.girder.bores:
            axis = part.girder.T[:3, :3] @ np.array([0.0, *(bore.end - bore.start)])
            middle = part.girder.T[:3, :3] @ (bore.middle + bore.shift) + part.girder.T[:3, 3]
            depth = np.linalg.norm(axis)
            along = (points - middle) @ axis / depth
            off = np.linalg.norm(points - middle - along[:, None] * axis / depth, axis=1)
            in_bore |= (np.abs(along) < 0.5 * depth - 0.1) & (off < bore.radius + 0.5)
        assert in_bore.sum() > 12
        for rows in (np.flatnonzero(in_bore), np.flatnonzero(~in_bore)):
            few = points[rng.choice(rows, min(len(rows), 8), replace=False)]
            assert max(cq.Vertex.makeVertex(*p).distance(solid) for p in few) < TOLERANCE_MM


QUIET = {
    "scanner": "plain-2mm",
    "step_mrad": 4.0,
    "stations": [4],
    "distance_mm": 1500.0,
    "sub_rays": 1,
}


def made(seed, scan, mode="surface", hole_mm=1.0, bolts=True):
    recipe = {
        "kind": "assembly",
        "assembly": {
            "type": "row", "section": "i", "parts": 2, "length_mm": 1400.0, "width_mm": 420.0, "height_mm": 600.0,
            "flange_mm": 20.0, "web_mm": 12.0,
        },
        **({"bolts": {}} if bolts else {}),
        "asbuilt": {"hole_mm": hole_mm},
        "scan": {"mode": mode, **scan},
    }  # fmt: skip
    if mode == "rays":
        recipe["scanner"] = {"noise_mm": 0.0}
    scene, truth = scenes.make("bolted", recipe, seed)
    if not bolts:
        return scene, truth, {}
    noted = {
        (what, where): value
        for what, where, value in zip(truth.as_built.what, truth.as_built.where, truth.as_built.value, strict=True)
    }
    shifts = {
        part.name: np.array(
            [[noted[f"hole {k + 1}, {a}", part.name] for a in ("along", "left", "up")] for k in range(HOLES)]
        )
        for part in scene.arch.parts
    }
    return scene, truth, shifts


def test_holes_are_drilled_off_their_places_along_their_plates():
    _, _, shifts = made(seed=5, scan={"spacing_mm": 500.0})
    for part in girder_assemblies.build(SIZES, BOLTS).parts:
        for bore, shift in zip(part.girder.bores, shifts[part.name], strict=True):
            assert shift @ np.array([0.0, *(bore.end - bore.start)]) == pytest.approx(0.0, abs=1e-12)  # float64
    drawn = np.concatenate([np.concatenate(list(made(s, {"spacing_mm": 500.0})[2].values())) for s in range(4)])
    across = np.linalg.norm(drawn, axis=1) ** 2
    assert across.mean() == pytest.approx(2.0, rel=0.35)  # two coordinates of 1 mm each, 96 draws: sd 10 %


@pytest.mark.parametrize("changes", [{"hole_mm": 200.0}, {"pitch_mm": 20.0}, {"web_bolts": 30}])
def test_holes_that_do_not_fit_are_refused(changes):
    with pytest.raises(UsageError, match=r"bolts\."):
        girder_assemblies.build(SIZES, bolt_holes.Params(**changes))


def test_only_rows_of_i_girders_have_bolts():
    with pytest.raises(UsageError, match="bolts"):
        girder_assemblies.build(girder_assemblies.Params(type="node"), BOLTS)


@pytest.mark.parametrize("section", ["i", "stiffened-box"])
def test_nodes_of_other_sections_than_plain_boxes_are_refused(section):
    with pytest.raises(UsageError, match=r"assembly\.section"):
        girder_assemblies.Params(type="node", section=section)


# --- the holes of a girder as the processor measures them


def without_motion(places, shifts):
    """Shifts (n, 2) less the best-fit motion of the group (Kabsch)."""
    a = places + shifts - (places + shifts).mean(axis=0)
    b = places - places.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    return a @ u @ np.diag([1.0, np.linalg.det(u @ vt)]) @ vt - b


def test_holes_of_girders_are_measured_where_they_were_drilled():
    scene, truth, shifts = made(seed=7, scan={"spacing_mm": 4.0, "sigma_mm": 0.3})
    names = tuple(part.name for part in scene.arch.parts)
    table = Components(
        name=names, status=(Status.OK,) * 2, reasons=((),) * 2, scans=names, T_bridge_scan=truth.arch.T_bridge_scan,
        covariance=np.zeros((2, 6, 6)), key_points_scan=np.zeros((2, 2, 8, 3)), key_points_sd=np.zeros((2, 2, 8, 3)),
    )  # fmt: skip
    drilled = bridge_holes.of_parts(scene, SimpleNamespace(components=table, method="adjustment"))
    found = bridge_holes.characteristics(drilled)
    held = []
    for part in girder_assemblies.build(SIZES, BOLTS).parts:
        bores = part.girder.bores
        web = [k for k, bore in enumerate(bores) if abs(bore.end[0] - bore.start[0]) > 1e-6]
        places = np.array([bores[k].middle for k in web])[:, [0, 2]]
        true = without_motion(places, shifts[part.name][web][:, [0, 2]])
        centred = places - places.mean(axis=0)
        by_id = {one.of: one for one in found[part.name]}
        assert sum(id_.endswith("diameter") for id_ in by_id) == HOLES
        assert sum(id_.endswith("along") for id_ in by_id) == len(web)  # two holes of a flange have a pitch alone
        for k in range(1, HOLES + 1):
            if f"hole-{k}-along" not in by_id:
                continue
            one, other = by_id[f"hole-{k}-along"], by_id[f"hole-{k}-across"]
            # Along is that of the girder; across may look either way.
            # Nominal places are those of polygons of 64 corners.
            sign = 1.0 if np.isclose(centred, [one.nominal, other.nominal], atol=0.01).all(axis=1).any() else -1.0
            row = int(np.argmin(np.linalg.norm(centred - [one.nominal, sign * other.nominal], axis=1)))
            np.testing.assert_allclose(centred[row], [one.nominal, sign * other.nominal], atol=0.01)  # the same
            held.append(one.low <= true[row, 0] <= one.high)
            assert abs(one.value - true[row, 0]) < 2.3 * one.wider_side  # 4.5 standard deviations
            assert one.wider_side < 0.25  # some 35 points of 0.3 mm a bore
        pitches = [one for id_, one in by_id.items() if id_.startswith("pitch")]
        assert len(pitches) == 2 + 10  # of each flange one; of two by four in the web ten
    assert np.mean(held) > 0.7  # of 16
    joint = {one.of: one for one in splices.of_joints(scene.arch, drilled)[scene.arch.joint_names[0]]}
    assert list(joint) == [*(f"plate-{k}-pass-through" for k in (1, 2, 3)), "splice-pass-through"]
    assert all(one.low <= one.value <= one.high and not one.reasons for one in joint.values())


def test_a_bridge_without_holes_has_none():
    scene, _, _ = made(seed=7, scan={"spacing_mm": 100.0}, bolts=False)
    assert bridge_holes.of_parts(scene, None) == []
