"""Random plants have exact forms, and mistakes in a form are caught by its proof."""

import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive import DerivationError
from obsynth.derive.algebra.zero_test import NUMERIC, FormProof
from obsynth.derive.forms.quasi_lpv import form as module
from obsynth.derive.forms.quasi_lpv.form import prove_form, quasi_lpv
from obsynth.derive.forms.quasi_lpv.terms import stacked_rows
from obsynth.symbolic import Plant, plants

R = sp.Rational

# -- mutants ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["quadruple_tank", "hinf_example", "three_tanks", "lorenz"])
def test_a_dropped_or_moved_term_is_caught(name):
    form = quasi_lpv(getattr(plants, name)())
    rows = stacked_rows(form.model)
    n = len(form.model.x)
    caught = 0
    for i in range(n):
        for j in range(n):
            entry = form.matrix[i, j]
            if entry == 0:
                continue
            mutants = []
            for term in sp.Add.make_args(entry):
                dropped = form.matrix.as_mutable()
                dropped[i, j] = entry - term
                moved = dropped.copy()
                moved[i, (j + 1) % n] += term
                mutants += [dropped, moved]
            tiny = form.matrix.as_mutable()
            tiny[i, j] = entry * (1 + R(1, 10**30))
            for mutant in (*mutants, tiny):
                with pytest.raises(DerivationError, match=f"row of {form.model.names('x')[i]}"):
                    prove_form(form.model, mutant, form.centre, rows)
                caught += 1
    assert caught >= 3 * n


def test_a_wrong_assembly_never_leaves_the_room(monkeypatch):
    right = module.assemble

    def forgetful(model, layout, centre, terms, chosen):
        return right(model, layout, centre, terms[1:], chosen[1:])

    monkeypatch.setattr(module, "assemble", forgetful)
    with pytest.raises(DerivationError, match="is not the plant's"):
        quasi_lpv(plants.quadruple_tank())


def test_evidence_by_numbers_is_not_called_a_proof():
    form = quasi_lpv(plants.lorenz())
    weak = FormProof(form.proof.rows, (NUMERIC, *form.proof.methods[1:]))
    assert form.proof.holds
    assert not weak.holds
    assert "60 digits in the rows of x" in str(weak)


# -- random plants ------------------------------------------------------------------

_TERMS = [
    lambda x, u, i, j: x[i] * x[j],
    lambda x, u, i, j: sp.sqrt(x[i]),
    lambda x, u, i, j: sp.sin(x[i]) * x[j],
    lambda x, u, i, j: sp.tanh(x[i] - x[j]) if i != j else sp.tanh(x[i]),
    lambda x, u, i, j: sp.cos(x[i]),
    lambda x, u, i, j: x[i] / (1 + x[j] ** 2),
    lambda x, u, i, j: sp.exp(-x[i]) * x[j],
    lambda x, u, i, j: u[0] * sp.sqrt(x[i]),
    lambda x, u, i, j: u[0] * x[i] * sp.cos(x[j]),
    lambda x, u, i, j: sp.Abs(x[i]) * x[i],
    lambda x, u, i, j: 1 / (1 + x[i]) - u[0],
    lambda x, u, i, j: sp.log(1 + x[i] + x[j]),
    lambda x, u, i, j: sp.cos(x[i] + 2 * x[j]),
    lambda x, u, i, j: sp.Integer(1),
]
_PART = st.tuples(
    st.integers(0, len(_TERMS) - 1),
    st.integers(0, 2),
    st.integers(0, 2),
    st.integers(-9, 9).filter(bool),
)


_ROWS = st.lists(st.lists(_PART, min_size=1, max_size=3), min_size=3, max_size=3)
_CENTRE = st.sampled_from([None, ([1, 2, R(3, 2)], [0])])


def form_of(rows, centre):
    plant = Plant("random")
    x = plant.states("x1:4", range=(0.5, 3))
    u = plant.inputs("u", range=(-1, 2))
    plant.dynamics([sum(R(c, 4) * _TERMS[t](x, u, i, j) for t, i, j, c in row) for row in rows])
    plant.outputs([x[0], x[2]])
    form = quasi_lpv(plant, centre=centre, alternatives=4)
    assert all(form.proof.methods)
    assert form.unfactored == ()
    assert not form.offset.free_symbols
    return form


@pytest.mark.long
@settings(max_examples=6, derandomize=True, deadline=None)
@given(rows=_ROWS, centre=_CENTRE)
def test_random_plants_of_factorable_terms_have_exact_forms(rows, centre, check_samples):
    check_samples(form_of(rows, centre), 10)


@pytest.mark.long
@settings(max_examples=20, derandomize=True, deadline=None)
@given(rows=_ROWS, centre=_CENTRE)
def test_many_random_plants_have_exact_forms(rows, centre, check_samples):
    check_samples(form_of(rows, centre), 40)
