"""Compiled kernels are made anew where the source of a kernel within them has changed.

Numba compiles a kernel again when its own file changes, not when that of a kernel that it calls does: tests of such a
change would run the old code, and pass.
"""

import hashlib
import json
from collections import defaultdict

from tests.support.structure import MODULES, ROOT, imports

STATE = ROOT / ".pytest_cache" / "kernels.json"
USES_NUMBA = (b"njit", b"inner_kernels", b"vectorize")


def discard_stale():
    """Remove compiled kernels of modules that use, directly or through others, a module of kernels that changed.

    Returns whether there were any such modules.
    """
    now = {name: _digest(path) for name, path in MODULES.items() if _has_kernels(path)}
    before = json.loads(STATE.read_text("utf-8")) if STATE.exists() else {}
    changed = {name for name in {**before, **now} if before.get(name) != now.get(name)}
    if not changed:
        return False
    for name in with_users(changed) & MODULES.keys():
        for path in compiled(MODULES[name]):
            path.unlink(missing_ok=True)
    STATE.parent.mkdir(exist_ok=True)
    STATE.write_text(json.dumps(now), "utf-8")
    return True


def with_users(changed):
    """Return names of modules, and of those whose kernels may have kernels or constants of them within."""
    users = defaultdict(set)
    for name, path in MODULES.items():
        if _has_kernels(path):
            for imported in imports(path):
                users[imported].add(name)
    waiting, stale = sorted(changed), set()
    while waiting:
        name = waiting.pop()
        if name not in stale:
            stale.add(name)
            waiting += users[name]
    return stale


def compiled(source):
    """Files of the compiled kernels of a source, and their index."""
    return [*(source.parent / "__pycache__").glob(f"{source.stem}.*.nb[ci]")]


def _has_kernels(path):
    source = path.read_bytes()
    return any(word in source for word in USES_NUMBA)


def _digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()
