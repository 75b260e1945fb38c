"""Every ball of a frame without a design, beside the strongest peers, on the same points in the same run.

    python -m tests.bench.spheres.peers --output out.json

CloudCompare's RANSAC_SD takes the whole cloud as ours does; pyransac3d and ``processor.fit_sphere`` fit the crop about
every true ball, which is easier. A peer that is not installed is left out and named (CloudCompare: Debian's packages
cloudcompare and xvfb).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import random
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement
from scipy.spatial import cKDTree

import processor
from processor.api.arrays import LEAST_POINTS
from processor.model import NORMAL_95, Status
from processor.space_frame import step as space_frame_step
from processor.space_frame.points.source import SceneSource
from processor.views import views
from tests.bench.bolt_balls import scene_of

NEAR_MM = 10.0
CROP_MM = 20.0
TAU_MM = 4.0


def scored(name, seconds, centres, radii, truth):
    """Figures of found balls (k, 3), (k,) against the true ones; the nearest found one answers for a true one."""
    row = {"method": name, "seconds": seconds, "found": len(radii)}
    if not len(radii):
        return row | {"recall": 0.0}
    distance, which = cKDTree(centres).query(truth.centres)
    hit = distance < NEAR_MM
    off = np.abs(radii[which[hit]] - truth.radii[hit])
    inside = cKDTree(truth.centres).query(centres)[0] < 50.0
    return row | {
        "recall": float(hit.mean()),
        "precision": float(inside.mean()),
        "centre mean": float(distance[hit].mean()),
        "radius mean": float(off.mean()),
        "radius max": float(off.max()),
    }


def ours(scene, truth):
    """Method ray, blind; compiled code warm."""
    blind = dataclasses.replace(scene, frame=None)
    for _ in range(2):
        started = time.monotonic()
        result = space_frame_step.run(blind, space_frame_step.Params())
        seconds = time.monotonic() - started
    known = np.isfinite(result.balls.centres).all(axis=1)
    return scored("ray, whole cloud", seconds, result.balls.centres[known], result.balls.radii[known], truth)


def crops_of(scene, truth):
    """Points of the crop about every true ball, of those that have as many as both fits need."""
    source = SceneSource(views(scene))
    points = np.vstack([chunk.points for chunk in source.chunks()]) + source.origin
    rows = cKDTree(points).query_ball_point(truth.centres, truth.radii + CROP_MM)
    return [points[own] for own in rows if len(own) >= LEAST_POINTS]


def fits(crops, truth):
    """fit_sphere on each crop, compiled code warm."""
    processor.fit_sphere(crops[0])
    started = time.monotonic()
    found = [processor.fit_sphere(crop) for crop in crops]
    seconds = time.monotonic() - started
    ok = [one for one in found if one.status is Status.OK]
    near = cKDTree(truth.centres).query(np.array([one.centre for one in ok]).reshape(-1, 3))[1]
    pulls = [(one.radius - r) / np.sqrt(one.covariance[3, 3]) for one, r in zip(ok, truth.radii[near], strict=True)]
    found = [one for one in found if one.points]
    centres, radii = np.array([one.centre for one in found]).reshape(-1, 3), np.array([one.radius for one in found])
    row = scored("fit_sphere, crops given", seconds, centres, radii, truth)
    return row | {"ok": len(ok), "intervals hold": float(np.mean(np.abs(pulls) < NORMAL_95)) if ok else float("nan")}


def ransac(crops, truth):
    """pyransac3d on each crop."""
    import pyransac3d

    random.seed(1)
    started = time.monotonic()
    found = [pyransac3d.Sphere().fit(crop, thresh=TAU_MM, maxIteration=1000)[:2] for crop in crops]
    seconds = time.monotonic() - started
    centres = np.array([np.ravel(centre) for centre, _ in found]).reshape(-1, 3)
    return scored("pyransac3d, crops given", seconds, centres, np.array([radius for _, radius in found]), truth)


def cloudcompare(scene, truth):
    """CloudCompare's RANSAC_SD for spheres and cylinders on the whole cloud, in metres less an origin."""
    source = SceneSource(views(scene))
    points = 1e-3 * np.vstack([chunk.points for chunk in source.chunks()])
    vertices = np.array([tuple(p) for p in points], dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
    with tempfile.TemporaryDirectory() as folder:
        cloud = Path(folder) / "cloud.ply"
        PlyData([PlyElement.describe(vertices, "vertex")]).write(cloud)
        command = ["xvfb-run", "-a", "CloudCompare", "-SILENT", "-M_EXPORT_FMT", "PLY", "-O", str(cloud), "-RANSAC"]
        command += ["EPSILON_ABSOLUTE", "0.004", "BITMAP_EPSILON_ABSOLUTE", "0.02", "SUPPORT_POINTS", "30"]
        command += ["MAX_NORMAL_DEV", "25", "PROBABILITY", "0.01", "OUTPUT_INDIVIDUAL_PRIMITIVES"]
        command += ["ENABLE_PRIMITIVE", "SPHERE", "CYLINDER"]
        started = time.monotonic()
        subprocess.run(command, cwd=folder, capture_output=True, timeout=900, check=True)
        seconds = time.monotonic() - started
        centres, radii = [], []
        for path in sorted(Path(folder).glob("*SPHERE*.ply")):
            mesh = PlyData.read(path)["vertex"]
            corners = np.stack([mesh[axis] for axis in "xyz"], axis=1).astype(np.float64)
            low, high = corners.min(axis=0), corners.max(axis=0)
            centres.append(500.0 * (low + high) + source.origin)
            radii.append(500.0 * float((high - low).max()))
    found, sizes = np.array(centres).reshape(-1, 3), np.array(radii)
    ball = (sizes > 30.0) & (sizes < 160.0)
    return scored("CloudCompare RANSAC_SD, whole cloud", seconds, found[ball], sizes[ball], truth)


def main():
    """Run ours and every peer there is, print a table with ratios, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", default="small")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    scene, truth = scene_of(arguments.case, 1)
    crops = crops_of(scene, truth.frame)
    rows = [ours(scene, truth.frame), fits(crops, truth.frame)]
    try:
        rows.append(ransac(crops, truth.frame))
    except ImportError:
        print("pyransac3d is not installed: left out (pip install pyransac3d)")
    if shutil.which("CloudCompare") and shutil.which("xvfb-run"):
        rows.append(cloudcompare(scene, truth.frame))
    else:
        print("CloudCompare is not installed: left out (apt-get install cloudcompare xvfb)")
    for row in rows:
        row["seconds by whole cloud"], row["seconds by fit"] = (row["seconds"] / one["seconds"] for one in rows[:2])
        print("  ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), flush=True)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
