"""Results of balls, written by hand: of a few balls, and of a whole frame."""

import dataclasses
import math

import numpy as np

from processor.evaluation.evaluate import ErrorReport
from processor.model import (
    FrameDesign,
    Scan,
    Scene,
    StepRun,
    Tolerance,
    reason,
)
from processor.pipeline import Execution
from processor.space_frame import step as space_frame_step
from processor.space_frame.design import movement
from processor.space_frame.result import (
    Balls,
    DesignPose,
    Gauges,
    MovementReference,
    Result,
    StationCorrections,
    StationMotion,
    Tubes,
)
from tests.support.results.bridge_results import NAN, PROVENANCE


def balls(method="ransac", radii=(45.5, 60.0, NAN), flag=("ok", "wrong-size", "not-found")):
    radii = np.array(radii)
    k = len(radii)
    centres = np.where(np.isfinite(radii)[:, None], np.arange(3.0 * k).reshape(k, 3) * 1000.0, NAN)
    found = Balls(
        ids=np.arange(k) + 7,
        centres=centres,
        radii=radii,
        lowest=centres - radii[:, None] * [0.0, 0.0, 1.0],
        covariance=np.where(np.isfinite(radii)[:, None, None], 0.04 * np.eye(4), NAN),
        lowest_sd=np.full(k, 0.1),
        points=np.full(k, 50),
        visible_fraction=np.full(k, 0.5),
        rms=np.full(k, 1.0),
        nominal_radii=np.full(k, 45.0),
        evidence=("ball",) * k,
        flag=tuple(flag),
        reasons=tuple(() if one == "ok" else (reason("spheres.no-sphere"),) for one in flag),
        verdict=("none",) * k,
    )
    return space_frame_step.Result(status="partial", method=method, balls=found)


NAN = float("nan")

NOMINAL = np.array([[0.0, 0, 6000], [3000, 0, 6000], [0, 4000, 6000], [3000, 4000, 6000], [1500, 2000, 8000]])

MOVED = np.array([[3.0, 4, 0], [0, 0, -12.0], [NAN] * 3, [0.3, 0, 0.4], [NAN] * 3])

SETTLED = np.array([0.0, 0.0, 2.0])  # less in the movements after a best fit

FLAG = ("ok", "wrong-size", "not-found", "low-confidence", "ok")

REASONS = (
    (),
    (reason("spheres.other-size", size=60.0, nominal=50.0),),
    (reason("spheres.no-ball-no-axes"),),
    (reason("spheres.few-points", points=12, least=20),),
    (reason("spheres.not-in-design"),),
)

TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # a quarter turn about z


def pose(R=None, t=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3] = np.eye(3) if R is None else R
    T[:3, 3] = t
    return T


def whole(limit=10.0, T=None, matching="ok", changed=None, **changes):
    """Four nodes of a design and one more; node 12 (the third) is missing. Movements have sd 0.5, 1 and 2 mm."""
    T = pose() if T is None else T
    there = NOMINAL + np.nan_to_num(MOVED)
    centres = (there - T[:3, 3]) @ T[:3, :3]
    radii = np.array([45.1, 60.2, NAN, 45.0, 50.0])
    centres[2] = NAN
    covariance = np.tile(np.diag([0.01, 0.04, 0.09, 0.0025]), (5, 1, 1))
    covariance[2] = NAN
    moved_covariance = np.tile(np.diag([0.25, 1.0, 4.0]), (5, 1, 1))
    moved_covariance[[2, 4]] = NAN
    columns = {
        "ids": np.array([10, 11, 12, 13, 14]),
        "centres": centres,
        "radii": radii,
        "lowest": centres - radii[:, None] * [0.0, 0.0, 1.0],
        "covariance": covariance,
        "lowest_sd": np.array([0.1, 0.2, NAN, 0.3, 0.4]),
        "points": np.array([500, 400, 0, 12, 300]),
        "visible_fraction": np.full(5, 0.3),
        "rms": np.full(5, 0.4),
        "nominal_radii": np.array([45.0, 50.0, 50.0, 45.0, NAN]),
        "evidence": ("fused", "ball", "axes", "fused", "fused"),
        "flag": FLAG,
        "reasons": REASONS,
        "sizes": np.array([45.0, 60.0, NAN, 45.0, 50.0]),
        "axes": np.array([3, 3, 0, 3, 4]),
        "stations": np.array([2, 2, 0, 1, 2]),
        "bound_sd": np.array([[0.08, 0.16, 0.24, 0.04, 0.09]] * 5),
        "efficiency": np.array([[0.8, 0.9, 0.95]] * 5),
        "movement": MOVED,
        "movement_ci95": 1.96 * np.sqrt(np.einsum("kii->ki", moved_covariance)),
        "movement_covariance": moved_covariance,
        "movement_gauge": ("design-coordinates",) * 5,
        "design_movement": MOVED,
        "design_ci95": 1.96 * np.sqrt(np.einsum("kii->ki", moved_covariance)),
        "best_fit_movement": MOVED + SETTLED,
        "best_fit_ci95": np.sqrt(np.einsum("kii->ki", moved_covariance)),
        **(changed or {}),
    }
    size, ci95 = movement.size_of(np.asarray(columns["movement"]), np.asarray(columns["movement_covariance"]))
    verdict = tuple(
        movement.judge(one, half, limit, matching == "ok" and evidence != "axes", Tolerance()).verdict
        for one, half, evidence in zip(size, ci95, columns["evidence"], strict=True)
    )
    made = Result(
        status="partial",
        method="ray",
        reasons=(reason("spheres.ranges"),),
        balls=Balls(**columns, movement_size=size, movement_size_ci95=ci95, verdict=verdict),
        movement_reference=MovementReference(
            gauge="design-coordinates", limit=limit, limit_source="" if math.isnan(limit) else "project.toml"
        ),
        gauges=Gauges(
            gauge="design-coordinates",
            basis="stations",
            georeference_sd=0.3,
            difference=-SETTLED,
            largest_difference=2.0,
            design_mean=np.nanmean(MOVED, axis=0),
            design_largest=12.0,
            best_fit_mean=np.nanmean(MOVED + SETTLED, axis=0),
            best_fit_largest=10.0,
        ),
        matching=DesignPose(status=matching, T_design_scan=T, covariance=np.zeros((6, 6)), rivals=np.empty((0, 4, 4))),
        tubes=Tubes(
            start=(np.array([[100.0, 0, 6000], [3000.0, 3900, 6000]]) - T[:3, 3]) @ T[:3, :3],
            end=(np.array([[2900.0, 0, 6000], [100.0, 4000, 6000]]) - T[:3, 3]) @ T[:3, :3],
            radii=np.array([30.0, 30.0]),
            bow=np.array([0.5, 1.5]),
            radius_ci95=np.array([0.2, 0.3]),
            start_ci95=np.full((2, 3), 0.4),
            end_ci95=np.full((2, 3), 0.5),
            a=np.array([10, 13]),
            b=np.array([11, -1]),
        ),
        stations=StationCorrections(
            names=("S1", "=S2"),
            T=np.array([pose(), pose(t=(1.0, -2.0, 3.0))]),
            reasons=((), (reason("spheres.weak-motions", motions=(StationMotion.SHIFT_X,)),)),
        ),
    )
    return dataclasses.replace(made, **changes)


def without_design(result):
    """The same balls as found without a design: no movements."""
    none = np.empty(0)
    names = (
        "movement", "movement_ci95", "movement_covariance", "movement_size", "movement_size_ci95", "design_movement",
        "design_ci95", "best_fit_movement", "best_fit_ci95",
    )  # fmt: skip
    found = dataclasses.replace(
        result.balls, **dict.fromkeys(names, none), movement_gauge=(), verdict=("none",) * len(result.balls)
    )
    return dataclasses.replace(result, balls=found, movement_reference=None, matching=None, gauges=None)


def repeated(result, times):
    """The balls of a result so many times."""
    many = {}
    for field in dataclasses.fields(result.balls):
        value = getattr(result.balls, field.name)
        many[field.name] = (
            np.tile(value, (times,) + (1,) * (value.ndim - 1)) if hasattr(value, "ndim") else value * times
        )
    many["ids"] = np.arange(len(result.balls) * times)
    return dataclasses.replace(result, balls=Balls(**many))


def cloud(result, design=NOMINAL, rng=None):
    """Points of spheres of 45 mm about all nodes."""
    rng = np.random.default_rng(0) if rng is None else rng
    unit = rng.normal(size=(5, 400, 3))
    unit /= np.linalg.norm(unit, axis=2)[:, :, None]
    T = pose() if result.matching is None else result.matching.T_design_scan
    return (design[:, None] + 45.0 * unit).reshape(-1, 3) @ T[:3, :3] - T[:3, 3] @ T[:3, :3]


def scene(result, points=None):
    points = cloud(result) if points is None else points
    design = FrameDesign([10, 11, 12, 13], NOMINAL[:4], [45.0, 50.0, 50.0, 45.0])
    return Scene("frame", "space-frame", (Scan("s", points),), frame=design)


def of_frame(result=None, report=None, points=None):
    result = whole() if result is None else result
    return (
        Execution(scene(result, points), (StepRun("spheres", "ray", "{}", result),), PROVENANCE),
        ErrorReport() if report is None else report,
    )


def with_truth():
    result = whole()
    radii = np.array([45.0, 60.0, 50.0, 45.2, NAN])
    return ErrorReport((), {"ray": radii}, {"ray": np.where(np.isnan(radii)[:, None], NAN, NOMINAL + 0.0)}), result
