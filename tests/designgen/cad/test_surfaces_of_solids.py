"""Scanned surfaces of every type of component against the CAD kernel's own distance to its CadQuery solid."""

import cadquery as cq
import numpy as np
import pytest
from OCP.Bnd import Bnd_Box
from OCP.BRepBndLib import BRepBndLib

from designgen import batch
from designgen.designs import arch_part, boxes_and_tubes, defect_specimens, stadium_roof, truss_bridge
from designgen.export import folder as export_folder
from designgen.export import step_files
from designgen.randomness import generator
from designgen.scanning import returns, sampler, scanner, space_frame_surfaces
from designgen.scanning.surfaces import Builder
from designgen.scanning.survey import levelled_pose
from designgen.scenes import make
from designgen.scenes import model as models
from processor.store import store
from tests.support.made import made
from tests.support.solids import built_solids

TOLERANCE_MM = 0.01  # of points on a CAD model, stated in docs/simulation.md
QUIET = scanner.Scanner(**{**scanner.preset("phase"), "flying_share": 0.0, "threshold": 0.0})
COUNT = 5  # points of each kind of face, which lies wrong as a whole or not: the kernel takes milliseconds for each


def departures(points, shape):
    """Distances to the nearest faces of a shape's shells; infinite where no face's box is within TOLERANCE_MM."""
    faces = [face for solid in shape.Solids() for shell in solid.Shells() for face in shell.Faces()]
    low, high = np.array([box_of(face) for face in faces]).reshape(-1, 2, 3).transpose(1, 0, 2)
    near = ((low - TOLERANCE_MM <= points[:, None]) & (points[:, None] <= high + TOLERANCE_MM)).all(axis=2)
    vertices = [cq.Vertex.makeVertex(*point) for point in points]
    return np.array(
        [
            min((vertex.distance(faces[k]) for k in np.flatnonzero(row)), default=np.inf)
            for vertex, row in zip(vertices, near, strict=True)
        ]
    )


def box_of(face):
    """Least and greatest coordinates of a box that holds a face, by the poles of its surface."""
    box = Bnd_Box()
    BRepBndLib.Add_s(face.wrapped, box, False)
    return box.Get()


def hits(builder, places, step_mrad=6.0):
    """Places that whole footprints hit from stations, without any error, and the names of their faces."""
    surfaces, found, names = builder.to_surfaces(), [], []
    for number, place in enumerate(places):
        T = levelled_pose(np.array(place), 0.3 * number)
        params = scanner.Params(step_mrad=step_mrad)
        seen = returns.scan_station(surfaces, T, QUIET, params, 1, f"S{number}", keep_hits=True).returns
        clean = seen.source == 0
        found.append(seen.hits[clean] @ T[:3, :3].T + T[:3, 3])
        names.append(np.array([*surfaces.surface_names, ""])[seen.surface[clean]])
    return np.concatenate(found), np.concatenate(names)


def of_patches(patches):
    builder = Builder()
    for part, patch in patches:
        builder.patch(part, patch)
    return builder


def around(low, high, ways):
    """Places beside a body, as far from its middle as it is long."""
    return [0.5 * (low + high) + float((high - low).max()) * np.array(way) for way in ways]


def check(points, kinds, shape):
    """Some points of each kind of face lie on a shape; returns the kinds."""
    rng, kinds = np.random.default_rng(0), np.array(kinds)
    few = [rng.permutation(np.flatnonzero(kinds == kind))[:COUNT] for kind in np.unique(kinds)]
    assert departures(points[np.concatenate(few)], shape).max() < TOLERANCE_MM
    return set(kinds.tolist())


@pytest.mark.parametrize("built", [pytest.param(False, marks=pytest.mark.slow), True], ids=["as designed", "as built"])
def test_rays_and_samples_meet_frames_where_their_solids_are(built):
    frame, solid, builder = built_solids.frame(built), made(built_solids.frame_solid, built), Builder()
    space_frame_surfaces.add_frame(builder, frame)
    seen = check(*hits(builder, [(400.0, 500.0, 4000.0), (2500.0, -600.0, 4400.0)], 4.0), solid)
    assert {"ball", "sleeve", "cone", "tube"} <= seen
    cloud = sampler.scan_frame(frame, sampler.Params(spacing_mm=40.0, sigma_mm=0.0), generator(0, "x"))
    check(cloud.points, cloud.part, solid)


@pytest.mark.parametrize(
    ("name", "built"),
    [
        pytest.param("rib", False, marks=pytest.mark.slow),
        pytest.param("rib", True, marks=pytest.mark.slow),
        ("foot", True),
        pytest.param("segment", True, marks=pytest.mark.slow),
    ],
)
def test_rays_meet_parts_of_arches_and_rings_where_their_solids_are(name, built):
    part, solid = built_solids.arch(name, built), made(built_solids.arch_solid, name, built)
    assert solid.isValid()
    middle = part.key_points(0.5 * (part.s0 + part.s1)).mean(axis=0)
    ahead = part.key_points(part.s1).mean(axis=0)
    aside = np.array([0.0, 4000.0, 1500.0])
    places = [middle + aside, middle - aside, ahead + 1.2 * (ahead - middle)]
    seen = check(*hits(of_patches((0, patch) for patch in arch_part.ray_patches(part)), places), solid)
    assert {"outer-top", "outer-left", "outer-right", *(["pad"] if name != "segment" else [])} <= seen
    assert any(kind.startswith("inner") for kind in seen)


GIRDERS = [("node", "box", 0), ("ribs", "box", 1), ("row", "stiffened-box", 0), ("row", "i", 1)]
GIRDER_WAYS = ([0.3, -0.8, 0.4], [-0.9, 0.3, 0.2], [0.1, 0.9, 0.1])


@pytest.mark.parametrize("which", GIRDERS)
def test_the_faces_of_a_part_of_an_assembly_enclose_the_volume_of_its_solid(which):
    solid = made(built_solids.designed_girder_solid, *which)
    assert solid.isValid()
    assert len(solid.Solids()) == 1
    vertices, faces = built_solids.designed_girder(*which).mesh()
    corners = (vertices - vertices.mean(axis=0))[faces]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert volume == pytest.approx(solid.Volume(), rel=1e-9)  # sums of float64; no face is missing


@pytest.mark.parametrize(
    "which", [GIRDERS[0], *(pytest.param(one, marks=pytest.mark.slow) for one in (*GIRDERS[1:3], (*GIRDERS[3], True)))]
)
def test_rays_meet_parts_of_assemblies_as_built_where_their_solids_are(which):
    part, solid = built_solids.girder(*which), made(built_solids.girder_solid, *which)
    assert solid.isValid()
    vertices = part.mesh()[0]
    places = around(vertices.min(axis=0), vertices.max(axis=0), GIRDER_WAYS)
    points, names = hits(of_patches((0, patch) for patch in part.built()), places, 6.0)
    seen = check(points, [name.split("-")[0].rstrip("0123456789") for name in names], solid)
    assert {"pad", "start" if which[0] != "node" else "chord", *(["bore"] if len(which) > 3 else [])} <= seen
    assert np.abs(part.displacement(vertices)).max() > 1.0


@pytest.mark.parametrize(
    "components",
    [
        defect_specimens.build(defect_specimens.Params(form="girder", components=("none", "step"))),
        pytest.param(truss_bridge.build(truss_bridge.Params())[:12], marks=pytest.mark.slow),
        pytest.param(stadium_roof.build(stadium_roof.Params())[:3], marks=pytest.mark.slow),
    ],
    ids=["girders", "truss", "roof"],
)
def test_rays_meet_structures_where_their_solids_are(components):
    patches = [(part, patch) for part, component in enumerate(components) for patch in component.patches]
    corners = np.vstack([p.at(p.p[[0, -1, -1, 0]], p.q[[0, 0, -1, -1]]) for _, p in patches])
    places = around(corners.min(axis=0), corners.max(axis=0), GIRDER_WAYS[:2])
    points, names = hits(of_patches(patches), places, 4.0)
    assert len(points) > 500
    solid, bodies = boxes_and_tubes.solid(components), [body for one in components for body in one.bodies]
    assert solid.isValid()
    assert solid.Volume() == pytest.approx(sum(volume_of(body) for body in bodies), rel=1e-6)  # that of the kernel
    check(points, names, solid)


def volume_of(body):
    if isinstance(body, boxes_and_tubes.Tube):
        return np.pi * body.radius**2 * np.linalg.norm(body.end - body.start)
    return float(np.prod(body.size))


def test_bodies_as_built_go_out_as_step(tmp_path):
    """Moved and turned bodies of a Python file: the points scanned lie on the solids that are read."""
    (tmp_path / "parts.py").write_text(
        "import cadquery as cq\n"
        "result = cq.Assembly().add(cq.Solid.makeBox(900, 400, 300), name='a')\n"
        "result.add(cq.Solid.makeCylinder(90, 700, cq.Vector(1500, 0, 0)), name='b')\n"
        "result.add(cq.Solid.makeBox(9, 9, 9), name='c')\n"
    )
    settings = ["asbuilt.b.move_mm=[5.0, -3.0, 8.0]", "asbuilt.b.turn_deg=[0.5, 0.0, 2.0]", "asbuilt.c.missing=true"]
    settings += ["scan.step_mrad=8.0", "scanner.noise_mm=0.0005"]
    recipe = models.recipe_of(str(tmp_path / "parts.py"), 3, "plain-2mm", "", settings)
    batch.make_scene(tmp_path / "s.h5", "parts", recipe, 1)
    export_folder.export(tmp_path / "s.h5", tmp_path / "out", "ply", with_truth=True, step=True)
    assert len(cq.importers.importStep(str(tmp_path / "out/design/structure.step")).solids().vals()) == 3
    built = cq.importers.importStep(str(tmp_path / "out/as-built/structure.step")).solids().vals()
    assert len(built) == 2
    scans = store.read_scene(tmp_path / "s.h5").scans
    points = np.concatenate([scan.points @ scan.pose[:3, :3].T + scan.pose[:3, 3] + scan.origin for scan in scans])
    rows = np.random.default_rng(2).choice(len(points), 6 * COUNT, replace=False)
    assert departures(points[rows], cq.Compound.makeCompound(built)).max() < TOLERANCE_MM
    export_folder.export(tmp_path / "s.h5", tmp_path / "blind", "ply", with_truth=False, step=True)
    assert not (tmp_path / "blind/as-built").exists()


ERRORS = {"length_mm": 2.0, "skew_mrad": 1.0, "corner_mm": 1.0}
SMALL = {"nodes_x": 2, "nodes_y": 1, "layers": 1, "spacing_mm": 1500.0}
AS_BUILT = {
    "ring": {"ring": {"parts": 3, "radius_mm": 800.0}, "asbuilt": {**ERRORS, "bow_mm": 2.0}},
    "assembly": {"assembly": {"type": "node"}, "asbuilt": ERRORS},
    "space-frame": {"frame": SMALL, "asbuilt": {"node_movement_mm": 3.0, "bow_share": 0.002, "eccentricity_mm": 1.0}},
}


@pytest.mark.parametrize(
    "kind",
    [pytest.param("ring", marks=pytest.mark.slow), pytest.param("assembly", marks=pytest.mark.slow), "space-frame"],
)
def test_scans_lie_on_the_solids_as_built_that_are_exported(kind, tmp_path):
    recipe = {"kind": kind, "seed": 1, "scan": {"mode": "surface", "spacing_mm": 60.0, "sigma_mm": 0.0}}
    scene, truth = make.make(kind, recipe | AS_BUILT[kind], 4)
    files = step_files.write_as_built(recipe | AS_BUILT[kind], 4, tmp_path / "as-built")
    solids = [solid for file in files for solid in cq.importers.importStep(str(file)).solids().vals()]
    for number, one in enumerate(scene.scans):
        T = np.eye(4) if truth.arch is None else truth.arch.T_bridge_scan[number]
        points = one.points[:: len(one.points) // (2 * COUNT) + 1] @ T[:3, :3].T + T[:3, 3]
        assert departures(points, cq.Compound.makeCompound(solids)).max() < TOLERANCE_MM
