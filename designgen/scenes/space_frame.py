"""Scenes of space frames: bolt balls and members as designed or as built, scanned as a whole."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from designgen.asbuilt import imperfections
from designgen.designs import space_frame
from designgen.randomness import generator
from designgen.recipe_params import filled
from designgen.scanning import clutter, sampler, space_frame_surfaces, surroundings, survey
from designgen.scanning.scan_settings import ByRays, Scanning
from designgen.scanning.surfaces import Builder
from processor.model import FrameDesign, FrameTruth, PointLabels, Scan, Scene, Truth


def make(name: str, recipe: Mapping[str, Any], scanning: Scanning, seed: int) -> tuple[Scene, Truth]:
    """Make the scene of a space frame and its truth."""
    frame = space_frame.build(filled(space_frame.Params, recipe, "frame"))
    errors = filled(imperfections.FrameParams, recipe, "asbuilt")
    ledger = imperfections.Ledger()
    built = imperfections.frame(frame, errors, generator(seed, "built"), ledger) if "asbuilt" in recipe else frame
    ids = np.arange(len(frame.centres))
    names = tuple(f"ball {i}" for i in ids)
    stations, station_truth = None, None
    origin = np.zeros(3)
    if isinstance(scanning, ByRays):
        params = scanning.params
        origin = np.array(params.origin_mm)
        builder = Builder()
        space_frame_surfaces.add_frame(builder, built)
        low, high = built.centres.min(axis=0), built.centres.max(axis=0)
        clutter.add_below_roof(builder, low, high, params.clutter, generator(seed, "clutter"))
        poses = survey.stations_below_box(low, high, params, seed)
        surroundings.add(builder, scanning.surroundings, surroundings.Box.about(built.centres), poses, seed)
        surveyed = survey.survey(builder.to_surfaces(), names, poses, scanning.device, params, seed)
        scans, labels, stations, station_truth = survey.in_project(surveyed, params, registered=True)
    else:
        cloud = sampler.scan_frame(built, scanning, generator(seed, "scan"))
        scans = (Scan("scan", cloud.points, sigma_mm=scanning.sigma_mm),)
        labels = (PointLabels("scan", names, cloud.part, cloud.source),)
    design = FrameDesign(
        ids=ids,
        centres=frame.centres + origin,
        radii=frame.radii,
        member_a=frame.members[:, 0],
        member_b=frame.members[:, 1],
        tube_diameters=np.full(len(frame.members), frame.connection.tube_diameter),
    )
    lowest = built.centres - built.radii[:, None] * np.array([0.0, 0.0, 1.0])
    scene = Scene(
        name,
        "space-frame",
        scans,
        frame=design,
        stations=stations,
        temperature_C=imperfections.stated(errors.temperature_C),
    )
    return scene, Truth(
        labels,
        frame=FrameTruth(ids, built.centres + origin, built.radii, lowest + origin),
        stations=station_truth,
        as_built=ledger.record() if "asbuilt" in recipe else None,
    )
