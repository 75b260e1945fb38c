"""Scenes of a script or a page whose words stay as they are, with fewer points in them."""

import designgen


def coarsely(monkeypatch, function, **coarse):
    """Have ``designgen.make`` or ``designgen.scan`` take settings of the table scan in place of those it is given."""
    made = getattr(designgen, function)

    def with_coarse(*arguments, settings=None, **others):
        kept = {**(settings or {}), **{f"scan.{key}": value for key, value in coarse.items()}}
        return made(*arguments, settings=kept, **others)

    monkeypatch.setattr(designgen, function, with_coarse)
