"""A job's process that fails as the file ``plant`` in its input says, and is done in no time where it says nothing.

With a file ``real`` in the input, and for scenes, it is that of the processor.

As ``failing_job.py batch ...`` it is the command line of processor, whose jobs are done so.
"""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from processor.jobs import causes, child


def fake(source, out):
    """Results of a sphere, without one."""
    time.sleep(0.05)
    out.mkdir(parents=True)
    balls = [{"id": 0, "flag": "ok"}, {"id": 1, "flag": "low-confidence"}]
    step = {"status": "ok", "method": "ray", "balls": balls}
    content = (source / "scan.xyz").read_text("utf-8") if source.is_dir() else source.read_text("utf-8")
    results = {"format": "processor-results", "steps": {"spheres": step}, "checks": [], "content": content}
    (out / "results.json").write_text(json.dumps(results), "utf-8")
    for name in ("results.h5", "report.html"):
        (out / name).write_text(content, "utf-8")


def plant(source):
    path = source / "plant"
    what = path.read_text("utf-8").strip() if path.is_file() else ""
    if what == "segfault":
        os.kill(os.getpid(), signal.SIGSEGV)
    elif what == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    elif what == "hang":
        time.sleep(3600)
    elif what == "deaf":  # holds the interpreter, so that no thread of it does anything
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        (10 ** (10**8)).__str__()
    elif what == "memory":
        held = []
        while True:
            held.append(b"x" * 2**24)
    elif what == "memory elsewhere":
        code = "held = []\nwhile True: held.append(b'x' * 2**24)"
        subprocess.run([sys.executable, "-c", code], check=False)
        time.sleep(60)
    elif what == "panic":
        raise BaseException("panicked at src/lib.rs")
    elif what == "talk":
        for _ in range(300):
            os.write(2, b"all is well, " * 500 + b"\n")
    elif what == "slow":
        time.sleep(1.5)
    elif what == "change":
        with (source / "scan.xyz").open("a") as file:
            file.write("9 9 9\n")
        (path).unlink()
    elif what.startswith("exit "):
        print("error: planted", file=sys.stderr)
        sys.exit(int(what.split()[1]))


def main():
    if sys.argv[1] == "batch":
        from processor import __main__
        from processor.batch import batch

        batch.Settings = partial(batch.Settings, program=(sys.executable, __file__))
        __main__.main()
        return
    child.guard(int(sys.argv[1]))
    with causes.exiting_by_cause():
        job()


def job():
    source = Path(sys.argv[4])
    plant(source)
    if source.suffix == ".h5" or (source / "real").exists():
        sys.argv[:] = sys.argv[2:]
        from processor.__main__ import main as processor

        processor()
    fake(source, Path(sys.argv[6]))


if __name__ == "__main__":
    main()
