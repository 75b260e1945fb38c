"""The ray scanner's speed: rays a second with all noise terms on, beside Open3D's caster alone; a whole data set.

    python -m tests.bench.generator --output bench-generator.json [--whole]

Open3D casts the same rays at the same triangles in float32, without noise, sub-rays or exact surfaces. ``--whole`` also
makes the roof of 1040 balls (12 M points), with plain noise and with all of it, each in a process of its own, and gives
time and memory.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import open3d

from designgen.designs import arch_bridge, arch_part, space_frame, truss_bridge
from designgen.scanning import raycast, returns, scanner, space_frame_surfaces, survey
from designgen.scanning.surfaces import Builder

ROUNDS = 3


def rib():
    """A rib seen from its side: many rays hit, every hit is moved from the net to the curved plate."""
    part = arch_bridge.build(arch_bridge.Params())[2]
    builder = Builder()
    for patch in arch_part.ray_patches(part):
        builder.patch(0, patch)
    middle = part.key_points(0.5 * (part.s0 + part.s1)).mean(axis=0)
    return builder.to_surfaces(), survey.levelled_pose(middle + np.array([0.0, 2500.0, 0.0]), 0.0)


def roof():
    """A roof from below: most rays meet the sky."""
    builder = Builder()
    frame = space_frame.build(space_frame.Params(nodes_x=9, nodes_y=9))
    space_frame_surfaces.add_frame(builder, frame)
    return builder.to_surfaces(), survey.levelled_pose(np.array([11_000.0, 13_000.0, 1_600.0]), 0.0)


def truss():
    """A truss bridge on its ground from beside it: half of the rays hit, nearly all of them a few large flat faces."""
    builder = Builder()
    for part, one in enumerate(truss_bridge.build(truss_bridge.Params())):
        for patch in one.patches:
            builder.patch(part, patch)
    return builder.to_surfaces(), survey.levelled_pose(np.array([3_000.0, -5_000.0, 1_600.0]), 0.0)


def ours(surfaces, T, params):
    """Median seconds and processor seconds of a scan with everything on, and the points it gives."""
    took = []
    for round_ in range(ROUNDS + 1):
        started = time.perf_counter(), time.process_time()
        found = returns.scan_station(surfaces, T, scanner.Scanner(), params, round_, "S1")
        took.append((time.perf_counter() - started[0], time.process_time() - started[1]))
    return *np.median(took[1:], axis=0).tolist(), len(found.returns.points)  # the first compiles


def theirs(surfaces, T, grid):
    """Median seconds of Open3D for the same rays at the nets' triangles."""
    corners = ((surfaces.numbers[:, :9].reshape(-1, 3) - T[:3, 3]) @ T[:3, :3]).astype(np.float32)
    scene = open3d.t.geometry.RaycastingScene()
    faces = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(open3d.core.Tensor(corners), open3d.core.Tensor(faces))
    row, column = (x.ravel() for x in np.meshgrid(np.arange(grid.rows), np.arange(grid.columns), indexing="ij"))
    rays = np.zeros((len(row), 6), np.float32)
    rays[:, 3:] = grid.directions(row, column)
    took = []
    for _ in range(ROUNDS):
        started = time.perf_counter()
        scene.cast_rays(open3d.core.Tensor(rays))
        took.append(time.perf_counter() - started)
    return float(np.median(took))


def whole(recipe):
    """Seconds, peak memory and points of a roof of 12 M points, made by the command."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "designgen", "make", recipe, "-o", f"{folder}/s.h5", "--json"]
        started = time.perf_counter()
        said = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        took = time.perf_counter() - started
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0
    return {"points": said["points"], "seconds": took, "peak MB": peak}


def main():
    """Run, print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--whole", action="store_true")
    arguments = parser.parse_args()
    found = {}
    if arguments.whole:
        for recipe in ("frame-1040", "frame-1040-phase"):
            found[recipe] = whole(recipe)
            said = "{points:,} points in {seconds:.1f} s, peak so far {peak MB:.0f} MB".format(**found[recipe])
            print(f"{recipe}: {said}")
    params = scanner.Params(step_mrad=1.0)
    step = 1e-3 * params.step_mrad
    rows = int(np.radians(returns.HIGHEST_DEG - returns.LOWEST_DEG) / step)
    grid = raycast.Grid(step, float(np.radians(returns.LOWEST_DEG)), rows, round(2.0 * np.pi / step))
    rays = grid.rows * grid.columns
    print("scene   rays        points      M rays/s  a core  M points/s  Open3D alone, M rays/s  ratio")
    for name, (surfaces, T) in {"rib": rib(), "roof": roof(), "truss": truss()}.items():
        took, busy, points = ours(surfaces, T, params)
        row = {"rays": rays, "points": points, "M rays/s": rays / took / 1e6, "M points/s": points / took / 1e6}
        row["M rays/s a core"] = rays / busy / 1e6  # what others do on the machine counts less here
        if name != "roof":  # its shapes have no triangles
            row["Open3D M rays/s"] = rays / theirs(surfaces, T, grid) / 1e6
            row["ratio"] = row["M rays/s"] / row["Open3D M rays/s"]
        found[name] = row
        other = f"{row['Open3D M rays/s']:10.2f} {row['ratio']:19.2f}" if "ratio" in row else ""
        print(
            f"{name:<7} {rays:<11,} {points:<11,} {row['M rays/s']:8.2f} {row['M rays/s a core']:7.2f} "
            f"{row['M points/s']:11.2f} {other}"
        )
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
