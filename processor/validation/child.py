"""The process of one cell: the scene is made by one process, run by another, and what came of it written beside.

``python -m processor.validation.child FOLDER``, where FOLDER holds spec.json; done.json is there at the end. Standard
input is a pipe that nothing is written to: it closes when the process that started this one is gone, however it
ended, and then this one ends too, with those it started.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

SPEC, DONE, RESULTS = "spec.json", "done.json", "results"
ANSWERED = (0, 1, 4)  # exit codes of processor run that leave results: done, done in part, an accuracy limit missed
TAIL = 500
KB = 1024.0


def main() -> None:
    """Do the cell in the folder of the command line."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    folder = Path(sys.argv[1])
    spec = json.loads((folder / SPEC).read_text("utf-8"))
    started = time.monotonic()
    failed = _do(spec, folder)
    peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / KB
    said = {"failed": failed, "seconds": time.monotonic() - started, "peak_mb": peak_mb}
    (folder / DONE).write_text(json.dumps(said), "utf-8")


def _do(spec: dict[str, Any], folder: Path) -> str:
    """Return why the cell failed, or nothing."""
    recipe, scene = spec["recipe"], folder / "scene.h5"
    if spec["recipe_text"]:
        recipe = folder / f"{recipe}.toml"
        recipe.write_text(spec["recipe_text"], "utf-8")
    settings = [word for setting in spec["settings"] for word in ("--set", setting)]
    made = _run("designgen", "make", str(recipe), "-o", str(scene), "--seed", str(spec["seed"]), *settings)
    if made.returncode != 0:
        return _why("designgen make", made)
    given = ["--steps", ",".join(spec["steps"])]
    given += ["--method", ",".join(spec["methods"])] if spec["methods"] else []
    if spec["params"]:
        (folder / "params.toml").write_text(_toml(spec["params"]), "utf-8")
        given += ["--params", str(folder / "params.toml")]
    ran = _run("processor", "run", str(scene), "-o", str(folder / RESULTS), *given)
    return "" if ran.returncode in ANSWERED else _why("processor run", ran)


def _run(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="replace",
        check=False,
    )


def _why(what: str, ended: subprocess.CompletedProcess[str]) -> str:
    lines = [line.strip() for line in ended.stderr.splitlines() if line.strip()]
    code = ended.returncode
    how = f"signal {-code} (out of memory?)" if code < 0 else f"exit code {code}"
    return f"{what}: {how}: {lines[-1][:TAIL]}" if lines else f"{what}: {how}"


def _toml(table: dict[str, Any], above: str = "") -> str:
    """Write parameters as TOML: numbers, texts, truth values and lists are written as in JSON."""
    own = [f"{_key(k)} = {json.dumps(v, ensure_ascii=False)}" for k, v in table.items() if not isinstance(v, dict)]
    below = [
        f"[{above}{_key(key)}]\n{_toml(value, f'{above}{_key(key)}.')}"
        for key, value in table.items()
        if isinstance(value, dict)
    ]
    return "\n".join([*own, *below]) + "\n"


def _key(name: str) -> str:
    return json.dumps(name, ensure_ascii=False)


def _end_with_parent() -> None:
    with suppress(OSError):
        while os.read(0, 1):
            pass
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    main()
