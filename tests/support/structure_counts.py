"""How large and how divided the sources are: numbers that only shrink, counted with ast."""

import ast
from collections import Counter

from tests.support.structure import MODULES, ROOT, SOURCES, is_record, nodes, tree, used_modules

FEW_LINES = 6  # a function of fewer that is called once is better read where it is called


def code_lines():
    """Lines of both packages."""
    return sum(len(path.read_text("utf-8").splitlines()) for path in SOURCES)


def record_classes():
    """Places of the classes that hold values alone."""
    return [
        f"{path.relative_to(ROOT)}:{node.lineno} {node.name}"
        for path in SOURCES
        for node in nodes(path)
        if is_record(node)
    ]


def constants_without_reason():
    """Numeric constants of modules without a comment in the line above or beside them."""
    found = []
    for path in SOURCES:
        lines = path.read_text("utf-8").splitlines()
        for node in tree(path).body:
            if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None or not _numeric(node.value):
                continue
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [one for target in targets for one in getattr(target, "elts", [target])]
            if not all(isinstance(one, ast.Name) and one.id.isupper() for one in names):
                continue
            beside = "\n".join(lines[node.lineno - 1 : node.end_lineno])
            above = lines[node.lineno - 2].strip() if node.lineno > 1 else ""
            if "#" not in beside and not above.startswith("#"):
                found.append(f"{path.relative_to(ROOT)}:{node.lineno} {beside.splitlines()[0]}")
    return found


def _numeric(value):
    """Whether a value has numbers that were chosen: 0 and 1 are of axes, signs, rows and codes."""
    numbers = (one.value for one in ast.walk(value) if isinstance(one, ast.Constant))
    return any(type(one) in (int, float) and one not in (0, 1) for one in numbers)


def called_once():
    """Functions of modules whose name stands in one place beside their definition, and those of few lines."""
    uses = Counter()
    for path in SOURCES:
        for node in nodes(path):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
                uses[node.id] += 1
            elif isinstance(node, ast.Attribute):
                uses[node.attr] += 1
    functions = [
        (path, node)
        for path in SOURCES
        for node in tree(path).body
        if isinstance(node, ast.FunctionDef) and uses[node.name] == 1
    ]
    few = [f"{path.relative_to(ROOT)}:{node.lineno} {node.name}" for path, node in functions if _short(node)]
    return [f"{path.relative_to(ROOT)}:{node.lineno} {node.name}" for path, node in functions], few


def _short(function):
    documented = ast.get_docstring(function) is not None
    body = function.body[1:] if documented else function.body
    return not body or function.end_lineno - body[0].lineno + 1 < FEW_LINES


def circles_of_folders():
    """Pairs of folders, neither within the other, that import each other."""
    edges = set()
    for name in MODULES:
        for other in used_modules(name):
            here, there = _folder(name), _folder(other)
            if here != there and not f"{here}.".startswith(f"{there}.") and not f"{there}.".startswith(f"{here}."):
                edges.add((here, there))
    return sorted((here, there) for here, there in edges if here < there and (there, here) in edges)


def _folder(name):
    return name if MODULES[name].name == "__init__.py" else name.rpartition(".")[0]
