"""Simulated field checks: spherical coordinates with known errors. Shares nothing with the estimator but rotations."""

import numpy as np
from scipy.spatial.transform import Rotation

from processor.field_check.variance_components import Sightings

OF_CLASS = {"range_view": 0.5, "range_repeat": 0.1, "angle_horizontal": 20e-6, "angle_vertical": 20e-6}


def room(rng, targets):
    """Return targets (t, 3) about the origin, mm, at 5 to 14 m, of different heights."""
    angle = np.linspace(0.0, 2.0 * np.pi, targets, endpoint=False) + rng.normal(0.0, 0.3, targets)
    away = rng.uniform(5e3, 14e3, targets)
    return np.stack([away * np.cos(angle), away * np.sin(angle), rng.uniform(-1.5e3, 6e3, targets)], axis=1)


def poses_of(rng, places, repeats, moved):
    """Return place, rotation and position of upright scans, ``repeats`` at each place, ``moved`` between or not."""
    found = []
    for k in range(places):
        far = np.array([np.cos(k), np.sin(k), 0.0]) * (0.0 if k == 0 else 15e3)
        at = far + rng.uniform(-1.0, 1.0, 3) * [4e3, 4e3, 100.0]
        for _ in range(repeats):
            turn = Rotation.from_euler("z", rng.uniform(-3.0, 3.0))
            found.append((k, turn, at + (rng.uniform(-1.0, 1.0, 3) * 1e3 if moved else 0.0)))
    return found


def observed(rng, place, offset, scale, errors):
    """Return a place as measured: range, azimuth and elevation with errors (3,) in mm and rad."""
    r = np.linalg.norm(place)
    azimuth, elevation = np.arctan2(place[1], place[0]), np.arcsin(place[2] / r)
    r = r * (1.0 + scale) + offset + errors[0]
    azimuth, elevation = azimuth + errors[1], elevation + errors[2]
    level = r * np.cos(elevation)
    return np.array([level * np.cos(azimuth), level * np.sin(azimuth), r * np.sin(elevation)])


def check(seed, sd, offset=0.0, scale=0.0, own_mm=0.02, targets=4, places=2, repeats=3, moved=False, known_sd=np.nan):
    """Return sightings, true places (t, 3) and starts of poses (s, 4, 4) of a simulated check."""
    rng = np.random.default_rng(seed)
    true, scans = room(rng, targets), poses_of(rng, places, repeats, moved)
    rows, starts, of_view = [], [], {}
    for number, (place, turn, at) in enumerate(scans):
        start = np.eye(4)
        start[:3, :3], start[:3, 3] = turn.as_matrix(), at
        starts.append(start)
        for target in range(targets):
            view = (number if moved else place, target)
            common = of_view.setdefault(view, rng.normal(0.0, sd["range_view"]))
            errors = rng.normal(0.0, [sd["range_repeat"], sd["angle_horizontal"], sd["angle_vertical"]])
            errors[0] = common + (0.0 if moved else errors[0])
            seen = observed(rng, turn.inv().apply(true[target] - at), offset, scale, errors)
            rows.append((number, *view, seen + rng.normal(0.0, own_mm, 3)))
    scan, station, target, seen = zip(*rows, strict=True)
    sightings = Sightings(
        places=np.array(seen),
        covariance=np.tile(own_mm**2 * np.eye(3), (len(rows), 1, 1)),
        scan=np.array(scan),
        station=np.array(station),
        target=np.array(target),
        known=true + rng.normal(0.0, np.nan_to_num(known_sd), true.shape),
        known_sd=np.full(targets, known_sd),
    )
    return sightings, true + rng.normal(0.0, 3.0, true.shape), np.array(starts)


def folder(path, seed, view_mm=0.5, radius=72.5, targets=5, places=4, points=2500, head=""):
    """Write a folder of scans, XYZ in metres, of spheres on a floor, each scan from a place of its own."""
    rng = np.random.default_rng(seed)
    true, scans = room(rng, targets), poses_of(rng, places, 1, moved=True)
    for number, (_, turn, at) in enumerate(scans):
        clouds = []
        for centre in true:
            normal = rng.normal(size=(8 * points, 3))
            normal /= np.linalg.norm(normal, axis=1)[:, None]
            normal = normal[normal @ (at - centre) > 0.25 * np.linalg.norm(at - centre)][:points]
            place = turn.inv().apply(centre + radius * normal - at)
            along = rng.normal(0.0, 0.3, len(place)) + rng.normal(0.0, view_mm)
            clouds.append(place * (1.0 + along / np.linalg.norm(place, axis=1))[:, None])
        np.savetxt(path / f"scan{number + 1}.xyz", np.concatenate(clouds) / 1000.0, fmt="%.7f")
    report = '[report]\nscanner = "Scanner X"\nserial = "0815"\nscanned = 2026-11-20\n'
    (path / "project.toml").write_text(f"{head}\n[targets]\nsphere_radius_mm = {radius}\n{report}", "utf-8")
    return path
