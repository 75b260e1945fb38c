"""Scenes that are valid files and impossible in what they mean: a name, a scene and the place that an error names."""

import dataclasses

import numpy as np

from processor.model import (
    ArchDesign,
    Control,
    DesignBodies,
    DesignPart,
    FrameDesign,
    Limit,
    Picks,
    Scan,
    Scene,
    Stations,
    StructureDesign,
    Tolerance,
)

NAN, INF = np.nan, np.inf
POINTS = np.random.default_rng(5).uniform(0.0, 900.0, (40, 3))
LONG = "n" * 2_000_000


def possible():
    """A scene with a bit of everything that comes in, all of it possible."""
    scans = (
        Scan(
            "a",
            POINTS,
            point_station=np.arange(40) % 3 - 1,
            position=[0.0, 0, 0],
            T_project_scan=np.eye(4),
            sigma_mm=1.0,
        ),
        Scan("b", POINTS + 1.0, component="p2", grid_row=np.arange(40) // 8, grid_column=np.arange(40) % 8),
    )
    triangle, edge = np.array([[0.0, 0, 0], [9, 0, 0], [0, 9, 0]]), np.array([[0.0, 0, 0], [9, 0, 0]])
    parts = tuple(DesignPart(f"p{k}", triangle, [[0, 1, 2]], edge, edge) for k in (1, 2, 3))
    structure = StructureDesign("s", triangle, [[0, 1, 2]], DesignBodies(("web",), [0]))
    return Scene(
        "site",
        "structure",
        scans,
        arch=ArchDesign(parts, ("J1", "J2"), ("p1", "p2"), ("p2", "p3"), np.ones((2, 8, 3))),
        frame=FrameDesign(
            np.arange(3), np.eye(3) * 500.0, np.full(3, 40.0),
            member_a=[0, 1], member_b=[1, 2], tube_diameters=[60.0, 60.0],
        ),
        stations=Stations(("S1", "S2"), [[0.0, 0, 0], [5, 0, 0]], np.tile(np.eye(4), (2, 1, 1))),
        structure=structure,
        tolerance=Tolerance("", "", (Limit("gap", "gap", low=-1.0, high=1.0),)),
        control=Control(
            ("T1", "T2"), np.eye(3)[:2], [1.0, 1.0], point=[0, 1], scan=[0, 1], station=[-1, -1],
            seen=np.eye(3)[:2], seen_sd=[0.0, 1.0],
        ),
        picks=Picks(("a",), ("b",), ("P",), [[1.0, 2, 3]], [[1.0, 2, 3]]),
    )  # fmt: skip


def with_value(record, path, change):
    """Return a record in which the value at a path of fields and numbers is changed by a function."""
    if not path:
        return change(record)
    if isinstance(record, tuple):
        at = int(path[0])
        return (*record[:at], with_value(record[at], path[1:], change), *record[at + 1 :])
    return dataclasses.replace(record, **{path[0]: with_value(getattr(record, path[0]), path[1:], change)})


def _item(value):
    """Put a value in the last row of an array."""

    def change(array):
        changed = np.array(array)
        changed[(-1,) * changed.ndim] = value
        return changed

    return change


def _pose(matrix):
    return lambda poses: np.broadcast_to(matrix, np.shape(poses))


def _rotation(**changes):
    def matrix():
        T = np.eye(4)
        for place, value in changes.items():
            T[int(place[1]), int(place[2])] = value
        return T

    return matrix()


POSES = {
    "scaled": np.diag([2.0, 2.0, 2.0, 1.0]),
    "mirrored": np.diag([-1.0, 1.0, 1.0, 1.0]),
    "sheared": _rotation(_01=0.5),
    "zero": np.zeros((4, 4)),
    "last row": _rotation(_30=1.0),
    "far": _rotation(_03=1e300),
    "infinite": _rotation(_13=INF),
    "infinite turn": _rotation(_00=INF),
}
SIZES = {"zero": 0.0, "negative": -5.0, "infinite": INF, "minus infinite": -INF, "NaN": NAN, "huge": 1e300}
PLACES = {"infinite": INF, "minus infinite": -INF, "NaN": NAN, "huge": 1e300}
COLUMNS = {
    "frame/radii": SIZES,
    "frame/tube_diameters": SIZES,
    "frame/centres": PLACES,
    "frame/ids": {"twice": 0},
    "frame/member_a": {"unknown": 99, "negative": -1, "itself": 2},
    "frame/member_b": {"unknown": 99, "itself": 1},
    "stations/positions": PLACES,
    "control/positions": PLACES,
    "control/sd": SIZES,
    "control/seen": PLACES,
    "control/seen_sd": {"negative": -1.0, "NaN": NAN, "infinite": INF},
    "control/point": {"beyond": 2, "negative": -1},
    "control/scan": {"beyond": 2, "negative": -1},
    "control/station": {"beyond": 2, "below": -2},
    "picks/in_a": PLACES,
    "structure/vertices": PLACES,
    "structure/faces": {"beyond": 3, "negative": -1},
    "structure/bodies/of_facet": {"beyond": 1, "negative": -1},
    "arch/joint_points": PLACES,
    "arch/parts/1/vertices": PLACES,
    "arch/parts/1/faces": {"beyond": 3, "negative": -1},
    "arch/parts/1/bottom_edge_left": {"NaN": NAN, "infinite": INF},
    "scans/0/point_station": {"beyond": 2, "below": -2, "far": 2**31 - 1},
    "scans/0/position": PLACES,
    "scans/0/origin": {"huge": 1e300},
    "scans/1/grid_row": {"below": -2, "huge": 2**31 - 1},
    "scans/1/grid_column": {"below": -2, "huge": 2**31 - 1},
}
VALUES = {
    "scans/0/sigma_mm": {"negative": -1.0, "infinite": INF},
    "temperature_C": {"infinite": INF, "below absolute zero": -300.0, "molten": 1e6},
    "kind": {"unknown": "tower", "long": LONG, "empty": ""},
    "name": {"long": LONG},
    "units": {"long": LONG},
    "scans/0/name": {"long": LONG},
    "scans/1/component": {"unknown": "p9", "long": LONG},
    "scans/0/station": {"long": LONG},
    "tolerance/limits/0/low": {"above the high": 2.0, "infinite": -INF},
    "tolerance/limits/0/key": {"long": LONG},
    "tolerance/root_gap_mm": {"NaN": NAN, "infinite": INF},
    "structure/name": {"long": LONG},
    "structure/bodies/names": {"long": (LONG,)},
    "arch/parts/1/name": {"long": LONG},
    "arch/parts/1/source": {"unknown": "guess"},
    "arch/joint_left": {"unknown": ("p1", "p9"), "itself": ("p2", "p1")},
    "arch/joint_right": {"itself": ("p1", "p3")},
    "arch/joint_names": {"twice": ("J1", "J1"), "long": ("J1", LONG)},
    "stations/ids": {"twice": ("S1", "S1"), "long": ("S1", LONG)},
    "control/ids": {"twice": ("T1", "T1"), "long": ("T1", LONG)},
    "picks/scan_a": {"unknown": ("z",), "itself": ("b",)},
    "picks/points": {"long": (LONG,)},
}  # fmt: skip


def impossible_scenes():
    """Yield the name of each case, the scene, and the place that the error names, as groups of the file."""
    whole = possible()
    for path, values in COLUMNS.items():
        for name, value in values.items():
            yield f"{path}: {name}", with_value(whole, path.split("/"), _item(value)), _place(path)
    for path, values in VALUES.items():
        for name, value in values.items():
            yield f"{path}: {name}", with_value(whole, path.split("/"), lambda _, value=value: value), _place(path)
    for path in ("scans/0/T_project_scan", "stations/T_project_station"):
        for name, matrix in POSES.items():
            yield f"{path}: {name}", with_value(whole, path.split("/"), _pose(matrix)), _place(path)


def _place(path):
    """Return the record that holds a field: two fields that contradict may be named by either."""
    parts = [f"{int(part):04d}" if part.isdigit() else part for part in path.split("/")]
    return "/".join(["/scene", *parts[:-1]])
