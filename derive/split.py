"""A plant as constant matrices plus a nonlinearity, with the proof that they add up."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np
import sympy as sp

from obsynth.derive.algebra.factorise import expand_terms, factorise
from obsynth.derive.algebra.linear_parts import (
    IdentityProof,
    constant_columns,
    jacobian,
    prove_identity,
)
from obsynth.derive.algebra.sizes import LARGEST_ROW, size
from obsynth.derive.algebra.zero_test import is_zero
from obsynth.derive.equilibrium import Equilibrium, operating_point
from obsynth.derive.errors import DerivationError, StructureError
from obsynth.derive.rigour import rational, round_number, substitute
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.convert import sx_function
from obsynth.symbolic.display import matrix_latex, short
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.shown import Shown, aligned, card, formulas
from obsynth.symbolic.taking import takes

LinearForm = Literal["frozen", "terms", "jacobian"]
_LARGEST = 150
"""Entries of a matrix that is shown in full."""
_FORMS: tuple[LinearForm, ...] = ("frozen", "terms", "jacobian")


@dataclass(frozen=True, eq=False, repr=False)
class Split(Shown):
    """x+ = A x + B u + D d + B_f f + W1 w + g(x, u), y = C x + W2 w + D_f f.

    For a continuous plant x+ stands for the time derivative.

    Attributes
    ----------
    model : Plant
        The plant.
    A, B, D, B_f, W1 : ndarray, shapes (n, n), (n, n_u), (n, n_d), (n, n_f), (n, n_w)
        Constant parts of the dynamics, in the units of the plant.
    C, W2, D_f : ndarray, shapes (m, n), (m, n_w), (m, n_f)
        Constant parts of the outputs; D_f is not zero for sensor faults only.
    g : sympy.Matrix, shape (n, 1)
        What remains, exactly: a function of x and u (and of uncertain parameters and scheduling
        variables where there are any).
    linear : str
        How A and B were chosen.
    at : Equilibrium
        Point of operation.
    proof : IdentityProof
        That all of this adds up.
    """

    model: Plant
    A: FloatArray
    B: FloatArray
    D: FloatArray
    B_f: FloatArray
    C: FloatArray
    W1: FloatArray
    W2: FloatArray
    D_f: FloatArray
    g: sp.Matrix
    linear: LinearForm
    at: Equilibrium
    proof: IdentityProof

    def g_function(self) -> ca.Function:
        """Return the nonlinearity as a CasADi function.

        Returns
        -------
        casadi.Function
            (x, u) -> (g,), with p and rho as further inputs where the plant has them.

        Examples
        --------
        >>> from obsynth.symbolic.plants import quadruple_tank
        >>> parts = split(quadruple_tank().discretise("euler", Ts=1.0))
        >>> g = parts.g_function()(parts.at.x, parts.at.u)
        >>> bool(abs(np.array(g)).max() < 1e-12)
        True
        """
        kinds = ["x", "u"] + [k for k in ("p", "rho") if self.model.names(k)]
        return sx_function("g", {k: _symbols(self.model, k) for k in kinds}, {"g": self.g})

    def to_dict(self) -> dict[str, Any]:
        """Return what is needed to derive the split again, as JSON-able data.

        Returns
        -------
        dict
            The plant, the form and the point of operation; no matrices, since reading them back
            would bypass the proof.
        """
        at = {"x": self.at.x.tolist(), "u": self.at.u.tolist()}
        return {"plant": self.model.to_dict(), "linear": self.linear, "at": at}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "Split":
        """Derive a split again from what `to_dict` returned.

        Parameters
        ----------
        data : mapping
            From `to_dict`, possibly through a file.

        Returns
        -------
        Split
            Equal to the original to the last bit, with a proof of its own.

        Raises
        ------
        DerivationError
            Data without a plant, a form or a point.
        """
        try:
            model, at = Plant.from_dict(data["plant"]), data["at"]
            return split(model, (at["x"], at["u"]), data["linear"])
        except (KeyError, TypeError) as error:
            raise DerivationError(
                f"this is no stored split: {error} is missing or wrong"
            ) from error

    def _repr_latex_(self) -> str:
        linear = [("A", "x"), ("B", "u"), ("D", "d"), ("B_f", "f"), ("W1", "w")]
        outputs = [("C", "x"), ("W2", "w"), ("D_f", "f")]
        left = "x^{+}" if self.model.Ts is not None else r"\dot{x}"
        rows = [f"{left} &= {self._sum(linear)} + g", f"y &= {self._sum(outputs)}"]
        for name, _ in (*linear, *outputs):
            if (matrix := getattr(self, name)).any() and matrix.size <= _LARGEST:
                rows.append(f"{_letter(name)} &= {matrix_latex(matrix)}")
        return aligned([*rows, f"g &= {sp.latex(self.g.applyfunc(short))}"])

    def _sum(self, blocks: Sequence[tuple[str, str]]) -> str:
        return " + ".join(f"{_letter(b)} {s}" for b, s in blocks if getattr(self, b).any()) or "0"

    def __str__(self) -> str:
        return f"split of {self.model.name}, linear part {self.linear}\n{self.proof}"

    def _repr_html_(self) -> str:
        first, *rest = str(self).splitlines()
        return card(first, formulas(self._repr_latex_()), rest, self.at)


def _letter(name: str) -> str:
    return name if "_" in name else re.sub(r"(\d)", r"_\1", name)


def _symbols(model: Plant, kind: str) -> list[sp.Symbol]:
    return [s.symbol for s in getattr(model, kind)]


def _check_outputs(model: Plant) -> None:
    allowed = {s.symbol for kind in ("x", "w", "f") for s in getattr(model, kind)}
    allowed |= set(model.constant_values)
    for name, row in zip(model.output_names, model.output, strict=True):
        for symbol in sorted(row.free_symbols - allowed, key=str):
            raise StructureError(
                f"the output {name} depends on {symbol}; this form needs outputs that are linear "
                "in states and disturbances with constant coefficients",
                symbol=str(symbol),
                row=name,
            )
        signals = [s.symbol for kind in ("x", "w", "f") for s in getattr(model, kind)]
        rest = substitute(row, model.constant_values).subs(dict.fromkeys(signals, 0))
        if not is_zero(rest):
            raise StructureError(
                f"the output {name} has the constant part {rest}; leave it out of the output and "
                "subtract it from the measurement",
                symbol=name,
                row=name,
                offset=rest,
            )


@takes(model="Plant")
def split(
    model: Plant,
    at: Any = None,
    linear: LinearForm = "frozen",
) -> Split:
    """Split a plant into constant matrices and a nonlinearity g.

    Equations (1)-(2) of Buciakowski et al.; ``linear="frozen"`` is their (57)-(59).

    Parameters
    ----------
    model : Plant
        Continuous or discrete.
    at : Equilibrium or (x, u), optional
        Point of operation; by default the equilibrium of the nominal inputs or, where none is
        found inside the ranges, the nominal values of states and inputs (the middles of their
        ranges).
    linear : {"frozen", "terms", "jacobian"}
        ``"frozen"``: the quasi-linear matrices A(x, u), B(x, u) of `factorise` at the point;
        ``"terms"``: the terms that are linear with a constant coefficient;
        ``"jacobian"``: the derivatives at the point. The sum is the same plant in every case.

    Returns
    -------
    Split
        Matrices, g and the proof of the identity.

    Raises
    ------
    StructureError
        An unknown input, a fault or a disturbance enters nonlinearly, or an output is not linear
        in states and disturbances; symbol and row are named.
    DerivationError
        An input without a value, or a matrix that is not finite at the point.

    Examples
    --------
    >>> from obsynth.symbolic.plants import quadruple_tank
    >>> parts = split(quadruple_tank().discretise("euler", Ts=1.0))
    >>> np.round(np.diag(parts.A), 6).tolist()
    [0.990154, 0.994626, 0.979926, 0.988667]
    >>> parts.proof.holds
    True
    """
    if linear not in _FORMS:
        raise DerivationError(
            f"linear={linear!r} is not known; choose one of {', '.join(_FORMS)}", linear=linear
        )
    model.check()
    x, u = _symbols(model, "x"), _symbols(model, "u")
    d, f, w = _symbols(model, "d"), _symbols(model, "f"), _symbols(model, "w")
    names, output_names = model.names("x"), model.output_names
    D = constant_columns(model, model.rhs, d, "unknown input", names)
    B_f = constant_columns(model, model.rhs, f, "fault", names)
    W1 = constant_columns(model, model.rhs, w, "disturbance", names)
    _check_outputs(model)
    C = constant_columns(model, model.output, x, "state", output_names)
    W2 = constant_columns(model, model.output, w, "disturbance", output_names)
    D_f = constant_columns(model, model.output, f, "sensor fault", output_names)
    point = operating_point(model, at)
    values = model.constant_values
    quiet = model.rhs.subs(dict.fromkeys([*d, *f, *w], 0))
    quiet = quiet.applyfunc(lambda e: substitute(e, values))
    A, B = _matrices(model, quiet, point, linear)
    exact_A, exact_B = _exact(A), _exact(B)
    columns_x, columns_u = sp.Matrix(len(x), 1, x), sp.Matrix(len(u), 1, u)
    remainder = quiet - exact_A * columns_x - exact_B * columns_u
    g = sp.ImmutableMatrix(remainder.applyfunc(lambda e: sp.Add(*expand_terms(e))))
    parts = {"D": D, "B_f": B_f, "W1": W1, "C": C, "W2": W2, "D_f": D_f}
    proof = prove_identity(model, exact_A, exact_B, g, parts)
    if not proof.holds:
        row = proof.methods.index("")
        raise DerivationError(
            f"row {row + 1} of the split could not be proved equal to the plant's", row=row
        )
    blocks = {name: part.value for name, part in parts.items()}
    return Split(model=model, A=A, B=B, g=g, linear=linear, at=point, proof=proof, **blocks)


def _exact(matrix: FloatArray) -> sp.Matrix:
    """Return the rational numbers that the doubles of a matrix are."""
    return sp.Matrix(*matrix.shape, [rational(value) for value in matrix.ravel()])


def _matrices(
    model: Plant, rows: sp.Matrix, point: Equilibrium, linear: str
) -> tuple[FloatArray, FloatArray]:
    """Evaluate A and B at the point of operation."""
    x, u = _symbols(model, "x"), _symbols(model, "u")
    numbers = {
        symbol: rational(value)
        for kind, values in (("x", point.x), ("u", point.u), ("p", point.p), ("rho", point.rho))
        for symbol, value in zip(_symbols(model, kind), values, strict=True)
    }
    if linear == "jacobian":
        if any(size(row) > LARGEST_ROW for row in rows):
            # g takes up what these doubles are off
            return _slopes(model, point)
        symbolic = (jacobian(rows, x), jacobian(rows, u))
    else:
        form = factorise(rows, x, u)
        symbolic = (form.A, form.B) if linear == "frozen" else (form.linear_A, form.linear_B)

    def at_point(entry: sp.Expr, i: int, j: int, signals: list[sp.Symbol]) -> float:
        value = entry.subs(numbers)
        if not value.is_finite:
            # the quotient t/x of a frozen form at x = 0 is the derivative of the term there
            others = {s: n for s, n in numbers.items() if s != signals[j]}
            try:
                value = sp.limit(entry.subs(others), signals[j], numbers[signals[j]])
            except NotImplementedError:
                value = sp.nan
        try:
            return round_number(value)[0]
        except DerivationError as error:
            raise DerivationError(
                f"the coefficient {entry} of {signals[j]} in the row of {x[i]} has no finite value "
                f"at the point of operation; choose another point with at=, or linear='terms'",
                row=str(x[i]),
                symbol=str(signals[j]),
            ) from error

    result = []
    for matrix, signals in zip(symbolic, (x, u), strict=True):
        filled = np.zeros((len(x), len(signals)))
        for i, j in np.ndindex(filled.shape):
            if matrix[i, j] != 0:
                filled[i, j] = at_point(matrix[i, j], i, j, signals)
        result.append(filled)
    return result[0], result[1]


def _slopes(model: Plant, point: Equilibrium) -> tuple[FloatArray, FloatArray]:
    """Differentiate a plant numerically at the point of operation."""
    sx = model.sx()
    arguments = [sx.x, sx.u, sx.d, sx.f, sx.w, sx.p, sx.rho]
    zeros = [np.zeros(kind.numel()) for kind in (sx.d, sx.f, sx.w)]
    slopes = ca.Function("slopes", arguments, [ca.jacobian(sx.rhs, v) for v in (sx.x, sx.u)])
    A, B = (np.array(part) for part in slopes(point.x, point.u, *zeros, point.p, point.rho))
    if not (np.isfinite(A).all() and np.isfinite(B).all()):
        raise DerivationError(
            "the derivatives are not finite at the point of operation; choose another with at=, or "
            "linear='terms'"
        )
    return A, B
