"""Processes of Dask, each forked when its command line comes, from one that has loaded the library for all of them.

As a program: command lines as JSON, one a line, on standard input; the process ids go to standard output. At the end of
the input all of them are ended.
"""

import importlib
import json
import os
import signal
import subprocess
import sys


def main():
    for each in ("scheduler", "worker"):
        importlib.import_module(f"distributed.cli.dask_{each}")
    for each in ("compare.compare", "deviation.step", "space_frame.step"):  # once for all workers
        importlib.import_module(f"processor.{each}")
    from dask.__main__ import main as dask

    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    pids = []
    while line := os.read(0, 1 << 16):
        pid = os.fork()
        if pid == 0:
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            sys.argv = ["dask", *json.loads(line)]
            dask()
            os._exit(0)
        pids.append(pid)
        print(pid, file=answers, flush=True)
    for pid in reversed(pids):
        os.kill(pid, signal.SIGKILL)  # one that has ended is not waited for yet: the number is still its own
        os.waitpid(pid, 0)


class Forks:
    """The program above, run with logs in ``log``; ended with all that it has started."""

    def __init__(self, log, folder, environment):
        self.program = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            cwd=folder,
            env=environment,
            text=True,
            bufsize=1,
            start_new_session=True,
        )

    def start(self, *arguments):
        """Start ``dask ARGUMENTS`` and return the process."""
        self.program.stdin.write(json.dumps(arguments) + "\n")
        return Fork(int(self.program.stdout.readline()))

    def end(self):
        self.program.stdin.close()
        self.program.wait()
        self.program.stdout.close()


class Fork:
    """One process of them."""

    def __init__(self, pid):
        self.pid = pid

    def kill(self):
        os.kill(self.pid, signal.SIGKILL)


if __name__ == "__main__":
    main()
