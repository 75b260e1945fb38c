"""CAD files in and out: units said by the file, sizes worked by hand, bad files refused with a reason."""

import json
import subprocess
import sys
from pathlib import Path

import cadquery as cq
import ifcopenshell
import ifcopenshell.api.aggregate
import ifcopenshell.api.context
import ifcopenshell.api.geometry
import ifcopenshell.api.project
import ifcopenshell.api.root
import ifcopenshell.api.unit
import pytest
import trimesh

from designgen import cad_files, recipes
from designgen.designs import arch_bridge, arch_part
from processor.model import InputError, UsageError

ROOT = Path(__file__).resolve().parents[2]
REAL = ROOT.parent / "shared/data/design"


@pytest.fixture
def box(tmp_path):
    """A box of 100 x 200 x 300 mm as STEP."""
    path = tmp_path / "box.step"
    cad_files.write_step(path, {"梁-1": cq.Solid.makeBox(100.0, 200.0, 300.0)})
    return path


def test_a_box_comes_back_in_its_unit(box, tmp_path):
    found = cad_files.read(box)
    (body,) = found.bodies
    assert (found.unit, found.unit_mm, body.solid) == ("millimetre", 1.0, True)
    assert body.size_mm == pytest.approx([100.0, 200.0, 300.0], abs=1e-9)
    assert body.volume_mm3 == pytest.approx(6e6)
    assert body.area_mm2 == pytest.approx(2 * (2e4 + 3e4 + 6e4))
    text = box.read_text()
    assert "SI_UNIT(.MILLI.,.METRE.)" in text
    metre = tmp_path / "metre.stp"
    metre.write_text(text.replace("SI_UNIT(.MILLI.,.METRE.)", "SI_UNIT($,.METRE.)"))
    found = cad_files.read(metre)
    assert (found.unit, found.unit_mm) == ("metre", 1000.0)
    assert found.bodies[0].size_mm == pytest.approx([1e5, 2e5, 3e5])
    asked = cad_files.read(box, "inch")
    assert asked.bodies[0].size_mm == pytest.approx([2540.0, 5080.0, 7620.0])
    assert asked.bodies[0].volume_mm3 == pytest.approx(6e6 * 25.4**3)
    with pytest.raises(UsageError, match="expected one of"):
        cad_files.read(box, "furlong")


def test_surfaces_without_a_solid_are_said_to_be_such(tmp_path):
    cad_files.write_step(tmp_path / "s.step", {"sheet": cq.Shell.makeShell([cq.Face.makePlane(50.0, 20.0)])})
    (body,) = cad_files.read(tmp_path / "s.step").bodies
    assert not body.solid
    assert body.area_mm2 == pytest.approx(1000.0)
    said = cad_files.import_file(tmp_path / "s.step", tmp_path / "out")
    assert said["bodies"][0]["kind"] == "surface"
    assert said["bodies"][0]["volume_mm3"] is None


def wall(path, prefix, sizes):
    """An IFC file with one extruded wall of ``sizes`` in the file's unit."""
    model = ifcopenshell.api.project.create_file(version="IFC4")
    project = ifcopenshell.api.root.create_entity(model, ifc_class="IfcProject", name="p")
    length = ifcopenshell.api.unit.add_si_unit(model, unit_type="LENGTHUNIT", prefix=prefix)
    ifcopenshell.api.unit.assign_unit(model, units=[length])
    context = ifcopenshell.api.context.add_context(model, context_type="Model")
    body = ifcopenshell.api.context.add_context(
        model, context_type="Model", context_identifier="Body", target_view="MODEL_VIEW", parent=context
    )
    made = ifcopenshell.api.root.create_entity(model, ifc_class="IfcWall", name="墙 1")
    x, y, z = map(float, sizes)
    profile = model.create_entity("IfcRectangleProfileDef", ProfileType="AREA", XDim=x, YDim=y)
    place = model.create_entity(
        "IfcAxis2Placement3D", Location=model.create_entity("IfcCartesianPoint", (0.0, 0.0, 0.0))
    )
    up = model.create_entity("IfcDirection", (0.0, 0.0, 1.0))
    solid = model.create_entity("IfcExtrudedAreaSolid", profile, place, up, z)
    shape = model.create_entity("IfcShapeRepresentation", body, "Body", "SweptSolid", [solid])
    ifcopenshell.api.geometry.assign_representation(model, product=made, representation=shape)
    assert project
    model.write(str(path))


@pytest.mark.parametrize(
    ("prefix", "sizes", "unit"), [("MILLI", (4000, 200, 2700), "millimetre"), (None, (4, 0.2, 2.7), "metre")]
)
def test_a_wall_in_ifc_has_its_size_in_any_unit(prefix, sizes, unit, tmp_path):
    wall(tmp_path / "wall.ifc", prefix, sizes)
    found = cad_files.read(tmp_path / "wall.ifc")
    (body,) = found.bodies
    assert (found.unit, body.name, body.solid) == (unit, "墙 1", True)
    assert body.size_mm == pytest.approx([4000.0, 200.0, 2700.0], rel=1e-9)
    assert body.volume_mm3 == pytest.approx(4000.0 * 200.0 * 2700.0)


def test_an_ifc_without_geometry_is_refused(tmp_path):
    model = ifcopenshell.api.project.create_file(version="IFC4")
    ifcopenshell.api.root.create_entity(model, ifc_class="IfcProject", name="p")
    model.write(str(tmp_path / "empty.ifc"))
    with pytest.raises(InputError, match=r"empty\.ifc"):
        cad_files.read(tmp_path / "empty.ifc")


def test_bad_files_are_refused(box, tmp_path):
    content = box.read_bytes()
    for name, data, said in [
        ("cut.step", content[: len(content) // 2], r"cut\.step"),
        ("other.step", b"solid x\nendsolid x\n", "found another kind"),
        ("empty.stp", b"", "found another kind"),
        ("a.dwg", b"AC1027", "expected a CAD file"),
        ("broken.ifc", b"ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\n#1=", r"broken\.ifc"),
        ("none.step", content.split(b"DATA;")[0] + b"DATA;\nENDSEC;\nEND-ISO-10303-21;\n", r"none\.step"),
    ]:
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(InputError, match=said):
            cad_files.import_file(path, tmp_path / "out")
        assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="cannot be read"):
        cad_files.read(tmp_path / "missing.step")


@pytest.mark.parametrize("name", ["base_interface_AP203.STEP", "base_interface_AP214.STEP"])
def test_real_files_in_inches(name, tmp_path):
    path = REAL / name
    if not path.exists():
        pytest.skip("the real data are not here")
    command = [sys.executable, "-m", "designgen", "import", str(path), "-o", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.splitlines()[0].endswith("unit inch (25.4 mm, said by the file)")
    assert len(done.stdout.splitlines()) == 2
    assert done.stderr == ""
    said = json.loads((tmp_path / "out/import.json").read_text("utf-8"))
    (body,) = said["bodies"]
    # A plate of 3/16 inch within a circle of about two feet.
    assert min(body["size_mm"]) == pytest.approx(0.1875 * 25.4, abs=1e-3)
    mesh = trimesh.load(tmp_path / "out" / body["mesh"])
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(body["volume_mm3"], rel=1e-3)


def test_designs_go_out_as_step_and_keep_their_volumes(tmp_path):
    recipe = recipes.load("arch-s1")[1]
    files = cad_files.write_design(recipe, tmp_path / "design")
    bridge = {k: tuple(v) if isinstance(v, list) else v for k, v in recipe["bridge"].items()}
    parts = arch_bridge.build(arch_bridge.Params(**bridge))
    assert [f.stem for f in files] == [part.name for part in parts]
    for path, part in zip(files[:2], parts[:2], strict=True):
        (body,) = cad_files.read(path).bodies
        assert body.volume_mm3 == pytest.approx(arch_part.solid(part).Volume(), rel=1e-6)
        first = path.read_bytes()
        cad_files.write_step(path, {part.name: arch_part.solid(part)})
        assert path.read_bytes() == first
    for name, bodies in (("plates-defects", 13), ("truss-bridge", None)):
        (path,) = cad_files.write_design(recipes.load(name)[1], tmp_path / name)
        found = cad_files.read(path).bodies
        assert bodies is None or len(found) == bodies
        assert all(body.solid for body in found)


def test_names_make_safe_and_different_files(tmp_path):
    shapes = {"a/../b": cq.Solid.makeBox(1, 1, 1), "A_.._B": cq.Solid.makeBox(2, 2, 2)}
    cad_files.write_step(tmp_path / "n.step", shapes)
    said = cad_files.import_file(tmp_path / "n.step", tmp_path / "out")
    files = {body["mesh"].lower() for body in said["bodies"]}
    assert len(files) == 2
    assert {p.name.lower() for p in (tmp_path / "out").iterdir()} == files | {"import.json"}
    with pytest.raises(UsageError, match="not empty"):
        cad_files.import_file(tmp_path / "n.step", tmp_path / "out")
