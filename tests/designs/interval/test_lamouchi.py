"""Acceptance of the interval observer on the example of Lamouchi, Raissi, Amairi and Aoun."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import obsynth as ob
from obsynth.derive.rigour import exact, nearest
from obsynth.designs.interval.printed import (
    FLAWS,
    largest_alpha,
    lipschitz_alpha,
    printed_faults,
)
from obsynth.designs.interval.record import IntervalDesign
from obsynth.designs.interval.synthesis import lp_problem, sylvester_gain, with_gains

BOX = np.tile([0.5, 1.5], (3, 1))
P_PAPER = np.array([[10.0, -5.0], [-10.0, 6.0]])
L_PAPER = np.array([[-0.3], [-2.1]])
A_PAPER = [[-1, 1, 0], [-1, 0, 0], [0, -1, -1]]
WIDTHS = {
    "b2": (0.440641, 0.786133, 0.936861),
    "c2": (0.0575, 0.106199, 0.294156),
    "d0": (0.0575, 0.105984, 0.292142),
    "d1": (0.0575, 0.019998, 0.283544),
}


def stored(observer):
    return IntervalDesign.from_record(observer.record)


@pytest.fixture(scope="module")
def literal(designs):
    """The printed P, L and DeltaA, never proved."""
    base = stored(designs["b2"])
    return with_gains(base, P_PAPER, L_PAPER)


@pytest.fixture(scope="module")
def seeds_100(paper_seeds):
    return paper_seeds(range(100))


@pytest.fixture(scope="module")
def hundred(designs, run_many, feedback, seeds_100):
    return {name: run_many(o, *seeds_100, feedback, BOX) for name, o in designs.items()}


def test_structure(designs, numbers):
    expected = numbers["example_structure"]
    for case, name in (("b2", "uncentred"), ("c2", "centred")):
        design = stored(designs[case])
        A2 = nearest(design.decoupled.T2 @ exact(design.nominal) @ design.decoupled.W)
        sign = np.sign(design.transformation.H[1:, 1:].diagonal())
        assert nearest(design.decoupled.C2) * sign == pytest.approx(np.array(expected["C2"]))
        assert np.outer(sign, sign) * A2 == pytest.approx(np.array(expected[f"A2_{name}"]))
    moved_by_y = nearest(design.decoupled.T2 @ exact(design.nominal) @ design.decoupled.Phi)
    assert moved_by_y == pytest.approx(np.array(expected["D2_centred"]))
    assert np.abs(designs["c2"].gains["E"]) == pytest.approx(np.abs(expected["E"]))
    share = stored(designs["c2"]).share.split(exact(design.nominal))
    assert np.abs(nearest(share.R)) == pytest.approx(np.abs(expected["G3_centred"]))
    ends = np.sort(np.abs(np.concatenate([nearest(share.M_lower), nearest(share.M_upper)])), axis=0)
    assert ends == pytest.approx(np.array(expected["G2"]))


def test_gains_by_sylvester_are_the_papers(numbers):
    A2 = np.array(numbers["example_structure"]["A2_uncentred"])
    C2 = np.array(numbers["example_structure"]["C2"])
    Q = np.array(numbers["example_structure"]["sylvester_Q"])[:, None]
    transform, gain = sylvester_gain(A2, C2, np.diag([0.5, 0.6]), Q)
    assert transform == pytest.approx(P_PAPER, abs=1e-9)
    assert gain == pytest.approx(L_PAPER, abs=1e-9)
    wrong = sylvester_gain(A2, -C2, np.diag([0.5, 0.6]), Q)[0]
    assert np.abs(wrong - P_PAPER).max() > 1.0


def test_linear_programme(example):
    solution = ob.IntervalObserver().problem(example).solve()
    weights = np.diag(solution["lambda"])
    assert weights == pytest.approx([1.907895, 1.052632], abs=1e-6)
    assert solution["Y"] / weights[:, None] == pytest.approx(np.array([[0.4], [-1.0]]), abs=1e-6)
    assert solution.objective == pytest.approx(0.02 * 6.809211, abs=1e-7)
    second = ob.IntervalObserver().problem(example).to_cvxpy()
    assert second.solve(solver="CLARABEL") == pytest.approx(solution.objective, abs=1e-6)
    chosen = ob.IntervalObserver(gains=(np.diag([1.0, -1.0]), None)).design(example)
    assert chosen.gains["L"] == pytest.approx(np.array([[0.4], [-1.0]]), abs=1e-9)
    data = stored(chosen).reduced
    flipped = data.__class__(**{**vars(data), "C2": -data.C2})
    assert lp_problem(flipped, np.eye(2)).solve()["Y"][1, 0] > 0.5


def test_the_theorems_numbers(designs, literal, numbers):
    expected = numbers["example_structure"]
    cases = {"paper": literal, "b2": stored(designs["b2"]), "c2": stored(designs["c2"])}
    for name, design in cases.items():
        parts = design.prediction.split(exact(design.nominal))
        low, high = nearest(parts.sigma_lower), nearest(parts.sigma_upper)
        alpha = lipschitz_alpha(low, high)
        key = "alpha_true_paper" if name == "paper" else f"alpha_{name}"
        assert alpha == pytest.approx(expected[key], rel=1e-9)
        limit = largest_alpha(nearest(parts.R))
        key = "alpha_max_LMI20" if name == "paper" else f"alphamax_{name}"
        assert limit == pytest.approx(expected[key], rel=1e-6)
        radius = expected[f"comparison_radius_{name}"]
        assert design.spectral_radius == pytest.approx(radius, rel=1e-9)
    parts = literal.prediction.split(exact(literal.nominal))
    assert nearest(parts.R) == pytest.approx(np.array(expected["R_paper"]), abs=1e-12)
    assert nearest(parts.sigma_lower) == pytest.approx(np.array(expected["sigma_lo_paper"]))
    assert nearest(parts.sigma_upper) == pytest.approx(np.array(expected["sigma_hi_paper"]))


@pytest.mark.parametrize("case", ["b2", "c2", "d0", "d1"])
def test_noise_free_values(case, designs, numbers, example):
    reference = numbers["example_deterministic"]
    # the method knows nothing of the first fault
    scenario = replace(ob.scenarios.interval_example(seed=None), f_range=[(-9, 9)])
    run = ob.simulate(example, designs[case], scenario)
    for k, x in reference["x"].items():
        assert run.x[int(k)] == pytest.approx(x, abs=1e-6)
    r = np.zeros((201, 4))
    memory = designs[case].memory0(np.ones(3), x_range=BOX)
    for k in range(200):
        expected = reference[case].get(str(k))
        if expected is not None:
            assert run.x_lower[k] == pytest.approx(expected["x_lo"], abs=1e-6)
            assert run.x_upper[k] == pytest.approx(expected["x_hi"], abs=1e-6)
            assert run.f_lower[k + 1] == pytest.approx(expected["f_lo"], abs=1e-6)
            assert run.f_upper[k + 1] == pytest.approx(expected["f_hi"], abs=1e-6)
            if case != "d1" and k:
                assert memory[:4] == pytest.approx(expected["r"], abs=1e-6)
        r[k] = memory[:4]
        memory = np.array(designs[case].step(memory, run.u[k], run.y[k])[0]).ravel()
    assert run.coverage == dict.fromkeys(("x1", "x2", "x3", "f"), 1.0)


@pytest.mark.parametrize("case", ["b2", "c2", "d0", "d1"])
def test_widths_and_inclusion_over_100_seeds(case, hundred):
    run = hundred[case]
    assert run.x_inside(1e-12)[:200].all()
    assert run.f_inside(1e-12).all()
    window = slice(50, 200)
    widths = (run.x_upper - run.x_lower)[window].mean(axis=(0, 1))
    assert widths[0] == pytest.approx(0.02, rel=0.01)
    assert widths[1:] == pytest.approx(WIDTHS[case][:2], rel=0.01)
    f_widths = (run.f_upper - run.f_lower)[51:201].mean()
    assert f_widths == pytest.approx(WIDTHS[case][2], rel=0.01)
    assert set(np.unique(run.status[1:])) == {0.0}


@pytest.mark.long
def test_the_default_is_the_vertex_form_with_contraction(example, run_many, feedback, seeds_100):
    observer = ob.IntervalObserver(cuts=(), horizon=10**9).design(example)
    run = run_many(observer, *seeds_100, feedback, BOX)
    cut = run_many(ob.IntervalObserver(horizon=10**9).design(example), *seeds_100, feedback, BOX)
    assert cut.x_inside().all() and cut.f_inside().all() and not cut.status[1:].any()
    assert np.all(cut.x_lower >= run.x_lower) and np.all(cut.x_upper <= run.x_upper)
    # the declared range of the fault, at the crests of its cosine
    assert (cut.f_upper - cut.f_lower)[51:].mean() == pytest.approx(0.2350, rel=0.01)
    widths = (run.x_upper - run.x_lower)[50:200].mean(axis=(0, 1))
    assert widths == pytest.approx((0.02, *WIDTHS["d1"][:2]), rel=0.01)
    assert (run.f_upper - run.f_lower)[51:].mean() == pytest.approx(WIDTHS["d1"][2], rel=0.01)


def controls(designs, hundred, flaws, **given):
    """Fraction of instants at which (32) with some flaws holds the fault, over 100 seeds.

    From the second call on: what r is at the first one is not in the memory.
    """
    run = hundred["c2"]
    n2 = 2
    r_lower, r_upper = run.memory[..., :n2], run.memory[..., n2 : 2 * n2]

    def by_run(array):
        return array[1:].swapaxes(0, 1)

    observer = given.get("observer", designs["c2"])
    low, high = printed_faults(
        observer, by_run(r_lower), by_run(r_upper), by_run(run.y), by_run(run.u), flaws
    )
    f = by_run(run.f)[:, :-1]
    return ((low <= f + 1e-12) & (f <= high + 1e-12)).mean(), (low, high)


def test_equation_32_without_flaws_is_what_runs(designs, hundred):
    inside, (low, high) = controls(designs, hundred, ())
    assert inside == 1.0
    assert low[..., 0] == pytest.approx(hundred["c2"].f_lower[2:, :, 0].T, abs=1e-12)
    assert high[..., 0] == pytest.approx(hundred["c2"].f_upper[2:, :, 0].T, abs=1e-12)


@pytest.mark.parametrize(
    ("flaws", "fraction"), [(FLAWS, 0.199), (("y",), 0.215), (("theta",), 1.0)]
)
def test_negative_controls(designs, hundred, flaws, fraction):
    design = stored(designs["c2"])
    turned = ob.IntervalObserver(
        gains=(np.diag([1.0, -1.0]), [0.4, -1]),
        bound="paper",
        contraction=False,
        H=np.diag([-1.0, 1.0, 1.0]),
    ).design(design.model.plant)
    inside, (low, _) = controls(designs, hundred, flaws, observer=turned)
    assert inside == pytest.approx(fraction, abs=0.02 if fraction < 1.0 else 0.0)
    # at full inclusion only the numbers tell the wrong lower theta_1 from the right one
    right = controls(designs, hundred, ())[1]
    assert not np.allclose(low, right[0], atol=1e-3)


def test_bounds_times_a_negative_gain_change_sides(designs, hundred):
    flipped = {"R0": [[1.0]], "K0": [[-1.0]], "H": np.eye(3)}
    turned = ob.IntervalObserver(
        gains=(np.diag([1.0, -1.0]), [0.4, -1]), bound="paper", contraction=False, **flipped
    ).design(stored(designs["c2"]).model.plant)
    assert float((turned.gains["K0"] @ turned.gains["R0"]).item()) == -1.0
    inside, (low, high) = controls(designs, hundred, ("product",), observer=turned)
    assert inside == 0.0
    assert (high - low)[:, 50:].mean() == pytest.approx(-WIDTHS["c2"][2], rel=0.01)
    assert controls(designs, hundred, (), observer=turned)[0] == 1.0


def test_the_printed_example_is_refused_with_its_numbers(example):
    printed = ob.IntervalObserver(
        form="printed",
        gains=(P_PAPER, L_PAPER),
        bound="paper",
        contraction=False,
        centred=False,
        nominal=A_PAPER,
    )
    with pytest.raises(ob.InfeasibleDesign, match="Theorem 1 is not met") as refusal:
        printed.design(example)
    assert refusal.value.radius == pytest.approx(8.272158, rel=1e-6)
    assert refusal.value.alpha == pytest.approx(21.85076, rel=1e-6)
    assert refusal.value.largest_alpha == pytest.approx(0.4, rel=1e-6)


def test_the_printed_fault_bound_is_refused_where_the_widths_are_stable(example):
    printed = ob.IntervalObserver(
        form="printed", gains=(np.diag([1.0, -1.0]), [0.4, -1]), bound="paper", contraction=False
    )
    with pytest.raises(ob.InfeasibleDesign, match="does not enclose the fault"):
        printed.design(example)


def test_the_printed_widths_explode(example, designs, numbers, paper_seeds, run_many, feedback):
    expected = numbers["example_mc100"]["a2 paper L,P literal, f fixed"]["w_k20_k199"]
    printed = ob.IntervalObserver(
        gains=(P_PAPER, L_PAPER),
        bound="paper",
        contraction=False,
        centred=False,
        nominal=A_PAPER,
        cuts=(),
    )
    step, memory0 = printed.unproved(example)
    shown = SimpleNamespace(model=designs["b2"].model, step=step, memory0=memory0)
    run = run_many(shown, *paper_seeds(range(20), 20), feedback, BOX)
    widths = (run.x_upper - run.x_lower)[20].mean(axis=0)
    assert widths == pytest.approx(expected[:3], rel=0.01)
    assert widths[1] == pytest.approx(3.9e19, rel=0.01)
    with pytest.raises(ob.ObsynthError, match="only given gains"):
        ob.IntervalObserver().unproved(example)
