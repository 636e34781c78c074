"""Products of sines and cosines as sums: the same function, proved, and narrower where taken."""

from importlib import import_module

import casadi as ca
import numpy as np
import pytest
import sympy as sp

from obsynth.derive import Status, jacobian_bounds
from obsynth.derive.algebra import factorise
from obsynth.derive.algebra.factorise import same_waves
from obsynth.derive.jacobian import entries as jacobian_entries
from obsynth.symbolic import Plant
from obsynth.symbolic.plants import quadrotor
from obsynth.symbolic.plants.planar_arm import planar_arm_bias

fu = import_module("sympy.simplify.fu")
a, b, v, m = sp.symbols("a b v m", real=True)


def arm_from_lagrange(n):
    """Bias vector of an arm as it comes out of its energy, nothing simplified."""
    plant = Plant("arm")
    q = plant.states(f"q1:{n + 1}", range=(-0.3, 0.3))
    dq = plant.states(f"dq1:{n + 1}", range=(-0.5, 0.5))
    tau = plant.inputs(f"tau1:{n + 1}", range=(-1, 1), nominal=0)
    mass, x, y = sp.zeros(n, n), sp.Integer(0), sp.Integer(0)
    for i in range(n):
        x, y = x + sp.sin(sum(q[: i + 1])), y - sp.cos(sum(q[: i + 1]))
        jacobian = sp.Matrix([x, y]).jacobian(q)
        mass += jacobian.T * jacobian
    rows = []
    for k in range(n):
        row = tau[k]
        for i in range(n):
            for j in range(n):
                symbol = mass[k, j].diff(q[i]) + mass[k, i].diff(q[j]) - mass[i, j].diff(q[k])
                row -= symbol * dq[i] * dq[j] / 2
        rows.append(row)
    plant.dynamics([*dq, *rows])
    plant.outputs(list(q))
    return plant


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        (sp.cos(a) * sp.cos(a + b) + sp.sin(a) * sp.sin(a + b), sp.cos(b)),
        (sp.sin(a) ** 2 + sp.cos(a) ** 2 + v, v + 1),
        (m * sp.sin(a) * sp.cos(a), m * sp.sin(2 * a) / 2),
        (v / (2 - 2 * sp.cos(b) ** 2), v / (1 - sp.cos(2 * b))),
        (sp.sqrt(2 + sp.sin(a) * sp.cos(a)), sp.sqrt(sp.sin(2 * a) / 2 + 2)),
    ],
)
def test_products_become_sums(typed, expected):
    found = factorise.products_to_sums(typed)
    assert sp.simplify(found - expected) == 0
    assert not any(
        isinstance(node, sp.Mul) and len(node.atoms(sp.sin, sp.cos)) > 1
        for node in sp.preorder_traversal(found)
    )


@pytest.mark.parametrize("expression", [v * sp.sin(a), a * b, sp.sin(sp.sin(a)), sp.tan(a)])
def test_nothing_to_do(expression):
    assert factorise.products_to_sums(expression) is None


def test_the_proof_refuses_what_differs():
    assert same_waves(sp.cos(a) ** 2, (1 + sp.cos(2 * a)) / 2)
    assert not same_waves(sp.cos(a) ** 2, (1 - sp.cos(2 * a)) / 2)
    assert not same_waves(v * sp.cos(a), m * sp.cos(a))


def forgetful(monkeypatch):
    """What was written before, or is written with a mistake, is not remembered."""
    monkeypatch.setattr(factorise, "_rewritten", factorise._rewritten.__wrapped__)


def wrong_rule(monkeypatch):
    forgetful(monkeypatch)
    right = fu.TR8
    monkeypatch.setattr(
        fu, "TR8", lambda e, **options: right(e, **options).subs(sp.cos(b), sp.sin(b))
    )


def test_a_wrong_rule_is_not_used(monkeypatch):
    wrong_rule(monkeypatch)
    typed = sp.cos(a) * sp.cos(a + b) + sp.sin(a) * sp.sin(a + b)
    assert factorise.products_to_sums(typed) is None


def test_points_catch_what_a_missing_proof_lets_through(monkeypatch):
    plant = arm_from_lagrange(2)
    forgetful(monkeypatch)
    monkeypatch.setattr(factorise, "same_waves", lambda one, other: True)
    right = fu.TR8
    monkeypatch.setattr(
        fu,
        "TR8",
        lambda e, **options: right(e, **options).subs(plant.x[1].symbol, plant.x[0].symbol),
    )
    typed = jacobian_entries.jacobian_entries(plant, "states")
    assert any(entry.has(sp.sin(plant.x[0].symbol)) for entry in typed.exact.values())


def test_robot_arms_as_typed():
    typed, short = jacobian_bounds(arm_from_lagrange(3), rtol=1e-4), planar_arm_bias(3)
    expected = jacobian_bounds(short, rtol=1e-4)
    scale = np.maximum(expected.max - expected.min, 1e-9)
    assert (np.abs(typed.min - expected.min) <= 2e-4 * scale + 1e-12).all()
    assert (np.abs(typed.max - expected.max) <= 2e-4 * scale + 1e-12).all()
    # the first angle has no influence, which the products hide
    assert (typed.max[:, 0] == 0.0).all()
    assert all(s in (Status.EXACT, Status.CONVERGED) for s in typed.status.ravel())


def test_forms_are_kept_where_sums_are_no_better():
    entries = jacobian_entries.jacobian_entries(quadrotor(), "states")
    thrust = entries.exact[(3, 8)]
    assert thrust.count_ops() < 40
    function = ca.Function("f", [entries.variables, entries.constants], [entries.values])
    assert function.n_instructions() < 400
