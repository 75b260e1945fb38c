"""Spheres as they are in the field: how often ``fit_sphere`` is ``ok``, and its intervals then hold.

    python -m tests.bench.spheres.field [--draws 200] [--only clean,mean-20] [--spacing 3.5] [--output out.json]

A cap of a ball of 75 mm is seen from 10 m, in rows and columns of the scanner, with noise along the rays. Its ranges
have an offset and a bias by incidence, drawn for each ball from the class "phase". Of each cell the table gives the
share that is ok, and of those the shares whose centre (of three coordinates) and radius lie within 95 %.
"""

from __future__ import annotations

import argparse
import json
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import processor
from designgen.scanning import processing
from processor.adjustment.scanner_class_errors import CLASSES
from processor.model import NORMAL_95, Scan, Scene, Status, Truth

RADIUS, RANGE = 75.0, 10_000.0
CAPS, NOISES = (0.1, 0.15, 0.2, 0.3, 0.5), (0.5, 1.0, 2.0, 3.0)
RAW = ("clean", "heavy-tails", "grazing-bias", "mixed-pixels", "base", "told", "told-wrong", "scanner")
TOUCHED = {
    "voxel": {"thin": "voxel"},
    "nearest": {"thin": "nearest"},
    "mean-8": {"smooth": "mean"},
    "mean-20": {},
    "mls": {"smooth": "mls"},
    "round-0.1": {"round_mm": 0.1},
    "round-1": {"round_mm": 1.0},
    "round-5": {"round_mm": 5.0},
    "doubled": {"duplicate": 1.0},
}
WRONG, STUB, SPLIT, LEAST_COS = 1.5, 20.0, 0.3, 0.1  # mm, mm, share of the points at the outline, of the bias


def rays(rng, half_width, spacing):
    """Places (n, 2) of a grid of directions, turned and shifted by chance, within a circle."""
    steps = np.arange(-half_width - spacing, half_width + spacing, spacing)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) + rng.uniform(0.0, spacing, 2)
    turn = rng.uniform(0.0, 2.0 * np.pi)
    return grid @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]


def drawn(rng, condition, cap, noise, spacing):
    """Points (n, 3) of one crop and the scanner; the ball is about (0, 0, 0), the scanner on the axis z."""
    outline = RADIUS * np.sqrt(1.0 - (1.0 - 2.0 * cap) ** 2)
    x, y = rays(rng, RADIUS + 60.0, spacing).T
    on = np.hypot(x, y) < min(outline, 0.999 * RADIUS)
    z, cosine = np.sqrt(np.maximum(RADIUS**2 - x**2 - y**2, 0.0)), np.ones(len(x))
    cosine[on] = np.maximum(z[on] / RADIUS, LEAST_COS)
    seen = on.copy()
    if condition == "base":  # a stub from the limb outwards, across the rays
        stub = ~on & (np.abs(y) < STUB) & (x > np.sqrt(RADIUS**2 - STUB**2)) & (x < RADIUS + 40.0)
        z[stub] = np.sqrt(STUB**2 - y[stub] ** 2)
        cosine[stub] = np.maximum(z[stub] / STUB, LEAST_COS)
        seen |= stub
    points, cosine = np.column_stack([x, y, z])[seen], cosine[seen]
    known = CLASSES["phase"]
    sizes = known.incidence_mm if condition == "grazing-bias" else known.incidence_mm * rng.standard_normal()
    off = known.view_mm * rng.standard_normal() + sizes * (1.0 / cosine - 1.0)
    if condition == "heavy-tails":  # Student's with 3 degrees of freedom, of the same standard deviation
        off = off + noise * rng.standard_t(3, len(points)) / np.sqrt(3.0)
    else:
        off = off + noise * rng.standard_normal(len(points))
    if condition == "mixed-pixels":
        split = (np.hypot(*points[:, :2].T) > outline - spacing) & (rng.random(len(points)) < SPLIT)
        off = np.where(split, rng.uniform(0.0, 60.0, len(points)), off)
    scanner = np.array([0.0, 0.0, RANGE])
    away = points - scanner
    return points + off[:, None] * away / np.linalg.norm(away, axis=1)[:, None], scanner


def touched(points, how, seed):
    """Points (m, 3) as software left them."""
    if how == "mean-20":
        return points[cKDTree(points).query(points, k=20)[1]].mean(axis=1)
    scene = Scene(name="ball", kind="structure", scans=(Scan(name="ball", points=points),))
    params = processing.Params(cell_mm=5.0, **TOUCHED[how])
    return processing.process(scene, Truth(), params, seed)[0].scans[0].points


def cell(condition, cap, noise, draws, spacing):
    """Shares: ok, and of those inside, the centre's coordinates and the radius."""
    ok, inside = 0, []
    for seed in range(draws):
        rng = np.random.default_rng([seed, int(100 * cap), int(10 * noise)])
        points, scanner = drawn(rng, condition, cap, noise, spacing)
        turn, centre = Rotation.random(random_state=int(rng.integers(1 << 31))), rng.uniform(-5000.0, 5000.0, 3)
        points = turn.apply(points) + centre
        if condition in TOUCHED:
            points = touched(points, condition, seed)
        held = {"told": RADIUS, "told-wrong": RADIUS + WRONG}.get(condition)
        fit = processor.fit_sphere(points, held, turn.apply(scanner) + centre if condition == "scanner" else None)
        if fit.status is Status.OK:
            ok += 1
            sd = np.sqrt(np.diag(fit.covariance))
            off = np.abs(np.append(fit.centre - centre, fit.radius - RADIUS)) < NORMAL_95 * sd
            inside.append([off[:3].mean(), off[3]])
    centre, radius = np.mean(inside, axis=0).tolist() if inside else (float("nan"),) * 2
    return {"ok": ok / draws, "centre": centre, "radius": float("nan") if condition.startswith("told") else radius}


def main() -> None:
    """Print a line a condition and cap, with three shares a noise, and write all as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--only", default=",".join((*RAW, *TOUCHED)))
    parser.add_argument("--spacing", type=float, default=3.5, help="of rays at the ball, mm")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    print("ok %, centre % and radius % inside | noise, mm " + "".join(f"{noise:>14}" for noise in NOISES))
    table = []
    for condition, cap in product(options.only.split(","), CAPS):
        row = [cell(condition, cap, noise, options.draws, options.spacing) for noise in NOISES]
        table += [{"condition": condition, "cap": cap, "noise": n, **one} for n, one in zip(NOISES, row, strict=True)]
        shares = "".join("  " + " ".join(f"{100.0 * x:4.0f}" for x in one.values()) for one in row)
        print(f"{condition:14} cap {cap:4.2f}{shares}", flush=True)
    if options.output:
        options.output.write_text(json.dumps(table, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
