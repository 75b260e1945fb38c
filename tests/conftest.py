"""Settings and fixtures of all tests: kernels compiled once for all workers, rare garbage collection, pictures."""

import contextlib
import fcntl
import gc
import hashlib
import json
import logging
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numba.core.caching import FunctionCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

from processor.jobs import garbage_collection
from tests.support import kernels
from tests.support.files.scan_folders import BOX, arch_design, surface, write_ply, write_xyz
from tests.support.pages import browser
from tests.support.solids import cad_in_process

_compile = Dispatcher.compile
_DRAW = {drawn: drawn.draw for drawn in (FigureCanvasAgg, Figure)}
_held: set[Path] = set()  # locks of this process: a kernel that calls itself asks for its own
_LOCKS = Path(tempfile.gettempdir(), f"kernel-locks-{os.getuid()}")


@contextlib.contextmanager
def _alone(path: Path):
    """Hold a lock that no other process holds."""
    if path in _held:
        yield
        return
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        _held.add(path)
        try:
            yield
        finally:
            _held.remove(path)


def _compile_once(self: Dispatcher, signature: object) -> object:
    """Compile a kernel, or load what another worker has compiled meanwhile."""
    cache = self._cache
    if signature in self.overloads or not isinstance(cache, FunctionCache):
        return _compile(self, signature)
    # Numba's own lock of threads first: one of them could wait for a file that another one of this process holds.
    place = hashlib.sha256(f"{cache.cache_path}/{cache._impl.filename_base}".encode()).hexdigest()
    _LOCKS.mkdir(mode=0o700, exist_ok=True)
    with global_compiler_lock, _alone(_LOCKS / place[:32]):
        return _compile(self, signature)


Dispatcher.compile = _compile_once


def pytest_configure(config):
    """Have kernels compiled anew where one within them has changed; workers start after that."""
    if not hasattr(config, "workerinput") and "KERNELS_KEPT" not in os.environ:
        kernels.discard_stale()


def pytest_collection_finish():
    """Leave out of further collections what is loaded now and stays: libraries of half a million objects."""
    gc.collect()
    gc.freeze()
    garbage_collection.collect_rarely()


def _blank(canvas):
    """Draw nothing, on a strip as wide as the picture: pages are laid out by its width, and encoding it takes time."""
    canvas.figure.set_size_inches(canvas.figure.get_figwidth(), 0.2)
    canvas.figure.draw(canvas.get_renderer())


@pytest.fixture(scope="session", autouse=True)
def blank_pictures():
    """Leave every picture and page of a document blank: few tests look at them, and drawing takes long."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FigureCanvasAgg, "draw", _blank)
        patch.setattr(Figure, "draw", lambda *_: None)
        yield


@pytest.fixture
def drawn_pictures(monkeypatch):
    """Draw pictures and pages of documents, for a test of what they show."""
    for drawn, draw in _DRAW.items():
        monkeypatch.setattr(drawn, "draw", draw)


@pytest.fixture
def bridge(tmp_path):
    """A folder of two scans in metres and a design in mm."""
    place = tmp_path / "bridge"
    for i, name in enumerate(("foot1", "rib1")):
        write_xyz(place / f"scans/{name}.xyz", surface(i))
        write_ply(place / f"design/{name}.ply", (BOX + np.array([4.0 * i, 0, 0])) * 1000.0)
    (place / "design.json").write_text(json.dumps(arch_design()))
    return place


@pytest.fixture(autouse=True)
def log_of_a_command():
    """Undo what a command that a test has run in this process did to the log: other tests look at its records."""
    log = logging.getLogger("processor")
    before = log.propagate, log.level, log.handlers[:]
    yield
    for handler in log.handlers[:]:
        if handler not in before[2]:
            log.removeHandler(handler)
            handler.close()
    log.propagate, log.level = before[:2]


@pytest.fixture
def cad_here(monkeypatch):
    """CAD files are read by this process: see :mod:`tests.support.solids.cad_in_process`."""
    cad_in_process.read_here(monkeypatch)


@pytest.fixture(scope="module", autouse=True)
def browser_of_a_file():
    """Close the browser that tests of a file have opened after the last of them."""
    yield
    browser.SHARED.close()
