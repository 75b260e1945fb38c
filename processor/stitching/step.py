"""Stitching: scans without poses into one frame, ``automatic`` by the structure itself, or by picked common points.

``automatic`` places the scans by the flat faces they share and by what each scanner looked through, then adjusts all of
them at once on these faces and their ends. ``three-point`` takes three or more picked points a pair (picks.csv), as in
paper 003, and chains the pairs; six parameters, or the paper's seven with ``scale = "free"``. Where control points are
given, three or more that span a plane, what either found is laid into their frame, and corrected by them.
"""

from __future__ import annotations

import numpy as np

from processor.model import Floats, InputError, Scan, Scene, UsageError
from processor.stitching import automatic, three_point, to_result
from processor.stitching.params import METHODS, Params
from processor.stitching.result import Result

__all__ = ["KIND", "METHODS", "NAME", "NEEDS", "Params", "Result", "applies", "run"]

NAME = "stitch"
NEEDS: tuple[str, ...] = ()
KIND = "structure"
LEAST_POINTS = 100


def applies(scene: Scene) -> bool:
    """Whether a scene of a structure has two or more scans, and not every one but the first comes with its pose."""
    return scene.kind == KIND and len(scene.scans) > 1 and any(not scan.T_project_scan.size for scan in scene.scans[1:])


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
        network, said = _three_point(scene, picked, reference, params)
    else:
        network, said = _automatic(scene.scans, picked, reference, params), []
    network, more = to_result.controlled(network, scene)
    return to_result.result(scene.scans, network, reference, params, [*more, *said])


def _automatic(
    scans: tuple[Scan, ...], picked: three_point.Picked, reference: int, params: Params
) -> to_result.Network:
    found = automatic.stitch(scans, params, reference, picked)
    origins = np.stack([cloud.origin for cloud in found.clouds])
    gross = [pair.is_gross for pair in found.pairs]
    messages = [
        "its own pose contradicts the others" if bad else "by itself it would stand elsewhere" if other else ""
        for bad, other in zip(gross, found.elsewhere, strict=True)
    ]
    tau, noise = found.solution.tau, float(np.median([cloud.sigma_mm for cloud in found.clouds]))
    return to_result.Network(
        found.solution.T, found.solution.covariance, origins, found.coarse.rivalry, found.coarse.T_rival,
        found.coarse.contrary, found.coarse.overlap, found.pairs,
        np.array(found.overlap), [not bad for bad in gross], messages,
        dissent=found.contradictions, refuted=found.refuted,
        spread=(noise, tau[0], tau[1]), point_mm=noise,
    )  # fmt: skip


def _three_point(
    scene: Scene, picked: three_point.Picked, reference: int, params: Params
) -> tuple[to_result.Network, list[str]]:
    if not picked:
        raise InputError(f"{scene.name}: method three-point needs common points; expected picks.csv in the scan folder")
    scans = scene.scans
    found, messages, scales, said = [], [], [], []
    lost: list[list[str]] = [[] for _ in scans]
    ties: dict[tuple[int, int], three_point.PairFit] = {}
    origins = np.stack([_origin(scan) for scan in scans])
    for (a, b), (in_a, in_b) in picked.items():
        try:
            ties[a, b] = three_point.fit_pair(in_a - origins[a], in_b - origins[b], params.scale == "free")
        except three_point.TooFewError as error:
            said.append(f"pair {scans[a].name}, {scans[b].name} not used: {error}, three that span a plane are needed")
            lost[a].append(f"{error} with {scans[b].name}")
            lost[b].append(f"{error} with {scans[a].name}")
    pooled = three_point.pooled(list(ties.values())) if ties else []
    for (a, b), one in zip(ties, pooled, strict=True):
        warning = three_point.verdict(one.scale, one.scale_sd, params.scale_limit_ppm, one.scaled_freedoms)
        if one.is_outlier and not warning:
            warning = f"its picks scatter by {one.sd_mm:.2g} mm, far more than the others': a blunder among them"
        if warning:
            said.append(f"pair {scans[a].name}, {scans[b].name}: {warning}")
        found.append(three_point.as_pair(a, b, one))
        messages.append(warning)
        scales.append((one.scale, three_point.widened(one.scale_sd, one.scaled_freedoms)))
    T, covariance = three_point.adjust(found, len(scans), reference)
    none = np.full((len(scans), 4, 4), np.nan)
    scale = np.array(scales).reshape(-1, 2)
    network = to_result.Network(
        T, covariance, origins, np.zeros(len(scans)), none, np.zeros(len(scans)), np.ones(len(scans)), found,
        np.full(len(found), np.nan), [True] * len(found),
        messages, scale[:, 0], scale[:, 1], lost=_unplaced(lost, {row for key in ties for row in key}),
        point_mm=float(np.median([one.sd_mm for one in pooled])) if pooled else float("nan"),
    )  # fmt: skip
    return network, said


def _unplaced(too_few: list[list[str]], tied: set[int]) -> list[str]:
    """Say why a scan of three-point may be without a pose: the pairs it has too few picks in, or no pairs at all."""
    found = []
    for row, said in enumerate(too_few):
        if said:
            found.append(f"{', '.join(said)}, three that span a plane are needed")
        else:
            found.append("its picks lead to scans that are not placed" if row in tied else "no picks with other scans")
    return found


def _origin(scan: Scan) -> Floats:
    return scan.position if scan.position.size else scan.origin + scan.points.mean(axis=0)
