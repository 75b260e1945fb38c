"""Results of a preassembled bridge, written by hand: of a method that measures gaps, and of the adjustment."""

import dataclasses

import numpy as np

from processor.geometry import rigid
from processor.model import (
    ArchDesign,
    DesignPart,
    Limit,
    Scan,
    Scene,
    StepRun,
    Tolerance,
    reason,
)
from processor.pipeline import Execution
from processor.preassembly.chain import joint_measures
from processor.preassembly.chain.span_and_closure import EndSurface, PartEnd
from processor.preassembly.result import (
    Adjustment,
    Components,
    Deviations,
    Gauge,
    Joints,
    JudgedJoints,
    Linear,
    MeanMax,
    Residuals,
    Result,
    Rivals,
    TradeOff,
)
from processor.preassembly.verdicts import chain as verdicts_chain
from processor.preassembly.verdicts import joints as verdicts_joints
from processor.preassembly.verdicts import trim_and_build_up

NAN = float("nan")

KEYS = [f"P{i}" for i in range(1, 9)]

PROVENANCE = {"input": "b.h5", "input_sha256": "00", "seed": 0, "software": {"processor": "0"}, "parameters": []}


def arch_scene(names=("foot1", "rib1", "foot2"), joints=("J1", "J2")):
    edge = np.stack([np.linspace(0.0, 4000.0, 21), np.zeros(21), np.zeros(21)], axis=1)
    parts = tuple(
        DesignPart(name, bottom_edge_left=edge + np.array([4000.0 * i, 450.0, 0.0]), bottom_edge_right=edge)
        for i, name in enumerate(names)
    )
    points = np.arange(len(joints))[:, None, None] * np.array([4000.0, 0.0, 0.0]) + np.full((8, 3), 4000.0)
    design = ArchDesign(parts, joints, names[:-1], names[1:], points)
    return Scene("bridge", "arch-bridge", (Scan("s", np.zeros((2, 3))),), arch=design)


def assembled(method="design-aided", names=("foot1", "rib1", "foot2"), joints=("J1", "J2"), scale=1.0):
    """Gap of point k, axis a at the first joint: k + a / 10 mm, signs alternating; the second joint has no answer."""
    gaps = np.full((2, 8, 3), NAN)
    gaps[0] = scale * (np.arange(1.0, 9.0)[:, None] + np.arange(3) / 10.0) * np.where(np.arange(3) == 1, -1.0, 1.0)
    key_points = np.full((3, 2, 8, 3), NAN)
    key_points[0, 1] = np.arange(24.0).reshape(8, 3)
    station = np.tile(np.arange(0.0, 12000.0, 200.0), 2)
    missing = reason("preassemble.at", place="J2", reasons=(reason("preassemble.no-joint-edges"),))
    deviation = scale * (1.0 + station / 1000.0)
    return Result(
        status="partial",
        method=method,
        components=Components(
            name=names,
            status=("ok", "ok", "failed"),
            reasons=((), (), (missing,)),
            scans=names,
            T_bridge_scan=np.array([np.eye(4), np.eye(4), np.full((4, 4), NAN)]),
            covariance=np.full((3, 6, 6), NAN),
            key_points_scan=key_points,
            key_points_sd=np.full((3, 2, 8, 3), NAN),
        ),
        joints=Joints(
            name=joints,
            left=names[:-1],
            right=names[1:],
            gaps=gaps,
            gap_ci95=np.full((2, 8, 3), NAN),
            verdict=("indeterminate", "indeterminate"),
        ),
        splicing=MeanMax(mean=4.6, max=8.2),
        linear=Linear(
            gauge=Gauge.LINES,
            chainage=station,
            edge=("left",) * 60 + ("right",) * 60,
            assembled=Deviations(error=MeanMax(mean=2.0, max=3.0), deviation=deviation),
            best_fit=Deviations(error=MeanMax(mean=4.0, max=5.0), deviation=deviation + scale),
        ),
    )


OWN = {"linear-offset.png", "gap-vectors.png"}

ACROSS = [[450, -550], [-450, -550], [-450, 550], [450, 550], [0, -550], [-450, 0], [0, 550], [450, 0]]

SECTION = np.column_stack([np.zeros(8), np.array(ACROSS, float)])

LIMITS = Tolerance(
    "GB 50205-2020",
    limits=(
        Limit("misalignment_mm", "misalignment", measure="misalignment", high=2.0, clause="9.2.3"),
        Limit("groove_gap_mm", "groove gap", measure="groove_gap", low=-1.0, high=2.0, clause="9.2.3", verified=True),
    ),
)

LIMITING = reason(
    "preassemble.limiting",
    joint="J1", point="P1", ci95=0.087, share=0.69, surface=EndSurface.END_FACE, end=PartEnd.END, part="rib1",
)  # fmt: skip

ADVICE = reason("preassemble.scan-more", part="rib1", surface=EndSurface.END_FACE, end=PartEnd.END)

SPAN = Tolerance("own", "1", (Limit("span_mm", "span", low=-1.0, high=1.0, measure="span", source="project.toml"),))


def adjusted(names=("foot1", "rib1", "foot2"), joints=("J1", "J2"), per_part=600):
    """Two joints with gaps of k / 2 and -k / 4 mm, sd 0.1; residuals of 1 mm on a box 4 m long, 0.9 m by 1.1 m."""
    base = assembled("adjustment", names, joints)
    gaps = np.stack([np.outer(np.arange(8.0), [0.5, 0.2, -0.3]), np.outer(np.arange(8.0), [-0.25, 0.1, 0.2])])
    records = [joint_measures.measure(gap, 0.01 * np.eye(24), np.eye(4), SECTION) for gap in gaps]
    rng = np.random.default_rng(3)
    points, residual, component = [], [], []
    for i in range(len(names)):
        side = rng.integers(0, 4, per_part)
        y, z = rng.uniform(0.0, 450.0, per_part), rng.uniform(0.0, 1100.0, per_part)
        y, z = np.choose(side, [y, 0.0 * y, y, 0.0 * y + 450.0]), np.choose(side, [0.0 * z, z, 0.0 * z + 1100.0, z])
        points.append(np.column_stack([rng.uniform(0.0, 4000.0, per_part) + 4000.0 * i, y, z]))
        residual.append(rng.normal(0.0, 1.0, per_part))
        component.append(np.full(per_part, i, np.int32))
    linear = base.linear
    adjustment = Adjustment(
        weight=0.1,
        joints=judged_joints(joints, records),
        chain=(verdicts_chain.judge({"span": (np.array([-1.25]), np.array([0.25]))}, SPAN, 12_000.0),),
        unused_limits=("bow_mm",),
        unused_limits_what=("bow of a unit preassembled",),
        linear_offset=np.column_stack([linear.assembled.deviation, np.zeros(120)]),
        linear_offset_ci95=np.full((120, 2), 0.3),
        rivals=Rivals(component=names[:1], T_rival_scan=[rigid.transform(np.diag([-1.0, -1.0, 1.0]), [5.0, 0, 0])]),
        span_departure=-1.25,
        span_ci95=0.5,
        closure=np.array([[1.0, 2.0, 3.0], [0.1, 0.2, 0.3]]),
        closure_ci95=np.full((2, 3), 0.25),
        limiting=(LIMITING,),
        advice=(ADVICE,),
        budget_sd=np.array([0.05, 0.0, 0.2, 0.0, 0.0]),
        residuals=Residuals(
            points=np.concatenate(points), distance=np.concatenate(residual), component=np.concatenate(component)
        ),
    )
    return dataclasses.replace(
        base,
        components=dataclasses.replace(base.components, status=("ok",) * len(names)),
        joints=dataclasses.replace(
            base.joints, gaps=gaps, gap_ci95=np.full((2, 8, 3), 0.196), verdict=verdicts(adjustment)
        ),
        splicing=dataclasses.replace(base.splicing, ci95=[0.1, 0.2]),
        linear=dataclasses.replace(
            linear,
            assembled=with_band(linear.assembled, 0.37, [0.3, 0.4]),
            best_fit=with_band(linear.best_fit, 0.5, [0.5, 0.6]),
        ),
        trade_off=trade_off(np.array([[2.0, 5.0, 1.0, 2.0], [1.0, 3.0, 1.5, 3.0], [0.5, 1.0, 4.0, 9.0]])),
        adjustment=adjustment,
    )


def judged_joints(names, records):
    return JudgedJoints(
        name=names,
        measures=tuple(records),
        conformity=tuple(verdicts_joints.judge(one, LIMITS) for one in records),
        proposal=tuple(trim_and_build_up.propose(one, LIMITS) for one in records),
    )


def verdicts(adjustment):
    return tuple(one.verdict for one in adjustment.joints.conformity)


def with_band(deviations, band, ci95):
    error = dataclasses.replace(deviations.error, ci95=ci95)
    return dataclasses.replace(deviations, error=error, ci95=np.full(len(deviations.deviation), band))


def trade_off(figures):
    return TradeOff(
        weight=np.array([1.0, 0.1, 0.01]),
        splicing_mean=figures[:, 0],
        splicing_max=figures[:, 1],
        linear_mean=figures[:, 2],
        linear_max=figures[:, 3],
    )


def of_bridge(**kwargs):
    runs = (
        StepRun("preassemble", "adjustment", "{}", adjusted(**kwargs)),
        StepRun("preassemble", "line", "{}", assembled("line", scale=40)),
    )
    scene = arch_scene(kwargs.get("names", ("foot1", "rib1", "foot2")), kwargs.get("joints", ("J1", "J2")))
    scene = dataclasses.replace(
        scene,
        arch=dataclasses.replace(scene.arch, joint_points=SECTION + np.array([[[4e3, 0, 0]], [[8e3, 0, 0]]])),
    )
    return Execution(scene, runs, PROVENANCE)
