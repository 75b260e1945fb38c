"""Tiles of one scene are computed by the workers of a Dask cluster, which runs those of a lost worker again."""

from __future__ import annotations

import importlib
import pickle
import platform
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from processor import tiles
from processor.jobs import runner
from processor.jobs.causes import one_line
from processor.jobs.software import OtherSoftwareError, check_same, source_digest, versions
from processor.model import InputError, UsageError
from processor.tiles import Shared

PACKAGES = ("numpy", "scipy", "numba", "llvmlite")
AHEAD = 2  # tiles submitted per thread of a worker: the points of all tiles at once would fill the scheduler's memory
LARGE = {"distributed.admin.large-graph-warning-threshold": "1GB"}  # tiles are large on purpose

R = TypeVar("R")


@contextmanager
def on_cluster(address: str | None, log: Callable[[str], None]) -> Iterator[None]:
    """Compute tiles on the Dask cluster whose scheduler has the address, as long as the context lasts; None: here.

    Raises UsageError where no scheduler answers, as :func:`processor.jobs.runner.executor` does, and for workers with
    other software.
    """
    with runner.executor(address, 1, log) as where:
        if isinstance(where, runner.Local):
            yield
            return
        _check_workers(where)
        with tiles.on(_ClusterWorkers(where.client, where.address)):
            yield


@cache
def software() -> dict[str, str]:
    """Return what tiles depend on: versions, and a digest of the processor's own files."""
    own = source_digest(["processor"], [".py"])[:12]
    return {"python": platform.python_version(), "processor": own, **versions(PACKAGES)}


def _check_workers(where: runner.Cluster) -> None:
    """Raise UsageError if a worker has other software, or none."""
    for worker, found in sorted(where.client.run(_software, on_error="return").items()):
        try:
            if isinstance(found, BaseException):
                raise OtherSoftwareError(one_line(found))
            check_same(found, software())
        except OtherSoftwareError as error:
            raise UsageError(f"--cluster {where.address}: {worker}: {error}") from error


def _software() -> dict[str, str]:
    return software()  # a cached function is not sent by its name


@dataclass(frozen=True)
class _ClusterWorkers:
    """Computes tiles by the workers of a cluster; what they share is a task of its own, whose result workers keep."""

    client: Any
    address: str
    sent: WeakKeyDictionary[Shared[Any], Any] = field(default_factory=WeakKeyDictionary)

    def results(self, function: Callable[..., R], tiles: Iterable[Any], shared: Sequence[Shared[Any]]) -> Iterator[R]:
        """Yield the results of tiles, in order; see :class:`processor.tiles.Workers`.

        Exceptions of the function are raised. Raises InputError if the scheduler is lost, or if several workers in
        turn end at a tile.
        """
        common = [self._future(one) for one in shared]
        most = AHEAD * max(1, sum(self.client.nthreads().values()))
        waiting: deque[Any] = deque()
        try:
            for tile in tiles:
                waiting.append(self._submit(_of_tile, software(), function, _packed(tile), *common))
                if len(waiting) >= most:
                    yield self._result(waiting.popleft())
            while waiting:
                yield self._result(waiting.popleft())
        finally:
            self.client.cancel(list(waiting))

    def _future(self, shared: Shared[Any]) -> Any:
        if shared not in self.sent:
            self.sent[shared] = self._submit(_unpacked, _packed(shared.value))
        return self.sent[shared]

    def _submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        dask: Any = importlib.import_module("dask")
        with dask.config.set(LARGE):
            return self.client.submit(function, *arguments, pure=False)

    def _result(self, future: Any) -> Any:
        distributed: Any = importlib.import_module("distributed")
        try:
            return future.result()
        except distributed.KilledWorker as error:
            limits = self.client.scheduler_info(n_workers=-1)["workers"].values()
            least = min((one["memory_limit"] for one in limits), default=0)
            memory = f" (the least limit is now {least / 1e9:.1f} GB)" if least else ""
            message = f"--cluster {self.address}: several workers ended at a tile; give them more memory{memory}"
            raise InputError(message) from error
        except MemoryError as error:
            message = f"--cluster {self.address}: a worker has too little memory for a tile; give it more"
            raise InputError(message) from error
        except distributed.CancelledError as error:
            raise InputError(f"--cluster {self.address}: the connection is lost; run again") from error


def _packed(value: Any) -> bytes:
    """Pickle in one piece: arrays sent apart may be read-only there, and kernels would be compiled again for them."""
    return pickle.dumps(value, protocol=5)


def _unpacked(data: bytes) -> Any:
    return pickle.loads(data)


def _of_tile(expected: dict[str, str], function: Callable[..., R], tile: bytes, *shared: Any) -> R:
    """Compute a tile on a worker, which may have joined after the others were checked."""
    check_same(software(), expected)
    return function(_unpacked(tile), *shared)
