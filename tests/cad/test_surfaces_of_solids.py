"""Scanned surfaces of every type of component against the CAD kernel's own distance to its CadQuery solid."""

import dataclasses

import cadquery as cq
import numpy as np
import pytest
from OCP.Bnd import Bnd_Box
from OCP.BRepBndLib import BRepBndLib

from designgen import batch
from designgen.asbuilt import imperfections
from designgen.designs import (
    arch_bridge,
    arch_part,
    bolt_holes,
    boxes_and_tubes,
    closed_ring,
    defect_specimens,
    girder_assemblies,
    prismatic_solids,
    space_frame,
    stadium_roof,
    truss_bridge,
)
from designgen.export import folder as export_folder
from designgen.randomness import generator
from designgen.scanning import returns, sampler, scanner, space_frame_surfaces
from designgen.scanning.surfaces import Builder
from designgen.scanning.survey import levelled_pose
from designgen.scenes import assembly
from designgen.scenes import model as models
from processor.store import store

TOLERANCE_MM = 0.01
QUIET = scanner.Scanner(**{**scanner.preset("phase"), "flying_share": 0.0, "threshold": 0.0})
COUNT = 25  # points of each kind of face: the kernel takes some milliseconds each


def departures(points, shells):
    """Distances to the nearest faces; infinite where no face's box is within TOLERANCE_MM of a point."""
    faces = [face for shell in shells for face in shell.Faces()]
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


def hits(builder, places, step_mrad):
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


def shells_of(shape):
    return [shell for solid in shape.Solids() for shell in solid.Shells()]


def of_each(points, names, rng):
    """Some points of each kind of face, by the first word of its name."""
    for name in np.unique(names):
        rows = np.flatnonzero(names == name)
        yield str(name), points[rng.choice(rows, min(len(rows), COUNT), replace=False)]


# --- bolt balls, sleeves, cones and tubes -----------------------------------------------------------------------------

SMALL = space_frame.Params(nodes_x=2, nodes_y=2, layers=2, spacing_mm=1500.0, depth_mm=1100.0, radii_mm=(60.0, 75.0))
BUILT = imperfections.FrameParams(
    node_movement_mm=3.0, radius_mm=0.4, wrong_sizes=1, temperature_C=35.0, eccentricity_mm=1.5, bow_share=0.002,
    missing_bolts=3,
)  # fmt: skip


@pytest.mark.parametrize("built", [False, True], ids=["as designed", "as built"])
def test_rays_meet_frames_where_their_solids_are(built):
    frame = space_frame.build(SMALL)
    if built:
        frame = imperfections.frame(frame, BUILT, generator(3, "built"), imperfections.Ledger())
    builder = Builder()
    space_frame_surfaces.add_frame(builder, frame)
    points, names = hits(builder, [(400.0, 500.0, 4000.0), (2500.0, -600.0, 4400.0)], 2.0)
    shells, seen = shells_of(space_frame.solid(frame)), set()
    for name, few in of_each(points, names, np.random.default_rng(0)):
        seen.add(name)
        assert departures(few, shells).max() < TOLERANCE_MM, name
    assert {"ball", "sleeve", "cone", "tube"} <= seen


@pytest.mark.parametrize("built", [False, True], ids=["as designed", "as built"])
def test_samples_of_frames_lie_on_their_solids(built):
    frame = space_frame.build(SMALL)
    if built:
        frame = imperfections.frame(frame, BUILT, generator(3, "built"), imperfections.Ledger())
    cloud = sampler.scan_frame(frame, sampler.Params(spacing_mm=10.0, sigma_mm=0.0), generator(0, "x"))
    picked = np.random.default_rng(1).choice(len(cloud.points), 4 * COUNT, replace=False)
    assert departures(cloud.points[picked], shells_of(space_frame.solid(frame))).max() < TOLERANCE_MM


# --- feet and ribs of arches ------------------------------------------------------------------------------------------

ERRORS = {
    "length_mm": 2.0, "skew_mrad": 1.0, "twist_mrad": 2.0, "bow_mm": 2.0, "section_mm": 1.0, "plate_mm": 0.3,
    "corner_mm": 2.0,
}  # fmt: skip


def arch(built):
    parts = arch_bridge.build(arch_bridge.Params())
    if not built:
        return parts
    errors = imperfections.ArchParams(**ERRORS)
    rngs = [generator(5, f"built {part.name}") for part in parts]
    return imperfections.arch(parts, errors, rngs, imperfections.Ledger())


@pytest.mark.parametrize("built", [False, True], ids=["as designed", "as built"])
@pytest.mark.parametrize("number", [0, 1], ids=["foot", "rib"])
def test_rays_meet_arch_parts_where_their_solids_are(number, built):
    part = arch(built)[number]
    solid = arch_part.solid(part)
    assert solid.isValid()
    builder = Builder()
    for patch in arch_part.ray_patches(part):
        builder.patch(0, patch)
    middle = part.key_points(0.5 * (part.s0 + part.s1)).mean(axis=0)
    ahead = part.key_points(part.s1).mean(axis=0)
    aside = np.array([0.0, 4000.0, 1500.0])
    places = [middle + aside, middle - aside, ahead + 1.2 * (ahead - middle)]
    points, names = hits(builder, places, 4.0)
    seen = set()
    for name, few in of_each(points, names, np.random.default_rng(0)):
        seen.add(name)
        assert departures(few, shells_of(solid)).max() < TOLERANCE_MM, name
    assert {"outer-top", "outer-left", "outer-right", "pad"} <= seen
    assert any(name.startswith("inner") for name in seen)


@pytest.mark.parametrize("built", [False, True], ids=["as designed", "as built"])
def test_rays_meet_segments_of_rings_where_their_solids_are(built):
    parts = closed_ring.build(closed_ring.Params())
    if built:
        rngs = [generator(5, f"built {part.name}") for part in parts]
        parts = imperfections.arch(parts, imperfections.ArchParams(**ERRORS), rngs, imperfections.Ledger())
    part = parts[1]
    builder = Builder()
    for patch in arch_part.ray_patches(part):
        builder.patch(0, patch)
    middle = part.key_points(0.5 * (part.s0 + part.s1)).mean(axis=0)
    places = [middle + np.array([500.0, side * 4000.0, 1500.0]) for side in (-1.0, 1.0)]
    points, names = hits(builder, places, 4.0)
    shells = shells_of(arch_part.solid(part))
    for name, few in of_each(points, names, np.random.default_rng(0)):
        assert departures(few, shells).max() < TOLERANCE_MM, name


@pytest.mark.parametrize(
    ("type_", "section", "number"),
    [("node", "box", 0), ("ribs", "box", 1), ("row", "stiffened-box", 0), ("row", "i", 1)],
    ids=["node", "node of a rib", "stiffened box", "I girder"],
)
def test_rays_meet_parts_of_assemblies_where_their_solids_are(type_, section, number):
    part = girder_assemblies.build(girder_assemblies.Params(type=type_, section=section)).parts[number]
    solid = prismatic_solids.solid(part.made_of)
    assert solid.isValid()
    assert len(solid.Solids()) == 1
    builder = Builder()
    for patch in part.patches:
        builder.patch(0, patch)
    vertices, faces = part.mesh()
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle, size = 0.5 * (low + high), float((high - low).max())
    places = [middle + size * np.array(way) for way in ([0.3, -0.8, 0.4], [-0.9, 0.3, 0.2], [0.1, 0.9, 0.1])]
    points = hits(builder, places, 4.0)[0]
    picked = np.random.default_rng(2).choice(len(points), 4 * COUNT, replace=False)
    assert departures(points[picked], shells_of(solid)).max() < TOLERANCE_MM
    # No face is missing: the mesh of the faces is closed, and encloses the solid's volume.
    corners = (vertices - middle)[faces]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert volume == pytest.approx(solid.Volume(), rel=1e-9)


@pytest.mark.parametrize(
    ("type_", "section", "number", "bolts"),
    [
        ("node", "box", 0, None),
        ("ribs", "box", 1, None),
        ("row", "stiffened-box", 0, None),
        ("row", "i", 1, bolt_holes.Params()),
    ],
    ids=["node", "node of a rib", "stiffened box", "I girder with bolt holes"],
)
def test_rays_meet_parts_of_assemblies_as_built_where_their_solids_are(type_, section, number, bolts):
    recipe = {
        "assembly": {"type": type_, "section": section, "length_mm": 3000.0},
        "asbuilt": {"length_mm": 2.0, "skew_mrad": 2.0, "corner_mm": 2.0, "hole_mm": 0.7},
    }
    if bolts is not None:
        recipe["bolts"] = dataclasses.asdict(bolts)
    part = assembly.built(recipe, 3, imperfections.Ledger())[1][number]
    solid = prismatic_solids.as_built(part)
    assert solid.isValid()
    builder = Builder()
    for patch in part.built():
        builder.patch(0, patch)
    vertices = part.mesh()[0]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle, size = 0.5 * (low + high), float((high - low).max())
    places = [middle + size * np.array(way) for way in ([0.3, -0.8, 0.4], [-0.9, 0.3, 0.2], [0.1, 0.9, 0.1])]
    points, names = hits(builder, places, 4.0)
    kinds = np.array([name.split("-")[0].rstrip("0123456789") for name in names])
    for name, few in of_each(points, kinds, np.random.default_rng(2)):
        assert departures(few, shells_of(solid)).max() < TOLERANCE_MM, name
    assert {"pad", "start" if type_ != "node" else "chord", *({"bore"} if bolts else ())} <= set(kinds)
    moved = part.displacement(vertices)
    assert np.abs(moved).max() > 1.0


# --- plates, girders, tubes of structures -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "components",
    [
        defect_specimens.build(defect_specimens.Params(form="girder", components=("none", "step"))),
        defect_specimens.build(defect_specimens.Params(components=("none", "none"))),
        truss_bridge.build(truss_bridge.Params())[:12],
        stadium_roof.build(stadium_roof.Params())[:3],
    ],
    ids=["girders", "plates", "truss", "roof"],
)
def test_rays_meet_structures_where_their_solids_are(components):
    builder = Builder()
    for part, component in enumerate(components):
        for patch in component.patches:
            builder.patch(part, patch)
    corners = np.vstack([p.at(p.p[[0, -1, -1, 0]], p.q[[0, 0, -1, -1]]) for c in components for p in c.patches])
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle, size = 0.5 * (low + high), float((high - low).max())
    places = [middle + size * np.array([0.3, -0.8, 0.4]), middle + size * np.array([-0.4, 0.9, 0.2])]
    points = hits(builder, places, 4.0)[0]
    assert len(points) > 500
    shells = shells_of(boxes_and_tubes.solid(components))
    picked = np.random.default_rng(2).choice(len(points), 4 * COUNT, replace=False)
    assert departures(points[picked], shells).max() < TOLERANCE_MM


def test_bodies_as_built_go_out_as_step(tmp_path):
    """Moved and turned bodies, of a Python file and of an arch: the points scanned lie on the solids that are read."""
    (tmp_path / "parts.py").write_text(
        "import cadquery as cq\n"
        "result = cq.Assembly().add(cq.Solid.makeBox(900, 400, 300), name='a')\n"
        "result.add(cq.Solid.makeCylinder(90, 700, cq.Vector(1500, 0, 0)), name='b')\n"
        "result.add(cq.Solid.makeBox(9, 9, 9), name='c')\n"
    )
    settings = ["asbuilt.b.move_mm=[5.0, -3.0, 8.0]", "asbuilt.b.turn_deg=[0.5, 0.0, 2.0]", "asbuilt.c.missing=true"]
    settings += ["scan.step_mrad=4.0", "scanner.noise_mm=0.0005"]
    recipe = models.recipe_of(str(tmp_path / "parts.py"), 3, "plain-2mm", "", settings)
    batch.make_scene(tmp_path / "s.h5", "parts", recipe, 1)
    export_folder.export(tmp_path / "s.h5", tmp_path / "out", "ply", with_truth=True, step=True)
    assert len(cq.importers.importStep(str(tmp_path / "out/design/structure.step")).solids().vals()) == 3
    built = cq.importers.importStep(str(tmp_path / "out/as-built/structure.step"))
    assert len(built.solids().vals()) == 2
    scene = store.read_scene(tmp_path / "s.h5")
    points = np.concatenate(
        [scan.points @ scan.pose[:3, :3].T + scan.pose[:3, 3] + scan.origin for scan in scene.scans]
    )
    picked = np.random.default_rng(2).choice(len(points), 2 * COUNT, replace=False)
    assert departures(points[picked], shells_of(cq.Compound.makeCompound(built.solids().vals()))).max() < TOLERANCE_MM
    export_folder.export(tmp_path / "s.h5", tmp_path / "blind", "ply", with_truth=False, step=True)
    assert not (tmp_path / "blind/as-built").exists()


FRAME = {"nodes_x": 2, "nodes_y": 2, "layers": 2, "spacing_mm": 1500.0, "depth_mm": 1100.0}
AS_BUILT_SCENES = {
    "ring": {"ring": {"parts": 3}, "asbuilt": {"length_mm": 2.0, "skew_mrad": 1.0, "corner_mm": 1.0, "bow_mm": 2.0}},
    "assembly": {"assembly": {"type": "node"}, "asbuilt": {"length_mm": 2.0, "skew_mrad": 1.0, "corner_mm": 1.0}},
    "space-frame": {
        "frame": FRAME, "asbuilt": {"node_movement_mm": 3.0, "bow_share": 0.002, "eccentricity_mm": 1.0}
    },
}  # fmt: skip


@pytest.mark.parametrize("kind", AS_BUILT_SCENES)
def test_scans_lie_on_the_solids_as_built_that_are_exported(kind, tmp_path):
    scan = {"mode": "surface", "spacing_mm": 60.0, "sigma_mm": 0.0}
    batch.make_scene(tmp_path / "s.h5", kind, {"kind": kind, "seed": 1, "scan": scan, **AS_BUILT_SCENES[kind]}, 4)
    export_folder.export(tmp_path / "s.h5", tmp_path / "out", "ply", with_truth=True, step=True)
    files = sorted((tmp_path / "out/as-built").iterdir())
    solids = [solid for file in files for solid in cq.importers.importStep(str(file)).solids().vals()]
    scene, truth = store.read_scene(tmp_path / "s.h5"), store.read_truth(tmp_path / "s.h5")
    shells = shells_of(cq.Compound.makeCompound(solids))
    for number, one in enumerate(scene.scans):
        T = np.eye(4) if truth.arch is None else truth.arch.T_bridge_scan[number]
        points = one.points[:: max(1, len(one.points) // COUNT)]
        assert departures(points @ T[:3, :3].T + T[:3, 3], shells).max() < TOLERANCE_MM
