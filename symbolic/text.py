"""Expressions as text: a small language of our own, read without evaluation; `written` writes it.

::

    condition  = conjunction {"or" conjunction}
    conjunction = negation {"and" negation}
    negation   = "not" negation | comparison
    comparison = sum [("<" | "<=" | ">" | ">=" | "==" | "!=") sum]
    sum        = ["-" | "+"] product {("+" | "-") product}
    product    = factor {("*" | "/") factor}
    factor     = ("-" | "+") factor | atom ["**" factor]
    atom       = number | name | name "(" argument {"," argument} ")" | "(" condition ")"
    argument   = condition | "[" condition {"," condition} "]"
    piecewise  = "piecewise(" "(" sum "," condition ")" {"," "(" sum "," condition ")"} ")"

Integers are exact, a quotient of integers is an exact rational, a number with a point or
an exponent is a double in its shortest form. ``pi`` is the constant.
"""

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

import sympy as sp
from sympy.core.relational import Relational
from sympy.logic.boolalg import And, BooleanFalse, BooleanFunction, BooleanTrue, Not, Or

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.functions import ALIASES, BY_NAME
from obsynth.symbolic.pieces import COMPOSED, Made

WORDS = frozenset({"and", "or", "not", "True", "False", "pi", "piecewise", "Piecewise"})
"""Words of the language that cannot name a symbol."""

_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:[0-9]+\.[0-9]*|\.[0-9]+|[0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r"|(?P<name>[A-Za-z_][A-Za-z0-9_]*)"
    r"|(?P<sign>\*\*|<=|>=|==|!=|[-+*/(),<>\[\]]))"
)
COMPARE = {"<": sp.Lt, "<=": sp.Le, ">": sp.Gt, ">=": sp.Ge, "==": sp.Eq, "!=": sp.Ne}
CONDITIONS = (Relational, BooleanFunction, BooleanTrue, BooleanFalse)
_DEEPEST = 100
_LONGEST = 100_000
# SymPy compares the arguments of Max, Or and Piecewise with each other.
_MOST = 100
_LARGEST_BITS = 8192


class TextError(PlantError):
    """Text that is no expression; ``position`` is the offset of the first wrong character."""


def read_text(
    text: str, symbols: Mapping[str, sp.Symbol], more: Mapping[str, Made] | None = None
) -> sp.Expr:
    """Read an expression with names of symbols in it; TextError says where it is none.

    more: functions beside those of every text, as in ``pieces.COMPOSED``
    """
    return _Reader(text, symbols, {**COMPOSED, **(more or {})}).read()


def undeclared(name: str, declared: Mapping[str, object]) -> str:
    """Return the message about a symbol that is not declared."""
    close = difflib.get_close_matches(name, declared, n=1, cutoff=0.5)
    hint = f"; did you mean {close[0]}?" if close else ""
    return f"the symbol {name} is not declared (declared: {', '.join(declared) or 'none'}){hint}"


@dataclass(frozen=True)
class _Token:
    kind: str
    text: str
    position: int


class _Reader:
    """Recursive descent; every method reads one rule of the grammar."""

    def __init__(
        self, text: str, symbols: Mapping[str, sp.Symbol], composed: Mapping[str, Made]
    ) -> None:
        if not isinstance(text, str):
            raise TextError(f"an expression is text, not {text!r}", position=0)
        if len(text) > _LONGEST:
            raise TextError(
                f"an expression has at most {_LONGEST} characters, this one has {len(text)} "
                f"({text[:60]!r}...); name its parts, or build it with SymPy",
                position=_LONGEST,
            )
        self.text = text
        self.symbols = symbols
        self.composed = composed
        self.depth = 0
        self.index = 0
        self.tokens = self._split()

    def read(self) -> sp.Expr:
        try:
            result = self._number(self._condition)
        except TextError:
            raise
        except (TypeError, ValueError, ArithmeticError) as error:
            # SymPy does not order or compare what is complex.
            self._fail(f"the expression is not a real function ({error})")
        if self._now.kind != "end":
            self._fail(f"unexpected {self._now.text!r}")
        return result

    def _split(self) -> list[_Token]:
        tokens, position = [], 0
        end = len(self.text.rstrip())
        while position < end:
            match = _TOKEN.match(self.text, position)
            if match is None:
                position += len(self.text[position:]) - len(self.text[position:].lstrip())
                hint = "; a power is written **" if self.text[position] == "^" else ""
                self._fail(f"the character {self.text[position]!r} has no meaning{hint}", position)
            kind = str(match.lastgroup)
            tokens.append(_Token(kind, match[kind], match.start(kind)))
            position = match.end()
        return [*tokens, _Token("end", "the end of the text", end)]

    @property
    def _now(self) -> _Token:
        return self.tokens[self.index]

    def _take(self, *texts: str) -> _Token | None:
        """Consume the present token when it is one of these."""
        token = self._now
        if token.kind != "end" and token.text in texts:
            self.index += 1
            return token
        return None

    def _expect(self, text: str, opened: int | None = None) -> None:
        if self._take(text) is None:
            told = "" if opened is None else f": {self.text[opened : opened + 20]!r} is not closed"
            self._fail(f"expected {text!r} in place of {self._now.text}{told}")

    def _fail(self, message: str, position: int | None = None) -> NoReturn:
        where = self._now.position if position is None else position
        shown = self.text if len(self.text) <= 200 else self.text[max(0, where - 100) : where + 100]
        raise TextError(
            f"{message}, at position {where} of {shown!r}", position=where, text=self.text
        )

    def _deeper(self) -> None:
        # Python's own stack would end in an error without a position.
        self.depth += 1
        if self.depth > _DEEPEST:
            self._fail(f"more than {_DEEPEST} levels of signs, powers and parentheses")

    def _another(self, parts: list[Any], part: Any) -> None:
        parts.append(part)
        if len(parts) > _MOST:
            self._fail(f"more than {_MOST} arguments or cases")

    def _number(self, rule: Any) -> sp.Expr:
        return self._as_number(self._now.position, rule())

    def _as_number(self, position: int, value: sp.Basic) -> sp.Expr:
        if isinstance(value, CONDITIONS):
            self._fail(f"the condition {value} stands where a number is needed", position)
        return value

    def _truth(self, rule: Any) -> sp.Basic:
        return self._as_truth(self._now.position, rule())

    def _as_truth(self, position: int, value: sp.Basic) -> sp.Basic:
        if not isinstance(value, CONDITIONS):
            self._fail(f"{value} stands where a condition is needed", position)
        return value

    def _condition(self) -> sp.Basic:
        self._deeper()
        result = self._joined("or", Or, lambda: self._joined("and", And, self._negation))
        self.depth -= 1
        return result

    def _joined(self, word: str, join: Any, rule: Any) -> sp.Basic:
        position = self._now.position
        first = rule()
        if self._now.text != word:
            return first
        parts = [self._as_truth(position, first)]
        while self._take(word):
            self._another(parts, self._truth(rule))
        return join(*parts)

    def _negation(self) -> sp.Basic:
        if self._take("not"):
            self._deeper()
            inner = self._truth(self._negation)
            self.depth -= 1
            return Not(inner)
        position = self._now.position
        left = self._sum()
        operator = self._take(*COMPARE)
        if operator is None:
            return left
        if isinstance(left, CONDITIONS):
            self._fail(f"the condition {left} cannot be compared", position)
        return COMPARE[operator.text](left, self._number(self._sum))

    def _sum(self) -> sp.Basic:
        position = self._now.position
        first = self._product(self._sign())
        if self._now.text not in ("+", "-"):
            return first
        terms = [self._as_number(position, first)]
        while self._now.text in ("+", "-"):
            sign = self._sign()
            terms.append(self._number(lambda sign=sign: self._product(sign)))
        return self._finite(sp.Add(*terms), position)

    def _sign(self) -> list[sp.Expr]:
        """Read a sign; return the factor it stands for."""
        token = self._take("+", "-")
        return [sp.Integer(-1)] if token is not None and token.text == "-" else []

    def _product(self, factors: list[sp.Expr]) -> sp.Basic:
        # A product is built from all of its factors at once: SymPy distributes a number
        # over a sum when it meets the two alone.
        position = self._now.position
        first = self._factor()
        if self._now.text not in ("*", "/") and not factors:
            return first
        factors = [*factors, self._as_number(position, first)]
        while operator := self._take("*", "/"):
            factor = self._number(self._factor)
            if operator.text == "/" and factor == 0:
                self._fail("division by zero")
            factors.append(1 / factor if operator.text == "/" else factor)
        return self._finite(sp.Mul(*factors), position)

    def _factor(self) -> sp.Basic:
        self._deeper()
        if sign := self._take("-", "+"):
            inner = self._number(self._factor)
            result = -inner if sign.text == "-" else inner
        else:
            position = self._now.position
            result = self._atom()
            if self._take("**"):
                if isinstance(result, CONDITIONS):
                    self._fail(f"the condition {result} has no power", position)
                result = self._power(result, self._number(self._factor), position)
        self.depth -= 1
        return result

    def _power(self, base: sp.Expr, exponent: sp.Expr, position: int) -> sp.Expr:
        # Exact powers are computed while reading: 9**9**9 would never end.
        if isinstance(base, sp.Rational) and isinstance(exponent, sp.Rational):
            if base == 0 and exponent < 0:
                self._fail("division by zero", position)
            bits = max(int(base.p).bit_length(), int(base.q).bit_length())
            if base not in (0, 1, -1) and bits * abs(exponent) > _LARGEST_BITS:
                self._fail(f"the power {base}**{exponent} is too large", position)
        return self._finite(base**exponent, position)

    def _finite(self, value: sp.Basic, position: int) -> sp.Basic:
        wild = isinstance(value, sp.Float) and not abs(value) < sp.Float("1.8e308")
        if wild or value in (sp.oo, -sp.oo, sp.zoo, sp.nan):
            self._fail("the value is not a finite number", position)
        return value

    def _atom(self) -> sp.Basic:
        token = self._now
        if token.kind == "end":
            self._fail("the text ends where a number, a name or a parenthesis is needed")
        self.index += 1
        if token.kind == "number":
            return self._literal(token)
        if token.text == "(":
            inner = self._condition()
            self._expect(")", token.position)
            return inner
        if token.kind != "name" or token.text in ("and", "or", "not"):
            self._fail(f"unexpected {token.text!r}", token.position)
        if self._now.text == "(":
            return self._call(token)
        if token.text in ("True", "False"):
            return sp.true if token.text == "True" else sp.false
        if token.text == "pi":
            return sp.pi
        if token.text in self.symbols:
            return self.symbols[token.text]
        return self._fail(undeclared(token.text, self.symbols), token.position)

    def _literal(self, token: _Token) -> sp.Expr:
        if token.text.isdigit():
            if len(token.text) > 4000:
                self._fail("the number has more than 4000 digits", token.position)
            return sp.Integer(int(token.text))
        return self._finite(sp.Float(float(token.text)), token.position)

    def _call(self, token: _Token) -> sp.Basic:
        if token.text in ("piecewise", "Piecewise"):
            return self._piecewise(token)
        known = BY_NAME.get(ALIASES.get(token.text, token.text))
        if known is None and token.text not in self.composed:
            names = ", ".join(sorted({*BY_NAME, *self.composed}))
            told = f"the function {token.text} is not supported; supported are {names}, piecewise"
            self._fail(told, token.position)
        own = known and (known.sympy, known.least, known.most)
        make, least, most = own or self.composed[token.text]
        self._expect("(")
        arguments = [self._argument(token.text)]
        while self._take(","):
            self._another(arguments, self._argument(token.text))
        self._expect(")", token.position)
        if not least <= len(arguments) <= (len(arguments) if most is None else most):
            self._fail(f"{token.text} does not take {len(arguments)} arguments", token.position)
        try:
            made = make(*arguments)
        except PlantError as error:
            self._fail(str(error), token.position)
        return self._finite(made, token.position)

    def _argument(self, function: str) -> Any:
        """Read a number, or the list of numbers that a table has."""
        opening = self._take("[") if function == "lookup" else None
        if opening is None:
            return self._number(self._condition)
        items = [self._number(self._condition)]
        while self._take(","):
            self._another(items, self._number(self._condition))
        self._expect("]", opening.position)
        return tuple(items)

    def _piecewise(self, token: _Token) -> sp.Expr:
        pairs: list[Any] = []
        self._expect("(")
        while True:
            self._expect("(")
            value = self._number(self._condition)
            self._expect(",")
            self._another(pairs, (value, self._truth(self._condition)))
            self._expect(")")
            if not self._take(","):
                break
        self._expect(")")
        if pairs[-1][1] != sp.true:
            self._fail("the last case of piecewise needs the condition True", token.position)
        return sp.Piecewise(*pairs)
