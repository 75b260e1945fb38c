"""Girders with bolt holes: scanned surfaces against their CadQuery solids, meshes, and where holes were drilled."""

import cadquery as cq
import numpy as np
import pytest

from designgen.designs import bolt_holes, girder_assemblies, prismatic_solids
from processor.model import UsageError
from tests.support.scenes.bolted_girders import BOLTS, QUIET, SIZES, bolted_girders

TOLERANCE_MM = 0.01


def test_the_mesh_of_a_girder_encloses_the_volume_of_its_solid():
    for part in girder_assemblies.build(SIZES, BOLTS).parts:
        vertices, faces = part.mesh()
        corners = (vertices - vertices.mean(axis=0))[faces]
        volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
        # Bores are polygons in the mesh: of 64 corners, smaller than the circle by 1.6 parts in a thousand.
        bores = sum(np.pi * b.radius**2 * np.linalg.norm(b.end - b.start) for b in part.girder.bores)
        solid = prismatic_solids.solid(part.made_of).Volume()
        # Differences of volumes of 1e8 mm3 in float64.
        assert volume - solid == pytest.approx(bores * (1.0 - np.sin(2 * np.pi / 64) * 64 / (2 * np.pi)), rel=1e-8)


@pytest.mark.parametrize("mode", ["surface", "rays"])
def test_scanned_points_of_a_girder_lie_on_its_drilled_solid(mode):
    settings = {"surface": {"spacing_mm": 12.0, "sigma_mm": 0.0}, "rays": QUIET}[mode]
    scene, truth, shifts = bolted_girders(seed=2, scan=settings, mode=mode)
    drilled = girder_assemblies.build(SIZES, BOLTS, shifts)
    rng = np.random.default_rng(0)
    for part, scan, T in zip(drilled.parts, scene.scans, truth.arch.T_bridge_scan, strict=True):
        solid = cq.Compound.makeCompound(prismatic_solids.solid(part.made_of).Shells())
        points = scan.points @ T[:3, :3].T + T[:3, 3]
        in_bore = np.zeros(len(points), bool)
        for bore in part.girder.bores:
            axis = part.girder.T[:3, :3] @ np.array([0.0, *(bore.end - bore.start)])
            middle = part.girder.T[:3, :3] @ (bore.middle + bore.shift) + part.girder.T[:3, 3]
            depth = np.linalg.norm(axis)
            along = (points - middle) @ axis / depth
            off = np.linalg.norm(points - middle - along[:, None] * axis / depth, axis=1)
            in_bore |= (np.abs(along) < 0.5 * depth - 0.1) & (off < bore.radius + 0.5)
        assert in_bore.sum() > 12
        for rows in (np.flatnonzero(in_bore), np.flatnonzero(~in_bore)):
            few = points[rng.choice(rows, min(len(rows), 8), replace=False)]
            assert max(cq.Vertex.makeVertex(*p).distance(solid) for p in few) < TOLERANCE_MM


def test_holes_are_drilled_off_their_places_along_their_plates():
    _, _, shifts = bolted_girders(seed=5, scan={"spacing_mm": 500.0})
    for part in girder_assemblies.build(SIZES, BOLTS).parts:
        for bore, shift in zip(part.girder.bores, shifts[part.name], strict=True):
            assert shift @ np.array([0.0, *(bore.end - bore.start)]) == pytest.approx(0.0, abs=1e-12)  # float64
    drawn = np.concatenate(
        [np.concatenate(list(bolted_girders(s, {"spacing_mm": 500.0})[2].values())) for s in range(4)]
    )
    across = np.linalg.norm(drawn, axis=1) ** 2
    assert across.mean() == pytest.approx(2.0, rel=0.35)  # two coordinates of 1 mm each, 96 draws: sd 10 %


@pytest.mark.parametrize("changes", [{"hole_mm": 200.0}, {"pitch_mm": 20.0}, {"web_bolts": 30}])
def test_holes_that_do_not_fit_are_refused(changes):
    with pytest.raises(UsageError, match=r"bolts\."):
        girder_assemblies.build(SIZES, bolt_holes.Params(**changes))


def test_only_rows_of_i_girders_have_bolts():
    with pytest.raises(UsageError, match="bolts"):
        girder_assemblies.build(girder_assemblies.Params(type="node"), BOLTS)


@pytest.mark.parametrize("section", ["i", "stiffened-box"])
def test_nodes_of_other_sections_than_plain_boxes_are_refused(section):
    with pytest.raises(UsageError, match=r"assembly\.section"):
        girder_assemblies.Params(type="node", section=section)
