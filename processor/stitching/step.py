"""Stitching: scans without poses into one frame, ``automatic`` by the structure itself, or by picked common points.

``automatic`` places the scans by the flat faces they share and by what each scanner looked through, then adjusts all of
them at once on these faces and their ends. ``three-point`` takes three or more picked points per pair (picks.csv), as
in paper 003, and chains the pairs; six parameters, or the paper's seven with ``scale = "free"``. Three or more control
points that span a plane fix the frame of either method's result and correct its poses.
"""

from __future__ import annotations

from dataclasses import replace

from processor.model import InputError, Scene, UsageError
from processor.stitching import automatic, three_point, to_result, verdicts
from processor.stitching.params import METHODS, Params
from processor.stitching.result import Result

__all__ = ["KIND", "METHODS", "NAME", "NEEDS", "Params", "Result", "applies", "run"]

NAME = "stitch"
NEEDS: tuple[str, ...] = ()
PLACES = True  # steps that need this one do not run without the poses of its scans
KIND = "structure"
LEAST_POINTS = 100  # chosen: a scan of fewer shows no three planes


def applies(scene: Scene) -> bool:
    """Whether a structure has two or more scans, some but the first without a pose, or no design to compare them with.

    Scans that all have poses and no design are stitched to check their poses.
    """
    unposed = any(not scan.T_project_scan.size for scan in scene.scans[1:])
    return scene.kind == KIND and len(scene.scans) > 1 and (unposed or scene.structure is None)


def run(scene: Scene, params: Params) -> Result:
    """Stitch the scans of a scene by one of METHODS.

    Raises InputError for fewer than two scans, or for three-point without picks; UsageError for an unknown method or
    reference.
    """
    if params.method not in METHODS:
        raise UsageError(f"stitch: unknown method {params.method!r}; it has {', '.join(METHODS)}")
    names = [scan.name for scan in scene.scans]
    if len(names) < 2:
        raise InputError(f"{scene.name}: stitching needs two scans or more, found {len(names)}")
    for scan in scene.scans:
        if len(scan.points) < LEAST_POINTS:
            raise InputError(
                f"{scene.name}: scan {scan.name!r} has {len(scan.points)} points; expected {LEAST_POINTS} or more"
            )
    if params.reference and params.reference not in names:
        raise UsageError(f"stitch.reference: no scan {params.reference!r}; there are {', '.join(names)}")
    reference = names.index(params.reference) if params.reference else 0
    picked = three_point.by_pair(scene.picks, scene.scans)
    if params.method == "three-point":
        if not picked:
            raise InputError(
                f"{scene.name}: method three-point needs common points; expected picks.csv in the scan folder"
            )
        network = three_point.stitch(scene.scans, params, reference, picked)
    else:
        network = automatic.stitch(scene.scans, params, reference, picked, scene.control)
    result = to_result.result(scene.scans, to_result.controlled(network, scene), reference, params)
    return replace(result, limits=verdicts.judge(scene, result))
