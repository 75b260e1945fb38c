"""What stands about a part while it is scanned: all of it labelled as of no part, and the part still seen."""

import functools
from pathlib import Path

import numpy as np
import pytest

import designgen
from designgen.export import folder as export_folder
from processor.model import UsageError
from processor.preassembly.parts import bending
from processor.scan_folder import folder
from processor.store import store

ROUGH = {"scan.step_mrad": 30.0, "scan.clutter": 0}
FRAME_OF_FOUR = Path(__file__).resolve().parents[2] / "fixtures" / "frame-of-four.toml"
KINDS = [*(pytest.param(kind, marks=pytest.mark.slow) for kind in ("site", "room")), "workshop"]
STANDS = {
    "workshop": {"floor", "wall 1", "wall 2", "trestle", "cable", "neighbour", "person", "crate"},
    "site": {"ground", "standard", "ledger", "board", "person", "crate"},
    "room": {"floor", "ceiling", "wall 1", "wall 2", "wall 3", "wall 4", "person", "crate"},
}


@functools.cache
def of_workshop():
    return seen("arch-s1-rays", **{"surroundings.kind": "workshop"})


def seen(recipe, **settings):
    """Points of the first scan, the names of their surfaces, and whether each is of a part."""
    scene, truth = designgen.make(recipe, seed=3, settings=ROUGH | settings)
    label = truth.labels[0]
    names = np.array([*label.surface_names, ""])[label.surface]
    return scene.scans[0].points, names, label.part >= 0


@pytest.mark.parametrize("kind", KINDS)
def test_a_part_stands_among_what_a_day_has(kind):
    points, names, of_part = (
        of_workshop() if kind == "workshop" else seen("arch-s1-rays", **{"surroundings.kind": kind})
    )
    assert STANDS[kind] <= set(names[~of_part])
    alone = seen("arch-s1-rays")[0]
    # Its stations see it from above the floor alone, and something stands before it.
    assert 0.2 * len(alone) < of_part.sum() < 1.5 * len(alone)
    assert np.ptp(points, axis=0).max() > 1.5 * np.ptp(alone, axis=0).max()


def test_no_sag_is_computed_of_parts_that_lie_on_trestles_without_bending(tmp_path):
    scene, truth = designgen.make("arch-s1-rays", seed=3, settings=ROUGH | {"surroundings.kind": "workshop"})
    store.write_scene(tmp_path / "s.h5", scene, truth, {})
    export_folder.export(tmp_path / "s.h5", tmp_path / "out", "ply", with_truth=False)
    back = folder.read_input(tmp_path / "out")
    beam = bending.beam(back.arch.parts[1], back.arch.parts[1].bottom_edge_left[0], back.steel)
    sag, _ = bending.sag(beam, np.array([0.0, 0.0, -1.0]), (0.2 * beam.length, 0.8 * beam.length))
    assert (
        np.abs(sag.across).max() < 1e-6
    )  # less than 1 mm with a modulus of 210,000 MPa, which is 5 million times less
    assert designgen.make("arch-s1", settings={"scan.spacing_mm": 400.0})[0].steel is None


def test_trestles_touch_the_part_in_a_levelled_scan():
    settings = ROUGH | {"surroundings.kind": "workshop", "asbuilt.temperature_C": 20.0}
    scene, truth = designgen.make("arch-s1-rays", seed=3, settings=settings)
    label, points, T = truth.labels[0], scene.scans[0].points, truth.arch.T_bridge_scan[0]
    names = np.array([*label.surface_names, ""])[label.surface]
    floor = np.quantile(points[names == "floor"][:, 2], [0.05, 0.5, 0.95])
    assert np.ptp(floor) < 20.0  # noise of some mm, and mixed pixels
    edge = (truth.arch.edges_bridge[0, 0] - T[:3, 3]) @ T[:3, :3]  # along the curved underside
    chord = (edge[-1] - edge[0])[:2] / np.linalg.norm((edge[-1] - edge[0])[:2])
    trestles = points[names == "trestle"]
    along = trestles[:, :2] @ chord
    for rows in (along < np.mean([along.min(), along.max()]), along > np.mean([along.min(), along.max()])):
        underside = np.interp(np.median(along[rows]), edge[:, :2] @ chord, edge[:, 2])
        # Rays are 120 mm apart, and the underside rises by some 30 mm over a trestle's width.
        assert underside - 150.0 < np.quantile(trestles[rows, 2], 0.98) < underside + 20.0
    assert underside - floor[1] == pytest.approx(800.0, abs=300.0)


@pytest.mark.slow
@pytest.mark.parametrize("recipe", [FRAME_OF_FOUR, "plates-defects", "arch-rib"])
def test_every_kind_of_scene_may_stand_in_a_workshop(recipe):
    _, names, of_part = seen(recipe, **{"surroundings.kind": "workshop"})
    assert {"floor", "wall 1", "neighbour"} <= set(names[~of_part])
    assert ("trestle" in names) is (recipe == "plates-defects")  # a roof, and a rib in its bridge, stand higher
    assert of_part.any()


@pytest.mark.parametrize("seed", [1, 4])
def test_nobody_stands_on_a_scanner_below_a_roof(seed):
    """Four scanners 1 m apart: one of either seed stood within a person, who was 80 and 98 % of its points.

    Of what stands 0.7 m off the person, 400 mm wide, takes 33 degrees of the turn, and two crates, at most 850 mm wide
    and lower than the horizon, 63 each.
    """
    settings = ROUGH | {"surroundings.kind": "room"}
    _, truth = designgen.make(FRAME_OF_FOUR, seed=seed, settings=settings)
    for label in truth.labels:
        names = np.array([*label.surface_names, ""])[label.surface]
        assert np.isin(names, ["person", "crate"]).mean() < (33 + 2 * 63 / 2) / 360


def test_surroundings_are_seen_by_rays_alone():
    with pytest.raises(UsageError, match=r"surroundings: only with scan\.mode"):
        designgen.make("arch-s1", settings={"surroundings.kind": "room"})
    with pytest.raises(UsageError, match=r"surroundings\.kind: expected one of workshop, site, room"):
        designgen.make("arch-s1-rays", settings={"surroundings.kind": "garden"})
