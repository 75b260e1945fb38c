"""Holes of girders as measured, against where they were drilled."""

from types import SimpleNamespace

import numpy as np

from designgen.designs import girder_assemblies
from processor.inspection import bridge_holes, splices
from processor.model import Status
from processor.preassembly.result import Components
from tests.support.best_fit import without_motion
from tests.support.scenes.bolted_girders import BOLTS, HOLES, SIZES, bolted_girders


def test_holes_of_girders_are_measured_where_they_were_drilled():
    scene, truth, shifts = bolted_girders(seed=7, scan={"spacing_mm": 4.0, "sigma_mm": 0.3})
    names = tuple(part.name for part in scene.arch.parts)
    table = Components(
        name=names, status=(Status.OK,) * 2, reasons=((),) * 2, scans=names, T_bridge_scan=truth.arch.T_bridge_scan,
        covariance=np.zeros((2, 6, 6)), key_points_scan=np.zeros((2, 2, 8, 3)), key_points_sd=np.zeros((2, 2, 8, 3)),
    )  # fmt: skip
    drilled = bridge_holes.of_parts(scene, SimpleNamespace(components=table, method="adjustment"))
    found = bridge_holes.characteristics(drilled)
    held = []
    for part in girder_assemblies.build(SIZES, BOLTS).parts:
        bores = part.girder.bores
        web = [k for k, bore in enumerate(bores) if abs(bore.end[0] - bore.start[0]) > 1e-6]
        places = np.array([bores[k].middle for k in web])[:, [0, 2]]
        true = without_motion(places + shifts[part.name][web][:, [0, 2]], places)
        centred = places - places.mean(axis=0)
        by_id = {one.of: one for one in found[part.name]}
        assert sum(id_.endswith("diameter") for id_ in by_id) == HOLES
        assert sum(id_.endswith("along") for id_ in by_id) == len(web)  # two holes of a flange have a pitch alone
        for k in range(1, HOLES + 1):
            if f"hole-{k}-along" not in by_id:
                continue
            one, other = by_id[f"hole-{k}-along"], by_id[f"hole-{k}-across"]
            # Along is that of the girder; across may look either way.
            # Nominal places are those of polygons of 64 corners.
            sign = 1.0 if np.isclose(centred, [one.nominal, other.nominal], atol=0.01).all(axis=1).any() else -1.0
            row = int(np.argmin(np.linalg.norm(centred - [one.nominal, sign * other.nominal], axis=1)))
            np.testing.assert_allclose(centred[row], [one.nominal, sign * other.nominal], atol=0.01)  # the same
            held.append(one.low <= true[row, 0] <= one.high)
            assert abs(one.value - true[row, 0]) < 2.3 * one.wider_side  # 4.5 standard deviations
            assert one.wider_side < 0.25  # some 35 points of 0.3 mm a bore
        pitches = [one for id_, one in by_id.items() if id_.startswith("pitch")]
        assert len(pitches) == 2 + 10  # of each flange one; of two by four in the web ten
    assert np.mean(held) > 0.7  # of 16
    joint = {one.of: one for one in splices.of_joints(scene.arch, drilled)[scene.arch.joint_names[0]]}
    assert list(joint) == [*(f"plate-{k}-pass-through" for k in (1, 2, 3)), "splice-pass-through"]
    assert all(one.low <= one.value <= one.high and not one.reasons for one in joint.values())


def test_a_bridge_without_holes_has_none():
    scene, _, _ = bolted_girders(seed=7, scan={"spacing_mm": 100.0}, bolts=False)
    assert bridge_holes.of_parts(scene, None) == []
