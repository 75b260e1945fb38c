"""Real scans of a sphere of 50 mm radius, against the centres a reference algorithm published for them."""

from pathlib import Path

import numpy as np
import pytest

from processor.model import Scan, Scene, reason
from processor.space_frame import step as space_frame_step

DATA = Path(__file__).resolve().parents[2] / "../shared/data/spheres"
PUBLISHED = {
    "SPH101": (-5895.833, 3628.939, -1561.255),
    "SPH102": (-4510.108, -6758.343, -1576.506),
    "SPH103": (-3508.773, 5865.925, -1570.917),
}


def scene(name, **known):
    file = DATA / f"{name}.xyz"
    if not file.is_file():
        pytest.skip(f"real scan {file.name} is not at hand")
    points = 1000.0 * np.loadtxt(file)
    origin = np.floor(points[0])
    return Scene(name, "structure", (Scan(name, points - origin, origin, **known),))


@pytest.mark.parametrize("name", PUBLISHED)
def test_free_radius(name):
    result = space_frame_step.run(scene(name), space_frame_step.Params())
    assert (result.status, result.balls.flag) == ("ok", ("ok",))
    assert reason("spheres.robust-distances") in result.reasons
    assert np.linalg.norm(result.balls.centres[0] - PUBLISHED[name]) < 0.25
    assert result.balls.radii[0] == pytest.approx(50.0, abs=0.2)


@pytest.mark.parametrize("name", PUBLISHED)
def test_fixed_radius_gives_the_published_centre(name):
    result = space_frame_step.run(scene(name), space_frame_step.Params(radius_mm=50.0))
    assert (result.status, result.balls.flag, result.balls.radii[0]) == ("ok", ("ok",), 50.0)
    assert np.linalg.norm(result.balls.centres[0] - PUBLISHED[name]) < 0.1
    assert reason("spheres.radius-held", radius=50.0) in result.reasons


@pytest.mark.parametrize("name", PUBLISHED)
def test_known_scanner_position_gives_the_published_centre(name):
    result = space_frame_step.run(scene(name, position=np.zeros(3)), space_frame_step.Params(radius_mm=50.0))
    assert result.status == "ok"
    assert reason("spheres.robust-ranges") in result.reasons
    assert np.linalg.norm(result.balls.centres[0] - PUBLISHED[name]) < 0.1


@pytest.mark.parametrize("name", PUBLISHED)
def test_seed_does_not_change_the_result(name):
    results = [space_frame_step.run(scene(name), space_frame_step.Params(seed=seed)) for seed in (1, 2)]
    assert results[0].balls.centres.tobytes() == results[1].balls.centres.tobytes()
    assert results[0].balls.covariance.tobytes() == results[1].balls.covariance.tobytes()


@pytest.mark.parametrize("name", PUBLISHED)
def test_bound_and_efficiency_are_given_with_the_estimate(name):
    result = space_frame_step.run(scene(name, position=np.zeros(3)), space_frame_step.Params())
    assert result.balls.stations.tolist() == [1]
    assert np.isfinite(result.balls.bound_sd).all()
    assert ((result.balls.efficiency > 0.2) & (result.balls.efficiency < 1.2)).all()


@pytest.mark.parametrize("name", PUBLISHED)
def test_mount_without_its_ball_gives_no_ball(name):
    whole = scene(name)
    scan = whole.scans[0]
    off = np.linalg.norm(scan.points + scan.origin - PUBLISHED[name], axis=1) - 50.0
    rest = Scene(name, "structure", (Scan(name, scan.points[np.abs(off) > 2.0], scan.origin),))
    result = space_frame_step.run(rest, space_frame_step.Params())
    assert (result.status, len(result.balls)) == ("failed", 0)


def test_sphere_of_a_real_scan_does_not_depend_on_a_map_offset():
    here = scene("SPH102")
    scan = here.scans[0]
    utm = np.array([500_000_000.0, 4_300_000_000.0, 0.0])
    there = Scene("there", "structure", (Scan("there", scan.points, scan.origin + utm),))
    a, b = (space_frame_step.run(one, space_frame_step.Params()) for one in (here, there))
    np.testing.assert_allclose(b.balls.centres - utm, a.balls.centres, atol=1e-6)
    np.testing.assert_allclose(b.balls.radii, a.balls.radii, atol=1e-6)
