"""From what a method found to the result: the project's frame, statuses, pairs and loops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from processor.geometry import rigid
from processor.model import NORMAL_95, Floats, InputError, Scan, Scene
from processor.stitching import frames
from processor.stitching.coarse.network import AMBIGUOUS
from processor.stitching.fine import control_points, pair_checks
from processor.stitching.fine.contradictions import Contradiction
from processor.stitching.fine.pair_checks import Pair
from processor.stitching.params import Params
from processor.stitching.result import Held, Result

CONTRARY = 0.25  # of what speaks for a pose; people and cars that moved make some
LOST = "shares too little with the others to be placed"
LITTLE = 0.1  # of both scans' faces


@dataclass(frozen=True)
class Network:
    """Poses of scans as found, T_ref_scan (k, 4, 4) in frames less ``origins`` (k, 3), and all that stands beside."""

    T: Floats
    covariance: Floats  # (6k, 6k): turns about each scan's own origin
    origins: Floats
    rivalry: Floats
    T_rival: Floats
    contrary: Floats  # (k,) what speaks against a scan's pose by what speaks for it
    shared: Floats  # (k,) its largest overlap with another scan
    pairs: list[Pair]
    overlap: Floats
    used: list[bool]
    messages: list[str]
    scale: Floats = field(default_factory=lambda: np.empty(0))
    scale_sd: Floats = field(default_factory=lambda: np.empty(0))
    refuted: Floats = field(default_factory=lambda: np.empty(0))  # (k,), see :func:`placing.refuted`
    dissent: Sequence[Contradiction] = ()  # about each scan's pose, where faces hold it
    spread: tuple[float, float, float] = (float("nan"),) * 3  # noise, patches, ends
    lost: Sequence[str] = ()  # why each scan that has no pose has none
    against: Sequence[str] = ()  # what control points have against each scan's pose
    point_mm: float = float("nan")  # standard deviation of a single point, or of a pick
    base: Floats | None = None  # (4, 4) where poses lead to in the project; None: from the reference's frame
    held: Held | None = None


def controlled(network: Network, scene: Scene) -> tuple[Network, tuple[str, ...]]:
    """Lay a network into the frame of control points, where there are any and they are enough; and what to say."""
    if scene.control is None or not len(scene.control.scan):
        return network, ()
    names = [scan.name for scan in scene.scans]
    try:
        found = control_points.hold(
            scene.control, names, network.T, network.covariance, network.origins, network.point_mm
        )
    except InputError as error:
        raise InputError(f"{scene.name}: {error}") from None
    if not found.held.holds:
        return replace(network, held=found.held), found.said
    base = rigid.transform(np.eye(3), found.centre)
    return replace(
        network, T=found.T, covariance=found.covariance, T_rival=found.M @ network.T_rival,
        against=found.against, base=base, held=found.held,
    ), found.said  # fmt: skip


def result(scans: Sequence[Scan], network: Network, reference: int, params: Params, said: Sequence[str] = ()) -> Result:
    """Write a result; see :class:`Result` for its frames."""
    given = scans[reference].T_project_scan
    T_project_file = given if given.size else np.eye(4)
    # The reference's cloud frame in the project, or the control points' where these hold all.
    own_base = T_project_file @ rigid.transform(np.eye(3), network.origins[reference])
    base = own_base if network.base is None else network.base
    k = len(scans)
    T, C = np.full((k, 4, 4), np.nan), np.full((k, 6, 6), np.nan)
    place, place_sd, turn_sd = np.full((k, 3), np.nan), np.full((k, 3), np.nan), np.full((k, 3), np.nan)
    rival = np.full((k, 4, 4), np.nan)
    status, message = [], []
    for s in range(k):
        if not np.isfinite(network.T[s]).all():
            status.append("failed")
            message.append((network.lost[s] if network.lost else "") or LOST)
            continue
        posed = base @ network.T[s]
        T[s] = frames.of_file(posed, network.origins[s])
        place[s] = posed[:3, 3]
        own = network.covariance[6 * s : 6 * s + 6, 6 * s : 6 * s + 6]
        own = frames.turned(own, base[:3, :3])
        C[s] = frames.about_origin(own, place[s])
        turn_sd[s], place_sd[s] = np.sqrt(np.diag(own)[:3]), np.sqrt(np.diag(own)[3:])
        if np.isfinite(network.T_rival[s]).all():
            rival[s] = frames.of_file(base @ network.T_rival[s], network.origins[s])
        state, why = _judged(network, s, place_sd[s], turn_sd[s], params)
        status.append(state)
        message.append(why)
    names = [scan.name for scan in scans]
    found = network.pairs
    heavy = np.array([1.0 / max(float(np.trace(p.covariance[3:, 3:])), 1e-12) for p in found])
    used = np.array(network.used, bool)
    good = [p for p, u in zip(found, used, strict=True) if u]
    loops = pair_checks.loops(good, heavy[used], reference, k) if good else []
    states = set(status)
    overall = "ok" if states <= {"ok"} else "failed" if states - {"failed"} == set() or k < 2 else "partial"
    if sum(one != "failed" for one in status) < 2:
        overall = "failed"
    text = list(said) + [f"{n}: {m}" for n, m in zip(names, message, strict=True) if m]
    count = len(found)
    return Result(
        overall, params.method, "; ".join(text), names[reference],
        tuple(names), tuple(status), tuple(message), T, C, place, place_sd, turn_sd, network.rivalry, rival,
        tuple(names[p.a] for p in found), tuple(names[p.b] for p in found),
        network.overlap, np.array([p.residual for p in found]), used.astype(np.uint8), tuple(network.messages),
        np.array([_pair_of_files(p, network.origins) for p in found]).reshape(-1, 4, 4),
        np.array([_pair_covariance(p, network.origins) for p in found]).reshape(-1, 6, 6),
        np.array([p.pieces for p in found], np.int64),
        network.scale if len(network.scale) else np.full(count, np.nan),
        network.scale_sd if len(network.scale_sd) else np.full(count, np.nan),
        tuple(" > ".join(names[i] for i in loop.rows) for loop in loops),
        np.array([loop.mm for loop in loops]), np.array([loop.mrad for loop in loops]),
        np.array([loop.ratio for loop in loops]), *network.spread, control=network.held,
    )  # fmt: skip


def _judged(network: Network, s: int, place_sd: Floats, turn_sd: Floats, params: Params) -> tuple[str, str]:
    rivalry = float(network.rivalry[s])
    if network.contrary[s] > CONTRARY:
        return "weak", f"much speaks against its pose ({100.0 * network.contrary[s]:.0f} % of what speaks for it)"
    if network.dissent and network.dissent[s].counts:
        other = network.dissent[s]
        return "weak", (
            f"{other.agree} faces agree that it stands {other.shift_mm:.2g} mm and {other.turn_mrad:.2g} mrad "
            f"elsewhere, {other.hold} speak against that: something moved in between, or the scan is bent"
        )
    if network.against and network.against[s]:
        return "weak", network.against[s]
    if network.shared[s] < LITTLE:
        return "weak", f"it shares little with any other scan ({100.0 * network.shared[s]:.0f} %)"
    if rivalry > AMBIGUOUS:
        return "ambiguous", f"another pose speaks for itself as well ({100.0 * rivalry:.0f} % of this one's score)"
    if not np.isfinite(place_sd).all():
        return "weak", "nothing tells how sure its pose is"
    if place_sd.max() > params.weak_mm or 1e3 * turn_sd.max() > params.weak_mrad:
        place, turn = NORMAL_95 * place_sd.max(), 1e3 * NORMAL_95 * turn_sd.max()
        return "weak", f"its pose is sure to {place:.2g} mm and {turn:.2g} mrad only"
    if len(network.refuted) and network.refuted[s] > 0.0:
        return "ambiguous", (
            f"{100.0 * network.refuted[s]:.2g} % of what it shares with the only scan beside it was looked through, as "
            "where a structure repeats itself or things moved: a third scan, common points or control would tell"
        )
    return "ok", ""


def _pair_of_files(pair: Pair, origins: Floats) -> Floats:
    T = rigid.transform(np.eye(3), origins[pair.a]) @ pair.T_a_b
    return frames.of_file(T, origins[pair.b])


def _pair_covariance(pair: Pair, origins: Floats) -> Floats:
    return frames.about_origin(pair.covariance, pair.T_a_b[:3, 3] + origins[pair.a])
