"""CAD files in and out: units stated in the file, sizes worked by hand, bad files refused with a reason."""

import json
import random
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cadquery as cq
import ifcopenshell
import ifcopenshell.api.aggregate
import ifcopenshell.api.context
import ifcopenshell.api.feature
import ifcopenshell.api.geometry
import ifcopenshell.api.project
import ifcopenshell.api.root
import ifcopenshell.api.unit
import numpy as np
import pytest
import trimesh

from designgen import recipe_files
from designgen.cad import files as cad_files
from designgen.cad import shapes, step
from designgen.designs import arch_part, closed_ring
from designgen.export import step_files
from processor.model import InputError, UsageError
from tests.support.files import damaged_files
from tests.support.processes import commands

ROOT = Path(__file__).resolve().parents[3]
REAL = ROOT.parent / "shared/data/design"


@pytest.fixture
def box(tmp_path):
    """A box of 100 x 200 x 300 mm as STEP."""
    path = tmp_path / "box.step"
    step_files.write_step(path, {"梁-1": cq.Solid.makeBox(100.0, 200.0, 300.0)})
    return path


@pytest.mark.usefixtures("cad_here")
def test_a_box_comes_back_in_its_unit(box, tmp_path):
    found = cad_files.read(box)
    (body,) = found.bodies
    assert (found.unit, found.unit_mm, body.solid) == ("millimetre", 1.0, True)
    assert body.size_mm == pytest.approx([100.0, 200.0, 300.0], abs=1e-9)  # float64
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


@pytest.mark.usefixtures("cad_here")
def test_surface_without_a_solid_is_reported_as_surface_without_volume(tmp_path):
    step_files.write_step(tmp_path / "s.step", {"sheet": cq.Shell.makeShell([cq.Face.makePlane(50.0, 20.0)])})
    (body,) = cad_files.read(tmp_path / "s.step").bodies
    assert not body.solid
    assert body.area_mm2 == pytest.approx(1000.0)
    said = cad_files.import_file(tmp_path / "s.step", tmp_path / "out")
    assert said["bodies"][0]["kind"] == "surface"
    assert said["bodies"][0]["volume_mm3"] is None


def wall(path, prefix, sizes, more=None):
    """An IFC file with one extruded wall of ``sizes`` in the file's unit; ``more`` adds to its model."""
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
    if more is not None:
        more(model, made, representation=shape)
    model.write(str(path))


def test_a_wall_in_ifc_has_its_size_in_metres(tmp_path):
    """Read by a process of its own."""
    wall(tmp_path / "wall.ifc", None, (4, 0.2, 2.7))
    found = cad_files.read(tmp_path / "wall.ifc")
    (body,) = found.bodies
    assert (found.unit, body.name, body.solid) == ("metre", "墙 1", True)
    assert body.size_mm == pytest.approx([4000.0, 200.0, 2700.0], rel=1e-9)  # float64
    assert body.volume_mm3 == pytest.approx(4000.0 * 200.0 * 2700.0)


@pytest.mark.usefixtures("cad_here")
def test_an_ifc_without_geometry_is_refused(tmp_path):
    model = ifcopenshell.api.project.create_file(version="IFC4")
    ifcopenshell.api.root.create_entity(model, ifc_class="IfcProject", name="p")
    model.write(str(tmp_path / "empty.ifc"))
    with pytest.raises(InputError, match=r"empty\.ifc"):
        cad_files.read(tmp_path / "empty.ifc")


@pytest.mark.usefixtures("cad_here")
def test_bad_files_are_refused(box, tmp_path):
    content = box.read_bytes()
    for name, data, said in [
        ("cut.step", content[: len(content) // 2], r"cut\.step"),
        ("other.step", b"solid x\nendsolid x\n", "found another kind"),
        ("empty.stp", b"", "found another kind"),
        ("a.dwg", b"AC1027", "expected a CAD file"),
        ("end.step", content.rstrip()[: -len("END-ISO-10303-21;")], "is cut off"),
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
@pytest.mark.usefixtures("cad_here")
def test_real_files_in_inches(name, tmp_path):
    path = REAL / name
    if not path.exists():
        pytest.skip("the real data are not here")
    done = commands.here("designgen", "import", path, "-o", tmp_path / "out")
    assert done.returncode == 0
    assert done.stdout.splitlines()[0].endswith("unit inch (25.4 mm, stated in the file)")
    assert len(done.stdout.splitlines()) == 2
    assert done.stderr == ""
    said = json.loads((tmp_path / "out/import.json").read_text("utf-8"))
    (body,) = said["bodies"]
    # A plate of 3/16 inch within a circle of about two feet.
    assert min(body["size_mm"]) == pytest.approx(0.1875 * 25.4, abs=1e-3)  # written in inches to five digits
    mesh = trimesh.load(tmp_path / "out" / body["mesh"])
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(body["volume_mm3"], rel=1e-3)  # 0.1 mm of deviation on round edges


@pytest.mark.usefixtures("cad_here")
def test_designs_go_out_as_step_and_keep_their_volumes(tmp_path):
    recipe = {"kind": "ring", "ring": {"parts": 3, "radius_mm": 600.0, "width_mm": 400.0, "height_mm": 300.0}}
    files = step_files.write_design(recipe, tmp_path / "design")
    parts = closed_ring.build(closed_ring.Params(**recipe["ring"]))
    assert [f.stem for f in files] == [part.name for part in parts]
    solid = arch_part.solid(parts[0])
    (body,) = cad_files.read(files[0]).bodies
    assert body.volume_mm3 == pytest.approx(solid.Volume(), rel=1e-6)  # digits of the file
    first = files[0].read_bytes()
    step_files.write_step(files[0], {parts[0].name: solid})
    assert files[0].read_bytes() == first
    plates = recipe_files.overridden(recipe_files.load("plates-defects")[1], ['structure.components=["none", "dent"]'])
    (path,) = step_files.write_design(plates, tmp_path / "plates")
    assert [body.solid for body in cad_files.read(path).bodies] == [True] * 2


@pytest.mark.usefixtures("cad_here")
def test_names_make_safe_and_different_files(tmp_path):
    shapes = {"a/../b": cq.Solid.makeBox(1, 1, 1), "A_.._B": cq.Solid.makeBox(2, 2, 2)}
    step_files.write_step(tmp_path / "n.step", shapes)
    said = cad_files.import_file(tmp_path / "n.step", tmp_path / "out")
    files = {body["mesh"].lower() for body in said["bodies"]}
    assert len(files) == 2
    assert {p.name.lower() for p in (tmp_path / "out").iterdir()} == files | {"import.json"}
    with pytest.raises(UsageError, match="not empty"):
        cad_files.import_file(tmp_path / "n.step", tmp_path / "out")


# --- what the file says ----------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("cad_here")
def test_a_file_without_a_known_unit_needs_one(box, tmp_path):
    text = box.read_text()
    path = tmp_path / "unknown.step"
    # None at all; a prefix and a name that do not exist, which the kernel would take for metres.
    wrongs = (
        text.replace("SI_UNIT(.MILLI.,.METRE.)", "SI_UNIT(.MILKI.,.METRE.)"),
        text.replace("SI_UNIT(.MILLI.,.METRE.)", "SI_UNIT(.MILLI.,.GRAM.)"),
        re.sub(r"(GLOBAL_UNIT_ASSIGNED_CONTEXT\s*\(\s*\()#\d+,", r"\1", text),
    )
    for number, wrong in enumerate(wrongs):
        path.write_text(wrong)
        with pytest.raises(InputError, match=r"states no known unit of length; name it with --units"):
            cad_files.read(path)
        found = cad_files.read(path, "inch")
        assert (found.unit, found.unit_mm, found.unit_stated) == ("inch", 25.4, "")
        assert found.bodies[0].size_mm == pytest.approx([2540.0, 5080.0, 7620.0])
        by_default = cad_files.import_file(path, tmp_path / f"default{number}", default_units="inch")
        assert (by_default["unit"], by_default["unit_stated"]) == ("inch", None)
        assert by_default["unit_from"] == "given by --default-units"
    stated = cad_files.import_file(box, tmp_path / "stated", default_units="inch")
    assert (stated["unit"], stated["unit_from"]) == ("millimetre", "stated in the file")
    said = cad_files.import_file(box, tmp_path / "out", "inch")
    line = f"{box.name}: unit inch (25.4 mm, given by --units; the file states millimetre)"
    assert cad_files.summary(said)[0] == line
    wall(tmp_path / "wall.ifc", "MILLI", (4000, 200, 2700))
    nowhere = re.sub(r"\n#\d+=\s?IFCUNITASSIGNMENT\([^;]*;", "", (tmp_path / "wall.ifc").read_text())
    nowhere = re.sub(r"(IFCPROJECT\([^;]*),#\d+\);", r"\1,$);", nowhere)
    (tmp_path / "none.ifc").write_text(nowhere)
    with pytest.raises(InputError, match="name it with --units"):
        cad_files.read(tmp_path / "none.ifc")
    assert cad_files.read(tmp_path / "none.ifc", default_units="mm").unit == "mm"
    assert cad_files.read(tmp_path / "none.ifc", "cm").bodies[0].size_mm == pytest.approx([40000.0, 2000.0, 27000.0])


@pytest.mark.usefixtures("cad_here")
def test_inches_go_by_their_factor(box, tmp_path):
    text, inch = box.read_text(), tmp_path / "inch.step"
    numbers = re.findall(r"#(\d+) = \( LENGTH_UNIT\(\) NAMED_UNIT\(\*\) SI_UNIT\(.MILLI.,.METRE.\) \);", text)
    for at, number in enumerate(numbers):
        made = (
            f"#{number} = ( CONVERSION_BASED_UNIT('INCH',#900{at}1) LENGTH_UNIT() NAMED_UNIT(#900{at}2) );\n"
            f"#900{at}1 = LENGTH_MEASURE_WITH_UNIT(LENGTH_MEASURE(25.4),#900{at}3);\n"
            f"#900{at}2 = DIMENSIONAL_EXPONENTS(1.,0.,0.,0.,0.,0.,0.);\n"
            f"#900{at}3 = ( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.) );"
        )
        text = re.sub(rf"#{number} = [^;]*;", made, text)
    inch.write_text(text)
    found = cad_files.read(inch)
    assert (found.unit, found.unit_mm, found.problems) == ("inch", pytest.approx(25.4), ())
    assert found.bodies[0].size_mm == pytest.approx([2540.0, 5080.0, 7620.0])


@pytest.mark.usefixtures("cad_here")
def test_names_are_escaped_when_written_and_read_however_written(tmp_path):
    path = tmp_path / "n.step"
    step_files.write_step(path, {"梁 'A'": cq.Solid.makeBox(1, 1, 1), "\U00020000\\x": cq.Solid.makeBox(2, 2, 2)})
    content = path.read_bytes()
    assert rb"\X2\6881\X0\ ''A''" in content
    assert rb"\X4\00020000\X0\\\x" in content
    assert [body.name for body in cad_files.read(path).bodies] == ["梁 'A'", "\U00020000\\x"]
    for coding in ("utf-8", "gb18030"):
        path.write_bytes(content.replace(rb"\X2\6881\X0" b"\\", "钢梁".encode(coding)))
        assert cad_files.read(path).bodies[0].name == "钢梁 'A'"
    wall(tmp_path / "w.ifc", None, (4, 0.2, 2.7))
    escaped = (tmp_path / "w.ifc").read_bytes()
    assert rb"\X2\5899\X0" in escaped
    for coding in ("utf-8", "gb18030"):
        (tmp_path / "w.ifc").write_bytes(escaped.replace(rb"\X2\5899\X0" b"\\", "钢墙".encode(coding)))
        assert cad_files.read(tmp_path / "w.ifc").bodies[0].name == "钢墙 1"


@pytest.mark.usefixtures("cad_here")
def test_openings_are_cut_and_spaces_are_no_bodies(tmp_path):
    def more(model, made, representation):
        item = representation.Items[0]
        profile = model.create_entity("IfcRectangleProfileDef", ProfileType="AREA", XDim=1000.0, YDim=500.0)
        hole = model.create_entity("IfcExtrudedAreaSolid", profile, item.Position, item.ExtrudedDirection, 2000.0)
        shape = model.create_entity(
            "IfcShapeRepresentation", representation.ContextOfItems, "Body", "SweptSolid", [hole]
        )
        for kind in ("IfcOpeningElement", "IfcSpace", "IfcVirtualElement"):
            one = ifcopenshell.api.root.create_entity(model, ifc_class=kind, name=kind)
            ifcopenshell.api.geometry.assign_representation(model, product=one, representation=shape)
            if kind == "IfcOpeningElement":
                ifcopenshell.api.feature.add_feature(model, feature=one, element=made)

    wall(tmp_path / "w.ifc", "MILLI", (4000, 200, 2700), more)
    found = cad_files.read(tmp_path / "w.ifc")
    (body,) = found.bodies
    assert (body.name, body.closed, found.problems) == ("墙 1", True, ())
    assert body.volume_mm3 == pytest.approx(200.0 * (4000.0 * 2700.0 - 1000.0 * 2000.0))


@pytest.mark.usefixtures("cad_here")
def test_round_walls_in_ifc_keep_the_deviation(tmp_path):
    wall(tmp_path / "w.ifc", "MILLI", (4000, 200, 2700))
    text = (tmp_path / "w.ifc").read_text()
    round_ = re.sub(r"IFCRECTANGLEPROFILEDEF\(\.AREA\.,\$,\$,[^;]*;", "IFCCIRCLEPROFILEDEF(.AREA.,$,$,500.);", text)
    (tmp_path / "w.ifc").write_text(round_)
    (body,) = cad_files.read(tmp_path / "w.ifc").bodies
    triangles = body.vertices[body.faces]
    middles = 0.5 * (triangles + np.roll(triangles, 1, axis=1))[np.ptp(triangles[..., 2], axis=1) > 1.0]
    deepest = 500.0 - np.linalg.norm(middles[..., :2], axis=2).min()
    assert 0.0 < deepest <= body.deviation_mm <= 0.1  # as stated in docs


# --- what the kernel does --------------------------------------------------------------------------------------------


def mutations(content, rng, count):
    """Damage a file, but for its end, without which nothing is read."""
    for _ in range(count):
        data = bytearray(content[:-40])
        rng.choice(damaged_files.WAYS)(data, rng)
        yield bytes(data) + content[-40:]


@pytest.mark.slow
def test_damaged_files_end_in_a_result_or_an_input_error(tmp_path, capfd):
    """A process a file, two at a time; bad files by hand are above, an open solid below."""
    each = 20
    shapes = {"a": cq.Workplane().box(30, 20, 10).edges("|Z").fillet(2).faces(">Z").hole(4).val()}
    step_files.write_step(tmp_path / "whole.step", shapes)
    wall(tmp_path / "whole.ifc", "MILLI", (4000, 200, 2700))
    rng, files = random.Random(7), []
    for whole in (tmp_path / "whole.step", tmp_path / "whole.ifc"):
        for number, data in enumerate(mutations(whole.read_bytes(), rng, each)):
            files.append(tmp_path / f"{number}{whole.suffix}")
            files[-1].write_bytes(data)
    capfd.readouterr()

    def outcome(path):
        try:
            found = cad_files.read(path, limit_s=60.0)
        except InputError as error:
            plain = str(path) in str(error) and "\n" not in str(error) and "within" not in str(error)
            return "refused" if plain else str(error)
        return "said" if found.problems else "read"

    with ThreadPoolExecutor(2) as pool:
        outcomes = list(pool.map(outcome, files))
    assert capfd.readouterr() == ("", "")
    assert len(outcomes) == 2 * each
    assert {"refused", "said"} <= set(outcomes) <= {"refused", "said", "read"}


@pytest.mark.parametrize(
    ("child", "said"),
    [
        ("import os, signal; print('noise'); os.kill(os.getpid(), signal.SIGSEGV)", "signal 11"),
        ("import sys; print('noise'); print('noise', file=sys.stderr); sys.exit(3)", "exit code 3"),
        ("print('noise')", "nonsense"),
        ("print('[1, 2]')", "nonsense"),
        ('print(\'{"unit": "mm", "unit_mm": 1, "unit_stated": "", "problems": [], "bodies": [{}]}\')', "nonsense"),
        ("import time; time.sleep(600)", "within 0.5 s"),
    ],
)
def test_a_kernel_that_dies_or_hangs_is_one_error(child, said, box, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(cad_files, "CHILD", child)
    with pytest.raises(InputError, match=rf"box\.step: .*{said}.*again") as caught:
        cad_files.read(box, limit_s=0.5 if "sleep" in child else 60.0)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux holds a process to its memory")
def test_memory_is_limited(box):
    with pytest.raises(InputError, match=r"box\.step"):
        cad_files.read(box, memory_bytes=2 * 10**8)


@pytest.mark.usefixtures("cad_here")
def test_open_solid_in_a_step_file_is_reported_and_exits_with_1(tmp_path):
    shapes = {"whole": cq.Solid.makeBox(1, 2, 3), "torn": cq.Solid.makeBox(40, 50, 60)}
    path = tmp_path / "torn.step"
    step_files.write_step(path, shapes)
    text = path.read_text()
    assert cad_files.read(path).problems == ()
    faces = list(re.finditer(r"#\d+ = ADVANCED_FACE\([^;]*;\n", text))
    assert len(faces) == 12
    path.write_text(text.replace(faces[-1][0], ""))
    done = commands.here("designgen", "import", path, "-o", tmp_path / "out")
    said = json.loads((tmp_path / "out/import.json").read_text("utf-8"))
    assert done.returncode == 1
    assert done.stdout.splitlines() == cad_files.summary(said)
    assert done.stderr.splitlines() == [f"{path}: {line}" for line in (*said["problems"], *said["notes"])]
    assert said["notes"] == ["'torn' is not closed: written as it is; check it in the CAD program"]
    assert any("did not become one" in problem for problem in said["problems"])
    assert [body["name"] for body in said["bodies"] if body["kind"] == "solid"] == ["whole"]


@pytest.mark.slow
def test_large_sphere_is_meshed_by_few_triangles_and_its_deviation_is_stated(tmp_path):
    radius = 2500.0
    step_files.write_step(tmp_path / "s.step", {"tank": cq.Solid.makeSphere(radius, angleDegrees1=-90)})
    (body,) = cad_files.read(tmp_path / "s.step").bodies
    assert len(body.faces) < 2_000_000
    assert body.closed
    assert body.volume_mm3 == pytest.approx(4.0 / 3.0 * np.pi * radius**3)
    depth = radius - np.linalg.norm(body.vertices[body.faces].mean(axis=1), axis=1)
    assert 0.0 < depth.max() <= body.deviation_mm < 0.2


# --- out -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.usefixtures("cad_here")
def test_georeferenced_designs_lie_where_their_scene_has_them(tmp_path):
    origin, recipe = [5.0e8, 4.3e9, 1.0e5], recipe_files.load("frame-small")[1]
    recipe["frame"] |= {"nodes_x": 2, "nodes_y": 1, "layers": 1, "radii_mm": [45.0]}
    corners = []
    for section in (recipe["scan"], {**recipe["scan"], "origin_mm": origin}):
        (path,) = step_files.write_design({**recipe, "scan": section}, tmp_path / "design")
        vertices = np.vstack([body.vertices for body in cad_files.read(path).bodies])
        corners.append([vertices.min(axis=0), vertices.max(axis=0)])
    assert np.abs(corners[1] - (np.array(corners[0]) + origin)).max() < 1e-5  # float64 at 4300 km, digits of the file


def test_a_step_file_that_cannot_be_written_leaves_the_old_one(box, monkeypatch):
    def fails(*_, **__):
        raise OSError(28, "No space left on device")

    before = box.read_bytes()
    monkeypatch.setattr(cq.Assembly, "export", fails)
    with pytest.raises(InputError, match=r"box\.step: cannot be written \(No space"):
        step_files.write_step(box, {"b": cq.Solid.makeBox(1.0, 1.0, 1.0)})
    assert box.read_bytes() == before
    assert [one.name for one in box.parent.iterdir()] == [box.name]


def test_a_part_placed_often_is_meshed_once_and_lies_where_it_was_placed(tmp_path, monkeypatch):
    plate = cq.Workplane().box(400.0, 300.0, 12.0).faces(">Z").workplane().pushPoints([(-90, 40), (60, -80)]).hole(26.0)
    solid = plate.findSolid().Solids()[0]
    whole, places = cq.Assembly(name="array"), [(1000.0 * k, 50.0 * k, -7.0 * k) for k in range(6)]
    for k, place in enumerate(places):
        location = cq.Location(cq.Vector(*place), cq.Vector(1, 2, 3), 25.0 * k)
        whole.add(solid, name=f"plate {k + 1}", loc=location)
    whole.add(cq.Workplane().sphere(50.0).val(), name="ball", loc=cq.Location(cq.Vector(0, 0, 900)))
    path = tmp_path / "array.step"
    whole.export(str(path))
    meshings = []
    monkeypatch.setattr(
        shapes.tessellation, "_mesh", lambda *a, of=shapes.tessellation._mesh: (meshings.append(1), of(*a))
    )
    read = step.parse(str(path), path.read_bytes(), "", "mm", exact=True)
    assert len(meshings) <= 2 * 2 * 3  # two shapes, edges and faces, in at most three refinements
    assert [body.name for body in read.bodies] == [*(f"plate {k + 1}" for k in range(6)), "ball"]
    for body, place in zip(read.bodies, places, strict=False):
        assert body.closed
        assert body.volume_mm3 == pytest.approx(400 * 300 * 12 - 2 * np.pi * 13**2 * 12, rel=1e-9)  # exact
        # Corners of the holes move the mean; places are 1 m apart.
        np.testing.assert_allclose(body.vertices.mean(axis=0), np.array(place), atol=40.0)
        corners = body.vertices[body.faces]
        volume = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
        assert volume == pytest.approx(body.volume_mm3, rel=1e-5)  # the deviation of two holes


def test_a_shape_that_shares_a_face_with_a_later_one_is_meshed_again():
    """Two solids of a compound that share a face: meshing the second takes the mesh of the face from the first."""
    whole = cq.Workplane().box(100, 100, 10).val().split(cq.Face.makePlane(300, 300, (0, 0, 0), (1, 0, 0)))
    first, second = whole.Solids()
    meshed = shapes.Meshed()
    meshed.add(first.wrapped, 0.05)
    assert meshed.deviation(first.moved(cq.Location(cq.Vector(5, 0, 0))).wrapped) == 0.05
    meshed.add(second.wrapped, 0.05)
    shared = any(a.isSame(b) for a in first.Faces() for b in second.Faces())
    assert shared
    assert meshed.deviation(first.wrapped) is None
    assert meshed.deviation(second.wrapped) == 0.05
