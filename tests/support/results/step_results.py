"""Results of stitching and of the search for defects, made by hand: all that they say, and no numbers that count."""

import dataclasses

import numpy as np

from processor.defects.result import Curve, DefectClass, Defects, Picture, SurfacePlaces, Windows
from processor.defects.result import Result as DefectsResult
from processor.inspection.result import AxisDepartures, Characteristics, InspectedComponent, Quantity
from processor.inspection.result import Result as Inspection
from processor.model import Scan, Scene, StepRun, StructureDesign, Verdict, reason
from processor.pipeline import Execution
from processor.stitching.common_point_checks import UnitSlip
from processor.stitching.result import Closures, ControlPoints, ControlSightings, Pairs, Scans
from processor.stitching.result import Result as Stitching

PROVENANCE = {"input": "site", "input_sha256": "0" * 64, "seed": 0, "software": {}, "parameters": []}
SCAN_REASONS = (
    None,
    reason("stitch.free-space", percent=31.0),
    reason("stitch.little-overlap", percent=4.0),
    reason("stitch.rival-pose", percent=97.0),
    reason("stitch.no-covariance"),
    reason("stitch.looked-through", percent=2.3),
    reason("stitch.faces-contradict", agree=7, shift_mm=3.1, turn_mrad=0.086, contradict=5),
    reason("stitch.uncertain-pose", position_mm=25.0, rotation_mrad=120.0),
    reason("stitch.no-overlap"),
)
STATES = ("ok", "weak", "weak", "ambiguous", "weak", "ambiguous", "weak", "weak", "failed")
PAIR_REASONS = (
    reason("stitch.pair-contradicts"),
    reason("stitch.pair-elsewhere"),
    reason("stitch.scale-of-units", scale=0.001, units=UnitSlip.M_MM),
    reason("stitch.scale-by-blunder", scale=1.004),
    reason("stitch.scale", ppm=-120.0, ci95_ppm=80.0),
    reason("stitch.picks-scatter", sd_mm=38.0),
)


def plate(columns=24, rows=12, side=50.0):
    """A scan of a plate, x along it and z up, and its design of two faces."""
    x, z = (side * np.arange(count) for count in (columns, rows))
    xx, zz = (one.ravel() for one in np.meshgrid(x, z, indexing="ij"))
    points = np.column_stack([xx, 2.0 * np.sin(xx / 200.0), zz])
    corners = np.array([[0.0, 0, 0], [x[-1], 0, 0], [x[-1], 0, z[-1]], [0, 0, z[-1]]])
    return points, StructureDesign("plate", corners, np.array([[0, 1, 2], [0, 2, 3]]))


def scene(names=("S1",), name="site"):
    points, design = plate()
    # No two scans measure the very same places, else one would be a copy of the other.
    scans = tuple(Scan(one, points + 1e-3 * k, np.zeros(3), T_project_scan=np.eye(4)) for k, one in enumerate(names))
    return Scene(
        name,
        "structure",
        scans,
        structure=design,
        units="mm",
        units_reason=(reason("units.by-project", file="project.toml"),),
    )


def stitching(names=("S1", "S2", "S3", "S4", "S5", "S6", "S7", "S8", "S9")):
    """Nine scans in all states, six pairs with all reasons of pairs, and a loop."""
    k, p = len(names), len(PAIR_REASONS)
    pose = np.tile(np.eye(4), (k, 1, 1))
    pose[:, :3, 3] = 1000.0 * np.column_stack([np.arange(k), np.arange(k) % 3, np.zeros(k)])
    pose[-1] = np.nan
    few, line = reason("stitch.few-points", points=2), reason("stitch.points-on-a-line")
    reasons = [
        reason("stitch.of-scan", scan=name, reason=one) for name, one in zip(names, SCAN_REASONS, strict=True) if one
    ]
    reasons.append(reason("stitch.pair-not-used", a=names[0], b=names[5], shortage=few))
    reasons.append(reason("stitch.pair-not-used", a=names[1], b=names[5], shortage=line))
    reasons += [reason("stitch.of-pair", a=names[0], b=names[i], reason=one) for i, one in enumerate(PAIR_REASONS, 1)]
    scans = Scans(
        name=names, status=STATES, reasons=[(one,) if one else () for one in SCAN_REASONS], T_project_scan=pose,
        covariance=np.zeros((k, 6, 6)), position=pose[:, :3, 3], position_sd=np.full((k, 3), 0.2),
        rotation_sd=np.full((k, 3), 1e-5), scale=np.ones(k), scale_sd=np.zeros(k),
        rivalry=np.full(k, 0.5), T_rival_scan=np.full((k, 4, 4), np.nan),
        from_frame=names, to_frame=("PRCS",) * k,
    )  # fmt: skip
    pairs = Pairs(
        a=(names[0],) * p, b=names[1 : p + 1], overlap=np.linspace(0.2, 0.9, p), residual=np.linspace(0.5, 1.0, p),
        used=np.arange(p) > 0, reasons=[(one,) for one in PAIR_REASONS], shared=np.full(p, 12),
        T_a_b=np.tile(np.eye(4), (p, 1, 1)), covariance=np.zeros((p, 6, 6)), scale=np.ones(p),
        scale_sd=np.full(p, np.nan), from_frame=names[1 : p + 1], to_frame=(names[0],) * p,
    )  # fmt: skip
    loop = (*names[:3], names[0])
    return Stitching(
        status="partial", method="automatic", reasons=reasons, reference=names[0], scans=scans, pairs=pairs,
        closures=Closures(loop=(loop,), mm=np.array([0.4]), mrad=np.array([0.1]), ratio=np.array([1.1])),
    )  # fmt: skip


def stitched_with_control():
    """The same, with control points and the frame of a site."""
    sightings = ControlSightings(
        point=("P1", "=P2"), scan=("S1", "S2"), off=np.ones((2, 3)), sd=np.ones((2, 3)), share=np.ones(2),
        used=[True, False],
    )  # fmt: skip
    control = ControlPoints(holds=True, redundancy=3, ratio=0.9, sightings=sightings)
    return dataclasses.replace(stitching(), control=control, frame="GLCS", T_GLCS_PRCS=np.eye(4))


def inspection():
    """Two components: of one four characteristics, one not measured, and an axis; the other not registered."""
    nan = float("nan")
    found = Characteristics(
        id=("length", "twist", "sweep", "end-squareness-over-width"),
        quantity=(Quantity.LENGTH, Quantity.TWIST, Quantity.SWEEP, Quantity.SQUARENESS),
        nominal=[12000.0, 0.0, 0.0, 0.0], actual=[12003.5, 1.25, -2.0, nan], deviation=[3.5, 1.25, -2.0, nan],
        ci95=[0.5, 0.2, 0.3, nan], lower=[-4.8, nan, -6.0, -2.0], upper=[4.8, nan, 6.0, 2.0], unit=("mm",) * 4,
        verdict=(Verdict.PASS, Verdict.NONE, Verdict.FAIL, Verdict.INDETERMINATE),
        limit=("part_length_mm", "", "part_sweep_mm", "part_squareness_mm"), clause=("GB", "", "GB", "GB"),
        verified=[False, False, False, False],
        reasons=((), (), (), (reason("inspect.end-not-measured", ends=("end",)),)),
    )  # fmt: skip
    axis = AxisDepartures(
        chainage=[100.0, 300.0], sideways=[0.0, -2.0], sideways_ci95=[0.1, 0.3], up=[0.0, 1.0], up_ci95=[0.1, 0.2]
    )
    parts = (
        InspectedComponent(name="rib1", characteristics=found, axis=axis),
        InspectedComponent(name="rib2", status="failed", reasons=(reason("inspect.not-registered"),)),
    )
    return Inspection(status="partial", method="default", components=parts)


CLASSES = tuple(DefectClass)
ALL = len(CLASSES)
EXAMINED = (reason("defects.examined", examined=1.2, surface=2.4),)
REMARKS = tuple((reason(f"defects.{code}"),) for code in ("through", "depth-bound", "no-thickness"))


def defects(count=ALL, reasons=EXAMINED, seed=1, places=288, method="default"):
    """Defects of every class, a picture of two and the curve of one."""
    rng = np.random.default_rng(seed)
    side = 5
    classes = tuple(CLASSES[i % len(CLASSES)] for i in range(count))
    deviation = rng.normal(size=(2, side, side))
    curve = Curve(along=np.linspace(-200.0, 200.0, 4), displacement=np.full(4, 1.5), ci95=np.full(4, 0.15))
    columns = {
        "confidence": 0.9, "area_mm2": 13.5e3, "depth_max": 1.5, "depth_ci95": 0.3, "depth_mean": 1.5,
        "volume_mm3": 1.5e4, "volume_ci95": 1.5e3, "edge_distance": 75.0, "curvature_per_m": 1.5, "lod95": 0.3,
        "z": 13.5, "chance": 1.5e-9,
    }  # fmt: skip
    return DefectsResult(
        status="ok",
        method=method,
        reasons=reasons,
        T_design_project=np.eye(4),
        registration_error=0.1,
        cell=10.0,
        noise=0.5,
        lod95=0.3,
        examined_mm2=1.2e6,
        expected_mm2=1.3e6,
        points=288,
        points_used=280,
        least_depth=Windows(side=[10.0, 20.0], depth=[1.0, 0.5], noise_inflation=[1.0, 1.2]),
        defects=Defects(
            id=np.arange(count),
            defect_class=classes,
            otherwise=tuple(reversed(classes)),
            component=tuple(f"component-{i + 1}" for i in range(count)),
            centre=np.column_stack(
                [rng.uniform(100.0, 1000.0, count), np.zeros(count), rng.uniform(50.0, 500.0, count)]
            ),
            axes=np.tile(np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]), (count, 1, 1)),
            extent=np.full((count, 2), 120.0),
            doubtful=np.zeros(count, bool),
            reasons=tuple(REMARKS[i % 3] if i % 4 else () for i in range(count)),
            deflection=tuple(Curve() if i else curve for i in range(count)),
            **{name: np.full(count, value) for name, value in columns.items()},
        ),
        pictures=tuple(
            Picture(low=[-30.0, -30.0], cell=12.0, deviation=one, part=np.arange(side**2).reshape(side, side) % 3 == 0)
            for one in deviation[:count]
        ),
        surface=SurfacePlaces(
            points=np.column_stack(
                [rng.uniform(0.0, 1150.0, places), np.zeros(places), rng.uniform(0.0, 550.0, places)]
            ),
            deviation=np.sin(np.arange(places)),
            defect=np.where(np.arange(places) % 4, -1, np.arange(places) % count),
        ),
    )


def execution(*runs, names=("S1",)):
    """An execution of (step, method, result)."""
    return Execution(scene(names), tuple(StepRun(*one) for one in runs), PROVENANCE)
