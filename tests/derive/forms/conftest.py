"""Comparison of quasi-LPV forms with their plants at random points."""

import casadi as ca
import numpy as np
import pytest
import sympy as sp

from obsynth.symbolic.convert import to_sx

KINDS = ("x", "u", "p", "rho", "d", "f", "w")


def _points_of(model, count=40):
    """Random values of all signals inside their boxes, one row each, by kind."""
    rng = np.random.default_rng(7)
    values = {}
    for kind in KINDS:
        box = model.box(kind)
        low = np.where(np.isfinite(box[:, 0]), box[:, 0], -1.0)
        high = np.where(np.isfinite(box[:, 1]), box[:, 1], 1.0)
        values[kind] = low + rng.random((count, len(box))) * (high - low)
    return values


def _values_of(model, expressions, points):
    """Values of expressions of the plant's signals at the points, shape (expressions, points)."""
    columns, table = [], {}
    for kind in KINDS:
        elements = [ca.SX.sym(n) for n in model.names(kind)]
        columns.append(ca.vertcat(*elements) if elements else ca.SX(0, 1))
        signals = getattr(model, kind)
        table.update({s.symbol: e for s, e in zip(signals, elements, strict=True)})
    rows = to_sx(list(expressions), table, ["e"] * len(expressions))
    function = ca.Function("e", columns, [ca.densify(ca.vertcat(*rows))])
    return np.array(function(*[points[k].T for k in KINDS]))


def _check(form, count=40):
    """The form is the plant, and its matrices stay in their ranges, vertices and bounds."""
    model = form.model
    points = _points_of(model, count)
    plant, matrices = model.function(), form.function()
    bounds = form.interval()
    family = form.vertices().family
    scalars = _values_of(model, [v.expression for v in form.scheduling] or [sp.Integer(0)], points)
    centre_x = np.array(form.centre.x, dtype=float)
    centre_u = np.array(form.centre.u, dtype=float)
    for k in range(count):
        at = {kind: points[kind][k] for kind in KINDS}
        quiet = {kind: 0.0 * at[kind] if kind in "dfw" else at[kind] for kind in KINDS}
        rhs = np.array(plant(*[quiet[q] for q in ("x", "u", "d", "f", "w", "p", "rho")])[0]).ravel()
        A, B, offset, _ = (np.array(m) for m in matrices(*[quiet[q] for q in KINDS]))
        made = A @ (at["x"] - centre_x) + B @ (at["u"] - centre_u) + offset.ravel()
        scale = np.abs(A) @ np.abs(at["x"] - centre_x) + np.abs(offset).ravel() + 1.0
        assert (np.abs(made - rhs) <= 1e-9 * (scale + np.abs(rhs))).all()
        A, B, offset, _ = (np.array(m) for m in matrices(*[at[q] for q in KINDS]))
        for name, value in (("A", A), ("B", B), ("offset", offset)):
            slack = 1e-9 * (1e-6 + np.abs(value))
            assert (bounds.minimum[name] - slack <= value).all()
            assert (value <= bounds.maximum[name] + slack).all()
        for variable, value in zip(form.scheduling, scalars[:, k], strict=False):
            slack = 1e-9 * (1e-6 + abs(value))
            assert variable.lower - slack <= value <= variable.upper + slack
        stacked = family.at(scalars[: len(form.scheduling), k])
        assert np.abs(stacked[form.layout.place("A")] - A).max() <= 1e-9 * np.abs(A).max() + 1e-12


@pytest.fixture(scope="session")
def check_samples():
    """Compare a form with its plant, its ranges, bounds and vertices at random points."""
    return _check
