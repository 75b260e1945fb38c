"""The key ``scanner`` of project.toml: classes, files of instruments, and what is refused."""

import json

import numpy as np
import pytest

import processor
from processor.adjustment import scanner_class_errors
from processor.model import InputError
from processor.scan_folder import folder

CHECKED = """
scanner_class = "phase"
about = "Scanner X"
serial = "0815"
checked = 2026-11-20
source = "field check of 4 targets"
view_mm = {value = 0.2, sd = 0.05}
zero_mm = {value = -0.1, sd = 0.1}
"""


def ball(path, seed=0):
    """Write 2,000 points of the half of a sphere that faces a scanner at the origin, at 5 m, in metres."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(6000, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    normal = normal[normal[:, 0] < -0.3][:2000]
    points = np.array([5000.0, 0.0, 0.0]) + 72.5 * normal
    points += rng.normal(0.0, 0.3, len(points))[:, None] * points / np.linalg.norm(points, axis=1)[:, None]
    np.savetxt(path, points / 1000.0, fmt="%.7f")


def project(tmp_path, text, scanner="", scans=("s1",)):
    """Write a scan folder of one ball a scan."""
    for name in scans:
        ball(tmp_path / f"{name}.xyz")
    (tmp_path / "project.toml").write_text(text, "utf-8")
    (tmp_path / "scanner.toml").write_text(scanner, "utf-8")
    return tmp_path


def variance(path, text, scanner=CHECKED):
    """Return the variance of the ball's centre along the rays, mm^2."""
    path.mkdir()
    balls = processor.run(project(path, text, scanner), steps=["spheres"]).steps["spheres"].balls
    assert len(balls) == 1
    return float(balls.covariance[0, 0, 0])


def test_the_class_and_the_check_are_in_the_interval(tmp_path):
    text = 'scanner = "scanner.toml"'
    plain, by_few = (CHECKED.replace("{value = 0.2, sd = 0.05}", view) for view in ("0.2", "0.23534"))
    assumed = variance(tmp_path / "assumed", "")
    assert assumed == variance(tmp_path / "phase", 'scanner = "phase"')
    assert assumed - variance(tmp_path / "plain", text, plain) == pytest.approx(0.5**2 - 0.2**2, rel=1e-3)
    # Student's factor of 0.5 (0.2 / 0.05)^2 = 8 degrees of freedom is 2.306 / 1.960.
    known = variance(tmp_path / "file", text)
    assert known == pytest.approx(variance(tmp_path / "by-few", text, by_few), rel=1e-4)


def test_results_and_page_say_which_instrument(tmp_path):
    def said(out):
        page = (out / "report.html").read_text("utf-8")
        return json.loads((out / "results.json").read_text("utf-8"))["instruments"], page

    scans = project(tmp_path, "", CHECKED)
    processor.run(scans, tmp_path / "a", steps=["spheres"])
    found, page = said(tmp_path / "a")
    assert (found[0]["name"], found[0]["stated"], found[0]["checked"]) == ("phase", False, None)
    assert "phase (class, assumed)" in page
    project(tmp_path, 'scanner = "scanner.toml"', CHECKED)
    processor.run(scans, tmp_path / "b", steps=["spheres"])
    found, page = said(tmp_path / "b")
    assert found[0]["terms"]["view_mm"] == {"value": 0.2, "sd": 0.05}
    assert (found[0]["serial"], found[0]["checked"]) == ("0815", "2026-11-20")
    assert "Scanner X 0815, checked 2026-11-20" in page
    assert "spheres.instrument-assumed" not in (tmp_path / "b" / "results.json").read_text("utf-8")


def test_scans_may_have_instruments_of_their_own(tmp_path):
    text = '[[scan]]\nfile = "s1.xyz"\nscanner = "scanner.toml"\n[[scan]]\nfile = "s2.xyz"\n'
    scene = folder.read_input(project(tmp_path, text, CHECKED, ("s1", "s2")))
    assert [(one.name, one.scans) for one in scene.instruments] == [("Scanner X", ("s1",)), ("phase", ())]
    with scanner_class_errors.used(scene.instruments):
        assert scanner_class_errors.known().view_mm == 0.5  # the larger one of both
    both = text + 'scanner = "scanner.toml"\n'
    scene = folder.read_input(project(tmp_path, both, CHECKED, ("s1", "s2")))
    assert [(one.name, one.scans) for one in scene.instruments] == [("Scanner X", ("s1", "s2"))]


@pytest.mark.parametrize(
    ("text", "scanner", "said"),
    [
        ('scanner = "fase"', "", r"expected one of phase, pulse, long-range, or a scanner.toml.*did you mean 'phase'"),
        ("scanner = 3", "", "expected a class of scanners or a scanner.toml as 'scanner', found 3"),
        ('scanner = "other.toml"', "", "there is no file 'other.toml'"),
        ('scanner = "../scanner.toml"', "", "leads out of the folder"),
        ('scanner = "scanner.toml"', "x = [", "not readable TOML"),
        ('scanner = "scanner.toml"', "view_mm = 0.5", "expected one of phase, pulse, long-range as 'scanner_class'"),
        ('scanner = "scanner.toml"', CHECKED + "view = 1", "unknown key 'view'"),
        ('scanner = "scanner.toml"', CHECKED + "scale_ppm = -1", "expected a number from 0 to 1000"),
        ('scanner = "scanner.toml"', CHECKED + "incidence_mm = 3e-4", "expected a number from 0.01 to 100"),
        ('scanner = "scanner.toml"', CHECKED + "incidence_mm = {value = 1, sd = -1}", "as 'sd', found -1"),
        ('scanner = "scanner.toml"', CHECKED + "incidence_mm = {value = 1}", "as 'sd', found nothing"),
        ('scanner = "scanner.toml"', CHECKED.replace("0815", ""), "expected a text as 'serial'"),
        ('scanner = "scanner.toml"', CHECKED.replace('serial = "0815"', ""), "expected serial of an instrument"),
        ('scanner = "scanner.toml"', CHECKED.replace("2026-11-20", '"yesterday"'), "expected a day, YYYY-MM-DD"),
    ],
)
def test_what_is_no_instrument_is_refused_in_one_line(tmp_path, text, scanner, said):
    with pytest.raises(InputError, match=said) as error:
        folder.read_input(project(tmp_path, text, scanner))
    assert "\n" not in str(error.value)
