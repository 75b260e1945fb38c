"""Places of a source where one small change alters a number: the mutants of numeric code.

Each kind is an error that people make in such code. A change replaces the text of one expression; the rest of the file
stays as it is.
"""

import ast
from collections.abc import Iterator
from dataclasses import dataclass

COMPARISONS = {ast.Lt: ("<=", ">"), ast.LtE: ("<", ">="), ast.Gt: (">=", "<"), ast.GtE: (">", "<="), ast.Eq: ("!=",)}
# Functions that are taken for each other: extremes, all for any, variance for standard deviation.
OTHER_NAME = {
    **{"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "argmin": "argmax", "argmax": "argmin"},
    **{"any": "all", "all": "any", "nanmin": "nanmax", "nanmax": "nanmin", "std": "var", "var": "std"},
    **{"floor": "ceil", "ceil": "floor", "sin": "cos", "cos": "sin", "mean": "median", "median": "mean"},
}
DROPPED = ("sqrt", "abs", "fabs", "negative")  # functions of one argument that can be forgotten
KEPT = (ast.JoinedStr, ast.Raise, ast.Assert)  # texts of errors are not numbers


@dataclass(frozen=True)
class Site:
    """One change: characters ``start`` to ``end`` of the source become ``new``.

    ``compiled``: it may stand in compiled code, as all does that is not within a plain function.
    """

    kind: str
    line: int
    start: int
    end: int
    old: str
    new: str
    compiled: bool

    def applied(self, source: str) -> str:
        return source[: self.start] + self.new + source[self.end :]


def sites(source: str) -> list[Site]:
    """All changes of a source, in their order in the text."""
    lines = [0]
    for line in source.splitlines(keepends=True):
        lines.append(lines[-1] + len(line))

    def offset(line: int, column: int) -> int:
        text = source[lines[line - 1] : lines[line]]
        return lines[line - 1] + len(text.encode()[:column].decode())

    found = []
    tree = ast.parse(source)
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    for node in _numeric_nodes(tree):
        around = [one for one in functions if one.lineno <= node.lineno <= (one.end_lineno or 0)]
        compiled = not around or any(_is_kernel(one) for one in around)
        start, end = offset(node.lineno, node.col_offset), offset(node.end_lineno, node.end_col_offset)
        for kind, new in _changes(node):
            old, new = source[start:end], f"({new.strip()})" if " " in new else new
            found.append(Site(kind=kind, line=node.lineno, start=start, end=end, old=old, new=new, compiled=compiled))
    return sorted(found, key=lambda site: (site.start, site.end, site.kind, site.new))


def _is_kernel(function: ast.FunctionDef) -> bool:
    return any(word in ast.unparse(one) for one in function.decorator_list for word in ("njit", "inner", "vectorize"))


def _numeric_nodes(tree: ast.AST) -> Iterator[ast.expr]:
    """Expressions but those of annotations, decorators, errors and default values of records' fields."""
    for name, value in ast.iter_fields(tree):
        if name in ("annotation", "returns", "decorator_list", "bases", "type_comment") or isinstance(value, KEPT):
            continue
        for node in value if isinstance(value, list) else [value]:
            if not isinstance(node, ast.AST) or isinstance(node, KEPT):
                continue
            if isinstance(node, ast.expr):
                yield node
            yield from _numeric_nodes(node)


def _changes(node: ast.expr) -> Iterator[tuple[str, str]]:
    """Pairs of a kind and the text that an expression becomes."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        left, right = ast.unparse(node.left), ast.unparse(node.comparators[0])
        for symbol in COMPARISONS.get(type(node.ops[0]), ()):
            yield "comparison", f"{left} {symbol} {right}"
    elif isinstance(node, ast.BinOp):
        yield from _of_binary(node, ast.unparse(node.left), ast.unparse(node.right))
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not | ast.Invert):
        kind = "sign" if isinstance(node.op, ast.USub) else "negation"
        yield kind, f" {ast.unparse(node.operand)}"
    elif isinstance(node, ast.BoolOp):
        yield "skipped condition", " " + ast.unparse(node.values[0])
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        yield from _of_number(node.value)
    elif isinstance(node, ast.Attribute) and node.attr == "T" and isinstance(node.ctx, ast.Load):
        yield "transposed", ast.unparse(node.value)
    elif isinstance(node, ast.Call):
        yield from _of_call(node)
    elif isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Load) and _is_mask(node.slice):
        yield "skipped filter", ast.unparse(node.value)


def _of_binary(node: ast.BinOp, left: str, right: str) -> Iterator[tuple[str, str]]:
    if isinstance(node.op, ast.Add | ast.Sub):
        yield "sign", f"({left}) {'-' if isinstance(node.op, ast.Add) else '+'} ({right})"
        yield "dropped term", f" {left}"
    elif isinstance(node.op, ast.Mult | ast.Div):
        yield "dropped factor", f" {left}"
        if isinstance(node.op, ast.Div):
            yield "inverted", f"({left}) * ({right})"
    elif isinstance(node.op, ast.Pow):
        yield "dropped power", f" {left}"
    elif isinstance(node.op, ast.BitAnd | ast.BitOr):
        yield "skipped condition", f" {left}"
    elif isinstance(node.op, ast.MatMult):
        yield "order of a product", f"({right}) @ ({left})"


def _of_number(value: float) -> Iterator[tuple[str, str]]:
    if isinstance(value, int):
        yield "off by one", repr(value + 1)
    elif value:
        yield "1 % of a constant", repr(value * 1.01)


def _of_call(node: ast.Call) -> Iterator[tuple[str, str]]:
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    function, whole = ast.unparse(node.func), ast.unparse(node)
    if name in OTHER_NAME:
        yield "other function", function[: -len(name)] + OTHER_NAME[name] + whole[len(function) :]
    if name in DROPPED and len(node.args) == 1 and not node.keywords:
        yield "variance for standard deviation" if name == "sqrt" else "sign", f" {ast.unparse(node.args[0])}"
    if any(keyword.arg == "ddof" for keyword in node.keywords):
        keywords = [keyword for keyword in node.keywords if keyword.arg != "ddof"]
        yield "degrees of freedom", ast.unparse(ast.Call(node.func, node.args, keywords))


def _is_mask(index: ast.expr) -> bool:
    """Whether an index chooses by a condition, as far as its text shows that."""
    if isinstance(index, ast.Compare | ast.BoolOp):
        return True
    if isinstance(index, ast.UnaryOp) and isinstance(index.op, ast.Invert):
        return True
    return isinstance(index, ast.BinOp) and isinstance(index.op, ast.BitAnd | ast.BitOr)
