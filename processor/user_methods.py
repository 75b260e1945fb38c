"""A method of the user's own: a function with the signature of a step's ``run``, named ``module:function``.

The name comes from the command line or from the user's file of parameters alone. What a scan folder holds never names
code: project.toml has no such key.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from processor.model import UsageError

folder: Path | None = None  # that the user is in, where it is not the current one: child processes are elsewhere
NAME = re.compile(r"([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*):([A-Za-z_]\w*)", re.ASCII)


def is_named(method: str) -> bool:
    """Whether a method's name is that of a function of the user's: it has a colon."""
    return ":" in method


def shown(method: str) -> str:
    """Return the name that tables and files have of a method: a colon is not allowed in all file names."""
    return method.replace(":", ".")


def load(method: str) -> Callable[..., Any]:
    """Import ``module:function``: a module that is installed, else a file ``module.py`` in the user's folder.

    Raises UsageError where the name, the module or the function is none.
    """
    if not (match := NAME.fullmatch(method)):
        raise UsageError(f"method {method!r}: expected module:function, e.g. my_module:my_method")
    module, name = match.groups()
    function = getattr(_module(module, method), name, None)
    if not callable(function):
        raise UsageError(f"method {method!r}: expected a function {name!r} in module {module}, found none")
    found: Callable[..., Any] = function
    return found


def _module(name: str, method: str) -> ModuleType:
    path = (folder or Path.cwd()) / f"{name}.py"
    try:
        if name not in sys.modules and _is_missing(name) and path.is_file():
            spec = importlib.util.spec_from_file_location(name, path)
            assert spec is not None
            assert spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            sys.modules[name] = module  # dataclasses of the module look it up
            try:
                spec.loader.exec_module(module)
            except BaseException:
                del sys.modules[name]
                raise
            return module
        return importlib.import_module(name)
    except Exception as error:
        why = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise UsageError(
            f"method {method!r}: module {name} cannot be imported ({why}); expected an installed module or {path}"
        ) from error


def _is_missing(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is None
    except ModuleNotFoundError:  # of the package it is in
        return True


def call(
    function: Callable[..., Any], method: str, scene: Any, params: Any, given: Mapping[str, Any], cls: type
) -> Any:
    """Call a function of the user's with what it takes of ``given``; its result must be of the step's class.

    Raises UsageError where it is not. The result has the method's shown name.
    """
    parameters = inspect.signature(function).parameters
    takes_all = any(one.kind is one.VAR_KEYWORD for one in parameters.values())
    result = function(scene, params, **{key: value for key, value in given.items() if takes_all or key in parameters})
    if not isinstance(result, cls):
        raise UsageError(
            f"method {method!r}: expected it to return a {cls.__module__}.{cls.__name__}, got {result!r:.60}"
        )
    return result
