"""Libraries that look for settings in the current folder while they are imported find none there.

Numba takes the folder of its compiled kernels from ``.numba_config.yaml``, and loads what lies in it as code;
Matplotlib and ezdxf take names of modules, programs and fonts from ``matplotlibrc`` and ``ezdxf.ini``. A folder that
comes from somebody else may hold such files. Settings in the user's own folders and environment variables stay.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import ModuleType

ROOT = "/"  # nobody but the administrator writes there
NUMBA, NUMBA_FILE = "numba.core.config", "_config_fname"
MODULES = frozenset({NUMBA, "matplotlib", "ezdxf._options"})  # those that read the settings
# Compiled kernels are loaded from these folders: a relative path is one of the current folder.
OF_CACHES = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")


class _Finder:
    """Finds the modules above as Python does, and gives them the loader below."""

    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name not in MODULES:
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _InRoot(spec.loader.name, spec.loader.path)
        return spec


class _InRoot(SourceFileLoader):
    """Executes a module in the root folder."""

    def exec_module(self, module: ModuleType) -> None:
        if module.__name__ == NUMBA:
            for name in OF_CACHES:
                if not os.path.isabs(os.environ.get(name, ROOT)):
                    del os.environ[name]
        with _in_root():
            super().exec_module(module)
        if module.__name__ == NUMBA:  # which reads its file again before it compiles
            setattr(module, NUMBA_FILE, os.path.join(ROOT, getattr(module, NUMBA_FILE)))


@contextmanager
def _in_root() -> Iterator[None]:
    """Make the root folder the current one of the whole process, for the moment that an import takes."""
    here = os.open(".", getattr(os, "O_PATH", os.O_RDONLY))  # O_PATH: also of a folder that cannot be read
    try:
        os.chdir(ROOT)
        yield
    finally:
        os.fchdir(here)
        os.close(here)


def leave_current_folder_out() -> None:
    """Import the modules above without the settings of the current folder from now on."""
    if _Finder not in sys.meta_path:
        sys.meta_path.insert(0, _Finder)
