"""What all tests share: kernels compiled once for all workers, blank pictures, no search for garbage in what stays."""

import base64
import contextlib
import fcntl
import gc
import hashlib
import os
import tempfile
from pathlib import Path

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numba.core.caching import FunctionCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

from processor.jobs import garbage

PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAIAAACQd1PeAAAADElEQVR4nGP4//8/AAX+Av4N70a4AAAAAElFTkSuQmCC"
)  # as PNG

_compile = Dispatcher.compile
_held: set[Path] = set()  # locks of this process: a kernel that calls itself asks for its own


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
    with global_compiler_lock, _alone(Path(tempfile.gettempdir(), f"kernel-{os.getuid()}-{place[:32]}.lock")):
        return _compile(self, signature)


Dispatcher.compile = _compile_once


def pytest_collection_finish():
    """Leave out of further collections what is loaded now and stays: libraries of half a million objects."""
    gc.collect()
    gc.freeze()
    garbage.search_rarely()


@pytest.fixture
def blank_pictures(monkeypatch):
    """Write every picture as one white pixel: for tests of all else on a page, as drawing takes most of the time."""
    monkeypatch.setattr(FigureCanvasAgg, "print_png", lambda _, out, **__: out.write(PIXEL))
