"""Runs whose results are given, so that what is exported of them is known; points by numpy alone."""

import dataclasses
import json

import numpy as np
from scipy.spatial.transform import Rotation

from processor.api.runs import Results
from processor.model import Scan, Scene, Status, StepRun
from processor.pipeline import Execution
from processor.preassembly.result import Components
from processor.preassembly.result import Result as Assembly
from processor.stitching.result import Result as Stitched
from processor.stitching.result import Scans
from processor.store import store

NEAR = np.zeros(3)
MAP = np.array([3_512_000_000.0, 420_000_000.0, 35_000.0])  # coordinates of a national grid, mm


def pose(seed, far=NEAR):
    """T_project_scan (4, 4)."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = far + rng.uniform(-9000.0, 9000.0, 3)
    return T


def swept(name, seed, rows=40, columns=70, **fields):
    """A scan in its scanner's frame, on rows and columns of the scanner's grid, with intensity."""
    rng = np.random.default_rng(seed)
    row, column = np.divmod(rng.permutation(rows * columns)[: rows * columns - 9], columns)
    e, a = 0.02 * (row - rows / 2), 0.05 * column
    r = rng.uniform(2000.0, 30_000.0, len(row))
    points = np.stack([r * np.cos(e) * np.cos(a), r * np.cos(e) * np.sin(a), r * np.sin(e)], axis=1)
    points = points.round(3)
    return Scan(
        name, points, intensity=rng.integers(0, 4096, len(row)).astype(float), grid_row=row.astype(np.int32),
        grid_column=column.astype(np.int32), colour=rng.integers(0, 256, (len(row), 3)), sigma_mm=1.5, **fields,
    )  # fmt: skip


def execution(scene, step, result, params=None):
    """What a run of one step would have left."""
    provenance = {
        "input": scene.name,
        "input_sha256": store.scene_hash(scene),
        "seed": 0,
        "software": {},
        "parameters": [{"step": step, **(params or {})}],
    }
    return Execution(scene, (StepRun(step, result.method, json.dumps(params or {}), result),), provenance)


def stitched(scans, poses, statuses=None, *, scale="fixed", scene=None):
    """Return the results of a run that stitched scans, of a scene or alone, by these poses (k, 4, 4)."""
    k = len(scans)
    table = Scans(
        name=[scan.name for scan in scans], status=statuses or [Status.OK] * k, reasons=((),) * k,
        T_project_scan=np.array(poses), covariance=np.zeros((k, 6, 6)), position=np.zeros((k, 3)),
        position_sd=np.zeros((k, 3)), rotation_sd=np.zeros((k, 3)), scale=np.ones(k), scale_sd=np.zeros(k),
        rivalry=np.zeros(k), T_rival_scan=np.full((k, 4, 4), np.nan), from_frame=["scan"] * k, to_frame=["project"] * k,
    )  # fmt: skip
    result = Stitched(status=Status.OK, method="automatic", reference=scans[0].name, scans=table)
    scene = scene or Scene("hall", "structure", tuple(scans))
    return Results(execution(scene, "stitch", result, {"scale": scale}))


def assembled(scans, poses, temperature_C=float("nan"), status=Status.OK, used=None, scan_poses=()):
    """Return the results of a run that assembled parts foot1, foot2, ... of one scan each by these poses (c, 4, 4)."""
    names, c = tuple(dict.fromkeys(scan.component for scan in scans)), len(poses)
    table = Components(
        name=names, status=[status] * c, reasons=((),) * c, scans=used or names, T_bridge_scan=np.array(poses),
        covariance=np.zeros((c, 6, 6)), key_points_scan=np.zeros((c, 2, 8, 3)), key_points_sd=np.zeros((c, 2, 8, 3)),
        scan_poses=scan_poses,
    )  # fmt: skip
    result = Assembly(status=status, method="adjustment", components=table)
    scene = Scene("bridge", "arch-bridge", tuple(scans), temperature_C=temperature_C)
    return Results(execution(scene, "preassemble", result))


def not_run(scene):
    """Return the results of a run without any step."""
    done = execution(scene, "stitch", Stitched(status=Status.OK, method="automatic"))
    return Results(dataclasses.replace(done, runs=(), provenance={**done.provenance, "parameters": []}))
