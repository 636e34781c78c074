"""Derivatives of what jumps, and walks that meet every part once."""

import random
import time
from importlib import import_module

import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from obsynth.derive.algebra.linear_parts import jacobian, slope
from obsynth.derive.algebra.sizes import simplified, size
from obsynth.derive.jacobian.entries import jacobian_entries
from obsynth.derive.rigour import substitute
from obsynth.derive.rigour.walks import once, replaced

X, Y = sp.symbols("x y", real=True)
# Nothing tells SymPy that the last term is a real number.
INNER = sp.sinh(X * Y) + sp.atan(X / 3) + (sp.sin(Y) + 2) ** (-2)
STEP = sp.Rational(1, 10**5)


@pytest.mark.parametrize(
    "jump", [sp.sign, sp.floor, sp.ceiling, sp.Abs, lambda a: sp.Heaviside(a, 1)]
)
def test_what_jumps_is_flat_and_nothing_is_left_undone(jump):
    """Against central differences.

    Mutants: a kind of jump left out of ``_FLAT``; the outer function of a modulus dropped.
    """
    row = X * jump(3 * INNER + sp.Abs(Y * jump(INNER)) / 7) + Y**2
    for symbol in (X, Y):
        found = slope(row, symbol)
        assert not found.has(sp.Derivative, sp.Subs, sp.DiracDelta, sp.Dummy)
        # away from the jumps
        for at in ({X: "31/100", Y: "47/100"}, {X: "-3/5", Y: "3/10"}):
            point = {s: sp.Rational(value) for s, value in at.items()}
            ends = [row.xreplace({**point, symbol: point[symbol] + h}) for h in (STEP, -STEP)]
            wanted = float(ends[0] - ends[1]) / float(2 * STEP)
            assert float(found.xreplace(point)) == pytest.approx(wanted, abs=1e-7)


def test_derivatives_of_what_is_known_to_be_real_are_sympys():
    """Mutant: a modulus always written by its sign (the slope of x |x| is 2 x sign(x) then)."""
    rows = sp.Matrix([X**2 * sp.sin(Y), sp.Max(X, Y), X * sp.Abs(X) + Y])
    assert jacobian(rows, [X, Y]) == rows.jacobian([X, Y])
    assert jacobian(rows, []).shape == (3, 0)


@pytest.mark.timeout(60)
def test_a_sign_of_something_sympy_does_not_know_to_be_real_ends():
    """Took for ever; the sign is 1 all over the box, so that y*sign(..) - y does not vary.

    Mutants: SymPy's own derivative in ``_exact_entry``; ``sp.simplify`` in ``simplified``.
    """
    plant = ob.Plant("sign")
    plant.states("x y", range=(-0.2, 0.2))
    plant.dynamics([-X, Y * sp.sign(INNER) - 2 * Y])
    plant.outputs([X, Y])
    start = time.perf_counter()
    (entry,) = (e for e in jacobian_entries(plant, "states").exact.values() if e != -1)
    assert not entry.has(sp.Derivative)
    bounds = ob.jacobian_bounds(plant)
    np.testing.assert_array_equal(bounds.min, [[-1, 0], [0, -1]])
    np.testing.assert_array_equal(bounds.max, [[-1, 0], [0, -1]])
    assert ob.analyse(plant) is not None
    assert time.perf_counter() - start < 10.0


def test_jumps_are_left_alone_when_the_rest_is_simplified():
    """Mutant: the names not put back."""
    jump = sp.sign(INNER)
    assert simplified(jump * (sp.sin(X) ** 2 + sp.cos(X) ** 2) - jump) == 0
    assert simplified(jump * (X + 1) - jump * X) == jump


def _random(source, depth):
    if not depth:
        return source.choice([X, Y, sp.Float(0.3), sp.Rational(2, 7)])
    parts = [_random(source, depth - 1) for _ in range(2)]
    kind = source.choice([sp.Add, sp.Mul, sp.Max, "power", "sine", "case"])
    if kind == "power":
        return parts[0] ** 2
    if kind == "sine":
        return sp.sin(parts[0])
    return sp.Piecewise((parts[0], X > Y), (parts[1], True)) if kind == "case" else kind(*parts)


def test_replacing_is_what_sympy_does():
    """Mutants: the first part of a node replaced only; conditions left as they are."""
    source = random.Random(1)
    new = {X: Y + sp.Rational(1, 3), Y: X**2}
    for _ in range(20):
        expression = _random(source, 3)
        assert replaced(expression, new) == expression.xreplace(new)
        assert set(once(expression)) == set(sp.preorder_traversal(expression))
    assert replaced(X + 1, {}) == X + 1


def test_cases_that_are_ruled_out_are_not_looked_at():
    """Mutant: all cases rebuilt (division by zero in one that does not count)."""
    row = sp.Piecewise((sp.sin(X) / X, sp.Ne(X, 0)), (sp.Symbol("one") + Y, True))
    assert replaced(row, {X: sp.Integer(0)}) == sp.Symbol("one") + Y
    # the condition True was met before, the other one was not
    both = sp.Piecewise((X, X > Y), (Y, True)) + sp.Piecewise((X**2, Y < -1), (2, True))
    new = {X: Y + 1, Y: X}
    assert replaced(both, new) == both.xreplace(new)
    chained = sp.Piecewise((1 / (X - 1), X > 1), (sp.log(Y), Y > 0), (2, True))
    assert replaced(chained, {X: sp.Integer(1), Y: sp.Integer(-1)}) == 2


@pytest.mark.timeout(60)
def test_long_expressions_of_few_parts_are_walked_in_no_time():
    """2^60 parts written out. Mutant: ``xreplace`` in ``substitute`` (never ends)."""
    long = X
    for _ in range(60):
        long = sp.sin(long) * sp.cos(long)
    long += sp.Float(0.5)
    assert size(substitute(long, {X: Y})) == 10**12


@pytest.mark.timeout(60)
def test_an_arm_of_three_links_is_split_after_a_runge_kutta_step():
    """Took 30 s and more, now below one. Mutant: as above."""
    step = ob.plants.planar_arm(3).discretise("rk4", 0.01)
    start = time.perf_counter()
    parts = ob.split(step, linear="jacobian")
    assert parts.proof.holds
    assert time.perf_counter() - start < 10.0
    x = np.linspace(-0.3, 0.4, 6)
    u = np.full(3, 0.1)
    others = [np.zeros(len(step.names(kind))) for kind in ("d", "f", "w", "p", "rho")]
    whole = np.array(step.function()(x, u, *others)[0]).ravel()
    summed = parts.A @ x + parts.B @ (u) + np.array(parts.g_function()(x, u))[:, 0]
    np.testing.assert_allclose(summed, whole, atol=1e-13)


def test_long_programs_get_fewer_boxes():
    """Mutant: the share applied to short programs as well, or not at all."""
    from obsynth.derive.intervals.search.branch import Budget

    given = Budget(4_000, 60)
    assert given.for_nodes(10) == given.for_nodes(2_000) == given
    assert given.for_nodes(20_000) == Budget(40, 60)


def test_the_search_for_an_equilibrium_is_bounded(monkeypatch):
    """No state rests here, and every start ends in tiny steps.

    Mutants: no limit over all starts; slow steps never given up.
    """
    plant = ob.Plant("restless")
    plant.states("x y", range=(-2, 2))
    plant.dynamics([sp.sqrt(1 + sp.exp(X * Y) + sp.sin(9 * X) ** 2), X - Y + sp.tanh(X * Y)])
    plant.outputs([X])
    equilibria = import_module("obsynth.derive.equilibrium")
    counts = []
    newton = equilibria._newton

    def counted(*arguments):
        found = newton(*arguments)
        counts.append(found[-1])
        return found

    monkeypatch.setattr(equilibria, "_newton", counted)
    monkeypatch.setattr(equilibria, "_VALUES", 300)
    with pytest.raises(ob.ObsynthError, match="no equilibrium"):
        ob.equilibrium(plant)

    assert max(counts) < 100 and sum(counts) < 300 + max(counts)
