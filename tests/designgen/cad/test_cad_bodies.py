"""Bodies of CAD files: closed where they are, curved ones of any size, under the names of their occurrences."""

import re

import cadquery as cq
import ifcopenshell
import numpy as np
import pytest
import trimesh
from OCP.BRepGProp import BRepGProp
from OCP.GProp import GProp_GProps

from designgen.cad import files, process, shapes, tessellation
from processor.model import InputError
from processor.scan_folder import guess

pytestmark = pytest.mark.usefixtures("cad_here")


def curved_rib(span_mm, scale=1.0):
    """A plate of 40 mm along an arch, from splines, extruded by 1 m."""
    x = scale * span_mm * np.linspace(-0.5, 0.5, 9)
    lower = [(float(a), float(0.25 * span_mm - a * a / span_mm)) for a in x]
    upper = [(a, b + 40.0) for a, b in lower]
    face = cq.Workplane("XZ").moveTo(*lower[0]).spline(lower[1:], includeCurrent=True)
    face = face.lineTo(*upper[-1]).spline(upper[-2::-1], includeCurrent=True).close()
    return face.extrude(1000.0).val()


@pytest.mark.parametrize("span_mm", [600.0, 6000.0])
def test_a_curved_plate_of_any_size_becomes_a_closed_mesh(span_mm):
    rib = curved_rib(span_mm)
    body = shapes.body_of("a.step", "rib", rib.wrapped, 1.0, solid=True)
    exact = GProp_GProps()
    BRepGProp.VolumeProperties_s(rib.wrapped, exact)
    mesh = trimesh.Trimesh(body.vertices, body.faces, process=False)
    assert body.closed
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(exact.Mass(), abs=body.deviation_mm * mesh.area)
    assert mesh.volume == pytest.approx(exact.Mass(), rel=1e-5)
    assert body.deviation_mm <= 0.1


def test_a_face_that_cannot_be_meshed_is_named_with_its_body(monkeypatch):
    box = cq.Workplane().box(400.0, 300.0, 200.0).val()
    monkeypatch.setattr(tessellation, "_is_empty", lambda mesh: mesh is None or mesh.Node(1).Z() > 99.0)
    problem = shapes.body_of("a.step", "web", box.wrapped, 1.0, solid=True)
    assert re.fullmatch(r"'web': face \d at -?[\d.]+ -?[\d.]+ -?[\d.]+ mm.* cannot be meshed, so that .*", problem)


def test_occurrences_of_a_sub_assembly_keep_the_names_of_their_assemblies(tmp_path):
    plate, half = cq.Workplane().box(100, 50, 20), cq.Assembly(name="half")
    for k, name in enumerate(("left", "right")):
        half.add(plate, name=name, loc=cq.Location(cq.Vector(0, 0, 100 * k)))
    whole = cq.Assembly(name="top")
    for name, x in (("A", 1000), ("B", -1000)):
        whole.add(half, name=name, loc=cq.Location(cq.Vector(x, 0, 0)))
    whole.export(str(tmp_path / "a.step"))
    found = {body.name: body.vertices.mean(axis=0).round(6).tolist() for body in files.read(tmp_path / "a.step").bodies}
    places = [[1000, 0, 0], [1000, 0, 100], [-1000, 0, 0], [-1000, 0, 100]]
    assert found == dict(zip(("A/left", "A/right", "B/left", "B/right"), places, strict=True))


def beam_with_opening(path):
    """A beam of 200 x 100 x 3000 mm with an opening through it of 100 x 100 x 200 mm."""
    model = ifcopenshell.file(schema="IFC4")
    make, new = model.create_entity, ifcopenshell.guid.new

    def frame(*origin):
        return make("IfcAxis2Placement3D", make("IfcCartesianPoint", [float(x) for x in origin]))

    context = make("IfcGeometricRepresentationContext", None, "Model", 3, 1e-5, frame(0, 0, 0), None)
    units = make("IfcUnitAssignment", [make("IfcSIUnit", None, "LENGTHUNIT", "MILLI", "METRE")])
    make("IfcProject", new(), None, "p", None, None, None, None, [context], units)

    def box(kind, name, origin, sizes):
        middle = make("IfcAxis2Placement2D", make("IfcCartesianPoint", [0.0, 0.0]))
        profile = make("IfcRectangleProfileDef", "AREA", None, middle, *map(float, sizes[:2]))
        up = make("IfcDirection", [0.0, 0.0, 1.0])
        solid = make("IfcExtrudedAreaSolid", profile, frame(*origin), up, float(sizes[2]))
        shape = make("IfcShapeRepresentation", context, "Body", "SweptSolid", [solid])
        return make(
            kind,
            GlobalId=new(),
            Name=name,
            ObjectPlacement=make("IfcLocalPlacement", None, frame(0, 0, 0)),
            Representation=make("IfcProductDefinitionShape", None, None, [shape]),
        )

    beam = box("IfcBeam", "B1", (0, 0, 0), (200, 100, 3000))
    opening = box("IfcOpeningElement", "O1", (0, 0, 1000), (100, 300, 200))
    make("IfcRelVoidsElement", new(), RelatingBuildingElement=beam, RelatedOpeningElement=opening)
    model.write(str(path))


def test_a_beam_with_an_opening_in_ifc_is_closed(tmp_path):
    beam_with_opening(tmp_path / "a.ifc")
    (body,) = files.read(tmp_path / "a.ifc").bodies
    assert body.closed
    assert body.volume_mm3 == pytest.approx(200.0 * 100.0 * 3000.0 - 100.0 * 100.0 * 200.0)


@pytest.mark.parametrize(
    ("name", "coding"),
    [
        ("Träger Größe ÜBER", "latin-1"),
        ("poutre n° 3 – côté", "cp1252"),
        ("钢梁 腹板 H型钢", "gb18030"),
        ("桁", "gb18030"),
        ("Träger 梁", "utf-8"),
    ],
)
def test_names_beyond_ascii_are_read_in_the_encoding_that_they_have(name, coding):
    assert process.escaped(f"#1=PRODUCT('{name}')".encode(coding)) == process.escape(f"#1=PRODUCT('{name}')").encode()


def test_a_design_that_cannot_be_read_is_no_structure(tmp_path):
    (tmp_path / "scans").mkdir()
    np.savetxt(tmp_path / "scans/S1.xyz", np.random.default_rng(0).uniform(0, 1000, (200, 3)))
    (tmp_path / "bridge.stl").write_text("solid bridge\nfacet normal 0 0 0\n")
    with pytest.raises(InputError, match=r"bridge\.stl: is cut off"):
        guess.guess(tmp_path)
