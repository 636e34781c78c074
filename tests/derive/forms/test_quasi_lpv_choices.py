"""The ways to write a row: all of them, ranked, preferred, refused."""

import numpy as np
import pytest
import sympy as sp

from obsynth.derive import DerivationError, UnboundedError
from obsynth.derive.forms.quasi_lpv.form import quasi_lpv
from obsynth.symbolic import Plant, plants

R = sp.Rational

# -- enumeration, ranking, preference -----------------------------------------------


@pytest.fixture
def product():
    """x1 is measured, x2 is not; the box is wide in x1."""
    plant = Plant("product")
    x1, x2, x3 = plant.states("x1:4", range=[(1, 4), (2, 3), (-1, 1)])
    (u,) = plant.inputs("u", range=(-1, 1))
    plant.dynamics([x1 * x2 * x3 - x1, -x2 + u * x1, sp.sin(x1 - x3) + x3**2])
    plant.outputs([x1, x3])
    return plant


def test_all_ways_are_enumerated(product):
    first, second, third, *outputs = quasi_lpv(product).ranking
    assert (first.total, second.total, third.total) == (3, 2, 1)
    assert {dict(a.choices)["x1*x2*x3"] for a in first.alternatives} == {"x1", "x2", "x3"}
    assert {dict(a.choices)["u*x1"] for a in second.alternatives} == {"x1", "u"}
    assert all(r.total == 1 for r in outputs)
    scores = [a.score for a in first.alternatives]
    assert scores == sorted(scores)


def test_velocity_inflation_is_the_mean_width_of_the_row(product):
    ranking = quasi_lpv(product, penalty=0.0).ranking[0]
    rng = np.random.default_rng(1)
    box = product.box("x")
    x = box[:, 0] + rng.random((400_000, 3)) * (box[:, 1] - box[:, 0])
    # f1 = x1 x2 x3 - x1 has the range [-16, 8]; widths: x2 x3 6, x1 x3 8, x1 x2 10
    width = {"x1": (6.0, 0), "x2": (8.0, 1), "x3": (10.0, 2)}
    for alternative in ranking.alternatives:
        size, column = width[dict(alternative.choices)["x1*x2*x3"]]
        expected = size * np.abs(x[:, column]).mean() / 24.0
        assert alternative.inflation == pytest.approx(expected, rel=5e-3)


def test_the_penalty_moves_the_choice_to_measured_signals(product):
    plain = quasi_lpv(product, penalty=0.0).ranking[0].alternatives[0]
    assert plain.unmeasured == ("x2",)
    assert dict(plain.choices)["x1*x2*x3"] == "x3"
    wary = quasi_lpv(product, penalty=100.0)
    assert wary.ranking[0].alternatives[0].unmeasured == ()
    assert wary.A[0, 1] == sp.Symbol("x1", real=True) * sp.Symbol("x3", real=True)
    assert wary.proof.holds


def test_the_user_prefers_a_signal_or_a_divisor(product):
    x1, x2, x3 = (s.symbol for s in product.x)
    assert quasi_lpv(product, prefer=["x1"]).A[0, 0] == x2 * x3 - 1
    assert quasi_lpv(product, prefer={"x1*x2*x3": "x2"}).A[0, 1] == x1 * x3
    assert quasi_lpv(product, prefer={"u*x1": "u"}).B[1, 0] == x1
    assert quasi_lpv(product, prefer={"u*x1": "x1"}).A[1, 0] == sp.Symbol("u", real=True)
    for prefer in (["x1"], {"x1*x2*x3": "x2"}):
        assert quasi_lpv(product, prefer=prefer).proof.holds


@pytest.mark.parametrize(
    ("prefer", "words"),
    [
        (["x9"], "x9.*x1, x2, x3"),
        ({"x1*x2": "x1"}, "no row.*u\\*x1.*x1\\*x2\\*x3"),
        ({"x1*x2*x3": "u"}, "cannot be divided by u.*x1; x2; x3"),
    ],
)
def test_a_preference_that_is_not_there_is_refused_with_what_is(product, prefer, words):
    with pytest.raises(DerivationError, match=words):
        quasi_lpv(product, prefer=prefer)


@pytest.mark.parametrize(
    "centre",
    ["middle", [1, 2, 3], ([1, 2], [0]), ([1, 2, np.nan], [0]), ([1, 2, np.inf], [0]), 5],
)
def test_a_centre_that_is_none_is_refused(product, centre):
    with pytest.raises(DerivationError, match="centre"):
        quasi_lpv(product, centre=centre)


@pytest.mark.parametrize("option", [{"alternatives": 0}, {"penalty": -1.0}, {"effort": "lazy"}])
def test_options_are_checked(product, option):
    with pytest.raises(DerivationError):
        quasi_lpv(product, **option)


def test_functions_of_a_difference_take_two_columns(product):
    x1, _, x3 = (s.symbol for s in product.x)
    form = quasi_lpv(product)
    assert form.A[2, 0] == sp.sinc(x1 - x3)
    assert sp.expand(form.A[2, 2] - (x3 - sp.sinc(x1 - x3))) == 0


# -- secants, or symbols with the range of their slopes ------------------------------


def test_secants_that_share_their_variables_are_not_lifted(check_samples):
    """.72 for the slopes of two axles' side forces, four variables. Mutant: always lifted."""
    plant = Plant("axles")
    v, y, r = plant.states("v y r", range=[(10, 30), (-2, 2), (-R(3, 5), R(3, 5))])
    front, rear = sp.atan((y + r) / v), sp.atan((y - r) / v)
    plant.dynamics([-v / 10, -20 * (front + rear), -15 * (front - rear)])
    plant.outputs([v, r])
    form = quasi_lpv(plant, rtol=1e-2, effort="fast")
    assert form.ranging.lifts == () and len(form.scheduling) == 2
    assert form.ranking[2].alternatives[0].inflation < 0.19
    check_samples(form)


@pytest.mark.long
@pytest.mark.parametrize(
    ("tyre", "variables", "inflation"), [("linear", 6, 0.093), ("pacejka", 8, 2.01)]
)
def test_a_bicycle_is_written_in_the_way_that_suits_its_tyres(tyre, variables, inflation):
    """.27 and nine variables for linear tyres lifted, 2.44 for nonlinear ones that are not."""
    form = quasi_lpv(plants.bicycle(tyre))
    assert len(form.scheduling) == variables
    assert form.ranking[2].alternatives[0].inflation == pytest.approx(inflation, rel=0.01)


# -- singular choices ---------------------------------------------------------------


def test_a_quotient_without_a_bound_is_left_out_and_a_centre_helps(check_samples):
    plant = Plant("tank that runs dry")
    (h,) = plant.states("h", range=(0, 4))
    (v,) = plant.inputs("v", range=(0, 1))
    plant.dynamics([v - sp.sqrt(h)])
    plant.outputs([h])
    form = quasi_lpv(plant)
    ((row, term, reason),) = form.unfactored
    assert (row, term) == ("h", -sp.sqrt(h))
    assert "no finite bound" in reason
    assert "stays in the offset" in str(form)
    assert form.proof.holds
    check_samples(form)
    better = quasi_lpv(plant, centre=([1], [0]))
    assert better.unfactored == ()
    assert better.A[0, 0] == -1 / (sp.sqrt(h) + 1)
    assert better.offset[0] == -1
    check_samples(better)


def test_a_product_is_divided_by_the_factor_that_stays_bounded():
    plant = Plant("two ways, one singular")
    x, y = plant.states("x y", range=[(0, 1), (-1, 1)])
    plant.dynamics([sp.sqrt(x) * y, -y])
    plant.outputs([x, y])
    form = quasi_lpv(plant)
    assert form.A[0, :] == sp.Matrix([[0, sp.sqrt(x)]])
    assert form.ranking[0].total == 1


def test_without_a_range_the_vertices_are_refused_and_the_form_is_not():
    plant = Plant("unbounded")
    x, y = plant.states("x y", range=[(-np.inf, np.inf), (0, 1)])
    plant.dynamics([x**3, -y])
    plant.outputs([x])
    form = quasi_lpv(plant)
    assert form.A[0, 0] == x**2
    assert form.proof.holds
    with pytest.raises(UnboundedError, match=r"x\*\*2.*no finite range.*x"):
        form.vertices()
    with pytest.raises(UnboundedError, match="A"):
        form.interval()


def test_what_has_no_closed_form_stays_in_the_offset_visibly(check_samples):
    plant = Plant("erf")
    x, y = plant.states("x y", range=(0.5, 2))
    plant.dynamics([sp.erf(1 + x), -y])
    plant.outputs([x])
    form = quasi_lpv(plant)
    assert form.unfactored == (("x", sp.erf(x + 1), "no closed form at this centre"),)
    check_samples(form)
