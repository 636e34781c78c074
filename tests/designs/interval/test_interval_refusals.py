"""What the interval observer refuses, by the plant's own names, and before it derives a form."""

import numpy as np
import pytest
import sympy as sp
from matrices import lpv

import obsynth as ob


def test_full_rank_of_C_and_F_is_not_enough():
    plant = lpv([[0, 1], [0, 0]], [[0], [1]], [[1, 0]])
    with pytest.raises(ob.StructureError, match=r"rank\(C F\) = 0") as refusal:
        ob.IntervalObserver().design(plant)
    assert refusal.value.symbols == ("f1",)
    assert refusal.value.states == ("x2",)
    assert (refusal.value.rank_CF, refusal.value.q) == (0, 1)


def test_faults_that_act_alike():
    plant = lpv([[0, 1], [0, 0]], [[1, 2], [1, 2]], [[1, 0], [0, 1]])
    with pytest.raises(ob.StructureError, match=r"rank\(F\) = 1"):
        ob.IntervalObserver().design(plant)


def test_an_undetectable_pair():
    half = sp.Rational(1, 2)
    plant = lpv([[half, 0, 0], [0, half, 0], [0, 0, 1]], [[1], [0], [0]], [[1, 0, 0], [0, 1, 0]])
    with pytest.raises(ob.StructureError, match="not detectable") as refusal:
        ob.IntervalObserver().design(plant)
    assert refusal.value.symbols == ("x3",)
    assert refusal.value.mode == pytest.approx(1.0)
    stable = lpv(
        [[half, 0, 0], [0, half, 0], [0, 0, half]], [[1], [0], [0]], [[1, 0, 0], [0, 1, 0]]
    )
    assert ob.IntervalObserver().design(stable).certificate.valid


def test_bounds_that_diverge(example):
    with pytest.raises(ob.InfeasibleDesign, match="diverge") as refusal:
        ob.IntervalObserver(gains=(np.eye(2), [3.0, 1.0]), contraction=False).design(example)
    assert refusal.value.radius > 1.0
    with pytest.raises(ob.InfeasibleDesign, match="below zero"):
        ob.IntervalObserver(gains=(np.eye(2), [0.4, -1]), bound="paper").design(example)


def test_the_contraction_alone_can_keep_bounds_together():
    plant = lpv([[2, 0], [1, 0]], [[], []], [[1, 0], [0, 1]])
    zero = (np.eye(2), np.zeros((2, 2)))
    observer = ob.IntervalObserver(gains=zero).design(plant)
    assert observer.performance["spectral_radius"] > 1.9
    assert observer.half_widths == pytest.approx([0.01, 0.01], rel=1e-4)
    with pytest.raises(ob.InfeasibleDesign, match="diverge"):
        ob.IntervalObserver(gains=zero, contraction=False).design(plant)


def test_the_class_of_plants(example):
    tanks = ob.plants.quadruple_tank()
    with pytest.raises(ob.StructureError, match="continuous time"):
        ob.IntervalObserver().design(tanks)
    p = ob.Plant("sensor")
    (x,) = p.states("x", range=(-1, 1))
    p.dynamics([x / 2], Ts=1)
    p.outputs([x])
    p2 = ob.Plant("loose")
    (x,) = p2.states("x", range=(-1, 1))
    (w,) = p2.disturbances("w")
    p2.dynamics([x / 2 + w], Ts=1)
    p2.outputs([x])
    with pytest.raises(ob.StructureError, match="no bound"):
        ob.IntervalObserver().design(p2)
    p3 = ob.Plant("irrational")
    (x,) = p3.states("x", range=(-1, 1))
    (f,) = p3.faults("f")
    p3.dynamics([x / 2 + sp.sqrt(2) * f], Ts=1)
    p3.outputs([x])
    with pytest.raises(ob.StructureError, match="irrational"):
        ob.IntervalObserver(form="corrected").design(p3)
    assert ob.IntervalObserver().design(p).half_widths == pytest.approx([0.0], abs=1e-9)


@pytest.mark.parametrize(
    ("row", "output", "words"),
    [
        (None, lambda x, u, f, w: x[0] + 2 * u, r"y1 = .*u.* has u in it.*take what is known"),
        (None, lambda x, u, f, w: x[0] + f, r"y1 = .* has f in it"),
        (None, lambda x, u, f, w: x[0] ** 2, "y1 = .*more than multiples"),
        (None, lambda x, u, f, w: x[0] + 1, "y1 = .*more than multiples"),
        (None, lambda x, u, f, w: x[0] * w, "y1 = .*more than multiples"),
        (lambda x, u, f, w: x[1] * f, None, "f enters x1 by x2, which varies with x2"),
        (lambda x, u, f, w: f + u * w, None, "w enters x1 by u, which varies with u"),
        (lambda x, u, f, w: w, None, r"rank\(F\) = 0"),
        (lambda x, u, f, w: f, lambda x, u, f, w: x[1], r"rank\(C F\) = 0"),
    ],
)
def test_what_equations_tell_is_refused_before_anything_is_derived(row, output, words, monkeypatch):
    """Mutants: any of them left to the form, which takes as long as it takes."""
    plant = ob.Plant("outside")
    x = plant.states("x1:3", range=(-1, 1))
    (u,) = plant.inputs("u", range=(-1, 1))
    (f,) = plant.faults("f")
    (w,) = plant.disturbances("w", bound=0.1)
    own = f if row is None else row(x, u, f, w)
    plant.dynamics([x[0] / 2 + sp.sin(x[1]) + own, x[1] / 2], Ts=1)
    plant.outputs([x[0] if output is None else output(x, u, f, w)])
    monkeypatch.setattr("obsynth.designs.interval.model.quasi_lpv", None)
    with pytest.raises(ob.StructureError, match=words):
        ob.IntervalObserver(form="corrected", gains="search").design(plant)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"gains": "guess"}, "'sylvester' or a pair"),
        ({"gains": 3.0}, "pair"),
        ({"bound": "ellipsoid"}, "bound is"),
        ({"form": "repaired"}, "form is"),
        ({"form": "printed"}, "stands for"),
        ({"precision": "half"}, "precision is"),
        ({"centred": False}, "needs nominal"),
        ({"nominal": np.eye(3)}, "centred=False"),
        ({"R": np.eye(2)}, "sylvester"),
        ({"gains": "sylvester", "Q": np.eye(2)}, "without R"),
        ({"H": [[np.inf]]}, "finite"),
    ],
)
def test_options(options, words):
    with pytest.raises(ob.ObsynthError, match=words):
        ob.IntervalObserver(**options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"H": np.eye(2)}, r"H has .* \(3, 3\); its shape is \(2, 2\)"),
        ({"gains": (np.eye(2), [1, 1, 1])}, r"L has .* \(2, 1\)"),
        ({"gains": "sylvester", "R": np.eye(2), "Q": [1, 1, 1]}, r"Q has .* \(2, 1\)"),
        ({"centred": False, "nominal": np.eye(2)}, "nominal has"),
    ],
)
def test_other_shapes_than_the_plants_are_refused_before_anything_is_derived(
    options, words, example, monkeypatch
):
    """Mutant: shapes asked for where a form has been derived."""
    monkeypatch.setattr("obsynth.designs.interval.model.quasi_lpv", None)
    with pytest.raises(ob.ObsynthError, match=words):
        ob.IntervalObserver(**options).design(example)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"H": 2 * np.eye(3)}, "not orthogonal"),
        ({"H": np.eye(3)[[1, 0, 2]]}, "do not factorise F"),
        ({"R0": [[1.0]]}, "without H"),
        ({"N": np.eye(2), "R1": [[3.0]]}, "do not factorise C H1"),
        ({"gains": (np.zeros((2, 2)), [1, 1])}, "regular"),
    ],
)
def test_options_that_do_not_fit_the_plant(options, words, example):
    with pytest.raises(ob.ObsynthError, match=words):
        ob.IntervalObserver(**options).design(example)


@pytest.mark.long
def test_given_transformations(example, designs):
    """For n - q >= 2 a rotation of the free coordinates is another observer, as good a proof."""
    c, s = np.cos(0.3), np.sin(0.3)
    H = np.array([[-1, 0, 0], [0, c, -s], [0, s, c]])
    turned = ob.IntervalObserver(H=H).design(example)
    assert turned.certificate.valid
    assert np.array_equal(turned.gains["H"], H)
    run = ob.simulate(example, turned, ob.scenarios.interval_example(3))
    assert min(run.coverage.values()) == 1.0
    same = ob.IntervalObserver(
        **{name: designs["d1"].gains[name] for name in ("H", "R0", "K0", "N", "R1", "K1")},
        cuts=(),
        horizon=10**9,
    ).design(example)
    assert same.half_widths == pytest.approx(designs["d1"].half_widths, rel=1e-9)


def test_forms_are_taken_where_they_can_be_derived_again(example):
    form = ob.quasi_lpv(example)
    observer = ob.IntervalObserver().design(form)
    assert observer.certificate.check().valid
    other = ob.quasi_lpv(example, centre=([1, 0, 0], [0]))
    with pytest.raises(ob.ObsynthError, match="not the one that is derived"):
        ob.IntervalObserver().design(other)
