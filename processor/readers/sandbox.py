"""Reading in a separate process, for formats whose libraries may crash, hang or exhaust memory on damaged files.

One process serves all files of a run. If it ends, an InputError gives the reason, and the next file gets a new process.
Points are returned in shared memory, without a copy. The limits are ``SLACK_BYTES`` of memory beyond the points, and
``limit_s`` of time.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import json
import math
import mmap
import os
import resource
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import processor.readers.pieces as pieces
from processor import large_arrays, progress
from processor.jobs import address_space
from processor.jobs.causes import signal_name
from processor.jobs.child import end_with_parent
from processor.jobs.process import end, isolated, start
from processor.model import InputError, Reason
from processor.readers.raw_scan import RawScan

SLACK_BYTES = 1 << 30  # memory beyond the points: for the buffers in which libraries decode
LEAST_S, BYTES_PER_S = 8.0, 1_000_000  # the libraries are much faster than this
PATIENCE = 4.0  # ratio of elapsed to processor time: the machine may be busy
START_S = 120.0  # imports of a first start on a slow disk; a child that takes longer does not come
ARRAYS = ("points", "origin", "intensity", "position", "T_project_scan", "station", "grid_row", "grid_column", "colour")
SMALL = 1 << 16  # bytes: smaller arrays are copied, as each would take a page of its own
BYTES_A_BYTE = 6.0  # of arrays per byte of a compressed file
SHOWN_S = 0.5  # between two messages of how much is read
START = "from processor.readers import sandbox; sandbox.serve()"


class _Helper:
    def __init__(self, process: subprocess.Popen[bytes], channel: socket.socket) -> None:
        self.process, self.channel = process, channel

    def end(self) -> int:
        """End the process and return its exit code, negative for a signal."""
        self.channel.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(0.5)
        end(self.process)
        return int(self.process.returncode)


_helper: _Helper | None = None
_lock = threading.Lock()


def limit_s(path: Path) -> float:
    """Return the limit of processor time for reading a file, s."""
    return LEAST_S + path.stat().st_size / BYTES_PER_S


def read(path: Path, module: str) -> list[RawScan]:
    """Read a file by a module of this package in the other process.

    Raises InputError as the module does, and if the process crashes or exceeds its time.
    """
    with _lock:
        helper = _running()
        try:
            folder = large_arrays.folder_for(int(BYTES_A_BYTE * path.stat().st_size))
            places = {"path": _hex(path), "folder": "" if folder is None else _hex(folder)}
            _send(helper.channel, {"module": module, "limit_s": limit_s(path), **places})
            # The process ends itself in time; this timeout is for one that is stopped or cannot be ended.
            helper.channel.settimeout(PATIENCE * limit_s(path) + 30.0)
            answer, descriptor = _receive(helper.channel)
            while "share" in answer:
                progress.show_share(answer["share"])
                answer, descriptor = _receive(helper.channel)
        except (OSError, EOFError) as error:
            raise _death(path, helper, error) from None
        except BaseException:
            _forget(helper)
            raise
    if "error" in answer:
        raise InputError(answer["error"], path=path if answer["about_file"] else None)
    return _scans(answer, descriptor, folder is not None)


def _hex(path: Path) -> str:
    return os.fsencode(path.absolute()).hex()


def _path(text: str) -> Path:
    return Path(os.fsdecode(bytes.fromhex(text)))


def _running() -> _Helper:
    global _helper
    if _helper is not None and _helper.process.poll() is None:
        return _helper
    if _helper is not None:
        _helper.end()
    ours, theirs = socket.socketpair()
    with theirs:
        process = start(
            isolated(START, str(theirs.fileno())),
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"},
            pass_fds=[theirs.fileno()],
            own_group=False,
        )
    ours.settimeout(START_S)
    try:
        _receive(ours)
    except (OSError, EOFError):
        process.kill()
        message = (process.communicate()[1].decode("utf-8", "replace").strip().splitlines() or ["no message"])[-1]
        ours.close()
        raise InputError(f"a process for reading scans cannot be started: {message}") from None
    assert process.stderr is not None
    process.stderr.close()
    _helper = _Helper(process, ours)
    return _helper


def _forget(helper: _Helper) -> None:
    global _helper
    _helper = None
    helper.process.kill()
    helper.end()


def _death(path: Path, helper: _Helper, error: BaseException) -> InputError:
    global _helper
    _helper = None
    code = helper.end()
    if code in (-signal.SIGPROF, -signal.SIGALRM) or isinstance(error, TimeoutError):
        reason = f"reading took more than {limit_s(path):.0f} s, far more than a file of its size needs"
    elif code == -signal.SIGKILL:
        return InputError("reading was killed, most likely for lack of memory; free some and run again", path=path)
    else:
        reason = f"the library that reads it crashed ({signal_name(-code) if code < 0 else f'exit code {code}'})"
    return InputError(f"{reason}; the file is damaged: copy or export it again", path=path)


@atexit.register
def close() -> None:
    """End the reading process, if there is one."""
    global _helper
    helper, _helper = _helper, None
    if helper is not None:
        helper.end()


def _scans(answer: dict[str, Any], descriptor: int, in_file: bool) -> list[RawScan]:
    try:
        length = os.fstat(descriptor).st_size
        shared = (large_arrays.mapped if in_file else mmap.mmap)(descriptor, length) if length else b""
    finally:
        os.close(descriptor)
    scans = []
    for scan in answer["scans"]:
        arrays: dict[str, Any] = {
            key: np.frombuffer(shared, dtype, math.prod(shape), offset).reshape(shape) if 0 not in shape else ()
            for key, (offset, shape, dtype) in scan["arrays"].items()
        }
        given = {key: scan[key] for key in ("unit", "step", "scanned")}
        fault, *remarks = [one and Reason(*one) for one in scan["reasons"]]
        scans.append(RawScan(scan["name"], unit_fault=fault, remarks=tuple(remarks), **given, **arrays))
    return scans


# --- messages: a length and JSON, with a file descriptor if there are arrays -----------------------------------------


def _send(channel: socket.socket, message: dict[str, Any], descriptor: int | None = None) -> None:
    text = json.dumps(message).encode()
    head = struct.pack("<Q", len(text))
    if descriptor is None:
        channel.sendall(head)
    else:
        socket.send_fds(channel, [head], [descriptor])
    channel.sendall(text)


def _receive(channel: socket.socket) -> tuple[dict[str, Any], int]:
    head, descriptors, _, _ = socket.recv_fds(channel, 8, 1)
    while len(head) < 8:
        head += _receive_some(channel, 8 - len(head))
    text = bytearray()
    while len(text) < struct.unpack("<Q", head)[0]:
        text += _receive_some(channel, struct.unpack("<Q", head)[0] - len(text))
    message: dict[str, Any] = json.loads(text)
    return message, descriptors[0] if descriptors else -1


def _receive_some(channel: socket.socket, most: int) -> bytes:
    data = channel.recv(min(most, 1 << 20))
    if not data:
        raise EOFError
    return data


def _sender(channel: socket.socket) -> Callable[[float], None]:
    """Return what sends the share of a file that is read, from 0 to 1, now and then."""
    last = 0.0

    def send(share: float) -> None:
        nonlocal last
        now = time.monotonic()
        if now > last + SHOWN_S:
            last = now
            _send(channel, {"share": share})

    return send


# --- the other process ---------------------------------------------------------------------------------------------


class _Shared:
    """Shared memory for arrays, or a file of a folder, which the other process maps by one descriptor."""

    def __init__(self, folder: Path | None) -> None:
        self.end = 0
        self.folder = folder
        self.blocks: list[tuple[int, int, int]] = []  # address, bytes, offset
        if folder is not None:
            self.descriptor = large_arrays.new_file(folder)
        elif hasattr(os, "memfd_create"):
            self.descriptor = os.memfd_create("scan")
        else:
            with tempfile.TemporaryFile() as file:
                self.descriptor = os.dup(file.fileno())

    def new(self, shape: tuple[int, ...], dtype: type) -> npt.NDArray[Any]:
        """Return an array in the shared memory, and raise the memory limit of the process by its size."""
        size = np.dtype(dtype).itemsize * math.prod(shape)
        if size < SMALL:
            return np.empty(shape, dtype)
        address_space.extend(size)
        offset = self.end
        self.end += -(-size // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY
        self._extend()
        if self.folder is None:
            memory = mmap.mmap(self.descriptor, size, offset=offset)
        else:
            memory = large_arrays.mapped(self.descriptor, size, offset)
        array: npt.NDArray[Any] = np.frombuffer(memory, dtype).reshape(shape)
        self.blocks.append((_address(array), size, offset))
        return array

    def place(self, array: Any) -> int:
        """Return the offset of an array in the shared memory; it is copied there if it is elsewhere."""
        address = _address(array)
        for first, size, offset in self.blocks:
            if first <= address and address + array.nbytes <= first + size:
                return offset + address - first
        offset = self.end
        self.end += -(-array.nbytes // 16) * 16
        self._extend()
        view = memoryview(array).cast("B") if array.size else b""
        done = 0
        while done < array.nbytes:
            done += os.pwrite(self.descriptor, view[done : done + (1 << 26)], offset + done)
        return offset

    def _extend(self) -> None:
        if self.folder is None:
            os.ftruncate(self.descriptor, self.end)
        else:
            large_arrays.reserve(self.descriptor, self.end, self.folder)


def _address(array: Any) -> int:
    return int(array.__array_interface__["data"][0])


def serve() -> None:
    """Answer requests until the other side closes."""
    end_with_parent()
    channel = socket.socket(fileno=int(sys.argv[1]))
    for name in ("laspy", "pye57"):
        importlib.import_module(name)
    for number in (signal.SIGPROF, signal.SIGALRM):
        signal.signal(number, signal.SIG_DFL)  # ends the process even inside a library
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    _send(channel, {})
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libraries raise what they print here
    while True:
        try:
            request, _ = _receive(channel)
        except (EOFError, OSError):
            return
        shared = _Shared(_path(request["folder"]) if request["folder"] else None)
        large_arrays.allocate_with(shared.new)
        pieces.show_with(_sender(channel))
        address_space.limit(SLACK_BYTES)
        signal.setitimer(signal.ITIMER_PROF, request["limit_s"])
        signal.setitimer(signal.ITIMER_REAL, PATIENCE * request["limit_s"])
        answer = _answer(_path(request["path"]), request["module"], shared)
        for timer in (signal.ITIMER_PROF, signal.ITIMER_REAL):
            signal.setitimer(timer, 0.0)
        _send(channel, answer, shared.descriptor)
        os.close(shared.descriptor)
        del shared
        large_arrays.allocate_with(None)


def _answer(path: Path, module: str, shared: _Shared) -> dict[str, Any]:
    try:
        with np.errstate(invalid="ignore"):
            scans = importlib.import_module(f"processor.readers.{module}").read(path)
    except InputError as error:
        about_file = error.path == path
        return {"error": error.problem if about_file else str(error), "about_file": about_file}
    except OSError as error:
        return {"error": f"cannot be read ({error.strerror or error})", "about_file": True}
    except MemoryError:
        return {"error": "needs more memory than a file of its size should; is it damaged?", "about_file": True}
    records = []
    for scan in scans:
        arrays = {}
        for key in ARRAYS:
            array = getattr(scan, key)
            arrays[key] = (shared.place(array), array.shape, array.dtype.str)
        given = {key: getattr(scan, key) for key in ("name", "unit", "step", "scanned")}
        reasons = [one and (one.code, one.values) for one in (scan.unit_fault, *scan.remarks)]
        records.append({**given, "reasons": reasons, "arrays": arrays})
    return {"scans": records}
