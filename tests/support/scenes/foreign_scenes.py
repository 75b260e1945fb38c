"""Scenes of the generators that share no code with designgen."""

import runpy
import sys
import warnings
from unittest import mock

from tests.support.structure import ROOT

FOREIGN = ROOT / "tests" / "bench" / "foreign"


def foreign_scene(name, out, *settings, seed=3):
    """Run a generator as a script, in this process."""
    words = [word for setting in settings for word in ("--set", setting)]
    script = str(FOREIGN / f"{name}.py")
    arguments = [script, str(out), "--seed", str(seed), *words]
    with mock.patch.object(sys, "argv", arguments), warnings.catch_warnings(action="ignore"):  # as Python runs it
        runpy.run_path(script, run_name="__main__")
    return out
