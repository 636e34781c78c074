"""Rows of a plant as terms about a point, each with the ways in which it can be written."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sympy as sp

from obsynth.derive.algebra.factorise import expand_terms
from obsynth.derive.equilibrium import Equilibrium, equilibrium
from obsynth.derive.errors import DerivationError
from obsynth.derive.forms.quasi_lpv.options import Option, kept, options
from obsynth.derive.jacobian.entries import matrix_entries
from obsynth.derive.rigour import rational, substitute
from obsynth.symbolic.equations import read_rows
from obsynth.symbolic.plant import Plant


@dataclass(frozen=True, eq=False)
class Centre:
    """Exact coordinates of the point about which deviations are taken.

    x, u: state and input; zeros for the origin
    """

    x: tuple[sp.Expr, ...]
    u: tuple[sp.Expr, ...]

    @property
    def is_origin(self) -> bool:
        """True when states and inputs are taken as they are."""
        return all(value == 0 for value in (*self.x, *self.u))


def deviations(model: Plant, centre: Centre) -> dict[sp.Symbol, sp.Expr]:
    """Signals whose deviation from the centre is not the signal itself, with that deviation."""
    symbols = [s.symbol for s in (*model.x, *model.u)]
    return {s: s - c for s, c in zip(symbols, (*centre.x, *centre.u), strict=True) if c != 0}


def read_centre(model: Plant, given: Any) -> Centre:
    """Read the option ``centre=``."""
    if given is None or (isinstance(given, str) and given == "origin"):
        zero = sp.Integer(0)
        return Centre((zero,) * len(model.x), (zero,) * len(model.u))
    if isinstance(given, str) and given == "equilibrium":
        given = equilibrium(model)
    if isinstance(given, Equilibrium):
        given = (given.x, given.u)
    try:
        x, u = given
        return Centre(_numbers(model, "x", x), _numbers(model, "u", u))
    except (TypeError, ValueError) as error:
        if isinstance(error, DerivationError):
            raise
        raise DerivationError(
            f"centre= is 'origin', 'equilibrium', an Equilibrium or a pair (x, u); given was "
            f"{given!r}",
            given=given,
        ) from error


def _numbers(model: Plant, kind: str, values: Any) -> tuple[sp.Expr, ...]:
    names = model.names(kind)
    listed = list(np.ravel(np.asarray(values, dtype=object)))
    exact = []
    for value in listed:
        number = sp.sympify(value if isinstance(value, sp.Expr | int) else float(value))
        exact.append(rational(float(number)) if number.is_Float else number)
    if len(exact) != len(names) or not all(n.is_finite and n.is_real for n in exact):
        raise DerivationError(
            f"the centre needs one finite number for each of {', '.join(names) or 'no signals'}; "
            f"given was {listed}",
            symbols=names,
        )
    return tuple(exact)


def decide_signs(rows: Sequence[sp.Expr], model: Plant, centre: Centre) -> list[sp.Expr]:
    """Write sign(g) and |g| without a kink where g keeps its sign on the box and at the centre.

    Secants exist in closed form only for what is smooth between the centre and the point.
    """
    kinked = sorted(
        {a for row in rows for a in row.atoms(sp.sign, sp.Abs)}, key=sp.default_sort_key
    )
    inner = list(dict.fromkeys(atom.args[0] for atom in kinked))
    if not inner:
        return list(rows)
    symbols = [s.symbol for s in (*model.x, *model.u)]
    at = dict(zip(symbols, (*centre.x, *centre.u), strict=True))
    entries = matrix_entries({(0, k): g for k, g in enumerate(inner)}, model)
    found = entries.search(1e-2, "fast")
    signs: dict[sp.Expr, int] = {}
    for k, (_, position) in enumerate(entries.places):
        value = inner[position].xreplace(at)
        if found.lower[k] > 0.0 and value.is_positive:
            signs[inner[position]] = 1
        elif found.upper[k] < 0.0 and value.is_negative:
            signs[inner[position]] = -1
    replacements = {
        atom: signs[g] * (g if isinstance(atom, sp.Abs) else 1)
        for atom in kinked
        if (g := atom.args[0]) in signs
    }
    return [row.xreplace(replacements) for row in rows]


@dataclass(frozen=True, eq=False)
class Term:
    """An additive term of a row among states, then outputs; symbols stand for deviations.

    options: how it can be written, the structurally preferred one first; never empty
    reason: why nothing but the offset is left for it; empty otherwise
    """

    row: int
    expression: sp.Expr
    options: tuple[Option, ...]
    reason: str = ""


def stacked_rows(model: Plant) -> list[sp.Expr]:
    """Right-hand sides, then outputs, constants as numbers."""
    return [substitute(row, model.constant_values) for row in (*model.rhs, *model.output)]


def row_names(model: Plant) -> tuple[str, ...]:
    """Names of the rows: states, then outputs."""
    return (*model.names("x"), *model.output_names)


def list_terms(model: Plant, rows: Sequence[sp.Expr], centre: Centre) -> list[Term]:
    """Expand the rows about the centre and list the ways to write every term."""
    states = [s.symbol for s in model.x]
    inputs = [s.symbol for s in model.u]
    noise = [s.symbol for kind in "dfw" for s in getattr(model, kind)]
    shift = {
        symbol: symbol + value
        for symbol, value in zip((*states, *inputs), (*centre.x, *centre.u), strict=True)
        if value != 0
    }
    found = []
    for i, row in enumerate(rows):
        own = i if i < len(states) else -1
        for term in expand_terms(row.xreplace(shift)):
            if not term.has(*states, *inputs, *noise):
                found.append(Term(i, term, (kept(term),)))
                continue
            ways = _own_columns(
                options(term, own, states, [*inputs, *noise]), states, inputs, noise
            )
            reason = "" if ways else "no closed form at this centre"
            found.append(Term(i, term, tuple(ways) or (kept(term),), reason))
    return found


def _own_columns(
    ways: list[Option], states: list[sp.Symbol], inputs: list[sp.Symbol], noise: list[sp.Symbol]
) -> list[Option]:
    """Keep what observers do not know out of the coefficients where that is possible."""
    clean = (
        [w for w in ways if not any(s.coefficient.has(*noise) for s in w.shares)] if noise else ways
    )
    if clean:
        return clean
    first = len(states) + len(inputs)
    return [w for w in ways if any(s.position >= first for s in w.shares)] or ways


def prefer_options(model: Plant, terms: list[Term], prefer: Any) -> list[Term]:
    """Restrict the options of the terms to what the user wants."""
    if prefer is None:
        return terms
    if isinstance(prefer, Mapping):
        for key, value in prefer.items():
            terms = _prefer_for_term(model, terms, key, str(value))
        return terms
    wanted = [prefer] if isinstance(prefer, str | sp.Symbol) else list(prefer)
    signals = [s.name for kind in "xudfw" for s in getattr(model, kind)]
    for name in map(str, wanted):
        if name not in signals:
            raise DerivationError(
                f"prefer= names {name!r}, which is no state and no input; there are "
                f"{', '.join(signals)}",
                symbol=name,
            )
    order = [signals.index(str(name)) for name in wanted]
    return [_with_preferred(term, order) for term in terms]


def _with_preferred(term: Term, order: list[int]) -> Term:
    for j in order:
        chosen = tuple(o for o in term.options if o.shares and o.shares[0].position == j)
        if chosen:
            return replace(term, options=chosen)
    return term


def _prefer_for_term(model: Plant, terms: list[Term], key: Any, value: str) -> list[Term]:
    symbols = {s.name: s.symbol for kind in "xudfw" for s in getattr(model, kind)}
    symbols |= {s.name: s.symbol for kind in ("p", "rho") for s in getattr(model, kind)}
    symbols |= {str(s): s for s in model.constant_values}
    (read,) = read_rows([key], symbols, "prefer=")
    wanted = _without_numbers(substitute(read, model.constant_values))
    result, hit = [], False
    for term in terms:
        if _without_numbers(term.expression) != wanted:
            result.append(term)
            continue
        hit = True
        chosen = tuple(o for o in term.options if o.text.replace(" ", "") == value.replace(" ", ""))
        if not chosen:
            raise DerivationError(
                f"the term {term.expression} cannot be divided by {value}; it can be divided by "
                f"{'; '.join(o.text for o in term.options)}",
                term=term.expression,
                options=tuple(o.text for o in term.options),
            )
        result.append(replace(term, options=chosen))
    if not hit:
        listed = {str(_without_numbers(t.expression)) for t in terms if len(t.options) > 1}
        raise DerivationError(
            f"prefer= names the term {key}, which is in no row; terms with a choice are "
            f"{', '.join(sorted(listed)) or 'none'} (in deviations from the centre)",
            term=key,
        )
    return result


def _without_numbers(term: sp.Expr) -> sp.Expr:
    factors = [f for f in sp.Mul.make_args(term) if not f.is_number]
    return sp.Mul(*factors)
