"""Girders with bolt holes: as scanned, and where their holes were drilled."""

import numpy as np

from designgen.designs import bolt_holes, girder_assemblies
from designgen.scenes import make as scenes

ROW = {
    "type": "row", "section": "i", "parts": 2, "length_mm": 1400.0, "width_mm": 420.0, "height_mm": 600.0,
    "flange_mm": 20.0, "web_mm": 12.0,
}  # fmt: skip
SIZES = girder_assemblies.Params(**ROW)
BOLTS = bolt_holes.Params()
HOLES = 12  # of a girder's end: 24 a joint
QUIET = {
    "scanner": "plain-2mm",
    "step_mrad": 4.0,
    "stations": [4],
    "distance_mm": 1500.0,
    "sub_rays": 1,
}


def bolted_girders(seed, scan, mode="surface", hole_mm=1.0, bolts=True):
    """Scene and truth of a row of two girders, and by how much each hole (12, 3) of a part was drilled off, mm."""
    recipe = {
        "kind": "assembly",
        "assembly": ROW,
        **({"bolts": {}} if bolts else {}),
        "asbuilt": {"hole_mm": hole_mm},
        "scan": {"mode": mode, **scan},
    }
    if mode == "rays":
        recipe["scanner"] = {"noise_mm": 0.0}
    scene, truth = scenes.make("bolted", recipe, seed)
    if not bolts:
        return scene, truth, {}
    noted = {
        (what, where): value
        for what, where, value in zip(truth.as_built.what, truth.as_built.where, truth.as_built.value, strict=True)
    }
    shifts = {
        part.name: np.array(
            [[noted[f"hole {k + 1}, {a}", part.name] for a in ("along", "left", "up")] for k in range(HOLES)]
        )
        for part in scene.arch.parts
    }
    return scene, truth, shifts
