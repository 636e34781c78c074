"""Quasi-LPV forms of the zoo and of the papers: exact, inside their ranges, readable."""

import numpy as np
import pytest
import sympy as sp

from obsynth.derive import DerivationError, StructureError, split
from obsynth.derive.forms.quasi_lpv.form import UNMEASURED_NOTE, quasi_lpv
from obsynth.symbolic import Plant, plants

R = sp.Rational
ZOO = [
    "exothermic_cstr",
    "haldane_bioreactor",
    "hinf_example",
    "induction_motor",
    "interval_example",
    "lorenz",
    "pmsm_dq",
    "qpv_example",
    "quadrotor",
    "quadruple_tank",
    "three_tanks",
    "three_tanks_fdt",
    "van_der_pol",
    "water_tanks",
]


@pytest.mark.parametrize("name", ZOO)
def test_the_zoo_has_exact_forms_inside_their_ranges(name, check_samples):
    form = quasi_lpv(getattr(plants, name)())
    assert form.proof.holds
    assert form.unfactored == ()
    check_samples(form)


@pytest.mark.long
@pytest.mark.parametrize("name", ["bicycle", "planar_arm 2", "planar_arm 3", "planar_arm_bias 3"])
def test_heavy_plants_have_exact_forms_inside_their_ranges(name, check_samples):
    base, *count = name.split()
    form = quasi_lpv(getattr(plants, base)(*map(int, count)), alternatives=4)
    assert all(form.proof.methods)
    assert form.unfactored == ()
    check_samples(form)


@pytest.mark.parametrize("name", ["exothermic_cstr", "lorenz", "three_tanks", "quadruple_tank"])
def test_forms_about_the_equilibrium(name, check_samples):
    model = getattr(plants, name)()
    form = quasi_lpv(model, centre="equilibrium")
    assert all(form.proof.methods)
    assert form.unfactored == ()
    assert not form.offset.free_symbols & {s.symbol for s in (*model.x, *model.u)}
    # at an equilibrium the offset is what is left of f there
    assert max(abs(float(e)) for e in form.offset.evalf()) < 1e-6
    assert not form.centre.is_origin
    check_samples(form)


def test_euler_keeps_the_structure_and_runge_kutta_does_not():
    model = plants.quadruple_tank()
    step = model.discretise("euler", Ts=R(1, 2))
    slow, fast = quasi_lpv(model), quasi_lpv(step)
    assert (fast.A - sp.eye(4) - slow.A / 2).expand() == sp.zeros(4, 4)
    assert fast.proof.holds
    with pytest.raises(StructureError, match=r"rk4.*euler"):
        quasi_lpv(model.discretise("rk4", Ts=1.0))


# -- one mechanism with split -------------------------------------------------------


def test_the_frozen_split_is_the_first_choice_at_the_point():
    model = plants.quadruple_tank().discretise("euler", Ts=1.0)
    parts = split(model)
    form = quasi_lpv(model)
    at = dict(
        zip([s.symbol for s in (*model.x, *model.u)], [*parts.at.x, *parts.at.u], strict=True)
    )
    assert np.allclose(np.array(form.A.subs(at), dtype=float), parts.A, rtol=1e-14)
    assert np.allclose(np.array(form.B.subs(at), dtype=float), parts.B, rtol=1e-14)


# -- the H-infinity example ---------------------------------------------------------


@pytest.mark.parametrize("variant", ["consistent", "as_printed"])
def test_hinf_the_offset_is_explicit_and_the_remainder_is_a_secant(variant):
    form = quasi_lpv(plants.hinf_example(variant))
    x1, x2, x3 = (s.symbol for s in form.model.x)
    assert form.offset == sp.Matrix([R(6, 100), 0, 0])
    assert form.A[2, 2] == R(65, 1000) - R(33, 100) * sp.sinc(x3)
    assert sp.simplify(form.A[1, :] - sp.Matrix([[R(118, 10000), R(299, 1000), R(47, 100)]])) == (
        sp.zeros(1, 3)
    )
    column = 1 if variant == "consistent" else 0
    assert form.A[0, column].has(sp.sinc)
    assert not form.A.has(sp.zoo, sp.nan)
    # closed forms without 0/0: they can be evaluated at the centre
    at_origin = form.A.subs({x1: 0, x2: 0, x3: 0})
    assert at_origin[2, 2] == R(65, 1000) - R(33, 100)
    assert form.vertices().exact is (variant == "consistent")


# -- unmeasured scheduling ----------------------------------------------------------


def test_unmeasured_scheduling_is_visible_with_what_it_means():
    form = quasi_lpv(plants.quadruple_tank())
    assert [v.unmeasured for v in form.scheduling] == [(), (), (), ("h4",)]
    assert [str(v.symbol) for v in form.unmeasured] == ["rho4"]
    text = str(form)
    assert UNMEASURED_NOTE in text
    assert "A(x) x - A(xhat) xhat is not A(x) (x - xhat)" in text
    assert UNMEASURED_NOTE in form._repr_html_().replace("&lt;", "<")
    measured = quasi_lpv(plants.van_der_pol())
    assert measured.unmeasured == ()
    assert UNMEASURED_NOTE not in str(measured)


def test_a_state_behind_a_sensor_fault_counts_as_unmeasured():
    form = quasi_lpv(plants.haldane_bioreactor())
    assert {n for v in form.unmeasured for n in v.unmeasured} == {"S"}


def test_declared_scheduling_tells_itself_whether_it_is_measured():
    assert quasi_lpv(plants.qpv_example()).unmeasured == ()
    assert len(quasi_lpv(plants.interval_example()).unmeasured) == 2


# -- secants bounded through their slopes -------------------------------------------


@pytest.fixture(scope="module")
def slip():
    """A nested tyre-like force of three states; its slope has a narrower range than its secant."""
    plant = Plant("slip")
    v, r, s = plant.states("v r s", range=[(-1, 1), (-1, 1), (5, 10)])
    (u,) = plant.inputs("u", range=(-1, 1))
    force = sp.sin(R(13, 10) * sp.atan(9 * sp.atan(4 * sp.atan((v + r / 2) / s))))
    plant.dynamics([-force + u, -r, -s])
    plant.outputs([r, s])
    return quasi_lpv(plant)


def test_a_lifted_secant_is_outer_and_holds(slip, check_samples):
    assert slip.unfactored == ()
    assert len(slip.ranging.lifts) >= 1
    assert not slip.vertices().exact
    assert all(slip.proof.methods)
    check_samples(slip, 200)


def test_a_lifted_range_is_not_called_attained(slip):
    lifted = [v for v in slip.scheduling if "v" in v.signals]
    assert lifted
    for variable in lifted:
        assert str(variable.status).startswith("budget")
        assert variable.lower <= variable.attained_lower <= variable.attained_upper
        assert variable.attained_upper <= variable.upper


# -- how it reads -------------------------------------------------------------------


def test_a_form_reads_well():
    form = quasi_lpv(plants.three_tanks())
    text = str(form)
    assert "rho1 = 1/sqrt(Abs(x1 - x3)) in [1.767767, 3.5355339], unmeasured: x3" in text
    assert "identity proved in all 5 rows" in text
    latex = form._repr_latex_()
    assert latex.startswith("$$\\begin{aligned}")
    assert "\\rho_{1} &= \\frac{1}{\\sqrt{\\left|{x_{1} - x_{3}}\\right|}} \\in [1.76777" in latex
    html = form._repr_html_()
    assert ">rho1</td>" in html
    assert "needs x3" in html


def test_ranking_and_centre_are_shown():
    form = quasi_lpv(plants.lorenz(), centre=([8, 8, 27], []))
    assert "x' = A (x - x_c) + B (u - u_c)" in str(form)
    assert "2 ways" in str(form)
    assert ">inflation</th>" in form._repr_html_()
    assert "2 ways" in str(form.ranking[1])


def test_constant_blocks_are_doubles_and_varying_ones_refused():
    form = quasi_lpv(plants.three_tanks())
    assert form.constant("C").tolist() == [[1, 0, 0], [0, 1, 0]]
    assert form.constant("B_f") == pytest.approx(np.array([[1, 0], [0, 1], [0, 0]]) / 0.0154)
    assert form.constant("W2").tolist() == [[1, 0], [0, 1]]
    with pytest.raises(StructureError, match=r"A\[1,1\].*x1, x3"):
        form.constant("A")
    with pytest.raises(DerivationError, match="no block 'Q'"):
        form.block("Q")


def test_faults_and_disturbances_keep_their_columns():
    form = quasi_lpv(plants.qpv_example())
    x = [s.symbol for s in form.model.x]
    assert form.block("B_f") == sp.diag(*x)
    assert form.constant("W1").tolist() == np.diag([0.25, 0.15, 0.25]).tolist()
    tanks = quasi_lpv(plants.water_tanks())
    h1, fl2 = sp.Symbol("h1", real=True), sp.Symbol("fl2", real=True)
    assert not tanks.A.has(fl2)
    assert tanks.block("B_f")[0, 2] == sp.sqrt(h1) / 2
