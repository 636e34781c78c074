"""Quadratic forms: the example of the QPV paper, random quadratic plants, refusals, mutants."""

import casadi as ca
import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive import DerivationError, StructureError, UnboundedError
from obsynth.derive.forms.qpv import build as module
from obsynth.derive.forms.qpv.augment import augment_plant
from obsynth.derive.forms.qpv.build import prove_quadratic, qpv
from obsynth.symbolic import Plant, plants

R = sp.Rational


@pytest.fixture(scope="module")
def paper():
    return qpv(plants.qpv_example())


def a_of(t1, t2):
    return np.array([[-4 - t1, 10, 2 + 2 * t2], [-1, -1 - t2, 1.5 + 2 * t1], [1, 1, -4 - 3 * t1]])


def b_of(t1):
    return np.array([[-1.2 - t1, 0, 0.7], [0, 0.5, 0], [0, 0, 2]])


# -- the example of Rotondo, Buciakowski and Witczak --------------------------------


def test_rotondo_the_augmented_matrices(paper):
    assert paper.names == ("x1", "x2", "x3", "f1", "f2", "f3")
    t1, t2 = (s.symbol for s in paper.model.rho)
    A = sp.Matrix([[-4 - t1, 10, 2 + 2 * t2], [-1, -1 - t2, R(3, 2) + 2 * t1], [1, 1, -4 - 3 * t1]])
    assert sp.diag(A, sp.zeros(3, 3)) == paper.A
    B = sp.Matrix([[-R(6, 5) - t1, 0, R(7, 10)], [0, R(1, 2), 0], [0, 0, 2]])
    assert B.col_join(sp.zeros(3, 3)) == paper.B
    assert sp.diag(R(1, 4), R(3, 20), R(1, 4)).col_join(sp.zeros(3, 3)) == paper.G
    assert sp.eye(3).row_join(sp.zeros(3, 3)) == paper.C
    assert sp.diag(R(1, 40), R(3, 200), R(1, 40)) == paper.H
    assert paper.c == sp.zeros(6, 1)
    assert all(part == sp.zeros(6, 6) for part in paper.M)
    for i, N in enumerate(paper.N):
        expected = sp.zeros(6, 6)
        if i < 3:
            expected[i, 3 + i] = 1
        assert expected == N
    assert paper.proof.holds


def test_rotondo_vertices_in_the_order_of_the_note(paper):
    corners = paper.vertices()
    assert (corners.count, corners.exact) == (4, True)
    order = [(0, 0), (0, 1), (1, 0), (1, 1)]
    for v, (t1, t2) in enumerate(order):
        np.testing.assert_allclose(corners.A[v, :3, :3], a_of(t1, t2), atol=1e-15)
        np.testing.assert_allclose(corners.B[v, :3], b_of(t1), atol=1e-15)
        assert corners.N[v, 2, 2, 5] == 1.0
    assert corners.N.shape == (4, 6, 6, 6)
    assert corners.M.shape == (4, 3, 6, 6)
    np.testing.assert_array_equal(corners.C[3], np.eye(3, 6))
    np.testing.assert_allclose(corners.H[1], np.diag([0.025, 0.015, 0.025]))
    held = [
        np.linalg.solve(-corners.B[v, :3], corners.A[v, :3, :3] @ [10, 10, 10]) for v in range(4)
    ]
    expected = [[72.5, 10, 10], [89.1667, 30, 10], [39.7727, -30, 25], [48.8636, -10, 25]]
    np.testing.assert_allclose(held, expected, atol=5e-5)


def test_rotondo_the_residual_is_zero_to_rounding(paper):
    function = paper.function()
    rng = np.random.default_rng(0)
    box = paper.box
    N = paper.constant("N")
    for _ in range(200):
        x = box[:, 0] + rng.random(6) * (box[:, 1] - box[:, 0])
        u, w, (t1, t2) = rng.normal(size=3) * 20, rng.normal(size=3), rng.random(2)
        rhs = np.array(function(x, u, [], [], w, [], [t1, t2])[0]).ravel()
        A = np.zeros((6, 6))
        A[:3, :3] = a_of(t1, t2)
        B = np.vstack([b_of(t1), np.zeros((3, 3))])
        G = np.vstack([np.diag([0.25, 0.15, 0.25]), np.zeros((3, 3))])
        made = A @ x + np.einsum("a,iab,b->i", x, N, x) + B @ u + G @ w
        assert np.abs(made - rhs).max() <= 1e-13 * np.abs(A).max() * np.abs(x).max()


def test_rotondo_both_forms_of_n_describe_the_same_dynamics(paper):
    symmetric = qpv(paper.model, form_of_N="symmetric")
    for upper, even in zip(paper.N, symmetric.N, strict=True):
        assert even == even.T
        assert even == (upper + upper.T) / 2
        assert upper.is_upper
    assert symmetric.N[0][0, 3] == R(1, 2)
    assert (paper.A, paper.B) == (symmetric.A, symmetric.B)
    # the LMIs see the difference: N_i alone differs, N_i + N_i' does not
    assert paper.N[0] != symmetric.N[0]
    assert paper.N[0] + paper.N[0].T == symmetric.N[0] + symmetric.N[0].T


def test_rotondo_faults_left_as_inputs_multiply_states_and_are_refused():
    with pytest.raises(StructureError, match=r"row of x1.*f1\*x1.*augment="):
        qpv(plants.qpv_example(), augment="none")
    with pytest.raises(StructureError, match=r"row of x3.*f3"):
        qpv(plants.qpv_example(), augment=["f1", "f2"])


# -- augmentation -------------------------------------------------------------------


def test_losses_of_effectiveness_are_states_that_multiply_inputs():
    plant = Plant("two pumps")
    x = plant.states("x1 x2", range=(0, 1))
    u = plant.inputs("u1 u2", range=(0, 2))
    plant.dynamics([-x[0] + 3 * u[0] + u[1], -x[1] + R(1, 2) * u[1]])
    plant.outputs([x[0], x[1]])
    form = qpv(plant, effectiveness={"u2": (0.0, 0.3)})
    assert form.names == ("x1", "x2", "loss_u2")
    assert form.box[2].tolist() == [0.0, 0.3]
    # B (I - diag(phi)) u: the loss of u2 takes the second column of B away
    loss = form.M[1][:, 2]
    assert loss == -form.B[:, 1]
    assert form.M[0] == sp.zeros(3, 3)
    assert qpv(plant, effectiveness=True).names == ("x1", "x2", "loss_u1", "loss_u2")
    assert qpv(plant).names == ("x1", "x2")


def test_a_fault_of_a_discrete_plant_stays_what_it_is():
    form = qpv(plants.qpv_example().discretise("euler", Ts=R(1, 100)))
    assert form.A[3:, 3:] == sp.eye(3)
    assert form.N[0][0, 3] == R(1, 100)
    assert form.proof.holds


def test_additive_faults_keep_their_column_or_become_states():
    model = plants.pmsm_dq()
    form = qpv(model)
    assert [s.name for s in form.plant.faults] == ["f1", "f2", "s1", "s2"]
    assert form.B_f[:, :2] == form.B
    assert form.D_f[:, 2:] == sp.eye(3, 2)
    grown = qpv(model, augment="all")
    assert grown.names[3:] == ("f1", "f2", "s1", "s2")
    assert grown.B_f.shape == (7, 0)
    assert grown.C[:, 5:] == sp.eye(3, 2)
    assert grown.A[0, 3] == form.B[0, 0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"form_of_N": "lower"}, "'lower'.*'upper' or 'symmetric'"),
        ({"augment": ["q"]}, "'q'.*no fault.*f1, f2, f3"),
        ({"effectiveness": ["x1"]}, "'x1'.*no input.*u1, u2, u3"),
    ],
)
def test_options_that_are_not_there_are_refused(options, words):
    with pytest.raises(DerivationError, match=words):
        qpv(plants.qpv_example(), **options)


def test_a_name_that_is_taken_is_not_taken_again():
    plant = Plant("taken")
    x = plant.states("x loss_u")
    (u,) = plant.inputs("u")
    plant.dynamics([u - x[0], -x[1]])
    plant.outputs([x[0]])
    with pytest.raises(DerivationError, match="loss_u, which is taken"):
        augment_plant(plant, effectiveness=["u"])


# -- parameters ---------------------------------------------------------------------


def test_uncertain_parameters_schedule_and_products_are_outer():
    plant = Plant("parameters")
    x = plant.states("x y", range=(0, 1))
    plant.params("k", range=(1, 2))
    plant.scheduling("s", range=(-1, 3))
    k, s = sp.symbols("k s", real=True)
    plant.dynamics([-k * x[0] + s * x[0] * x[1], s * k * x[1] ** 2 - x[1] + s**2])
    plant.outputs([k * x[0]])
    form = qpv(plant)
    assert [str(v.expression) for v in form.scheduling] == ["k", "s", "s**2", "k*s"]
    corners = form.vertices()
    assert (corners.count, corners.exact) == (16, False)
    ranges = {str(v.expression): (v.lower, v.upper) for v in form.scheduling}
    assert ranges["k*s"] == pytest.approx((-2, 6))
    assert ranges["s**2"] == pytest.approx((0, 9))
    rng = np.random.default_rng(0)
    for value in rng.uniform((1, -1), (2, 3), (50, 2)):
        at = dict(zip((k, s), map(R, value), strict=True))
        A = np.array(form.A.xreplace(at), dtype=float)
        family = corners.family.at([float(v.expression.xreplace(at)) for v in form.scheduling])
        np.testing.assert_allclose(family[:2, 1:3], A, atol=1e-12)
        assert (corners.A.min(axis=0) - 1e-12 <= A).all()
        assert (corners.A.max(axis=0) + 1e-12 >= A).all()
        assert (corners.c.max(axis=0) + 1e-12 >= np.array(form.c.xreplace(at), float)).all()


def test_a_plant_that_does_not_vary_has_one_vertex():
    corners = qpv(plants.lorenz()).vertices()
    assert corners.count == 1
    np.testing.assert_allclose(corners.A[0], [[-10, 10, 0], [28, -1, 0], [0, 0, -8 / 3]])
    assert corners.N[0, 1, 0, 2] == -1.0
    assert corners.N[0, 2, 0, 1] == 1.0
    np.testing.assert_array_equal(qpv(plants.lorenz()).constant("N")[1], corners.N[0, 1])


def test_constant_matrices_only_where_they_are(paper):
    assert paper.constant("C").tolist() == np.eye(3, 6).tolist()
    with pytest.raises(StructureError, match=r"A\[1,1\].*theta1.*vertices"):
        paper.constant("A")
    assert qpv(plants.lorenz()).constant("M").shape == (0, 3, 3)


def test_scheduling_without_a_range_has_no_vertices():
    plant = Plant("unbounded scheduling")
    (x,) = plant.states("x")
    (s,) = plant.scheduling("s")
    plant.dynamics([s * x])
    plant.outputs([x])
    form = qpv(plant)
    assert form.A[0] == s
    with pytest.raises(UnboundedError, match="s"):
        form.vertices()


# -- refusals -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "row", "term", "degree"),
    [
        ("van_der_pol", "x2", "x1**2*x2", 3),
        ("quadruple_tank", "h1", "sqrt(h1)", None),
        ("exothermic_cstr", "C_A", "exp(-8750/T)", None),
        ("hinf_example", "x1", "cos(12*x2)", None),
        ("quadrotor", "vx", "vx*Abs(vx)", None),
    ],
)
def test_a_term_without_a_place_is_named_with_row_and_degree(name, row, term, degree):
    with pytest.raises(StructureError) as refusal:
        qpv(getattr(plants, name)())
    assert refusal.value.row == row
    assert refusal.value.degree == degree
    assert term in str(refusal.value)
    assert f"row of {row}" in str(refusal.value)


@pytest.mark.parametrize(
    ("row", "output", "where", "words"),
    [
        ("u*u", "x", "x", "degree 2.*2 in the inputs u"),
        ("x*y*u", "x", "x", "degree 3.*2 in the states x, y; 1 in the inputs u"),
        ("x*y*u/7.1", "x", "x", r"the term 0\.140845\*u\*x\*y of degree 3"),
        ("w*x", "x", "x", "degree 2.*1 in the states x; 1 in the disturbances w"),
        ("x/y", "x", "x", "no polynomial in x, y"),
        ("x", "x*y", "y1", "degree 2.*outputs have to be affine"),
        ("x", "sqrt(x)", "y1", "no polynomial in x"),
    ],
)
def test_every_kind_of_excess_is_explained(row, output, where, words):
    plant = Plant("excess")
    plant.states("x y", range=(1, 2))
    plant.inputs("u")
    plant.disturbances("w")
    plant.dynamics([row, "-y"])
    plant.outputs([output])
    with pytest.raises(StructureError, match=f"row of {where} .*{words}"):
        qpv(plant)


def test_a_runge_kutta_step_is_refused():
    with pytest.raises(StructureError, match=r"rk4.*euler"):
        qpv(plants.lorenz().discretise("rk4", Ts=0.01))


# -- random quadratic plants and mutants --------------------------------------------

_NUMBER = st.integers(-5, 5).map(lambda k: R(k, 3))


@st.composite
def quadratic(draw):
    plant = Plant("random")
    x = plant.states("x1:4", range=(-1, 1))
    u = plant.inputs("u1:3", range=(-1, 1))
    (f,) = plant.faults("f", range=(-1, 1))
    (w,) = plant.disturbances("w", bound=1)
    (s,) = plant.scheduling("s", range=(0, 1))
    atoms = [sp.Integer(1), *x, *u, w]
    atoms += [a * b for a in (*x, f) for b in (*x, f)] + [a * b for a in (*x, f) for b in u]
    rows = []
    for _ in range(3):
        terms = draw(st.lists(st.tuples(st.sampled_from(atoms), _NUMBER), max_size=6))
        shape = draw(st.sampled_from([sp.Integer(1), s, sp.cos(s), 1 / (1 + s)]))
        rows.append(sp.Add(*[c * a * shape for a, c in terms]))
    plant.dynamics(rows)
    plant.outputs([x[0] + s * w, draw(_NUMBER) * f + x[1] + 1])
    return plant


@settings(max_examples=25, derandomize=True, deadline=None)
@given(quadratic(), st.sampled_from(["upper", "symmetric"]))
def test_random_quadratic_plants_are_recovered(plant, form_of_N):
    form = qpv(plant, form_of_N)
    x = sp.Matrix([s.symbol for s in form.plant.states])
    u = sp.Matrix([s.symbol for s in plant.u])
    w = sp.Matrix([s.symbol for s in plant.w])
    made = form.c + form.A * x + form.B * u + form.G * w
    made += sp.Matrix([(x.T * N * x)[0] for N in form.N])
    made += sum((v * part * x for v, part in zip(u, form.M, strict=True)), sp.zeros(4, 1))
    assert sp.simplify(made[:3, :] - plant.rhs) == sp.zeros(3, 1)
    assert made[3] == 0
    assert (form.C * x + form.H * w + form.output_offset - plant.output).expand() == sp.zeros(2, 1)
    assert form.proof.holds


@settings(max_examples=10, derandomize=True, deadline=None)
@given(quadratic(), st.data())
def test_a_changed_coefficient_is_caught(plant, data):
    form = qpv(plant)
    places = [(i, j) for i in range(6) for j in range(form.matrix.cols) if form.matrix[i, j] != 0]
    place = data.draw(st.sampled_from(places))
    for change in (lambda e: 0 * e, lambda e: e + R(1, 10**25), lambda e: -e):
        mutant = form.matrix.as_mutable()
        mutant[place] = change(mutant[place])
        with pytest.raises(DerivationError, match="is not the plant's"):
            prove_quadratic(form.plant, form.layout, sp.ImmutableMatrix(mutant))


def test_a_product_on_the_wrong_place_never_leaves_the_room(monkeypatch):
    right = module.read_coefficients

    def shifted(plant, layout, form_of_N):
        entries = right(plant, layout, form_of_N)
        column = layout.quadratic(0, 3)
        entries[(0, column + 1)] = entries.pop((0, column))
        return entries

    monkeypatch.setattr(module, "read_coefficients", shifted)
    with pytest.raises(DerivationError, match="row of x1 is not the plant's"):
        qpv(plants.qpv_example())


# -- how it reads -------------------------------------------------------------------


def test_a_quadratic_form_reads_well(paper):
    text = str(paper)
    assert "x = (x1, x2, x3, f1, f2, f3), N upper" in text
    assert "  x2: f2*x2" in text
    assert "theta1 in [0, 1]" in text
    assert repr(paper) == "QPV('QPV example', states x1, x2, x3, f1, f2, f3, N upper)"
    assert "N_{1} &=" in paper._repr_latex_()
    assert "M_{1}" not in paper._repr_latex_()
    html = paper._repr_html_()
    assert ">f3</td>" in html and ">process fault</td>" in html
    assert isinstance(paper.function(), ca.Function)
