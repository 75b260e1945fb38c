"""``processor field-check`` on folders of simulated scans: from the scans to the instrument of a project."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from processor.adjustment import scanner_class_errors
from processor.cli.main import commands
from processor.field_check import check, sightings
from processor.field_check.sightings import Noise, Seen
from processor.model import Scene, Verdict
from processor.scan_folder import folder as scan_folder
from tests.support import field_checks


def run(*arguments):
    return CliRunner().invoke(commands, list(map(str, arguments)))


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    """A folder of four scans of five spheres by a scanner of half its class's error of a view, and its check."""
    folder = field_checks.folder(tmp_path_factory.mktemp("check"), 1, view_mm=0.25)
    out = folder.with_name("out")
    done = run("field-check", folder, "-o", out)
    assert done.exit_code == 0, done.output
    return folder, out, done.output


def test_a_folder_of_spheres_becomes_an_instrument(checked):
    _, out, output = checked
    record = json.loads((out / "results.json").read_text("utf-8"))
    assert (record["format"], record["class"], record["verdict"]) == ("processor-field-check", "phase", "pass")
    terms = {term["name"]: term for term in record["terms"]}
    assert set(terms) == {
        "range_view", "range_offset", "angle_horizontal", "angle_vertical", "range_noise_white",
    }  # fmt: skip
    for name, true in {"range_view": 0.25, "range_offset": 0.0, "range_noise_white": 0.3}.items():
        assert abs(terms[name]["value"] - true) <= terms[name]["ci95"]
    assert len(record["sightings"]) == 20
    assert len(record["distances"]) == 10 * 6  # pairs of targets and of stations
    assert "PASS: 4 scans of 5 targets from 4 places" in output
    assert "Scanner X 0815" in (out / "report.html").read_text("utf-8")


def test_the_instrument_narrows_the_intervals_of_a_project(checked, tmp_path):
    _, out, _ = checked
    (tmp_path / "scanner.toml").write_bytes((out / "scanner.toml").read_bytes())
    (tmp_path / "project.toml").write_text('scanner = "scanner.toml"\n', "utf-8")
    np.savetxt(tmp_path / "scan.xyz", np.random.default_rng(0).uniform(0.0, 1.0, (2000, 3)))
    (instrument,) = scan_folder.read_input(tmp_path).instruments
    assert (instrument.name, instrument.serial, instrument.checked) == ("Scanner X", "0815", "2026-11-20")
    errors = scanner_class_errors.errors_of(instrument)
    assert 0.25 < errors.view_mm < 0.5


def test_same_bytes_give_the_same_check(checked):
    folder, out, _ = checked
    again = out.with_name("again")
    assert run("field-check", folder, "-o", again, "--lang", "zh").exit_code == 0
    for name in ("scanner.toml", "results.json", "sightings.csv"):
        assert (again / name).read_bytes() == (out / name).read_bytes()
    assert "扫描仪现场检校" in (again / "report.html").read_text("utf-8")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda path: (path / "project.toml").write_text("", "utf-8"), r"expected \[targets\]"),
        (lambda path: [(path / f"scan{k}.xyz").unlink() for k in (2, 3, 4)], "expected 2 scans or more"),
    ],
)
def test_what_is_no_field_check_is_refused(checked, tmp_path, change, said):
    folder, _, _ = checked
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    change(tmp_path)
    done = run("field-check", tmp_path, "-o", tmp_path.with_name("none"))
    assert done.exit_code != 0
    with pytest.raises(Exception, match=said):
        raise done.exception


def seen_of(seed, times, **settings):
    """Return what a simulated check shows, with noise of the class, and no scene but its name."""
    sd = {name: times * size for name, size in field_checks.OF_CLASS.items()}
    found, places, poses = field_checks.check(seed, sd, **settings)
    none = np.full(len(found.places), np.nan)
    return Seen(
        sightings=found,
        noise=Noise(white=none, black=none, bias=none, cosine=none),
        scans=tuple(map(str, range(len(poses)))),
        targets=tuple(map(str, range(len(places)))),
        places=places,
        poses=poses,
        reasons=(),
    )


def test_an_instrument_off_its_class_is_found():
    scene = Scene("check", "structure")
    verdicts = [check.check_of("check", seen_of(seed, 2.0), scene).verdict for seed in range(8)]
    assert verdicts == [Verdict.FAIL] * 8
    # By its class of 95 %, and each term of 95 % shared among the terms: one of ten rejects a good one.
    good = [check.check_of("check", seen_of(seed, 1.0), scene).verdict for seed in range(8)]
    assert good.count(Verdict.FAIL) <= 3


def test_the_noise_of_a_sphere_is_that_of_its_ranges(checked):
    folder, _, _ = checked
    noise = sightings.seen_in(scan_folder.read_input(folder)).noise
    assert np.sqrt(np.mean(noise.white**2)) == pytest.approx(0.3, rel=0.05)
    assert np.isnan(noise.black).all()
