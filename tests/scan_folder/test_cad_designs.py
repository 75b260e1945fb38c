"""Designs as STEP and IFC: turned into meshes by a process of its own, once, and refused where that cannot be whole."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from designgen.cad.bodies import UNITS_MM
from processor.model import InputError
from processor.scan_folder import cad, folder, guess
from processor.scan_folder.units import MM_PER_UNIT

REAL = Path(__file__).resolve().parents[3] / "shared/data/design/base_interface_AP203.STEP"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty double x\nproperty double y\nproperty double z\n"
    "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    "{0} 0 0\n{1} 0 0\n{0} 1000 0\n{0} 0 1000\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n"
)
# Stands for `designgen import FILE -o OUT --default-units U --named=ORIGINAL`: the file says what is to happen.
FAKE = f"""
import json, os, pathlib, sys
source, out, named = pathlib.Path(sys.argv[2]), pathlib.Path(sys.argv[4]), sys.argv[7].partition("=")[2]
says = json.loads(source.read_text())
with open(says["log"], "a") as log:
    log.write(" ".join(sys.argv[5:7]) + "\\n")
if says.get("error"):
    print("error: " + named + ": " + says["error"], file=sys.stderr)
    sys.exit(3)
out.mkdir()
for i in range(says["bodies"]):
    (out / f"body-{{i}}.ply").write_text({PLY!r}.format(2000.0 * i, 2000.0 * i + 1000.0))
bodies = [{{"mesh": says.get("mesh", f"body-{{i}}.ply")}} for i in range(says["bodies"])]
(out / "import.json").write_text(json.dumps({{"bodies": bodies, "problems": says.get("problems", [])}}))
"""


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """Makes a file that the fake import takes; gives the file, and what the import was called with."""
    (tmp_path / "fake.py").write_text(FAKE)
    monkeypatch.setattr(cad, "_designgen", lambda path: [sys.executable, str(tmp_path / "fake.py")])
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    log = tmp_path / "log"
    log.touch()

    def make(name="whole.STEP", **says):
        path = tmp_path / "in put" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps({"bodies": 2, "log": str(log), **says}))
        return path, lambda: log.read_text().splitlines()

    return make


def test_all_bodies_are_read_and_converted_only_once(fake, tmp_path):
    path, calls = fake()
    for _ in range(2):
        vertices, faces, *_ = cad.read(path, "m")
    assert calls() == ["--default-units m"], "the second time it is known"
    assert vertices.shape == (8, 3)
    assert np.ptp(vertices, axis=0).tolist() == [3000.0, 1000.0, 1000.0]
    assert faces.tolist()[4:] == (np.array(faces[:4]) + 4).tolist()
    assert os.listdir(path.parent) == ["whole.STEP"], "nothing is written into the input"


def test_meshes_that_have_changed_in_the_cache_are_made_again(fake, tmp_path):
    path, calls = fake()
    vertices = cad.read(path, "m")[0]
    (made,) = (tmp_path / "cache/steel-scan-check/cad").iterdir()
    mesh, known = made / "body-1.ply", made / "sha256"
    changes = (
        lambda: (made / "import.json").write_text("{"),
        lambda: mesh.write_text(mesh.read_text().replace("3000", "3900")),  # a mesh as whole as the other
        lambda: mesh.rename(made / "body-2.ply"),
        lambda: known.write_text("0" * 64),
        known.unlink,
    )
    for count, change in enumerate(changes, 2):
        change()
        for _ in range(2):
            np.testing.assert_array_equal(cad.read(path, "m")[0], vertices)
        assert len(calls()) == count
    assert [one.name for one in made.parent.iterdir()] == [made.name]


def test_the_unit_of_a_file_that_states_none(fake):
    path, calls = fake()
    cad.read(path, "inch")
    assert calls() == ["--default-units inch"], "in the one run, which takes it only where the file states none"
    assert set(MM_PER_UNIT) <= set(UNITS_MM), "designgen takes every unit that a scan folder can have"


@pytest.mark.parametrize(
    ("says", "expected"),
    [
        ({"error": "is cut off"}, r"whole\.STEP: is cut off$"),
        ({"problems": ["solid 3 is lost", "face 7"]}, r"to meshes completely \(solid 3 is lost, and 1 more\)"),
        ({"bodies": 0}, "expected solids or surfaces"),
        ({"mesh": "../../../x.ply"}, "expected solids or surfaces"),
    ],
)
def test_incomplete_conversions_are_refused(fake, says, expected):
    path, _ = fake(**says)
    with pytest.raises(InputError, match=expected):
        cad.read(path, "m")


def test_unwritable_cache_is_ignored(fake, tmp_path):
    (tmp_path / "cache").touch()
    path, calls = fake()
    for _ in range(2):
        assert len(cad.read(path, "m")[0]) == 8
    assert calls() == ["--default-units m"] * 2


def test_without_designgen_the_error_states_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "a.ifc").write_text("ISO-10303-21;")
    monkeypatch.setattr(cad.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with pytest.raises(InputError, match=r"a\.ifc: .* designgen .* pip install 'steel-scan-check\[designgen\]'"):
        cad.read(tmp_path / "a.ifc", "m")


def test_a_structure_and_a_component_by_step(fake, tmp_path):
    place, _ = fake()[0].parent, None
    np.savetxt(place / "scan.xyz", np.random.default_rng(1).uniform(0, 1, (100, 3)) * [3, 1, 1], fmt="%.5f")
    (place / "project.toml").write_text('design = "whole.STEP"\nunits = "m"\n')
    scene = folder.read_input(place)
    assert scene.kind == "structure"
    assert np.ptp(scene.structure.vertices, axis=0).tolist() == [3000.0, 1000.0, 1000.0], (
        "in mm, whatever the scans are"
    )
    (place / "project.toml").write_text('kind = "space-frame"\ndesign = "whole.STEP"\n')
    with pytest.raises(InputError, match="alone is a design of kind structure"):
        folder.read_input(place)
    edge = [[0, 0, 0], [3, 0, 0]]
    part = {"mesh": "whole.STEP", "bottom_edge_left": edge, "bottom_edge_right": edge}
    design = {"units": "m", "kind": "arch-bridge", "order": ["foot1"], "components": {"foot1": part}, "joints": []}
    (place / "design.json").write_text(json.dumps(design))
    (place / "project.toml").write_text('[[scan]]\nfile = "scan.xyz"\ncomponent = "foot1"\n')
    part = folder.read_input(place).arch.parts[0]
    assert np.ptp(part.vertices, axis=0).tolist() == [3000.0, 1000.0, 1000.0]
    assert part.bottom_edge_left[1].tolist() == [3000.0, 0.0, 0.0]


def test_a_real_step_file(tmp_path, monkeypatch):
    pytest.importorskip("cadquery")
    if not REAL.is_file():
        pytest.skip(f"no {REAL}")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    shutil.copy(REAL, tmp_path / "接口 'a'.STEP")
    vertices, faces, *_ = cad.read(tmp_path / "接口 'a'.STEP", "m")
    assert np.sort(np.ptp(vertices, axis=0)) == pytest.approx([4.7625, 599.41, 638.7], abs=0.1)  # as meshes deviate
    corners = vertices[faces] - vertices.mean(axis=0)
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
    assert volume == pytest.approx(1.25799e6, rel=1e-3)  # the same, on round edges
    assert subprocess.run(["ls", "-A", tmp_path], capture_output=True, text=True, check=True).stdout.count("\n") == 2


def test_a_design_that_cannot_be_read_is_no_structure(tmp_path):
    (tmp_path / "scans").mkdir()
    np.savetxt(tmp_path / "scans/S1.xyz", np.random.default_rng(0).uniform(0, 1000, (200, 3)))
    (tmp_path / "bridge.stl").write_text("solid bridge\nfacet normal 0 0 0\n")
    with pytest.raises(InputError, match=r"bridge\.stl: is cut off"):
        guess.guess(tmp_path)
