"""Child processes and pools of them: limits, stopping, and the end of all descendants."""

import os
import subprocess
import sys
import threading
import time
from contextlib import closing

import pytest

from processor.jobs import causes, process, program, runner
from processor.jobs.causes import Cause
from processor.jobs.child import Loss, Lost
from processor.model import InputError, UsageError
from processor.store import whole_output
from tests.support.processes.living import alive, ends_soon

SLEEP = "import time; time.sleep(60)"
PARENT = """
import sys
from processor.jobs import process
child = process.start(process.isolated(
    "from processor.jobs.child import end_with_parent; end_with_parent(); import os, time;"
    "print(os.getpid(), flush=True); time.sleep(60)"
), stdout=None, own_group=sys.argv[1] == "own")
child.wait()
"""


@pytest.mark.parametrize("group", ["own", "parent's"])
def test_a_child_ends_with_its_parent(group):
    parent = subprocess.Popen([sys.executable, "-c", PARENT, group], stdout=subprocess.PIPE, text=True)
    child = int(parent.stdout.readline())
    assert alive(child)
    parent.kill()
    parent.communicate()
    assert ends_soon(child)


def test_end_of_a_command_has_cause_exit_code_and_last_line():
    def ended(code, **limits):
        return process.run([sys.executable, "-c", code], **limits)

    exited = ended("import sys; x = b'x' * 2**26; print('one\\n\\ntwo \\n\\n', file=sys.stderr); sys.exit(3)")
    assert (exited.cause, exited.code, exited.last_line) == (Cause.EXIT, 3, "two")
    assert exited.max_rss_mb > 64.0
    killed = ended("import os, signal; os.kill(os.getpid(), signal.SIGTERM)")
    assert (killed.cause, killed.code) == (Cause.SIGNAL, 15)
    assert ended(SLEEP, timeout_s=0.1).cause is Cause.TIME
    assert ended(f"x = b'x' * 2**27; {SLEEP}", memory_mb=100).cause is Cause.MEMORY
    assert ended(SLEEP, stopped=lambda: True).cause is Cause.STOPPED
    assert ended(SLEEP, timeout_s=0.1, own_group=False).cause is Cause.TIME


GUARDED = """
import errno, sys
from processor.model import InputError
def full_disk():
    raise OSError(errno.ENOSPC, "no room")
def reported(error, cause, fail=full_disk):
    try:
        try:
            fail()
        except (OSError, MemoryError) as first:
            raise error from (first if cause else None)
    except InputError:
        sys.exit(3)
"""


@pytest.mark.parametrize(
    ("memory_mb", "code", "cause", "exit_code"),
    [
        (0, "raise MemoryError", Cause.MEMORY, 86),
        (1, "bytes(2**31)", Cause.MEMORY, 86),  # more than such a process may allocate
        (1, "import numpy; numpy.ones(2**28)", Cause.MEMORY, 86),
        (0, "full_disk()", Cause.OUTPUT, 87),
        (0, "reported(InputError('no room'), cause=True)", Cause.OUTPUT, 87),
        (0, "reported(InputError('of another kind'), cause=False)", Cause.EXIT, 3),
        (0, "reported(InputError('damaged'), cause=True, fail=lambda: bytes(2**62))", Cause.EXIT, 3),
        (0, "raise OSError(errno.ENOENT, 'MemoryError: No space left on device')", Cause.EXIT, 1),
        (0, "print('error: MemoryError', file=sys.stderr); sys.exit(3)", Cause.EXIT, 3),
    ],
)
def test_a_guarded_process_tells_its_cause_by_its_exit_code(tmp_path, memory_mb, code, cause, exit_code):
    script = tmp_path / "script.py"
    script.write_text(GUARDED + code)
    ended = process.run([*process.GUARDED, str(memory_mb), str(script)])
    assert (ended.cause, ended.code) == (cause, exit_code), ended.last_line


@pytest.mark.parametrize("kind", [OSError, RuntimeError])
def test_a_full_disk_that_hdf5_tells_in_its_text_is_an_error_of_the_output(tmp_path, kind):
    message = r"cannot be written \(No space left on device\)"
    with pytest.raises(InputError, match=message) as caught, whole_output.replacing(tmp_path / "a.h5"):
        raise kind("Can't write data (write failed, errno = 28, error message = 'No space left on device')")
    assert causes.cause_of(caught.value) is Cause.OUTPUT


def test_all_descendants_of_a_command_are_ended(tmp_path):
    code = (
        "import subprocess, sys; from pathlib import Path;"
        f"inner = subprocess.Popen([sys.executable, '-c', {SLEEP!r}]); Path(sys.argv[1]).write_text(str(inner.pid))"
    )
    ended = process.run([sys.executable, "-c", code, str(tmp_path / "pid")])
    assert ended.cause is Cause.EXIT
    assert ends_soon(int((tmp_path / "pid").read_text()))


def fail(_):
    raise ImportError("no module\nnamed x")


def test_raising_job_is_lost_and_its_process_takes_the_next():
    pool = process.Pool()
    assert pool.do(fail, 1) == Lost(Loss.NOT_RUN, "ImportError: no module named x")
    assert pool.do(abs, -2) == 2
    assert len(pool._idle) == 1
    pool.close()


def test_a_job_is_stopped_at_once():
    pool, stop = process.Pool(), threading.Event()
    threading.Timer(0.5, stop.set).start()
    started = time.monotonic()
    assert pool.do(time.sleep, 60.0, stop.is_set) == Lost(Loss.STOPPED)
    assert time.monotonic() - started < 20.0
    assert not pool._idle


def test_an_error_of_a_job_here_stops_the_others():
    stopped, all_began = [], threading.Barrier(3, timeout=60.0)

    def do(job, is_stopped):
        all_began.wait()
        if job == 0:
            raise InputError("no room")
        while not is_stopped():
            time.sleep(0.01)
        stopped.append(job)

    with pytest.raises(InputError, match="no room"), closing(runner.Local(3).run(do, range(3))) as results:
        list(results)
    assert sorted(stopped) == [1, 2]


def test_signal_is_raised_at_the_next_check():
    with runner.stoppable() as check_stop:
        check_stop()
        os.kill(os.getpid(), 15)
        time.sleep(0.1)
        with pytest.raises(runner.StoppedError) as caught:
            check_stop()
    assert caught.value.exit_code == 143


@pytest.mark.parametrize("name", ["", "file"])
def test_lock_is_refused_while_it_is_taken(tmp_path, name):
    with (
        runner.locked(tmp_path / name, "busy"),
        pytest.raises(UsageError, match="busy"),
        runner.locked(tmp_path / name, "busy"),
    ):
        pass
    with runner.locked(tmp_path / name, "busy"):
        pass


@pytest.mark.parametrize("error", [MemoryError(), OSError(12, "Cannot allocate memory"), MemoryError((3,), "float64")])
def test_lack_of_memory_is_one_line(error, monkeypatch):
    assert program._line(error).startswith("not enough memory (")
    assert "internal error" in program._line(SystemError("NULL"))
    monkeypatch.setattr(program.address_space, "room", lambda: 1e6)
    assert program._line(SystemError("NULL")).startswith("not enough memory (")
    assert program._line(InputError("damaged")) == "damaged"


def test_signals_have_their_names_and_those_without_one_their_number():
    assert [causes.signal_name(number) for number in (9, 11, 40)] == ["SIGKILL", "SIGSEGV", "signal 40"]
