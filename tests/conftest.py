"""Kernels are compiled once for all workers: who comes second waits for the first, and loads what it has compiled."""

import contextlib
import fcntl
import hashlib
import os
import tempfile
from pathlib import Path

from numba.core.caching import FunctionCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

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
    cache = self._cache
    if signature in self.overloads or not isinstance(cache, FunctionCache):
        return _compile(self, signature)
    # Numba's own lock of threads first: one of them could wait for a file that another one of this process holds.
    place = hashlib.sha256(f"{cache.cache_path}/{cache._impl.filename_base}".encode()).hexdigest()
    with global_compiler_lock, _alone(Path(tempfile.gettempdir(), f"kernel-{os.getuid()}-{place[:32]}.lock")):
        return _compile(self, signature)


Dispatcher.compile = _compile_once
