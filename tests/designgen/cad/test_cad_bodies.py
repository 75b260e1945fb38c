"""Bodies of CAD files: closed where they are, curved ones of any size, under the names of their occurrences."""

import re

import cadquery as cq
import numpy as np
import pytest
import trimesh
from OCP.BRepGProp import BRepGProp
from OCP.GProp import GProp_GProps

from designgen.cad import files, process, shapes, tessellation

pytestmark = pytest.mark.usefixtures("cad_here")


def curved_rib(span_mm, scale=1.0):
    """A plate of 40 mm along an arch, from splines, extruded by 1 m."""
    x = scale * span_mm * np.linspace(-0.5, 0.5, 9)
    lower = [(float(a), float(0.25 * span_mm - a * a / span_mm)) for a in x]
    upper = [(a, b + 40.0) for a, b in lower]
    face = cq.Workplane("XZ").moveTo(*lower[0]).spline(lower[1:], includeCurrent=True)
    face = face.lineTo(*upper[-1]).spline(upper[-2::-1], includeCurrent=True).close()
    return face.extrude(1000.0).val()


@pytest.mark.parametrize("span_mm", [600.0, pytest.param(6000.0, marks=pytest.mark.slow)])
def test_a_curved_plate_of_any_size_becomes_a_closed_mesh(span_mm):
    rib = curved_rib(span_mm)
    body = shapes.body_of("a.step", "rib", rib.wrapped, 1.0, solid=True)
    exact = GProp_GProps()
    BRepGProp.VolumeProperties_s(rib.wrapped, exact)
    mesh = trimesh.Trimesh(body.vertices, body.faces, process=False)
    assert body.closed
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(exact.Mass(), abs=body.deviation_mm * mesh.area)  # as stated
    assert mesh.volume == pytest.approx(exact.Mass(), rel=1e-5)  # 0.1 mm on a plate of 40 mm, mean of both sides
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
