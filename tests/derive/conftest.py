"""The quadruple tank of the bounded-error paper in the variants that the tests need."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import flint
import numpy as np
import pytest
import sympy as sp

from obsynth.derive import JacobianBounds, Split, jacobian_bounds, split
from obsynth.symbolic import Plant
from obsynth.symbolic.plants import quadruple_tank

REFERENCE = Path(__file__).parent.parent / "reference" / "bounded_error_uio.json"


@pytest.fixture(scope="session")
def reference() -> dict[str, Any]:
    """Numbers of an independent implementation, arrays where they are matrices."""
    data = json.loads(REFERENCE.read_text())["model"]
    return {name: np.array(value) for name, value in data.items()}


@pytest.fixture(scope="session")
def model() -> Plant:
    return quadruple_tank().discretise("euler", Ts=1.0)


@pytest.fixture(scope="session")
def parts(model: Plant) -> Split:
    return split(model)


@pytest.fixture(scope="session")
def bounds(parts: Split) -> JacobianBounds:
    return jacobian_bounds(parts)


@pytest.fixture(scope="session")
def tanks() -> Callable[..., Plant]:
    """Build a tank system with other measurements, other ranges or another inflow."""

    def build(
        measured: tuple[int, ...] = (0, 1, 2),
        lowest: float = 5.0,
        inflow: int = 2,
        tank_areas: tuple[int, int, int, int] = (28, 32, 28, 32),
    ) -> Plant:
        plant = Plant("tanks")
        levels = [(60, 280), (60, 280), (lowest, 100), (lowest, 100)]
        h = plant.states("h1:5", range=levels, unit="cm")
        v = plant.inputs("v1:3", range=(0, 20), nominal=10, unit="V")
        (d,) = plant.unknown_inputs("d")
        plant.actuator_faults("f1:3", of=v, rate=0.05)
        w = plant.disturbances(f"w1:{len(measured) + 1}", bound=0.1)
        R = sp.Rational
        hole = [R(71, 1000), R(51, 1000), R(71, 1000), R(51, 1000)]
        flow = [a * sp.sqrt(2 * 981 * level) for a, level in zip(hole, h, strict=True)]
        pump = [R(3235, 1000) * v[0], R(3320, 1000) * v[1]]
        share = [R(565, 1000), R(47, 100)]
        rows = [
            flow[2] - flow[0] + share[0] * pump[0],
            flow[3] - flow[1] + share[1] * pump[1],
            -flow[2] + (1 - share[1]) * pump[1],
            -flow[3] + (1 - share[0]) * pump[0],
        ]
        rows = [row / area for row, area in zip(rows, tank_areas, strict=True)]
        rows[inflow] += d
        plant.dynamics(rows)
        plant.outputs([h[k] + w[j] for j, k in enumerate(measured)])
        return plant.discretise("euler", Ts=1.0)

    return build


_UNARY = {
    ca.OP_ASSIGN: lambda a: a,
    ca.OP_NEG: lambda a: -a,
    ca.OP_EXP: lambda a: a.exp(),
    ca.OP_LOG: lambda a: a.log(),
    ca.OP_SQRT: lambda a: a.sqrt(),
    ca.OP_SQ: lambda a: a * a,
    ca.OP_TWICE: lambda a: 2 * a,
    ca.OP_INV: lambda a: 1 / a,
    ca.OP_SIN: lambda a: a.sin(),
    ca.OP_COS: lambda a: a.cos(),
    ca.OP_TAN: lambda a: a.tan(),
    ca.OP_ASIN: lambda a: a.asin(),
    ca.OP_ACOS: lambda a: a.acos(),
    ca.OP_ATAN: lambda a: a.atan(),
    ca.OP_SINH: lambda a: a.sinh(),
    ca.OP_COSH: lambda a: a.cosh(),
    ca.OP_TANH: lambda a: a.tanh(),
    ca.OP_ASINH: lambda a: a.asinh(),
    ca.OP_ACOSH: lambda a: a.acosh(),
    ca.OP_ATANH: lambda a: a.atanh(),
    ca.OP_LOG1P: lambda a: a.log1p(),
    ca.OP_EXPM1: lambda a: a.expm1(),
    ca.OP_ERF: lambda a: a.erf(),
    ca.OP_FABS: lambda a: abs(a),
    ca.OP_FLOOR: lambda a: a.floor(),
    ca.OP_CEIL: lambda a: a.ceil(),
    ca.OP_SIGN: lambda a: a.sgn(),
    ca.OP_NOT: lambda a: flint.arb(0 if a == 1 else 1),
}
_BINARY = {
    ca.OP_ADD: lambda a, b: a + b,
    ca.OP_SUB: lambda a, b: a - b,
    ca.OP_MUL: lambda a, b: a * b,
    ca.OP_DIV: lambda a, b: a / b,
    ca.OP_POW: lambda a, b: a**b,
    ca.OP_CONSTPOW: lambda a, b: a**b,
    ca.OP_FMIN: lambda a, b: a.min(b),
    ca.OP_FMAX: lambda a, b: a.max(b),
    ca.OP_ATAN2: lambda a, b: flint.arb.atan2(a, b),
    ca.OP_HYPOT: lambda a, b: (a * a + b * b).sqrt(),
    ca.OP_LT: lambda a, b: _decided(a < b, a >= b),
    ca.OP_LE: lambda a, b: _decided(a <= b, a > b),
    ca.OP_EQ: lambda a, b: _decided(a == b, a != b),
    ca.OP_IF_ELSE_ZERO: lambda c, a: a if c == 1 else flint.arb(0),
}


def _decided(yes: bool, no: bool) -> flint.arb:
    if yes == no:
        raise ArithmeticError("a comparison is open at this precision")
    return flint.arb(1 if yes else 0)


@pytest.fixture(scope="session")
def exactly() -> Callable[[ca.Function, Any], list[Any]]:
    """Outputs of an SX function at a point of doubles, as balls of 300 bits; no code of ours.

    Where a value is undefined, its ball is not finite.
    """

    def run(function: ca.Function, point: Any) -> list[Any]:
        before, flint.ctx.prec = flint.ctx.prec, 300
        try:
            return _walk(function, [float(v) for v in np.ravel(point)])
        finally:
            flint.ctx.prec = before

    return run


def _walk(function: ca.Function, point: list[float]) -> list[Any]:
    starts = np.cumsum([0, *[function.numel_in(k) for k in range(function.n_in())]])
    work: dict[int, Any] = {}
    results: dict[tuple[int, int], Any] = {}
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        out, args = function.instruction_output(k), function.instruction_input(k)
        if code == ca.OP_CONST:
            work[out[0]] = flint.arb(function.instruction_constant(k))
        elif code == ca.OP_INPUT:
            work[out[0]] = flint.arb(point[starts[args[0]] + args[1]])
        elif code == ca.OP_OUTPUT:
            results[(out[0], out[1])] = work[args[0]]
        elif code in _UNARY:
            work[out[0]] = _UNARY[code](work[args[0]])
        else:
            work[out[0]] = _BINARY[code](work[args[0]], work[args[1]])
    return [results[(i, j)] for i in range(function.n_out()) for j in range(function.nnz_out(i))]
