"""Components as designed and as built, with errors of every kind, and their CadQuery solids."""

from designgen.asbuilt import imperfections
from designgen.designs import arch_bridge, arch_part, closed_ring, girder_assemblies, prismatic_solids, space_frame
from designgen.randomness import generator
from designgen.scenes import assembly

SMALL = space_frame.Params(nodes_x=2, nodes_y=2, layers=2, spacing_mm=1500.0, depth_mm=1100.0, radii_mm=(60.0, 75.0))
ERRORS_OF_FRAME = imperfections.FrameParams(
    node_movement_mm=3.0, radius_mm=0.4, wrong_sizes=1, temperature_C=35.0, eccentricity_mm=1.5, bow_share=0.002,
    missing_bolts=3,
)  # fmt: skip
ERRORS = imperfections.ArchParams(
    length_mm=2.0, skew_mrad=1.0, twist_mrad=2.0, bow_mm=2.0, section_mm=1.0, plate_mm=0.3, corner_mm=2.0
)
RING = closed_ring.Params(radius_mm=2000.0)


def frame(built):
    """A pyramid of five balls."""
    made = space_frame.build(SMALL)
    return imperfections.frame(made, ERRORS_OF_FRAME, generator(3, "built"), imperfections.Ledger()) if built else made


def frame_solid(built):
    return space_frame.solid(frame(built))


def arch(name, built):
    """A foot or rib of a bridge, or a segment of a ring."""
    parts = closed_ring.build(RING) if name == "segment" else arch_bridge.build(arch_bridge.Params())
    if built:
        rngs = [generator(5, f"built {part.name}") for part in parts]
        parts = imperfections.arch(parts, ERRORS, rngs, imperfections.Ledger())
    return parts[0 if name == "foot" else 1]


def arch_solid(name, built):
    return arch_part.solid(arch(name, built))


def bridge_solid(params, number):
    return arch_part.solid(arch_bridge.build(params)[number])


def girder(kind, section, number, bolted=False):
    """A part of an assembly, with all errors that it can have."""
    recipe = {
        "assembly": {"type": kind, "section": section, "length_mm": 3000.0},
        "asbuilt": {"length_mm": 2.0, "skew_mrad": 2.0, "corner_mm": 2.0, "hole_mm": 0.7},
        **({"bolts": {}} if bolted else {}),
    }
    return assembly.built(recipe, 3, imperfections.Ledger())[1][number]


def girder_solid(*which):
    return prismatic_solids.as_built(girder(*which))


def designed_girder(kind, section, number):
    return girder_assemblies.build(girder_assemblies.Params(type=kind, section=section)).parts[number]


def designed_girder_solid(*which):
    return prismatic_solids.solid(designed_girder(*which).made_of)
