"""From the poses of either method to the result: the project's frame, statuses, pairs and loops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from processor.distinct_rows import components
from processor.geometry import rigid
from processor.model import NORMAL_95, Floats, InputError, Reason, Scan, Scene, Status, reason
from processor.stitching import poses_with_scale
from processor.stitching.coarse.network import AMBIGUOUS, CoarsePoses
from processor.stitching.fine import control_points, pairs_and_loops
from processor.stitching.fine.contradictions import Contradiction
from processor.stitching.fine.pairs_and_loops import Pair
from processor.stitching.params import Params
from processor.stitching.result import NAN, Closures, ControlPoints, Pairs, ProjectFrame, Result, Scans

CONTRARY = 0.25  # least share of the support that contradicts a pose; people and cars that move cause some
LITTLE = 0.1  # overlap of both scans
STRANGE = ("stitch.free-space", "stitch.little-overlap")  # of a scan of another place


@dataclass(frozen=True)
class Network:
    """Poses T_ref_scan (k, 4, 4) of scans less ``origins`` (k, 3), and what the result states of them and of pairs."""

    T: Floats
    covariance: Floats  # (6k, 6k): rotations about each scan's own origin
    origins: Floats
    coarse: CoarsePoses  # what competes with the poses and contradicts them
    pairs: list[Pair]
    pose_scale_sd: Floats = field(default_factory=lambda: np.empty(0))  # (k,) of the scale in T; absent: it is fixed
    refuted: Floats = field(default_factory=lambda: np.empty(0))  # (k,), see :func:`network.refuted`
    contradictions: Sequence[Contradiction] = ()  # of each scan's pose by faces
    links: Sequence[tuple[int, int]] | None = None  # see :func:`network.links`; None: not known
    estimated: tuple[float, float, float] = (NAN, NAN, NAN)  # noise, patches, ends
    unplaced: Sequence[Reason] = ()  # why each scan has no pose, where it has none
    by_control: Sequence[Reason | None] = ()  # contradictions of each scan's pose by control points
    point_mm: float = NAN  # standard deviation of a single point or of a pick
    base: Floats | None = None  # (4, 4) from the poses' frame to the project; None: by the reference scan
    control: ControlPoints | None = None
    reasons: tuple[Reason, ...] = ()


def controlled(network: Network, scene: Scene) -> Network:
    """Transform a network into the frame of control points, if there are any and they determine it."""
    if scene.control is None or not len(scene.control.scan):
        return network
    names = [scan.name for scan in scene.scans]
    try:
        placed = control_points.adjust(
            scene.control, names, network.T, network.covariance, network.origins, network.point_mm
        )
    except InputError as error:
        raise InputError(f"{scene.name}: {error}") from None
    network = replace(network, control=placed.control, reasons=(*placed.reasons, *network.reasons))
    if not placed.control.holds:
        return network
    return replace(
        network, T=placed.T, covariance=placed.covariance,
        coarse=replace(network.coarse, T_rival=placed.M @ network.coarse.T_rival),
        by_control=placed.contradictions, base=rigid.transform(np.eye(3), placed.centre),
    )  # fmt: skip


def result(scans: Sequence[Scan], network: Network, reference: int, params: Params) -> Result:
    """Write a result; see :class:`Result` for its frames."""
    given = scans[reference].T_project_scan
    base = network.base
    if base is None:  # from the frame of the reference's cloud
        base = (given if given.size else np.eye(4)) @ rigid.transform(np.eye(3), network.origins[reference])
    names = [scan.name for scan in scans]
    T_reference = rigid.with_origin(base @ network.T[reference], network.origins[reference])
    is_global = network.base is not None or not np.array_equal(T_reference, np.eye(4))
    frame = ProjectFrame.GLCS if is_global else ProjectFrame.PRCS
    table = _scans(names, network, base, frame, reference, params)
    states = table.status
    status = Status.OK if set(states) == {Status.OK} else Status.PARTIAL
    if sum(state != Status.FAILED for state in states) < 2:
        status = Status.FAILED
    of_scans = (
        reason("stitch.of-scan", scan=name, reason=single)
        for name, row in zip(names, table.reasons, strict=True)
        for single in row
    )
    noise, patch, ends = network.estimated
    return Result(
        status=status,
        method=params.method,
        reasons=(*_strangers(names, network, table, reference), *network.reasons, *of_scans),
        reference=names[reference],
        scans=table,
        pairs=_pairs(names, network),
        closures=_closures(names, network),
        noise_mm=noise,
        patch_mm=patch,
        ends_share=ends,
        frame=frame,
        T_GLCS_PRCS=T_reference if is_global else np.empty(0),
        control=network.control,
    )


def _scans(
    names: Sequence[str], network: Network, base: Floats, frame: ProjectFrame, reference: int, params: Params
) -> Scans:
    k = len(names)
    is_free = len(network.pose_scale_sd) > 0 and bool(np.nanmax(network.pose_scale_sd) > 0.0)
    T, T_rival = (_of_files(base @ poses, network.origins) for poses in (network.T, network.coarse.T_rival))
    position = (base @ network.T)[:, :3, 3]
    own = network.covariance.reshape(k, 6, k, 6)[np.arange(k), :, np.arange(k)]
    of_scans = np.stack([poses_with_scale.turned(one, base[:3, :3]) for one in own])
    sd = np.sqrt(np.einsum("kii->ki", of_scans))
    assessed = [_assess(network, s, sd[s], params) for s in range(k)]
    status = [state for state, _ in assessed]
    reasons: list[tuple[Reason, ...]] = [() if why is None else (why,) for _, why in assessed]
    unsure = tuple(name for name, state in zip(names, status, strict=True) if state == Status.AMBIGUOUS)
    for s in _not_joined(network.links, status, reference):
        # Where no rival pose is known, what made it weak is said first and stays the answer: people walk through scans.
        if unsure or status[s] is Status.OK:
            status[s] = Status.AMBIGUOUS
        reasons[s] += (reason("stitch.rests-on", scans=unsure) if unsure else reason("stitch.joins-contradicted"),)
    return Scans(
        name=tuple(names),
        status=tuple(status),
        reasons=tuple(reasons),
        T_project_scan=T,
        covariance=np.stack([rigid.about_origin(one, at) for one, at in zip(of_scans, position, strict=True)]),
        position=position,
        position_sd=sd[:, 3:],
        rotation_sd=sd[:, :3],
        scale=np.array([poses_with_scale.scale_of(pose) if is_free else 1.0 for pose in T]),
        scale_sd=network.pose_scale_sd if is_free else np.zeros(k),
        rivalry=network.coarse.rivalry,
        T_rival_scan=T_rival,
        from_frame=tuple(map(_socs, names)),
        to_frame=(str(frame),) * k,
    )


def _of_files(poses: Floats, origins: Floats) -> Floats:
    """Return poses (k, 4, 4) for coordinates as in the files, which have the origins (k, 3); NaN of those not known."""
    found = np.full_like(poses, NAN)
    for s in np.flatnonzero(np.isfinite(poses).all(axis=(1, 2))):
        found[s] = rigid.with_origin(poses[s], origins[s])
    return found


def _not_joined(links: Sequence[tuple[int, int]] | None, status: Sequence[Status], reference: int) -> list[int]:
    """Return the scans ok or weak by themselves, but whose links lead to the reference only by way of ambiguous ones.

    A repetitive structure may be placed wrongly in two halves, each of which is right by itself.
    """
    near: dict[int, set[int]] = {s: set() for s in range(len(status))}
    for a, b in links or ():
        near[a].add(b)
        near[b].add(a)
    reached, todo = {reference}, [reference]
    while todo:
        for s in near[todo.pop()] - reached:
            reached.add(s)
            if status[s] not in (Status.AMBIGUOUS, Status.FAILED):
                todo.append(s)
    settled = (Status.OK, Status.WEAK)
    return [] if links is None else [s for s, state in enumerate(status) if state in settled and s not in reached]


def _strangers(names: Sequence[str], network: Network, scans: Scans, reference: int) -> tuple[Reason, ...]:
    """Name the scans that do not belong to the network of most; the reference where it is not of the largest group."""
    if network.links is None:
        return ()
    groups = components(len(names), *np.reshape(np.array(network.links, np.int64), (-1, 2)).T)
    sizes = np.bincount(groups)
    if sizes.max() > 1 and sizes[groups[reference]] < sizes.max():
        out = np.flatnonzero(groups == groups[reference]).tolist()
    else:
        out = [
            s
            for s in range(len(names))
            if (scans.status[s] == Status.FAILED or any(one.code in STRANGE for one in scans.reasons[s]))
        ]
    return (reason("stitch.not-of-network", scans=tuple(names[s] for s in out)),) if out else ()


def _assess(network: Network, s: int, sd: Floats, params: Params) -> tuple[Status, Reason | None]:
    """Return the status of a scan whose pose has standard deviations (6,), and the first reason that it is not ok."""
    coarse = network.coarse
    if not np.isfinite(network.T[s]).all():
        return Status.FAILED, network.unplaced[s] if network.unplaced else reason("stitch.no-overlap")
    if coarse.contrary[s] > CONTRARY:
        return Status.WEAK, reason("stitch.free-space", percent=100.0 * coarse.contrary[s])
    if network.contradictions and network.contradictions[s].is_significant:
        other = network.contradictions[s]
        return Status.WEAK, reason(
            "stitch.faces-contradict",
            agree=other.agree,
            shift_mm=other.shift_mm,
            turn_mrad=other.turn_mrad,
            contradict=other.oppose,
        )
    if network.by_control and (contradiction := network.by_control[s]):
        return Status.WEAK, contradiction
    if coarse.overlap[s] < LITTLE:
        return Status.WEAK, reason("stitch.little-overlap", percent=100.0 * coarse.overlap[s])
    if coarse.rivalry[s] > AMBIGUOUS:
        return Status.AMBIGUOUS, reason("stitch.rival-pose", percent=100.0 * coarse.rivalry[s])
    rotation, position = 1e3 * sd[:3].max(), sd[3:].max()  # mrad, mm
    if not np.isfinite(position):
        return Status.WEAK, reason("stitch.no-covariance")
    if position > params.weak_mm or rotation > params.weak_mrad:
        rotation, position = NORMAL_95 * rotation, NORMAL_95 * position
        return Status.WEAK, reason("stitch.uncertain-pose", position_mm=position, rotation_mrad=rotation)
    if len(network.refuted) and network.refuted[s] > 0.0:
        return Status.AMBIGUOUS, reason("stitch.looked-through", percent=100.0 * network.refuted[s])
    return Status.OK, None


def _pairs(names: Sequence[str], network: Network) -> Pairs:
    pairs, origins = network.pairs, network.origins
    return Pairs.from_items(
        pairs,
        a=tuple(names[pair.a] for pair in pairs),
        b=tuple(names[pair.b] for pair in pairs),
        T_a_b=np.array(
            [
                rigid.with_origin(rigid.transform(np.eye(3), origins[pair.a]) @ pair.T_a_b, origins[pair.b])
                for pair in pairs
            ]
        ),
        covariance=np.array(
            [rigid.about_origin(pair.covariance[:6, :6], pair.T_a_b[:3, 3] + origins[pair.a]) for pair in pairs]
        ),
        from_frame=tuple(_socs(names[pair.b]) for pair in pairs),
        to_frame=tuple(_socs(names[pair.a]) for pair in pairs),
    )


def _closures(names: Sequence[str], network: Network) -> Closures:
    loops = pairs_and_loops.loops([pair for pair in network.pairs if pair.used], len(names))
    return Closures.from_items(loops, loop=tuple(tuple(names[i] for i in loop.rows) for loop in loops))


def _socs(name: str) -> str:
    """Name the frame of a scan's file: the scanner's own coordinate system."""
    return f"SOCS({name})"
