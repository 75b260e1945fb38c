"""A Dask scheduler and its workers as processes of this machine."""

import contextlib
import os
import socket
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.support.processes import dask_forks

ROOT = Path(__file__).resolve().parents[3]
PATIENCE_S = 60.0
# Dask looks at its processes up to a hundred times a second, whether they work or not.
QUIET = {
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
    "DASK_DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "5s",
    "DASK_DISTRIBUTED__WORKER__MEMORY__MONITOR_INTERVAL": "1s",
}


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@dataclass
class DaskCluster:
    """A scheduler and workers of one thread each; ``command`` precedes that of a worker, e.g. taskset."""

    folder: Path
    environment: dict
    address: str = ""
    processes: list = field(default_factory=list)
    workers: dict = field(default_factory=dict)  # by name

    def start(self):
        port = free_port()
        self.address = f"tcp://127.0.0.1:{port}"
        self._process("scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")

    def add_worker(self, name, *options, command=(), environment=None):
        """Start a worker and wait until it is registered."""
        before = self._registered()
        own = ("--no-nanny", "--nthreads", "1", "--host", "127.0.0.1", "--no-dashboard", "--name", name)
        place = ("--local-directory", str(self.folder))
        self.workers[name] = self._process(
            "worker", self.address, *own, *place, *options, command=command, environment=environment
        )
        end = time.monotonic() + PATIENCE_S
        while self._registered() == before:
            assert time.monotonic() < end, (self.folder / "cluster.log").read_text()
            time.sleep(0.02)

    def stop(self):
        for process in reversed(self.processes):
            process.kill()
            process.wait()

    def _registered(self):
        return (self.folder / "cluster.log").read_text().count("Registered to")

    def _process(self, *arguments, command=(), environment=None):
        with (self.folder / "cluster.log").open("a") as log:
            process = subprocess.Popen(
                [*command, sys.executable, "-m", "dask", *arguments], stdout=log, stderr=log, cwd=self.folder,
                env={**self.environment, **(environment or {})},
            )  # fmt: skip
        self.processes.append(process)
        return process


def _environment():
    """That of processes that import the project and its tests."""
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    # The libraries' own threads would only take processors from each other.
    environment = {**os.environ, **QUIET, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    return {**environment, "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "3s"}  # to a worker that ended


@contextlib.contextmanager
def cluster_in(folder):
    """A scheduler without workers, which are added."""
    pytest.importorskip("distributed")
    cluster = DaskCluster(Path(folder), _environment())
    try:
        cluster.start()
        yield cluster
    finally:
        cluster.stop()


@contextlib.contextmanager
def forked(folder, workers=2, protocol="tcp", environment=os.environ):
    """A scheduler and workers that are soon there: the address, and the processes, that of the scheduler first."""
    pytest.importorskip("distributed")
    address, path = f"{protocol}://127.0.0.1:{free_port()}", folder / "cluster.log"
    own = ("--host", "127.0.0.1", "--no-dashboard")
    worker = ("worker", address, *own, "--no-nanny", "--nthreads", "1", "--local-directory", str(folder))
    with path.open("w") as log:
        forks = dask_forks.Forks(log, folder, {**environment, **QUIET})
    try:
        scheduler = forks.start("scheduler", *own, "--protocol", protocol, "--port", address.rpartition(":")[2])
        processes = [scheduler, *(forks.start(*worker) for _ in range(workers))]
        end = time.monotonic() + PATIENCE_S
        while path.read_text().count("Registered to") < workers:
            assert time.monotonic() < end, path.read_text()
            time.sleep(0.01)
        yield address, processes
    finally:
        forks.end()


@pytest.fixture(scope="module")
def dask_cluster(tmp_path_factory):
    """Two workers for all tests of a file that do not end them: its address, and the process of each."""
    with forked(tmp_path_factory.mktemp("dask"), environment=_environment()) as (address, (_, *workers)):
        yield SimpleNamespace(address=address, workers=workers)
