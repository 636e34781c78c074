"""Make mutants of a source file: one small change each, in expressions that guarantees rest on.

Changes: rounding left out (`up(x)` becomes `x`, a unit roundoff becomes 0), the least for the
largest, the lower end for the upper, a sign, a term or a condition dropped, a comparison negated,
all for any, a factor halved, one branch of a choice in code for both, a refusal that is never
reached, a claim that always holds. How many
roundings a bound counts is left as it is: it covers a worst case that numbers do not reach.
"""

import ast
import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

_PAIRS = (
    ("lower", "upper"),
    ("low", "high"),
    ("lo", "hi"),
    ("al", "ah"),
    ("bl", "bh"),
    ("min", "max"),
    ("minimum", "maximum"),
    ("fmin", "fmax"),
    ("below", "above"),
    ("least", "most"),
)
SWAPPED = {a: b for pair in _PAIRS for a, b in (pair, pair[::-1])}
_QUANTIFIERS = {"all": "any", "any": "all"}
# Calls that choose or connect in code that is generated, by the number of what they are given.
_CHOICES = {("if_else", 3): (1, 2), ("select", 3): (1, 2)}
_CONDITIONS = {("logic_and", 2): (0, 1), ("logic_or", 2): (0, 1), ("logic_not", 1): (0,)}
# Calls that round outwards their first argument, and numbers that stand for rounding.
_ROUNDED = {"up", "down", "raised", "lowered", "widen", "above", "_above", "outward"}
_ZERO = {
    "UNIT_ROUNDOFF",
    "ULPS",
    "_ULP",
    "_EPS",
    "_UNDERFLOW",
    "unit",
    "rounding",
    "margin",
    "lost",
}
_ZERO_CALLS = {"gamma_bound", "allowance"}
_ONE = {"UP", "_ROUND", "ROUND_UP"}
_NEGATED = {ast.Lt: ">=", ast.LtE: ">", ast.Gt: "<=", ast.GtE: "<", ast.Eq: "!=", ast.NotEq: "=="}
# Both ends of an interval have the same.
_SIZES = {"shape", "size", "numel", "ndim"}
# What only shows, and what a mutant cannot tell the truth about.
_SHOWN = {"__str__", "__repr__", "_repr_html_", "__format__"}


@dataclass(frozen=True)
class Change:
    """One change of a source: bytes start to end become a text.

    kind: which of the changes
    function: dotted name of the function around it
    line: the line that it stands in, from 1, and that line's text
    was, becomes: the expression before and after, in one line
    """

    kind: str
    function: str
    line: int
    text: str
    was: str
    becomes: str
    start: int
    end: int

    def apply(self, source: str) -> str:
        """Return the mutant."""
        raw = source.encode()
        return (raw[: self.start] + self.becomes.encode() + raw[self.end :]).decode()

    def fits(self, entry: Mapping[str, str]) -> bool:
        """Whether it is the change that an entry of the list tells of."""
        mine = {"function": self.function, "was": self.was, "becomes": self.becomes}
        mine["line"] = self.text
        return all(entry.get(name, value) == value for name, value in mine.items())

    def rank(self, seed: int, file: str) -> str:
        """Order by chance, the same for the same words wherever they stand in the file."""
        words = f"{seed} {file} {self.function} {self.text} {self.was} {self.becomes}"
        return hashlib.sha256(words.encode()).hexdigest()


def _name(node: ast.expr) -> str:
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def _is_rounding(node: ast.expr) -> bool:
    called = isinstance(node, ast.Call) and _name(node.func) in _ZERO_CALLS
    return called or (isinstance(node, ast.Name) and node.id in _ZERO)


def _factors(node: ast.expr) -> list[ast.expr]:
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
        return _factors(node.left) + _factors(node.right)
    return [node]


class _Finder(ast.NodeVisitor):
    """Walk through functions and collect changes; texts, annotations and refusals are left out."""

    def __init__(self, source: str, leave: set[str]) -> None:
        self.raw = source.encode()
        self.lines = source.splitlines()
        self.starts = [0]
        for line in self.raw.splitlines(keepends=True):
            self.starts.append(self.starts[-1] + len(line))
        self.leave = leave | _SHOWN
        self.lines_left = [tuple(name.split(": ", 1)) for name in leave if ": " in name]
        self.scope: list[str] = []
        self.known: set[str] = set()
        self.found: list[Change] = []

    def place(self, node: ast.AST) -> tuple[int, int]:
        first, last = self.starts[node.lineno - 1], self.starts[node.end_lineno - 1]
        return first + node.col_offset, last + node.end_col_offset

    def text(self, node: ast.AST) -> str:
        start, end = self.place(node)
        return self.raw[start:end].decode()

    def add(self, kind: str, node: ast.AST, becomes: str) -> None:
        if self.scope:
            start, end = self.place(node)
            words = " ".join(self.text(node).split())
            line = self.lines[node.lineno - 1].strip()
            where = ".".join(self.scope)
            if any(where == name and line.startswith(begin) for name, begin in self.lines_left):
                return
            self.found.append(Change(kind, where, node.lineno, line, words, becomes, start, end))

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self.scope.append(node.name)
        for part in node.body:
            if isinstance(part, ast.FunctionDef | ast.ClassDef):
                self.visit(part)
        self.scope.pop()

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        self.scope.append(node.name)
        outside = self.known
        self.known = outside | {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
        self.known |= {a.arg for a in ast.walk(node) if isinstance(a, ast.arg)}
        if node.name not in self.leave and ".".join(self.scope) not in self.leave:
            for part in node.body:
                self.visit(part)
        self.known = outside
        self.scope.pop()

    def visit_Assign(self, node: ast.Assign) -> None:
        self.visit(node.value)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_Raise(self, node: ast.Raise) -> None:
        pass

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        pass

    def visit_If(self, node: ast.If) -> None:
        if any(isinstance(part, ast.Raise) for part in node.body):
            self.add("refusal", node.test, "False")
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        factors = _factors(node)
        if any(map(_is_rounding, factors)):
            for factor in filter(_is_rounding, factors):
                self.visit(factor)
            return
        left, right = self.text(node.left), self.text(node.right)
        if isinstance(node.op, ast.Add | ast.Sub) and not isinstance(node.left, ast.List):
            other = "-" if isinstance(node.op, ast.Add) else "+"
            self.add("sign", node, f"(({left}) {other} ({right}))")
            self.add("term", node, f"({left})")
        if isinstance(node.op, ast.BitAnd | ast.BitOr):
            self.add("condition", node, f"({left})")
            self.add("condition", node, f"({right})")
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        word = " and " if isinstance(node.op, ast.And) else " or "
        for k in range(len(node.values)):
            kept = [f"({self.text(v)})" for i, v in enumerate(node.values) if i != k]
            self.add("condition", node, f"({word.join(kept)})")
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
            self.add("sign", node, f"({self.text(node.operand)})")
        elif isinstance(node.op, ast.Not | ast.Invert):
            self.add("condition", node, f"({self.text(node.operand)})")
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        if len(node.ops) == 1 and type(node.ops[0]) in _NEGATED:
            sides = self.text(node.left), self.text(node.comparators[0])
            self.add(
                "comparison", node, f"(({sides[0]}) {_NEGATED[type(node.ops[0])]} ({sides[1]}))"
            )
        for part in (node.left, *node.comparators):
            # flags are told apart by anything between 0 and 1
            if not (isinstance(part, ast.Constant) and part.value == 0.5):
                self.visit(part)

    def visit_Call(self, node: ast.Call) -> None:
        name = _name(node.func)
        if name in _ROUNDED and node.args:
            self.add("rounding", node, f"({self.text(node.args[0])})")
        elif name in _ZERO_CALLS:
            self.add("rounding", node, f"(0.0 * {self.text(node)})")
        elif name in _QUANTIFIERS:
            front = self.text(node.func)[: -len(name)]
            self.add("quantifier", node.func, front + _QUANTIFIERS[name])
        elif name == "Claim" and len(node.args) > 2:
            self.add("claim", node.args[2], "True")
        elif name == "where" and len(node.args) == 2 and isinstance(node.func, ast.Attribute):
            self.add("choice", node, f"({self.text(node.func.value)})")
            self.add("choice", node, f"({self.text(node.args[1])})")
        for kind, calls in (("choice", _CHOICES), ("condition", _CONDITIONS)):
            for k in calls.get((name, len(node.args)), ()):
                self.add(kind, node, f"({self.text(node.args[k])})")
        if name in _ROUNDED and node.args:
            self.visit(node.args[0])
        elif name not in _ZERO_CALLS:
            self.generic_visit(node)

    def visit_Name(self, node: ast.Name) -> None:
        if isinstance(node.ctx, ast.Load):
            self._swap(node, node.id, "")
            if node.id in _ZERO:
                self.add("rounding", node, f"(0.0 * {node.id})")
            elif node.id in _ONE:
                self.add("rounding", node, "1.0")

    def visit_Attribute(self, node: ast.Attribute) -> None:
        if isinstance(node.ctx, ast.Load):
            self._swap(node, node.attr, self.text(node)[: -len(node.attr)])
        if node.attr not in _SIZES:
            self.visit(node.value)
        elif isinstance(node.value, ast.Attribute):
            self.visit(node.value.value)

    def _swap(self, node: ast.expr, name: str, front: str) -> None:
        other = SWAPPED.get(name)
        if other and (front or name in ("min", "max") or other in self.known):
            self.add("swap", node, front + other)

    def visit_Subscript(self, node: ast.Subscript) -> None:
        index = node.slice
        last = index.elts[-1] if isinstance(index, ast.Tuple) else index
        end = isinstance(last, ast.Constant) and last.value in (0, 1)
        if isinstance(node.ctx, ast.Load) and end and _name(node.value) != "shape":
            self.add("swap", last, str(1 - last.value))
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, float) and 1e-3 <= node.value < 1e3 and node.value != 1.0:
            self.add("factor", node, repr(0.5 * node.value))


def changes(source: str, leave: set[str] | None = None) -> list[Change]:
    """List the changes of a source.

    leave: names of functions that are left aside; lines of one as "function: how the line begins"
    """
    finder = _Finder(source, leave or set())
    finder.visit(ast.parse(source))
    return finder.found


def pick(found: list[Change], seed: int, file: str) -> Iterator[Change]:
    """Go through changes by chance, every kind in turn."""
    taken: Counter[str] = Counter()
    ranked = []
    for change in sorted(found, key=lambda c: c.rank(seed, file)):
        ranked.append((taken[change.kind], change.rank(seed, file), change))
        taken[change.kind] += 1
    yield from (change for *_, change in sorted(ranked, key=lambda r: r[:2]))
