"""Every fault that a few operators can make in a Python file.

Left out is what no result depends on: docstrings and other text, types, ``raise`` statements and
warnings (their words), how things are printed, and choices: the nominals, limits and units with
which variables are declared, and the numbers that arguments have by default.
"""

from __future__ import annotations

import ast
from itertools import pairwise

from .faults import Fault

__all__ = ["alters", "python_faults"]

SWAPS: dict[type, str] = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.Pow: "*"}
COMPARISONS: dict[type, tuple[str, ...]] = {
    ast.Lt: ("<=", ">="),
    ast.LtE: ("<", ">"),
    ast.Gt: (">=", "<="),
    ast.GtE: (">", "<"),
    ast.Eq: ("!=",),
    ast.NotEq: ("==",),
    ast.Is: ("is not",),
    ast.IsNot: ("is",),
    ast.In: ("not in",),
    ast.NotIn: ("in",),
}
NAMES = {
    "min": "max", "minimum": "maximum", "fmin": "fmax", "argmin": "argmax", "nanmin": "nanmax",
    "mmin": "mmax", "any": "all", "sin": "cos", "sum1": "sum2", "vertcat": "horzcat",
    "zeros": "ones", "floor": "ceil", "cumsum": "diff", "column_stack": "vstack",
}  # fmt: skip
NAMES |= {b: a for a, b in NAMES.items() if a not in ("zeros", "cumsum", "column_stack")}
QUIET = {
    "description", "display", "repr", "unit", "nominal", "min", "max", "minimum", "maximum", "name",
    "stacklevel", "indent",
}  # fmt: skip
UNSWAPPED = {
    "isinstance", "getattr", "field", "coefficient", "__setattr__", "min", "max", "fmin", "fmax",
    "minimum", "maximum", "isclose", "is_equal", "add", "multiply",
}  # fmt: skip
PRINTED = {"__str__", "__repr__", "_repr_html_", "summary", "describe", "plot", "__dir__"}
SILENT = (ast.Raise, ast.JoinedStr, ast.Import, ast.ImportFrom, ast.Global, ast.Nonlocal)


class _Finder(ast.NodeVisitor):
    def __init__(self, file: str, text: str) -> None:
        self.file, self.text = file, text
        starts = [0]
        for line in text.splitlines(keepends=True):
            starts.append(starts[-1] + len(line))
        self._starts, self._lines = starts, text.splitlines()
        self.found: list[Fault] = []

    # ---- places ----

    def place(self, line: int, column: int) -> int:
        ahead = self._lines[line - 1].encode()[:column].decode()
        return self._starts[line - 1] + len(ahead)

    def span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return (
            self.place(node.lineno, node.col_offset),
            self.place(node.end_lineno, node.end_col_offset),
        )

    def source(self, node: ast.expr | ast.stmt) -> str:
        start, end = self.span(node)
        return self.text[start:end]

    def add(self, node: ast.expr | ast.stmt, new: str, kind: str) -> None:
        start, end = self.span(node)
        old = self.text[start:end]
        if old != new:
            self.found.append(Fault(self.file, start, end, new, kind, node.lineno, old))

    # ---- what is looked at ----

    def visit(self, node: ast.AST) -> None:
        if not isinstance(node, SILENT):
            super().visit(node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        if node.name in PRINTED:
            return
        for value in [*node.args.defaults, *(d for d in node.args.kw_defaults if d is not None)]:
            self._default(value)
        self._body(node.body)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        if any("Protocol" in self.source(b) for b in node.bases):
            return
        self._body(node.body)

    def visit_Lambda(self, node: ast.Lambda) -> None:
        self.visit(node.body)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self._default(node.value)

    def _default(self, value: ast.expr) -> None:
        """A number that stands where none is given is a choice; yes or no is more."""
        number = value.operand if isinstance(value, ast.UnaryOp) else value
        if not isinstance(number, ast.Constant) or isinstance(number.value, bool):
            self.visit(value)

    def visit_Assign(self, node: ast.Assign) -> None:
        if any(isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets):
            return
        self.generic_visit(node)

    def visit_If(self, node: ast.If) -> None:
        if self.source(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            return
        self._negated(node.test)
        self.generic_visit(node)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        self._negated(node.test)
        self.generic_visit(node)

    def visit_comprehension(self, node: ast.comprehension) -> None:
        for test in node.ifs:
            self._negated(test)
        self.generic_visit(node)

    def _body(self, body: list[ast.stmt]) -> None:
        for child in body:
            self.visit(child)

    def _negated(self, test: ast.expr) -> None:
        if isinstance(test, ast.Compare) and len(test.ops) == 1:
            return  # its own operator is turned round
        self.add(test, f"(not ({self.source(test)}))", "condition negated")

    # ---- faults ----

    def visit_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Constant):
            return
        if isinstance(node.value, ast.Call) and self.source(node.value.func) in (
            "warnings.warn",
            "print",
        ):
            return
        if isinstance(node.value, ast.Call):
            self.add(node, "pass", "statement dropped")
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self.add(node, "pass", "statement dropped")
        self.visit(node.value)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        left, right = self.source(node.left), self.source(node.right)
        other = SWAPS.get(type(node.op))
        texts = (node.left, node.right)
        text = any(isinstance(e, (ast.JoinedStr, ast.List, ast.Tuple, ast.Dict)) for e in texts)
        text |= any(isinstance(e, ast.Constant) and isinstance(e.value, str) for e in texts)
        if other is not None and not text:
            between = self.text[self.span(node.left)[1] : self.span(node.right)[0]]
            # brackets round either side stay
            sign = {ast.Pow: "**", ast.Mult: "*", ast.Div: "/", ast.Add: "+", ast.Sub: "-"}
            mark = sign[type(node.op)]
            ahead, _, behind = between.partition(mark)
            self.add(node, f"{left}{ahead}{other}{behind}{right}", "operator")
            outer = self.span(node)
            word = {ast.Mult: "factor", ast.Div: "factor", ast.Pow: "power"}
            name = word.get(type(node.op), "term")
            self._replaced(node, outer, left, f"{name} dropped")
            if not isinstance(node.op, (ast.Pow, ast.Div)):
                new = right if isinstance(node.op, (ast.Mult, ast.Add)) else f"(-({right}))"
                self._replaced(node, outer, new, f"{name} dropped")
        self.generic_visit(node)

    def _replaced(self, node: ast.expr, span: tuple[int, int], new: str, kind: str) -> None:
        start, end = span
        old = self.text[start:end]
        self.found.append(Fault(self.file, start, end, f"({new})", kind, node.lineno, old))

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        inner = self.source(node.operand)
        if isinstance(node.op, (ast.USub, ast.Not)):
            self.add(node, f"({inner})", "sign dropped")
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        for one, two in pairwise(node.values):
            start, end = self.span(one)[1], self.span(two)[0]
            between = self.text[start:end]
            word, other = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
            if between.count(word) == 1:
                new = between.replace(word, other)
                self.found.append(
                    Fault(self.file, start, end, new, "operator", node.lineno, between)
                )
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        sides = [node.left, *node.comparators]
        for one, op, two in zip(sides, node.ops, node.comparators, strict=False):
            start, end = self.span(one)[1], self.span(two)[0]
            between = self.text[start:end]
            ahead = between[: len(between) - len(between.lstrip(" )\n"))]
            behind = between[len(between.rstrip(" (\n")) :]
            for other in COMPARISONS.get(type(op), ()):
                new = f"{ahead}{other}{behind}"
                self.found.append(
                    Fault(self.file, start, end, new, "comparison", node.lineno, between)
                )
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        name = node.func.attr if isinstance(node.func, ast.Attribute) else self.source(node.func)
        if name in ("cast", "TypeVar", "warn", "require_finite", "require_positive"):
            if name.startswith("require"):
                for argument in node.args:
                    self.visit(argument)
            return
        if name in NAMES:
            end = self.span(node.func)[1]
            start = end - len(name)
            new = NAMES[name]
            self.found.append(Fault(self.file, start, end, new, "function", node.lineno, name))
        plain = [a for a in node.args if not isinstance(a, ast.Starred)]
        if len(plain) == len(node.args) >= 2 and name not in UNSWAPPED:
            for one, two in pairwise(plain):
                if isinstance(one, ast.Constant) and isinstance(one.value, str):
                    continue
                (a, b), (c, d) = self.span(one), self.span(two)
                old = self.text[a:d]
                new = self.text[c:d] + self.text[b:c] + self.text[a:b]
                if old != new:
                    self.found.append(
                        Fault(self.file, a, d, new, "arguments swapped", node.lineno, old)
                    )
        self.visit(node.func)
        for argument in node.args[2 if name == "coefficient" else 0 :]:  # unit and nominal
            self.visit(argument)
        for keyword in node.keywords:
            if keyword.arg not in QUIET:
                self.visit(keyword.value)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self.add(node, str(not value), "constant")
        elif isinstance(value, int):
            self.add(node, str(value + 1), "constant")
        elif isinstance(value, float) and value != 0.0 and abs(value) < 1e300:
            if abs(value) <= 1e-6 and self.source(node).startswith("1e"):
                self.add(node, repr(1e6 * value), "constant")  # a tolerance: twice is as good
                return
            self.add(node, repr(2 * value), "constant")
            self.add(node, repr(1.01 * value), "constant")
        elif value == 0.0 and isinstance(value, float):
            self.add(node, "1.0", "constant")


def python_faults(file: str, text: str) -> list[Fault]:
    """Faults of ``text``, some of which may not compile or change nothing: see :func:`alters`."""
    finder = _Finder(file, text)
    finder.visit(ast.parse(text))
    return finder.found


def alters(fault: Fault, text: str) -> bool:
    """Whether what the fault leaves compiles, and says something else."""
    try:
        tree = ast.parse(fault.applied(text))
    except SyntaxError:
        return False
    return ast.dump(tree) != ast.dump(ast.parse(text))
