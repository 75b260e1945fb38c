"""Stitching: scans without poses into one frame, ``automatic`` by the structure itself, or by picked common points.

``automatic`` places the scans by the flat faces they share and by what each scanner looked through, then adjusts all of
them at once on these faces and their ends. ``three-point`` takes three or more picked points per pair (picks.csv), as
in paper 003, and chains the pairs; six parameters, or the paper's seven with ``scale = "free"``. Three or more control
points that span a plane fix the frame of either method's result and correct its poses.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from processor import diagnostics, large_arrays
from processor.model import Floats, InputError, Reason, Scan, Scene, UsageError, reason
from processor.stitching import automatic, three_point, to_result, verdicts
from processor.stitching.coarse.network import CoarsePoses
from processor.stitching.fine.pairs_and_loops import Pair
from processor.stitching.params import METHODS, Params
from processor.stitching.result import Result
from processor.stitching.three_point import PairFit, Picked
from processor.stitching.to_result import Network

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
        network = _by_picks(scene.scans, picked, reference, params)
    else:
        network = automatic.stitch(scene.scans, params, reference, picked, scene.control)
    result = to_result.result(scene.scans, to_result.controlled(network, scene), reference, params)
    return replace(result, limits=verdicts.judge(scene, result))


def _by_picks(scans: Sequence[Scan], picked: Picked, reference: int, params: Params) -> Network:
    names = [scan.name for scan in scans]
    origins = np.stack([_origin(scan) for scan in scans])
    fits: dict[tuple[int, int], PairFit] = {}
    shortages: dict[tuple[int, int], Reason] = {}
    for (a, b), (in_a, in_b) in picked.items():
        try:
            fits[a, b] = three_point.fit_pair(in_a - origins[a], in_b - origins[b], params.scale == "free")
        except three_point.TooFewError as error:
            shortages[a, b] = error.shortage
    pooled = three_point.pooled(list(fits.values())) if fits else []
    limit = params.scale_limit_ppm
    pairs = [three_point.as_pair(a, b, fit, limit) for (a, b), fit in zip(fits, pooled, strict=True)]
    _say_pairs(names, pooled, pairs, picked)
    unused = [
        reason("stitch.pair-not-used", a=names[a], b=names[b], shortage=shortage)
        for (a, b), shortage in shortages.items()
    ]
    of_pairs = [
        reason("stitch.of-pair", a=names[pair.a], b=names[pair.b], reason=single)
        for pair in pairs
        for single in pair.reasons
    ]
    adjusted = three_point.adjust(pairs, len(scans), reference)
    misclosed = () if adjusted.factor == 1.0 else (reason("stitch.loops-misclose", factor=adjusted.factor),)
    return Network(
        T=adjusted.T,
        covariance=adjusted.covariance,
        origins=origins,
        coarse=CoarsePoses.unrivalled(adjusted.T),
        pairs=pairs,
        pose_scale_sd=adjusted.scale_sd,
        unplaced=_unplaced(names, shortages, {row for pair in fits for row in pair}),
        point_mm=float(np.median([fit.sd_mm for fit in pooled])) if pooled else float("nan"),
        reasons=(*unused, *misclosed, *of_pairs),
    )


def _say_pairs(names: Sequence[str], fits: Sequence[PairFit], pairs: Sequence[Pair], picked: Picked) -> None:
    """Say what the picks of each pair gave, for diagnostics."""
    for fit, pair in zip(fits, pairs, strict=True):
        of_pair = names[pair.a], names[pair.b]
        with diagnostics.at(", ".join(of_pair)):
            diagnostics.note(
                "three points",
                points=pair.shared,
                rms_mm=pair.residual,
                pick_sd_mm=fit.sd_mm,
                scale_ppm=1e6 * (fit.scale - 1.0),
            )
            for name, points in zip(of_pair, picked[pair.a, pair.b], strict=True):
                with diagnostics.placed(np.eye(4), f"scan {name}"):
                    diagnostics.keep(f"picks in {name}", points)


def _unplaced(
    names: Sequence[str], shortages: Mapping[tuple[int, int], Reason], tied: Collection[int]
) -> tuple[Reason, ...]:
    """Return why each scan of three-point may have no pose: its pairs with too few picks, or no pairs at all."""
    reasons = []
    for row in range(len(names)):
        short = tuple(
            reason("stitch.shortage-with-scan", shortage=shortage, scan=names[a if row == b else b])
            for (a, b), shortage in shortages.items()
            if row in (a, b)
        )
        if short:
            reasons.append(reason("stitch.too-few-picks", shortages=short))
        else:
            reasons.append(reason("stitch.picks-of-unplaced") if row in tied else reason("stitch.no-picks"))
    return tuple(reasons)


def _origin(scan: Scan) -> Floats:
    return scan.position if scan.position.size else scan.origin + large_arrays.centroid(scan.points)
