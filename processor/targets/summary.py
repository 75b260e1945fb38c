"""How many targets were found, in a sentence."""

from __future__ import annotations

from processor.language.messages import Text, text
from processor.model import Scene, TargetKind, Targets


def summary(scene: Scene) -> Text:
    """Say how many targets were found in the scans, how many of them have names, and what was not searched."""
    table = Targets() if scene.targets is None else scene.targets
    counts = [
        text(template, count=table.kind.count(kind))
        for kind, template in (
            (TargetKind.CHECKERBOARD, "{count} {count:?checkerboard|checkerboards}"),
            (TargetKind.SPHERE, "{count} {count:?sphere|spheres}"),
        )
        if kind in table.kind
    ]
    found = text(
        "targets in {scans} {scans:?scan|scans}: {counts}; {named} of them are control points",
        scans=len(scene.scans),
        counts=counts or text("none"),
        named=sum(bool(name) for name in table.name),
    )
    remarks = scene.target_remarks
    return text("{found}. {remarks:.}", found=found, remarks=remarks) if remarks else found
