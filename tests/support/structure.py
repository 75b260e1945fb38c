"""The structure of the sources, read with ast: modules, imports, circles, sizes."""

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("processor", "designgen")
OTHER_FOLDERS = ("tests", "docs", "fixtures", "examples")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
MOST_FILES, MOST_LINES, MOST_ARGUMENTS = 20, 60, 10


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in SOURCES}


@cache
def tree(path):
    return ast.parse(path.read_text("utf-8"))


@cache
def nodes(path):
    """Every node of a file's tree but the contexts of names, which say nothing here."""
    found = [tree(path)]
    for node in found:  # grows on the way
        found += _children(node)
    return found


def _children(node):
    for name in node._fields:
        value = getattr(node, name, None)
        if isinstance(value, list):
            yield from (one for one in value if isinstance(one, ast.AST))
        elif isinstance(value, ast.AST) and name != "ctx":
            yield value


@cache
def imports(path):
    """Every module that a file imports, those inside functions too; of `from a import b` both a and a.b.

    Of `import_module(f"a.{name}.b")` these are all modules whose names fit. Imports for type checkers alone do not
    count, and neither do other names in strings.
    """
    found = set()
    only_types = {
        id(inner)
        for node in nodes(path)
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    for node in nodes(path):
        if id(node) in only_types:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) == "import_module":
            found |= modules_named(node.args[0])
    return frozenset(found)


def modules_named(name):
    """The modules of the project that an argument of import_module can name; a field of an f-string is any word."""
    if not isinstance(name, ast.JoinedStr) or not isinstance(name.values[0], ast.Constant):
        return set()
    pattern = "".join(re.escape(one.value) if isinstance(one, ast.Constant) else r"\w+" for one in name.values)
    return {module for module in MODULES if re.fullmatch(pattern, module)}


def within(names, *packages):
    return {n for n in names if any(n == p or n.startswith(p + ".") for p in packages)}


def used_modules(name):
    """The modules of the project that a module imports; packages without code of their own are passed over."""
    own = {n for n in imports(MODULES[name]) if n in MODULES and n != name}
    return {n for n in own if MODULES[n].name != "__init__.py" or len(tree(MODULES[n]).body) > 1}


SHARED_ROOMS = ("model", "plain_text", "meshes", "store", "writers", "progress", "jobs", "version")


def foreign_imports():
    """Imports over the borders of the packages: CAD in processor, HDF5 outside the store, geometry in designgen."""
    wrong = []
    for name, path in MODULES.items():
        used = imports(path)
        if within({name}, "processor"):
            wrong += [(name, each) for each in within(used, "designgen", "cadquery", "OCP")]
        else:
            rooms = within(used, *(f"processor.{room}" for room in SHARED_ROOMS)) | {"processor"}
            wrong += [(name, each) for each in within(used, "processor") - rooms]
        if not within({name}, "processor.store"):
            wrong += [(name, each) for each in within(used, "h5py")]
    return wrong


def circles():
    """Groups of modules that import each other, directly or through others (Tarjan)."""
    graph = {name: sorted(used_modules(name)) for name in MODULES}
    index, low, on, stack, found = {}, {}, set(), [], []

    def visit(node):
        index[node] = low[node] = len(index)
        stack.append(node)
        on.add(node)
        for other in graph[node]:
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in on:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            group = []
            while not group or group[-1] != node:
                group.append(stack.pop())
                on.discard(group[-1])
            if len(group) > 1:
                found.append(sorted(group))

    for name in graph:
        if name not in index:
            visit(name)
    return found


def crowded_folders():
    """Map each folder of more than ``MOST_FILES`` files to their number: modules of packages, all files elsewhere."""
    others = (path for place in OTHER_FOLDERS for path in (ROOT / place).rglob("*"))
    files = [*SOURCES, *(path for path in others if path.is_file() and "__pycache__" not in path.parts)]
    counts = Counter(str(path.parent.relative_to(ROOT)) for path in files)
    return {folder: count for folder, count in counts.items() if count > MOST_FILES}


def long_functions():
    """Functions with too many lines or arguments."""
    found = []
    for path in SOURCES:
        for node in nodes(path):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            lines = node.end_lineno - min([node.lineno, *(one.lineno for one in node.decorator_list)]) + 1
            arguments = len(node.args.posonlyargs) + len(node.args.args) + len(node.args.kwonlyargs)
            if lines > MOST_LINES or arguments > MOST_ARGUMENTS:
                found.append(
                    f"{path.relative_to(ROOT)}:{node.lineno} {node.name}: {lines} lines, {arguments} arguments"
                )
    return found


def is_record(node):
    """Whether a node is a class that holds values alone: a dataclass or a named tuple."""
    return isinstance(node, ast.ClassDef) and (
        any("dataclass" in ast.dump(one) for one in node.decorator_list)
        or any("NamedTuple" in ast.dump(one) for one in node.bases)
    )


def positional_records(most=5):
    """Calls of dataclasses and named tuples of the project with more than ``most`` positional arguments."""
    records = {node.name for path in SOURCES for node in nodes(path) if is_record(node)}
    found = []
    for path in SOURCES:
        for node in nodes(path):
            name = getattr(node.func, "id", getattr(node.func, "attr", "")) if isinstance(node, ast.Call) else ""
            if name in records and len(node.args) > most:
                found.append(f"{path.relative_to(ROOT)}:{node.lineno} {name}: {len(node.args)} positional arguments")
    return found


STEPS = ("defects", "deviation", "inspection", "preassembly", "space_frame", "stitching")
LAYERS = (
    ("version", "plain_text", "large_arrays", "inner_kernels", "library_settings"),
    ("model",),
    ("record_checks", "tiles"),
    (
        "progress",
        "diagnostics",
        "language",
        "jobs",
        "robust_statistics",
        "distinct_rows",
        "unit_ratio",
        "user_methods",
        "column_names",
    ),
    ("geometry",),
    ("views",),
    ("scene_cloud", "adjustment"),
    ("registration",),
    ("components", "limits", "store"),
    ("readers", "writers"),
    ("meshes",),
    ("scan_folder",),
    STEPS,
    ("targets",),
    ("pipeline",),
    ("compare", "evaluation", "field_check"),
    ("results",),
    ("epochs",),
    ("report", "clouds"),
    ("api",),
    ("batch", "validation"),
    ("cli",),
    ("__main__",),
)
FOR_STEPS = (
    "version", "plain_text", "large_arrays", "inner_kernels", "model", "progress", "diagnostics", "robust_statistics",
    "distinct_rows", "unit_ratio", "tiles", "geometry", "registration", "views", "scene_cloud", "adjustment",
    "components", "limits",
)  # fmt: skip


def wrong_arrows():
    """Imports that do not lead to a lower layer of processor, or from one step to another or to files."""
    rank = {name: i for i, names in enumerate(LAYERS) for name in names}
    found = []
    for name in MODULES:
        if not name.startswith("processor."):
            continue
        room = name.split(".")[1]
        assert room in rank, f"{name}: not in a layer"
        for other in sorted(used_modules(name)):
            target = other.split(".")[1] if other.count(".") else ""
            if other.split(".")[0] != "processor" or target in ("", room):
                continue
            if rank[target] >= rank[room] or (room in STEPS and target not in FOR_STEPS):
                found.append(f"{name} -> {other}")
    return found


CUTS = (
    "split", "rsplit", "partition", "rpartition", "startswith", "endswith", "removeprefix", "removesuffix", "replace",
)  # fmt: skip
FOR_PEOPLE = {
    "message", "reason", "reasons", "units_reason", "doubt", "doubts", "problem", "problems", "fault", "faults",
}  # fmt: skip


def messages_read_again(sources=SOURCES):
    """Calls that cut, or look into, a text for people: a message, a reason, a doubt, or an error as a text.

    ``split()`` at white space puts a text on one line and reads nothing.
    """
    found = []
    for path in sources:
        calls = [node for node in nodes(path) if isinstance(node, ast.Call)]
        names = FOR_PEOPLE | _items_for_people(nodes(path))
        found += [
            f"{path.name}:{node.lineno} {ast.unparse(node.func)}"
            for node in calls
            if isinstance(node.func, ast.Attribute)
            and node.func.attr in CUTS
            and not (node.func.attr == "split" and not node.args)
            and _for_people(node.func.value, names)
        ]
    return found


def _items_for_people(every):
    """The names of the items of lists of texts for people, in loops over them."""
    return {
        node.target.id
        for node in every
        if isinstance(node, ast.For | ast.comprehension) and isinstance(node.target, ast.Name)
        if _for_people(node.iter, FOR_PEOPLE)
    }


def _for_people(node, names):
    """Whether an expression is a text for people, or a part of one, by the names in it."""
    if isinstance(node, ast.Subscript):
        return _for_people(node.value, names)
    if isinstance(node, ast.Call):
        name = getattr(node.func, "id", getattr(node.func, "attr", ""))
        if name == "str" and node.args:
            return "error" in ast.unparse(node.args[0]) or _for_people(node.args[0], names)
        if isinstance(node.func, ast.Attribute):  # message.strip().split(...), messages("en").text(...).split(...)
            return _for_people(node.func.value, names) or ast.unparse(node.func.value).startswith("messages(")
        return name in names
    return getattr(node, "id", getattr(node, "attr", "")) in names
