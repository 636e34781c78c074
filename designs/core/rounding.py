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

and never by more than the two intervals are apart, which settles comparisons. A comparison that is
open in a cell is taken apart: where it may be wrong, its operands are as close as their errors, and
a choice between branches that meet there is still a small error. Rounding
adds u 2^floor(log2 |value|), half the distance of the numbers there; to sums of doubles u |value|,
which holds for those of GCC's library too (`SOFT`); to library functions u |value| a unit; and to
all but sums half the smallest number. The exact interval of a
constant is the one that derivations take, see `derive.intervals.program`. Two facts make it sharp:
a sum or difference of inputs with whole coefficients lies in what the box says of that form, and
a - b is exact where a and b are within a factor of two of each other (Sterbenz), or one is zero.
The analysis itself rounds outwards.
"""

from collections.abc import Collection, Mapping
from typing import NamedTuple

import casadi as ca
import numpy as np

from obsynth.derive.intervals.functions import ULPS
from obsynth.derive.intervals.program import constant_interval
from obsynth.derive.intervals.rules import NAMES, RULES
from obsynth.derive.rigour import Interval, down, up
from obsynth.derive.rigour.interval import TINY, UNIT, multiply, raised
from obsynth.designs.core.boxes import LIMITS
from obsynth.designs.core.rounding_rules import (
    NO_ROUNDING,
    ONE_ROUNDING,
    RANGES,
    Form,
    Node,
    form_of,
    is_exact,
    over,
    propagated,
)
from obsynth.symbolic.arrays import BoolArray, FloatArray, IntArray

_LARGEST = {"double": float(np.finfo(np.float64).max), "single": float(np.finfo(np.float32).max)}
# above half the smallest positive number, and above `ULPS` of it
_UNDERFLOW = {"double": TINY, "single": 2.0**-145}
_WAVES = ("sine", "cosine", "tangent")
_TESTS = (ca.OP_LT, ca.OP_LE, ca.OP_SIGN)
_MOST_CELLS = 4096
SOFT = 1.0 + 2.0**-31
"""In GCC's library for ARM, where no FPU has doubles, a sum of opposite signs whose exponents are
33 apart is rounded down if it loses its first bit: it is then above (1 - 2^-32) of a power of two,
and less than its last place, u of that power, away."""
_ZERO: Interval = (np.zeros((2, 1)), np.zeros((2, 1)))


class Bound(NamedTuple):
    """Of one output: ``|fl(F) - F|`` and ``|F|``, shape (entries,), infinite where unknown."""

    error: FloatArray
    size: FloatArray


def rounding_bound(
    function: ca.Function,
    box: Mapping[str, Interval],
    precision: str = "double",
    known: Mapping[str, Interval] | None = None,
    read: Collection[str] = (),
) -> dict[str, Bound]:
    """Bound what rounding does to the outputs, by their names.

    Shapes: ends in `box` (entries, cells) by the names of all inputs; in `known` the same by names
    of outputs, what the exact ones are known to lie in for the v in question. Inputs that are
    `read` are any numbers, rounded to the precision before anything else.
    """
    if not function.is_a("SXFunction"):
        function = function.expand()
    with np.errstate(all="ignore"):
        tape = _Tape(function, box, precision, known or {}, read)
        found = tape.run()
        while tape.open is not None and tape.branch():
            found = tape.run()
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
        read: Collection[str],
    ) -> None:
        self.function, self.precision = function, precision
        self.unit = UNIT[precision]
        self.read = {k for k, name in enumerate(function.name_in()) if name in read}
        ends = [box[name] for name in function.name_in()]
        cells = max(lo.shape[1] for lo, _ in ends)
        self.cells = (cells,)
        self.box: list[Interval] = [
            (np.broadcast_to(lo, (len(lo), cells)), np.broadcast_to(hi, (len(hi), cells)))
            for lo, hi in ends
        ]
        self.known: dict[int, Interval] = {}
        self.right: dict[int, BoolArray] = {}
        self.open: tuple[int, list[int], list[Node], IntArray] | None = None
        writer: dict[int, int] = {}
        for k in range(function.n_instructions()):
            out, args = function.instruction_output(k), function.instruction_input(k)
            if function.instruction_id(k) != ca.OP_OUTPUT:
                writer[out[0]] = k
            elif (name := function.name_out(out[0])) in known:
                lo, hi = known[name]
                self.known[writer[args[0]]] = (
                    np.broadcast_to(lo[out[1]], self.cells),
                    np.broadcast_to(hi[out[1]], self.cells),
                )

    def branch(self) -> bool:
        """Take the open comparison apart; whether there was room for it.

        Cells where it is right, computed or not, and once more those where it may be wrong, in
        which its operands are as close as their errors.
        """
        if self.open is None or self.cells[0] + self.open[-1].size > _MOST_CELLS:
            return False
        k, places, operands, wrong = self.open
        count = self.cells[0]
        again = np.concatenate([np.arange(count), wrong])
        self.cells = (again.size,)
        self.box = [(lo[:, again], hi[:, again]) for lo, hi in self.box]
        self.known = {i: (lo[again], hi[again]) for i, (lo, hi) in self.known.items()}
        self.right = {i: side[again] for i, side in self.right.items()}
        self.right[k] = np.arange(again.size) < count
        near = up(np.sum([node.e for node in operands], axis=0))
        other = [node.range for node in operands[::-1]] if len(operands) == 2 else [_ZERO]
        for place, (lo, hi) in zip(places, other, strict=True):
            old = self.known.get(place, (-np.inf, np.inf))
            low, high = (np.full(again.size, side) for side in (-np.inf, np.inf))
            low[count:], high[count:] = down(lo[0] - near)[wrong], up(hi[0] + near)[wrong]
            self.known[place] = np.maximum(old[0], low), np.minimum(old[1], high)
        return True

    def run(self) -> dict[tuple[int, int], Node]:
        """Return the nodes of the scalar outputs."""
        work: dict[int, Node] = {}
        place: dict[int, int] = {}
        found: dict[tuple[int, int], Node] = {}
        function, self.open = self.function, None
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
            if code in _TESTS:
                node.test = k, False
                if k in self.right:
                    node.e = np.where(self.right[k], 0.0, node.e)
                elif self.open is None and node.e.any():
                    parts = [place[a] for a in args], [work[a] for a in args]
                    self.open = k, *parts, np.flatnonzero(node.e)
            work[out[0]], place[out[0]] = node, k
        return found

    def _input(self, number: int, entry: int) -> Node:
        lo, hi = (np.broadcast_to(end[entry], self.cells) for end in self.box[number])
        node = Node(
            np.stack([lo, lo]), np.stack([hi, hi]), np.zeros(self.cells), {(number, entry): 1}
        )
        if number in self.read:
            self._round(node, 1.0, np.zeros(self.cells, dtype=bool), sums=False)
        return node

    def _constant(self, value: float) -> Node:
        stored = float(np.float32(value)) if self.precision == "single" else value
        lo, hi = constant_interval(value)
        e = 0.0 if lo == hi == stored else float(up(max(abs(stored - lo), abs(stored - hi))))
        fill = np.ones(self.cells)
        return Node(
            np.stack([lo * fill, stored * fill]),
            np.stack([hi * fill, stored * fill]),
            (e if np.isfinite(e) else np.inf) * fill,
            {} if value == 0.0 else None,
        )

    def _operation(self, name: str, operands: list[Node]) -> Node:
        if name not in RANGES:
            unknown = np.full((2, *self.cells), np.nan)
            return Node(unknown, unknown, np.full(self.cells, np.inf))
        lo, hi = RANGES[name](*(node.range for node in operands))
        lo, hi = np.broadcast_to(lo, (2, *self.cells)), np.broadcast_to(hi, (2, *self.cells))
        node = Node(lo.copy(), hi.copy(), np.full(self.cells, np.inf))
        still = np.all([operand.e == 0.0 for operand in operands], axis=0)
        e = np.where(still, 0.0, propagated(name, operands, node))
        node.e = np.where(np.isnan(e), np.inf, e)
        node.form = form_of(name, operands)
        if node.form is not None:
            self._cut(node, self._of_form(node.form))
        self._settle(node)
        chosen = self._choose(name, node, operands)
        if name not in NO_ROUNDING and not chosen:
            units = 1.0 if name in ONE_ROUNDING else 2.0 * ULPS
            self._round(node, units, is_exact(name, operands), sums=name in ("add", "subtract"))
        undefined = ~(node.size <= _LARGEST[self.precision]).all(axis=0)
        if name in _WAVES and self.precision == "single":
            undefined |= ~(operands[0].size <= LIMITS["single"].angle).all(axis=0)
        node.e = np.where(undefined, np.inf, node.e)
        return node

    def _choose(self, name: str, node: Node, operands: list[Node]) -> bool:
        """Follow truth values; whether a sum puts the two halves of a choice together, unrounded.

        The choice is one of its branches, the wrong one where the comparison is.
        """
        a, b = operands[0], operands[-1]
        if name == "logical_not" and a.test is not None:
            node.test = a.test[0], not a.test[1]
        if name == "if_else_zero" and a.test is not None:
            node.choice = a, b
        if name != "add" or a.choice is None or b.choice is None:
            return False
        (first, then), (second, otherwise) = a.choice, b.choice
        if first.test is None or second.test != (first.test[0], not first.test[1]):
            return False
        node.lo = np.maximum(node.lo, np.minimum(then.lo, otherwise.lo))
        node.hi = np.minimum(node.hi, np.maximum(then.hi, otherwise.hi))
        right = np.maximum(then.e, otherwise.e)
        node.e = np.where(first.e == 0.0, np.minimum(node.e, right), node.e)
        self._settle(node)
        return True

    def _of_form(self, form: Form) -> Interval:
        total: Interval = (np.zeros(self.cells), np.zeros(self.cells))
        for (number, entry), coefficient in form.items():
            lo, hi = self.box[number]
            times = np.full(1, float(coefficient))
            total = RULES["add"](total, multiply((lo[entry], hi[entry]), (times, times)))
        return total

    def _cut(self, node: Node, known: Interval) -> None:
        node.lo[0], node.hi[0] = np.maximum(node.lo[0], known[0]), np.minimum(node.hi[0], known[1])
        self._settle(node)

    def _settle(self, node: Node) -> None:
        """Let the two intervals and their distance say of each other what they can."""
        near = np.isfinite(node.e)
        lo, hi = down(node.lo[0] - node.e), up(node.hi[0] + node.e)
        node.lo[1] = np.where(near & (lo > node.lo[1]), lo, node.lo[1])
        node.hi[1] = np.where(near & (hi < node.hi[1]), hi, node.hi[1])
        apart = np.max(node.hi, axis=0) - np.min(node.lo, axis=0)
        apart = np.where(apart > 0.0, up(apart), apart)
        node.e = np.where(apart < node.e, np.maximum(apart, 0.0), node.e)

    def _round(self, node: Node, units: float, exact: BoolArray, sums: bool) -> None:
        underflow = 0.0 if sums else _UNDERFLOW[self.precision]
        size = node.size[1]
        if sums and self.precision == "double":
            at = SOFT * size
        else:
            at = size if units > 1.0 else np.ldexp(1.0, np.frexp(size)[1] - 1)
        step = np.where(exact, 0.0, raised(units * self.unit * at, 2) + underflow)
        step = np.where(size == 0.0, 0.0, step)
        lo, hi = down(node.lo[1] - step), up(node.hi[1] + step)
        # rounding to nearest does not change signs
        node.lo[1] = np.where(
            exact, node.lo[1], np.where(node.lo[1] >= 0.0, np.maximum(lo, 0.0), lo)
        )
        node.hi[1] = np.where(
            exact, node.hi[1], np.where(node.hi[1] <= 0.0, np.minimum(hi, 0.0), hi)
        )
        node.e = np.where(step > 0.0, over(node.e + step), node.e)
