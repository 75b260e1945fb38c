"""Stations for a model: given in a file, or placed one after the other where each adds most to what is seen.

Candidates lie around the box of the model, at several heights and two distances, and inside of it where there is room.
What a candidate sees is found by rays to points spread over the surface. A further station leaves the first unchanged.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from designgen.models.model import Model
from designgen.models.surface_samples import sample_surface
from designgen.randomness import generator
from designgen.scanning.facets import Facets
from designgen.scanning.returns import LOWEST_DEG
from designgen.scanning.scanner import Scanner
from designgen.scanning.survey import levelled_pose
from processor.model import Bools, Floats, InputError

SAMPLES = 4000  # points of the surface by which candidates are compared
AROUND, HEIGHTS_DEG = 12, (-30.0, 5.0, 35.0, 65.0)  # directions of candidates from the middle of the box
FARTHER = 2.0  # times the distance, of the second ring
INSIDE = 5  # candidates inside of the box along its longest side
LEAST_COS = 0.2  # of the incidence at which a point counts as seen
AGAIN = 0.25  # worth of a further look at a point, as a share of the one before
DISTANCE_SHARE, NEAREST_MM, FARTHEST_MM = 0.75, 1_000.0, 12_000.0  # distance from the box by its largest side
ROOM_SHARE, ROOM_MM = 1.5, 600.0  # free distance around a station, in units of the least range


def read_stations(path: Path, seed: int) -> dict[str, Floats]:
    """Return the poses T_scene_station of upright scanners at the positions (mm, in the model's frame) of a JSON file.

    The file is {"S1": {"position": [x, y, z], "heading_deg": 0.0}, ...}, or a list of such with "id"; without a heading
    one is drawn. Raises InputError for a file of another form.
    """
    form = '{"S1": {"position": [x, y, z]}, ...} in mm'
    try:
        content = json.loads(path.read_text("utf-8"))
        entries = content.items() if isinstance(content, dict) else [(entry["id"], entry) for entry in content]
        places = {str(name): (_position(entry), _heading(str(name), entry, seed)) for name, entry in entries}
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{path}: expected stations as {form}, found others ({error})") from None
    if not places:
        raise InputError(f"{path}: expected stations as {form}, found none")
    return {name: levelled_pose(position, heading) for name, (position, heading) in places.items()}


def _position(entry: Any) -> Floats:
    position = np.array(entry["position"], np.float64)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise ValueError(f"position {entry['position']!r}")
    return position


def _heading(name: str, entry: Any, seed: int) -> float:
    """Return the heading of a station, rad: given, or drawn."""
    if "heading_deg" in entry:
        heading = math.radians(float(entry["heading_deg"]))
        if not math.isfinite(heading):
            raise ValueError(f"heading_deg {entry['heading_deg']!r}")
        return heading
    return _drawn(name, seed)


def _drawn(name: str, seed: int) -> float:
    return float(generator(seed, f"place {name}").uniform(0.0, 2.0 * np.pi))


def place_stations(
    model: Model, count: int, distance_mm: float | None, device: Scanner, seed: int
) -> dict[str, Floats]:
    """Return the poses of ``count`` upright scanners S1, S2, ... of a model, mm.

    ``distance_mm``: of the nearer ring from the model's box; None: by the size of the model.
    """
    vertices, triangles = model.mesh()
    corners = vertices[triangles]
    low, high = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
    size = float((high - low).max())
    if distance_mm is None:
        distance_mm = min(max(DISTANCE_SHARE * size, NEAREST_MM, 1.5 * device.min_range_mm), FARTHEST_MM)
    facets = Facets.of(corners)
    points, normals = sample_surface(corners, SAMPLES)
    places = _candidates(low, high, distance_mm, _room(device), points)
    seen = np.stack([_seen(facets, place, points, normals, device) for place in places])
    worth, chosen = np.ones(len(points)), []
    for _ in range(count):
        gains = seen @ worth
        best = int(np.argmax(gains))  # the first of equal ones
        chosen.append(best)
        worth = np.where(seen[best], AGAIN * worth, worth)
    return {f"S{i + 1}": levelled_pose(places[k], _drawn(f"S{i + 1}", seed)) for i, k in enumerate(chosen)}


def _room(device: Scanner) -> float:
    return max(ROOM_SHARE * device.min_range_mm, ROOM_MM)


def _candidates(low: Floats, high: Floats, distance: float, room: float, points: Floats) -> Floats:
    """Return places (k, 3) around the box, and those inside of it that are ``room`` away from the points, mm."""
    from scipy.spatial import cKDTree

    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    places = []
    for reach in (distance, FARTHER * distance):
        for elevation in np.radians(HEIGHTS_DEG):
            for azimuth in 2.0 * np.pi * np.arange(AROUND) / AROUND:
                across, up = np.cos(elevation), np.sin(elevation)
                unit = np.array([across * np.cos(azimuth), across * np.sin(azimuth), up])
                # On a box with round edges, ``reach`` outside of the model's box.
                # The least is the way from the middle to the surface of the box, mm.
                places.append(middle + unit * (reach + float(np.min(half / np.maximum(np.abs(unit), 1e-12)))))
    step = float(np.ptp([low, high], axis=0).max()) / INSIDE
    counts = np.maximum(1, np.round((high - low) / step)).astype(int)
    inside = [low + (np.array(index) + 0.5) / counts * (high - low) for index in np.ndindex(*counts.tolist())]
    free = cKDTree(points).query(np.array(inside))[0] > room
    return np.array([*places, *np.array(inside)[free]])


def _seen(facets: Facets, place: Floats, points: Floats, normals: Floats, device: Scanner) -> Bools:
    """Return which points (n,) a scanner at a place sees at a fair incidence."""
    arm = points - place
    range_ = np.linalg.norm(arm, axis=1)
    facing: Bools = -np.einsum("ni,ni->n", arm, normals) > LEAST_COS * range_
    facing &= (range_ > device.min_range_mm) & (range_ < device.max_range_mm)
    facing &= arm[:, 2] > range_ * np.sin(np.radians(LOWEST_DEG))
    rows = np.flatnonzero(facing)
    facing[rows] = facets.free(place, points[rows])
    return facing
