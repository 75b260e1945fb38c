"""Bad models: messages on bodies that overlap, shells, names and sizes, and what is done to a design's mesh."""

import json
import logging
import re

import cadquery as cq
import pytest
import trimesh

from designgen import __main__
from designgen.cad import faults
from designgen.models import loading

BOX = trimesh.creation.box((400.0, 300.0, 200.0))


def assembly(**shapes):
    made = cq.Assembly(name="parts")
    for name, shape in shapes.items():
        made.add(shape, name=name)
    return made


def overlaps(**shapes):
    model = loading.load(assembly(**shapes))
    bodies = [faults.Named(body.name, body.vertices, body.triangles, True) for body in model.bodies]
    return [(*pair[:2], pytest.approx(pair[2], abs=1e-6)) for pair in faults.overlapping(bodies)]  # float64


@pytest.mark.parametrize("gap", [-40.0, -0.3, -0.05, 0.0, 5.0])
def test_bodies_that_overlap_and_bodies_that_touch(gap):
    beam = cq.Solid.makeBox(300, 50, 50, cq.Vector(100 + gap, 25, 25))
    found = overlaps(plate=cq.Solid.makeBox(100, 100, 100), beam=beam)
    assert found == ([("plate", "beam", -gap)] if gap < -0.1 else [])


def test_a_bolt_in_its_hole_touches_and_one_in_the_full_overlaps():
    bolt = cq.Solid.makeCylinder(10, 500, cq.Vector(0, 0, -200))
    plate = cq.Workplane().box(100, 100, 30)
    assert overlaps(plate=plate.faces(">Z").workplane().hole(20).val(), bolt=bolt) == []
    ((first, second, depth),) = overlaps(plate=plate.val(), bolt=bolt)
    assert (first, second) == ("plate", "bolt")
    assert 8.0 < depth.expected <= 15.0 + 1e-6  # half the plate, or the bolt's radius
    inside = overlaps(plate=plate.val(), pin=cq.Solid.makeBox(4, 4, 4, cq.Vector(10, 10, -2)))
    assert [pair[:2] for pair in inside] == [("plate", "pin")], "wholly inside"


@pytest.mark.usefixtures("cad_here")
def test_faults_of_a_model_are_reported_on_import_and_on_scan(tmp_path, monkeypatch, capsys, caplog):
    web, rib = cq.Solid.makeBox(400, 300, 20), cq.Solid.makeBox(20, 300, 200, cq.Vector(10, 0, 5))
    shell = cq.Workplane().box(100, 100, 100).faces("<X").val()
    path = tmp_path / "part.step"
    cq.exporters.export(cq.Workplane(obj=cq.Compound.makeCompound([web, rib, shell])), str(path))
    monkeypatch.setattr("sys.argv", ["designgen", "import", str(path), "-o", str(tmp_path / "meshes")])
    with pytest.raises(SystemExit) as ended:
        __main__.main()
    assert not ended.value.code
    said = [line.removeprefix(f"{path}: ") for line in capsys.readouterr().err.splitlines()]
    said = [line for line in said if "part" in line]
    assert said[0] == "3 bodies have no names in the file: they are numbered, as part-1"
    assert said[1] == "'part-3' is not closed: written as it is; check it in the CAD program"
    assert re.match(r"'part-1' and 'part-2' overlap by (9\.\d|10\.0) mm: they are taken as they are", said[2])
    assert json.loads((tmp_path / "meshes/import.json").read_text())["notes"] == said
    with caplog.at_level(logging.WARNING, "designgen"):
        loading.log_notes(loading.load(assembly(web=web, rib=rib)))
    (line,) = (line for line in caplog.messages if "overlap" in line)
    assert re.match(r"model: 'web' and 'rib' overlap by (9\.\d|10\.0) mm: they are taken as they are", line)


@pytest.mark.parametrize(("scale", "doubted"), [(1.0, False), (0.001, True), (1e5, True)])
def test_implausible_size_of_a_model_gives_a_warning_about_its_unit(scale, doubted, caplog):
    with caplog.at_level(logging.WARNING, "designgen"):
        loading.log_notes(loading.load((scale * BOX.vertices, BOX.faces)))
    assert any("is its unit right?" in line for line in caplog.messages) == doubted


def test_mesh_without_a_unit_is_reported_with_its_size_in_mm(tmp_path):
    BOX.export(tmp_path / "box.stl")
    assert (
        "taken as mm, 400 x 300 x 200 mm in all; state another by --units"
        in loading.load(tmp_path / "box.stl").notes[0]
    )
