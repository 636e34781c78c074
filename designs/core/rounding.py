"""A proved bound of what rounding adds to a function: forward analysis of its instructions.

Let F be the function with the constants that its equations have, over real numbers, and fl(F) what
runs: every instruction of the CasADi tape rounded to the nearest number of the precision, every
constant too, library functions good to `ULPS` units in the last place; nothing reordered (a product
and a sum may be fused). Then ``|fl(F)(v) - F(v)| <= rounding_bound(F, ...)``, output by output, for
every v of the box whose entries are numbers of the precision.

Per cell of the box and node of the tape stand an interval of the exact value, one of the computed
value, and a bound e of their distance. With a~ = a + e_a computed in place of a,

    a~ + b~   differs from  a + b    by at most  e_a + e_b
    a~ b~                   a b                  e_a |b| + |a| e_b + e_a e_b
    a~^2                    a^2                  2 |a| e_a + e_a^2
    a~ / b~                 a / b                e_a |1/b~| + |a| e_b |1/b~| |1/b|
    sqrt(a~)                sqrt(a)              min(e_a / (sqrt(a~) + sqrt(a)), sqrt(e_a))
    max(a~, b~)             max(a, b)            e of the operand that wins in the whole cell, or
                                                 the larger one
    f(a~)                   f(a)                 e_a sup |f'| over both intervals

and never by more than the two intervals are apart, which settles comparisons and choices. Rounding
adds u |computed value|, and for all but sums half the smallest number; the exact interval of a
constant is the one that derivations take, see `derive.intervals.program`. Two facts make it sharp:
a sum or difference of inputs with whole coefficients lies in what the box says of that form, and
a - b is exact where a and b are within a factor of two of each other (Sterbenz), or one is zero.
The analysis itself rounds outwards.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from obsynth.derive.intervals.functions import ULPS
from obsynth.derive.intervals.program import constant_interval
from obsynth.derive.intervals.rules import NAMES, RULES
from obsynth.derive.rigour import Interval, down, up
from obsynth.derive.rigour.interval import TINY, UNIT, absolute, multiply, power_int, raised
from obsynth.symbolic.arrays import BoolArray, FloatArray

Form = Mapping[tuple[int, int], int]
_LARGEST = {"double": float(np.finfo(np.float64).max), "single": float(np.finfo(np.float32).max)}
# above half the smallest positive number, and above `ULPS` of it
_UNDERFLOW = {"double": TINY, "single": 2.0**-145}
_ONE_ROUNDING = frozenset({"add", "subtract", "multiply", "divide", "inverse", "square", "sqrt"})
_NO_ROUNDING = frozenset(
    {"assign", "negate", "twice", "absolute", "minimum", "maximum", "sign", "copysign", "floor"}
    | {"ceiling", "remainder", "less", "less_equal", "equal", "not_equal", "logical_not"}
    | {"conjunction", "disjunction", "if_else_zero"}
)
_ONE: Interval = (np.ones(1), np.ones(1))
_RULES: Mapping[str, Callable[..., Interval]] = {
    **RULES,
    "assign": lambda a: a,
    "square": lambda a: power_int(a, 2),
    "inverse": lambda a: RULES["divide"](_ONE, a),
    "not_equal": lambda a, b: RULES["logical_not"](RULES["equal"](a, b)),
}


def _one_plus(a: Interval, sign: float) -> Interval:
    square = power_int(a, 2)
    return RULES["add"](_ONE, square if sign > 0 else RULES["negate"](square))


_SLOPES: Mapping[str, Callable[[Interval], Interval]] = {
    "exp": RULES["exp"],
    "expm1": RULES["exp"],
    "log": lambda a: RULES["divide"](_ONE, a),
    "log1p": lambda a: RULES["divide"](_ONE, RULES["add"](_ONE, a)),
    "sine": RULES["cosine"],
    "cosine": RULES["sine"],
    "tangent": lambda a: _one_plus(RULES["tangent"](a), 1.0),
    "asin": lambda a: RULES["divide"](_ONE, RULES["sqrt"](_one_plus(a, -1.0))),
    "acos": lambda a: RULES["divide"](_ONE, RULES["sqrt"](_one_plus(a, -1.0))),
    "atan": lambda a: RULES["divide"](_ONE, _one_plus(a, 1.0)),
    "sinh": RULES["cosh"],
    "cosh": RULES["sinh"],
    "tanh": lambda a: (0.0 * a[0], 0.0 * a[0] + 1.0),
    "asinh": lambda a: (0.0 * a[0], 0.0 * a[0] + 1.0),
    "acosh": lambda a: RULES["divide"](_ONE, RULES["sqrt"](RULES["negate"](_one_plus(a, -1.0)))),
    "atanh": lambda a: RULES["divide"](_ONE, _one_plus(a, -1.0)),
    "erf": lambda a: (0.0 * a[0], 0.0 * a[0] + 1.1284),
}
"""Derivatives of library functions, for intervals."""


@dataclass(eq=False)
class _Node:
    """What is known of one number of the tape, per cell.

    lo, hi (2, cells): of the exact value and of the computed one
    e (cells,): bound of their distance
    form: the combination of inputs that it exactly is, if any
    """

    lo: FloatArray
    hi: FloatArray
    e: FloatArray
    form: Form | None = None

    @property
    def range(self) -> Interval:
        """Both intervals."""
        return self.lo, self.hi

    @property
    def size(self) -> FloatArray:
        """Largest magnitudes, (2, cells)."""
        return np.maximum(np.abs(self.lo), np.abs(self.hi))

    @property
    def least(self) -> FloatArray:
        """Smallest magnitudes, (2, cells)."""
        return absolute(self.range)[0]


class Bound(NamedTuple):
    """Of one output: ``|fl(F) - F|`` and ``|F|``, shape (entries,), infinite where unknown."""

    error: FloatArray
    size: FloatArray


def cut_box(box: FloatArray, pieces: int) -> Interval:
    """Cut every side of a box, shape (n, 2), into pieces: ends of the cells, (n, pieces^n)."""
    edges = np.linspace(box[:, 0], box[:, 1], pieces + 1)
    edges[-1] = box[:, 1]
    index = np.indices((pieces,) * len(box)).reshape(len(box), -1)
    rows = np.arange(len(box))[:, None]
    return edges[index, rows], edges[index + 1, rows]


def rounding_bound(
    function: ca.Function,
    box: Mapping[str, Interval],
    precision: str = "double",
    known: Mapping[str, Interval] | None = None,
) -> dict[str, Bound]:
    """Bound what rounding does to the outputs, by their names.

    Shapes: ends in `box` (entries, cells) by the names of all inputs; in `known` the same by names
    of outputs, what the exact ones are known to lie in for the v in question.
    """
    if not function.is_a("SXFunction"):
        function = function.expand()
    with np.errstate(all="ignore"):
        found = _Tape(function, box, precision, known or {}).run()
    bounds = {}
    for i, name in enumerate(function.name_out()):
        nodes = [found[i, j] for j in range(function.nnz_out(i))]
        size = np.array([node.size[0].max() for node in nodes])
        bounds[name] = Bound(
            np.array([node.e.max() for node in nodes]), np.where(np.isnan(size), np.inf, size)
        )
    return bounds


class _Tape:
    """The analysis of one function over one box."""

    def __init__(
        self,
        function: ca.Function,
        box: Mapping[str, Interval],
        precision: str,
        known: Mapping[str, Interval],
    ) -> None:
        self.function, self.precision = function, precision
        self.unit = UNIT[precision]
        self.box = [tuple(map(np.atleast_2d, box[name])) for name in function.name_in()]
        self.cells = np.broadcast_shapes(*(lo.shape[1:] for lo, _ in self.box))
        self.known: dict[int, Interval] = {}
        writer: dict[int, int] = {}
        for k in range(function.n_instructions()):
            out, args = function.instruction_output(k), function.instruction_input(k)
            if function.instruction_id(k) != ca.OP_OUTPUT:
                writer[out[0]] = k
            elif (name := function.name_out(out[0])) in known:
                lo, hi = known[name]
                self.known[writer[args[0]]] = lo[out[1]], hi[out[1]]

    def run(self) -> dict[tuple[int, int], _Node]:
        """Return the nodes of the scalar outputs."""
        work: dict[int, _Node] = {}
        found: dict[tuple[int, int], _Node] = {}
        function = self.function
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            out, args = function.instruction_output(k), function.instruction_input(k)
            if code == ca.OP_OUTPUT:
                found[out[0], out[1]] = work[args[0]]
                continue
            if code == ca.OP_INPUT:
                node = self._input(args[0], args[1])
            elif code == ca.OP_CONST:
                node = self._constant(function.instruction_constant(k))
            else:
                node = self._operation(NAMES.get(code, ""), [work[a] for a in args])
            if k in self.known:
                self._cut(node, self.known[k])
            work[out[0]] = node
        return found

    def _input(self, number: int, entry: int) -> _Node:
        lo, hi = (np.broadcast_to(end[entry], self.cells) for end in self.box[number])
        return _Node(
            np.stack([lo, lo]), np.stack([hi, hi]), np.zeros(self.cells), {(number, entry): 1}
        )

    def _constant(self, value: float) -> _Node:
        stored = float(np.float32(value)) if self.precision == "single" else value
        lo, hi = constant_interval(value)
        e = 0.0 if lo == hi == stored else float(up(max(abs(stored - lo), abs(stored - hi))))
        fill = np.ones(self.cells)
        return _Node(
            np.stack([lo * fill, stored * fill]),
            np.stack([hi * fill, stored * fill]),
            (e if np.isfinite(e) else np.inf) * fill,
            {} if value == 0.0 else None,
        )

    def _operation(self, name: str, operands: list[_Node]) -> _Node:
        if name not in _RULES:
            unknown = np.full((2, *self.cells), np.nan)
            return _Node(unknown, unknown, np.full(self.cells, np.inf))
        lo, hi = _RULES[name](*(node.range for node in operands))
        lo, hi = np.broadcast_to(lo, (2, *self.cells)), np.broadcast_to(hi, (2, *self.cells))
        node = _Node(lo.copy(), hi.copy(), np.full(self.cells, np.inf))
        still = np.all([operand.e == 0.0 for operand in operands], axis=0)
        e = np.where(still, 0.0, _propagated(name, operands, node))
        node.e = np.where(np.isnan(e), np.inf, e)
        node.form = _form(name, operands)
        if node.form is not None:
            self._cut(node, self._of_form(node.form))
        self._settle(node)
        if name not in _NO_ROUNDING:
            units = 1.0 if name in _ONE_ROUNDING else 2.0 * ULPS
            self._round(node, units, _exact(name, operands), sums=name in ("add", "subtract"))
        undefined = ~(node.size <= _LARGEST[self.precision]).all(axis=0)
        node.e = np.where(undefined, np.inf, node.e)
        return node

    def _of_form(self, form: Form) -> Interval:
        total: Interval = (np.zeros(self.cells), np.zeros(self.cells))
        for (number, entry), coefficient in form.items():
            lo, hi = self.box[number]
            times = np.full(1, float(coefficient))
            total = RULES["add"](total, multiply((lo[entry], hi[entry]), (times, times)))
        return total

    def _cut(self, node: _Node, known: Interval) -> None:
        node.lo[0], node.hi[0] = np.maximum(node.lo[0], known[0]), np.minimum(node.hi[0], known[1])
        self._settle(node)

    def _settle(self, node: _Node) -> None:
        """Let the two intervals and their distance say of each other what they can."""
        near = np.isfinite(node.e)
        lo, hi = down(node.lo[0] - node.e), up(node.hi[0] + node.e)
        node.lo[1] = np.where(near & (lo > node.lo[1]), lo, node.lo[1])
        node.hi[1] = np.where(near & (hi < node.hi[1]), hi, node.hi[1])
        apart = np.max(node.hi, axis=0) - np.min(node.lo, axis=0)
        apart = np.where(apart > 0.0, up(apart), apart)
        node.e = np.where(apart < node.e, np.maximum(apart, 0.0), node.e)

    def _round(self, node: _Node, units: float, exact: BoolArray, sums: bool) -> None:
        underflow = 0.0 if sums else _UNDERFLOW[self.precision]
        step = np.where(exact, 0.0, raised(units * self.unit * node.size[1], 2) + underflow)
        step = np.where(node.size[1] == 0.0, 0.0, step)
        lo, hi = down(node.lo[1] - step), up(node.hi[1] + step)
        # rounding to nearest does not change signs
        node.lo[1] = np.where(
            exact, node.lo[1], np.where(node.lo[1] >= 0.0, np.maximum(lo, 0.0), lo)
        )
        node.hi[1] = np.where(
            exact, node.hi[1], np.where(node.hi[1] <= 0.0, np.minimum(hi, 0.0), hi)
        )
        node.e = np.where(step > 0.0, _over(node.e + step), node.e)


def _over(value: FloatArray) -> FloatArray:
    """Raise a sum of few nonnegative terms above its rounding; an exact zero stays one."""
    return np.where(value == 0.0, 0.0, raised(value, 12))


def _times(a: FloatArray, b: FloatArray) -> FloatArray:
    """Multiply nonnegative numbers; zero times anything is zero, and no other product is."""
    product = np.where((a == 0.0) | (b == 0.0), 0.0, a * b)
    return np.where((product == 0.0) & (a != 0.0) & (b != 0.0), TINY, product)


def _propagated(name: str, operands: list[_Node], node: _Node) -> FloatArray:
    """Bound what the errors of the operands do to the result, (cells,); infinite where unknown."""
    a, b = operands[0], operands[-1]
    if name in ("add", "subtract"):
        return _over(a.e + b.e)
    if name in ("negate", "absolute", "assign"):
        return a.e
    if name == "twice":
        return 2.0 * a.e
    if name == "multiply":
        return _over(_times(a.e, b.size[0]) + _times(a.size[0], b.e) + _times(a.e, b.e))
    if name == "square":
        return _over(2.0 * _times(a.size[0], a.e) + _times(a.e, a.e))
    if name in ("divide", "inverse"):
        exact, computed = 1.0 / b.least
        turned = _times(_times(b.e, computed), exact)
        if name == "inverse":
            return _over(turned)
        return _over(_times(a.e, computed) + _times(turned, a.size[0]))
    if name == "sqrt":
        roots = np.sqrt(np.maximum(a.lo, 0.0)).sum(axis=0)
        return _over(np.minimum(np.where(roots > 0.0, a.e / roots, np.inf), np.sqrt(a.e)))
    if name in ("minimum", "maximum"):
        if name == "minimum":
            first = (a.hi.max(axis=0) < b.lo.min(axis=0)), (b.hi.max(axis=0) < a.lo.min(axis=0))
        else:
            first = (a.lo.min(axis=0) > b.hi.max(axis=0)), (b.lo.min(axis=0) > a.hi.max(axis=0))
        return np.where(first[0], a.e, np.where(first[1], b.e, np.maximum(a.e, b.e)))
    if name == "if_else_zero":
        return np.where(a.e == 0.0, b.e, np.inf)
    if name == "hypotenuse":
        return _over(a.e + b.e)
    if name == "arctangent2":
        (y, _), (x_lo, _) = _hull(a), _hull(b)
        away = (x_lo > 0.0) | (y > 0.0) | (_hull(a)[1] < 0.0)
        radius = np.hypot(a.least.min(axis=0), b.least.min(axis=0)) * (1.0 - 2.0**-48)
        return np.where(away, _over((a.e + b.e) / radius), np.inf)
    if name in ("power", "power_const"):
        return _power(a, b)
    if name in _SLOPES:
        lo, hi = _hull(a)
        return _over(_times(a.e, np.maximum(*map(np.abs, _SLOPES[name]((lo, hi))))))
    return np.full_like(node.e, np.inf)


def _hull(a: _Node) -> Interval:
    return a.lo.min(axis=0), a.hi.max(axis=0)


def _power(a: _Node, b: _Node) -> FloatArray:
    """a^b for a > 0: b a^(b-1) and log(a) a^b."""
    base, exponent = _hull(a), _hull(b)
    by_base = multiply(exponent, RULES["power"](base, RULES["subtract"](exponent, _ONE)))
    by_exponent = multiply(RULES["log"](base), RULES["power"](base, exponent))
    first, second = (np.maximum(*map(np.abs, slope)) for slope in (by_base, by_exponent))
    return _over(_times(a.e, first) + _times(b.e, second))


def _form(name: str, operands: list[_Node]) -> Form | None:
    forms = [operand.form for operand in operands]
    if name not in ("add", "subtract", "negate") or any(form is None for form in forms):
        return None
    signs = {"add": (1, 1), "subtract": (1, -1), "negate": (-1,)}[name]
    total: dict[tuple[int, int], int] = {}
    for sign, form in zip(signs, forms, strict=True):
        for key, coefficient in (form or {}).items():
            total[key] = total.get(key, 0) + sign * coefficient
    return {key: coefficient for key, coefficient in total.items() if coefficient}


def _exact(name: str, operands: list[_Node]) -> BoolArray:
    """Where a sum needs no rounding: one operand is zero, or Sterbenz."""
    if name not in ("add", "subtract"):
        return np.zeros(operands[0].e.shape, dtype=bool)
    (al, ah), (bl, bh) = ((node.lo[1], node.hi[1]) for node in operands)
    if name == "add":
        bl, bh = -bh, -bl
    zero = ((al == 0.0) & (ah == 0.0)) | ((bl == 0.0) & (bh == 0.0))
    above = (al > 0.0) & (bl > 0.0) & (bh <= 2.0 * al) & (ah <= 2.0 * bl)
    below = (ah < 0.0) & (bh < 0.0) & (bl >= 2.0 * ah) & (al >= 2.0 * bh)
    return np.asarray(zero | above | below)
