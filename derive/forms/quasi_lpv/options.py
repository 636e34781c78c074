"""All ways in which a term of a row can be written as coefficients times signals."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice

import sympy as sp

from obsynth.derive.algebra.factorise import divisors
from obsynth.derive.algebra.secants import at_zero, secant

Symbols = Sequence[sp.Symbol]
Weights = tuple[tuple[int, sp.Expr], ...]
_MOST_ORDERS = 6
_JUMPS = (sp.Piecewise, sp.atan2, sp.floor, sp.ceiling, sp.Mod, sp.sign, sp.Heaviside)


@dataclass(frozen=True, eq=False)
class Share:
    """What a term contributes to one column: a coefficient, by the position of its signal.

    slope: a derivative of the term. The coefficient is its mean along a way to the centre, so a
        range of the slope over a box that holds the centre is one of the coefficient; None where
        the term has no such derivative
    moving: signals that change along this way; the others stay where they are
    proxy: what stands for the coefficient in ranges; None for the coefficient itself
    """

    position: int
    coefficient: sp.Expr
    slope: sp.Expr | None = None
    moving: tuple[sp.Symbol, ...] = ()
    proxy: sp.Expr | None = None

    @property
    def bounded(self) -> sp.Expr:
        """The coefficient as ranges see it."""
        return self.coefficient if self.proxy is None else self.proxy


@dataclass(frozen=True, eq=False)
class Option:
    """One way to write a term: the sum of coefficient times signal, plus a rest for the offset.

    text: what the term is divided by: ``"x2"``, ``"x1 - x3"``, or signals one after the other,
        ``"x1, x2"``, for a telescoped secant
    """

    shares: tuple[Share, ...]
    rest: sp.Expr
    text: str

    @property
    def columns(self) -> tuple[tuple[int, sp.Expr], ...]:
        """Positions and coefficients."""
        return tuple((share.position, share.coefficient) for share in self.shares)


def kept(term: sp.Expr) -> Option:
    """Leave a term in the offset."""
    return Option((), term, "offset")


def options(term: sp.Expr, own: int, states: Symbols, inputs: Symbols) -> list[Option]:
    """List the ways to write a term, the structurally preferred one first."""
    signals = [*states, *inputs]
    found = [
        _divided(term, divisor.form, divisor.weights, signals)
        for divisor in divisors(term, own, states, inputs)
    ]
    for j, signal in enumerate(signals):
        if term.has(signal) and at_zero(term, signal) == 0:
            found.append(_divided(term, signal, ((j, sp.Integer(1)),), signals))
    for form, weights, replaced, z in _linear_arguments(term, signals):
        if at_zero(replaced, z) == 0 and (quotient := secant(replaced, z)) is not None:
            shares = _shares(weights, quotient, _derivative(replaced, z), z, form, signals)
            found.append(Option(shares, sp.Integer(0), sp.sstr(form)))
    if not found:
        found = list(islice(_telescopes(term, signals), _MOST_ORDERS))
    return _distinct(found)


def _divided(term: sp.Expr, form: sp.Expr, weights: Weights, signals: Symbols) -> Option:
    """Divide by a form with which the term vanishes, without 0/0 where that is possible."""
    if form.is_Symbol:
        z, replaced = form, term
    else:
        z = sp.Dummy("z", real=True)
        replaced = _through(term, form, sp.Integer(0), z)
    quotient = secant(replaced, z)
    if quotient is None:
        quotient = term / form
    slope = _derivative(replaced, z) if at_zero(replaced, z) == 0 else None
    shares = _shares(weights, quotient, slope, z, form, signals)
    return Option(shares, sp.Integer(0), sp.sstr(form))


def _shares(
    weights: Weights,
    quotient: sp.Expr,
    slope: sp.Expr | None,
    z: sp.Symbol,
    form: sp.Expr,
    signals: Symbols,
) -> tuple[Share, ...]:
    back = quotient.xreplace({z: form})
    if slope is None:
        return tuple(Share(j, w * back) for j, w in weights)
    slope = slope.xreplace({z: form})
    moving = tuple(signals[j] for j, _ in weights)
    return tuple(Share(j, w * back, w * slope, moving) for j, w in weights)


def _derivative(term: sp.Expr, z: sp.Symbol) -> sp.Expr | None:
    if term.has(*_JUMPS):
        return None
    slope = sp.diff(term, z)
    return None if slope.has(sp.Derivative, sp.Subs, sp.DiracDelta) else slope


def _through(term: sp.Expr, form: sp.Expr, constant: sp.Expr, z: sp.Symbol) -> sp.Expr:
    """Write a term as a function of the value z of a linear form."""
    replacements = {}
    for argument in _arguments(term):
        for sign in (1, -1):
            if sp.expand(argument - sign * (form + constant)) == 0:
                replacements[argument] = sign * (z + constant)
    return term.xreplace(replacements)


def _arguments(term: sp.Expr) -> list[sp.Expr]:
    atoms = sorted(term.atoms(sp.Function, sp.Pow), key=sp.default_sort_key)
    found: dict[sp.Expr, None] = {}
    for atom in atoms:
        arguments = atom.args[:1] if atom.is_Pow else atom.args
        found.update(dict.fromkeys(a for a in arguments if isinstance(a, sp.Expr)))
    return list(found)


def _linear_arguments(
    term: sp.Expr, signals: Symbols
) -> Iterator[tuple[sp.Expr, Weights, sp.Expr, sp.Symbol]]:
    """Find arguments that are linear in two or more signals, other signals in the coefficients."""
    seen: set[sp.Expr] = set()
    for argument in _arguments(term):
        slopes = [(j, sp.diff(argument, s)) for j, s in enumerate(signals) if argument.has(s)]
        weights = tuple((j, c) for j, c in slopes if not c.has(signals[j]))
        inside = [signals[j] for j, _ in weights]
        if len(weights) < 2 or any(c.has(*inside) for _, c in weights):
            continue
        form = sp.Add(*[c * signals[j] for j, c in weights])
        if sp.expand(form) in seen or sp.expand(-form) in seen:
            continue
        constant = sp.expand(argument - form)
        if constant.has(*inside):
            continue
        seen.add(sp.expand(form))
        z = sp.Dummy("z", real=True)
        replaced = _through(term, form, constant, z)
        if not replaced.has(*inside):
            yield form, weights, replaced, z


def _telescopes(term: sp.Expr, signals: Symbols) -> Iterator[Option]:
    """Take a term to its value at the centre signal by signal, in every admissible order."""
    if not term.has(*signals):
        yield Option((), term, "")
        return
    alone = [(s, ((j, sp.Integer(1)),), term, s) for j, s in enumerate(signals) if term.has(s)]
    for form, weights, replaced, z in chain(_linear_arguments(term, signals), alone):
        start, quotient = at_zero(replaced, z), secant(replaced, z)
        if start is not None and quotient is not None:
            shares = _shares(weights, quotient, _derivative(replaced, z), z, form, signals)
            yield from _continued(start, signals, shares, sp.sstr(form))


def _continued(
    start: sp.Expr, signals: Symbols, shares: tuple[Share, ...], text: str
) -> Iterator[Option]:
    for later in _telescopes(start, signals):
        label = f"{text}, {later.text}" if later.text else text
        yield Option(_merged([*shares, *later.shares]), later.rest, label)


def _merged(shares: list[Share]) -> tuple[Share, ...]:
    total: dict[int, Share] = {}
    for share in shares:
        before = total.get(share.position)
        if before is not None:
            # two means along different ways: no single slope holds their sum
            share = Share(share.position, before.coefficient + share.coefficient)
        total[share.position] = share
    return tuple(share for share in total.values() if share.coefficient != 0)


def _distinct(found: list[Option]) -> list[Option]:
    """Drop repetitions, and the same column in other words."""
    seen: set[tuple[object, ...]] = set()
    result = []
    for option in found:
        single = len(option.shares) == 1 and option.rest == 0
        key: tuple[object, ...] = (frozenset(option.columns), option.rest)
        if single:
            key = (option.shares[0].position,)
        if key not in seen:
            seen.add(key)
            result.append(option)
    return result
