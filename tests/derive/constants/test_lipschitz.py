"""Lipschitz, one-sided Lipschitz and inner-boundedness constants: numbers, samples, mutants."""

import dataclasses
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
import sympy as sp

from obsynth.derive import Status, UnboundedError, jacobian_bounds, split
from obsynth.derive.constants.eigenvalue_search import Maximum
from obsynth.derive.constants.lipschitz import _inner, lipschitz
from obsynth.derive.constants.symmetric_field import eigenvalue_over_interval
from obsynth.derive.errors import DerivationError
from obsynth.derive.jacobian.entries import matrix_entries
from obsynth.symbolic import Plant, plants


def lorenz_split():
    return split(plants.lorenz(), at=(np.zeros(3), []), linear="terms")


def hinf_split(variant):
    return split(plants.hinf_example(variant), at=(np.zeros(3), np.zeros(1)), linear="terms")


def function_of(subject):
    """(x, u) -> g or rhs, and the box of x and u."""
    if isinstance(subject, Plant):
        model, sx = subject, subject.sx()
        quiet = ca.vertcat(sx.d, sx.f, sx.w)
        value = ca.substitute(sx.rhs, quiet, ca.SX.zeros(quiet.numel()))
        function = ca.Function("f", [sx.x, sx.u], [value])
    else:
        model, function = subject.model, subject.g_function()
    return function, model.box("x"), model.box("u")


def wrong_differences(subject, found, count=4000, seed=0):
    """Pairs of points at which one of the three inequalities fails."""
    function, box_x, box_u = function_of(subject)
    rng = np.random.default_rng(seed)

    def pick(box):
        share = rng.random((count, len(box)))
        share[: count // 4] = np.round(share[: count // 4])
        return box[:, 0] + share * (box[:, 1] - box[:, 0])

    a, u = pick(box_x), pick(box_u)
    b = np.clip(a + rng.normal(size=a.shape) * 10.0 ** rng.uniform(-4, 0, (count, 1)) * 5, *box_x.T)
    change = np.array(function(a.T, u.T) - function(b.T, u.T)).T
    step = a - b
    square = (step**2).sum(axis=1)
    inner = (step * change).sum(axis=1)
    # a sample cannot be trusted beyond its own cancellation
    slack = 1e-9 * square + 1e-13 * (np.abs(a).sum(axis=1) + np.abs(change).sum(axis=1)) ** 2
    tests = (
        (change**2).sum(axis=1) - found.norm.upper**2 * square,
        inner - found.one_sided.upper * square,
        (change**2).sum(axis=1) - found.inner.beta.upper * square - found.inner.gamma * inner,
    )
    return [int((test > slack * max(1.0, found.norm.upper**2)).sum()) for test in tests]


# -- numbers ---------------------------------------------------------------------------------------


def test_quadruple_tank_at_the_exact_equilibrium(parts):
    found = lipschitz(parts)
    assert found.one_sided.upper == pytest.approx(0.018729, abs=5e-7)
    assert found.norm.upper == pytest.approx(0.020981, abs=5e-7)
    assert found.norm.gap <= 1e-14
    assert found.one_sided.gap <= 1e-14


def test_lorenz_symmetrised_before_bounding():
    found = lipschitz(lorenz_split())
    assert found.one_sided.upper == pytest.approx(np.hypot(27, 50) / 2, rel=1e-12)
    assert found.one_sided.upper == pytest.approx(28.41215, abs=6e-6)
    assert set(found.one_sided.at) == {"y", "z"}


def test_lorenz_bounded_before_symmetrising():
    """What the interval matrix of J alone gives: x - x is no longer zero."""
    bounds = jacobian_bounds(lorenz_split())
    low = 0.5 * (bounds.min + bounds.min.T)
    high = 0.5 * (bounds.max + bounds.max.T)
    (loose,), _ = eigenvalue_over_interval(0.5 * (low + high)[None], 0.5 * (high - low)[None])
    assert loose == pytest.approx(39.37, abs=5e-3)


def test_lorenz_norm_by_hand():
    """J = [0 0 0; -z 0 -x; y x 0]: the Gram matrix of its two rows at the corner."""
    x, y, z = 20.0, 27.0, 50.0
    J = np.array([[-z, 0, -x], [y, x, 0]])
    assert lipschitz(lorenz_split()).norm.upper == pytest.approx(np.linalg.norm(J, 2), rel=1e-12)


@pytest.mark.parametrize(
    ("variant", "square"), [("consistent", 0.51663779), ("as_printed", 0.5184)]
)
def test_hinf_example(variant, square):
    found = lipschitz(hinf_split(variant))
    assert found.norm.upper**2 == pytest.approx(square, rel=2e-6)
    assert found.norm.status is not Status.BUDGET


# -- soundness -------------------------------------------------------------------------------------


SUBJECTS = {
    "tank": lambda: split(plants.quadruple_tank().discretise("euler", Ts=1.0)),
    "lorenz": lorenz_split,
    "lorenz, whole": plants.lorenz,
    "van der Pol": plants.van_der_pol,
    "CSTR": lambda: split(plants.exothermic_cstr()),
    "three tanks": plants.three_tanks,
    "hinf": lambda: hinf_split("consistent"),
}


@pytest.mark.parametrize("name", list(SUBJECTS))
def test_differences_never_exceed_the_constants(name):
    subject = SUBJECTS[name]()
    found = lipschitz(subject)
    assert wrong_differences(subject, found) == [0, 0, 0]
    for value in (found.norm, found.one_sided, found.inner.beta):
        assert value.upper >= value.attained
        assert value.gap <= 2e-6 * max(abs(value.attained), 1e-3 * found.norm.upper**2)


@pytest.mark.parametrize("name", ["tank", "lorenz", "van der Pol"])
def test_smaller_constants_fail(name):
    """The attained values are attained: one per cent less is refuted by a pair next to them."""
    subject = SUBJECTS[name]()
    found = lipschitz(subject)
    function, box_x, box_u = function_of(subject)
    model = subject if isinstance(subject, Plant) else subject.model
    for value, kind in ((found.norm, "norm"), (found.one_sided, "symmetric")):
        at = np.array([value.at.get(n, box_x[k].mean()) for k, n in enumerate(model.names("x"))])
        u = np.array([value.at.get(n, box_u[k].mean()) for k, n in enumerate(model.names("u"))])
        J = np.array(ca.Function("J", function.sx_in(), [ca.jacobian(*_jacobian(function))])(at, u))
        J = J.reshape(len(at), len(at))
        true = np.linalg.norm(J, 2) if kind == "norm" else np.linalg.eigvalsh(0.5 * (J + J.T))[-1]
        assert true == pytest.approx(value.attained, rel=1e-9)
        assert true > value.upper - 0.01 * abs(value.upper)


def _jacobian(function):
    arguments = function.sx_in()
    return function(*arguments), arguments[0]


@pytest.mark.parametrize("share", [0.9, 0.7])
def test_mutant_constants_are_refuted_by_the_same_samples(share):
    subject = lorenz_split()
    found = lipschitz(subject)

    def smaller(value):
        return dataclasses.replace(value, upper=share * value.upper)

    mutant = dataclasses.replace(
        found,
        norm=smaller(found.norm),
        one_sided=smaller(found.one_sided),
        inner=dataclasses.replace(found.inner, beta=smaller(found.inner.beta)),
    )
    assert all(wrong_differences(subject, mutant, 40_000))


# -- inner-boundedness -----------------------------------------------------------------------------


@pytest.mark.parametrize("gamma", [-3.0, 0.0, 1.5, 8.0])
def test_every_gamma_gives_a_valid_pair(gamma):
    subject = plants.van_der_pol()
    found = lipschitz(subject, gamma=gamma)
    assert found.inner.gamma == gamma
    assert wrong_differences(subject, found)[2] == 0
    assert found.inner.beta.upper == pytest.approx(found.inner.radius**2 - gamma**2 / 4)
    if gamma == 0.0:
        assert found.inner.radius == found.norm.upper


def test_default_gamma_has_the_smallest_ball():
    subject = plants.van_der_pol()
    best = lipschitz(subject).inner
    for gamma in (best.gamma - 1.0, best.gamma + 1.0):
        assert lipschitz(subject, gamma=gamma).inner.radius > best.radius


def test_a_linear_function_is_its_own_ball():
    plant = Plant("scaled")
    x = plant.states("x1:3", range=(-1, 1))
    plant.dynamics([-2 * x[0], -2 * x[1]])
    plant.outputs([x[0]])
    found = lipschitz(plant)
    assert found.norm.upper == pytest.approx(2.0, rel=1e-12)
    assert found.one_sided.upper == pytest.approx(-2.0, rel=1e-12)
    assert found.inner.gamma == pytest.approx(-4.0, abs=1e-4)
    assert found.inner.radius <= 1e-4


def test_nothing_left_over_is_zero():
    plant = Plant("linear")
    x = plant.states("x1:3", range=(-1, 1))
    plant.dynamics([x[1] / 2, x[0] / 4], Ts=1)
    plant.outputs([x[0]])
    found = lipschitz(split(plant, linear="terms"))
    assert found.norm.upper == 0.0
    assert found.one_sided.upper == 0.0


def test_beta_is_not_below_the_ball_that_it_comes_from():
    """ball^2 - shift^2 in exact numbers; mutant: the margin of its rounding left out."""
    rng = np.random.default_rng(0)
    for ball, shift in rng.uniform(0.0, 2.0, (200, 2)) * 10.0 ** rng.integers(-9, 9, (200, 2)):
        beta = _inner(Maximum(ball, ball, {}, Status.EXACT, "given"), shift).beta
        exact = Fraction(ball) ** 2 - Fraction(shift) ** 2
        assert Fraction(beta.attained) <= exact <= Fraction(beta.upper)
        assert beta.gap <= 2e-15 * (ball**2 + shift**2)


# -- refusals and reading --------------------------------------------------------------------------


def test_unbounded_slopes_are_refused():
    plant = Plant("tank")
    (h,) = plant.states("h", range=(0, 1))
    plant.dynamics([-(h**0.5)])
    plant.outputs([h])
    with pytest.raises(UnboundedError, match="h in"):
        lipschitz(plant)
    entries = matrix_entries({(0, 0): -sp.sqrt(h).diff(h)}, plant)
    with pytest.raises(UnboundedError, match="h in") as caught:
        entries.ranges(1e-6, "fast")
    low, high = caught.value.sub_box["h"]
    assert low == 0.0 < high


def test_gamma_has_to_be_a_number(parts):
    with pytest.raises(DerivationError, match="gamma"):
        lipschitz(parts, gamma=float("nan"))


def test_constants_can_be_read(parts):
    found = lipschitz(parts)
    text = str(found)
    assert "g of quadruple tank" in text
    assert "0.020981" in text
    assert "one-sided" in text
    assert "<table>" in found._repr_html_()
    assert float(found.norm) == found.norm.upper
