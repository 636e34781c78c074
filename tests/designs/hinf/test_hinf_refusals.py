"""What the method refuses, and what the refusals say."""

import numpy as np
import pytest
import sympy as sp

import obsynth as ob


def plant(
    A=((0.5, 0.2), (0.1, 0.4)),
    L=(0.0, 1.0),
    W=(1.0, 1.0),
    C=((1.0, 0.0), (0.0, 1.0)),
    Ts=1,
    g=None,
    box=(-10, 10),
):
    """A linear plant of second order with one fault, and g of the states on top."""
    made = ob.Plant("small")
    x = made.states("x1:3", range=box)
    (f,) = made.faults("f") if L is not None else (0,)
    (w,) = made.disturbances("w") if W is not None else (0,)
    rows = [
        sum(a * s for a, s in zip(row, x, strict=True))
        + (L[i] * f if L is not None else 0)
        + (W[i] * w if W is not None else 0)
        for i, row in enumerate(A)
    ]
    if g is not None:
        rows[g[0]] += g[1](x)
    if Ts is None:
        made.dynamics(rows)
    else:
        made.dynamics(rows, Ts=Ts)
    made.outputs([sum(c * s for c, s in zip(row, x, strict=True)) for row in C])
    return made


def refused(kind, match, made, method=None):
    with pytest.raises(kind, match=match) as caught:
        (method or ob.HinfUIO()).design(made)
    return caught.value


def test_the_small_plant_itself_is_designed():
    assert ob.HinfUIO().design(plant()).certificate.valid


def test_continuous_time():
    refused(ob.StructureError, "discretise", plant(Ts=None))


def test_no_fault_no_disturbance():
    refused(ob.StructureError, "no fault to estimate", plant(L=None))
    refused(ob.StructureError, "nothing to attenuate", plant(W=None))


def test_a_fault_that_no_output_shows():
    error = refused(ob.StructureError, r"rank\(C L\) = 0", plant(C=((1.0, 0.0),)))
    assert error.symbols == ("f",) and error.states == ("x2",)


def test_an_observable_plant_with_an_unstable_zero():
    """Observability, which the paper asks for, holds; (Abar, C) is not detectable."""
    made = plant(A=((0.5, 1.0), (-0.7, 0.3)), L=(1.0, 2.0), C=((1.0, 0.0),))
    split = ob.split(made, linear="terms")
    observability = np.vstack([split.C, split.C @ split.A])
    assert np.linalg.matrix_rank(observability) == 2
    error = refused(ob.StructureError, "mode", made)
    assert abs(error.mode) > 1.0
    assert error.condition == "detectability"
    # the zero of (A, L, C): det [A - z I, L; C, 0] vanishes
    pencil = np.block([[split.A - error.mode * np.eye(2), split.B_f], [split.C, np.zeros((1, 1))]])
    assert abs(np.linalg.det(pencil)) < 1e-9
    stable = plant(A=((0.5, 0.1), (-0.7, 0.3)), L=(1.0, 2.0), C=((1.0, 0.0),))
    assert ob.HinfUIO().design(stable).certificate.valid


def test_an_integrator_that_the_fault_hides():
    """A pendulum whose torque fails and whose speed alone is measured: the angle is lost."""
    made = ob.Plant("pendulum")
    phi, omega = made.states("phi omega", range=[(-3, 3), (-10, 10)])
    (v,) = made.inputs("v", range=(-5, 5), nominal=0)
    made.actuator_faults("f", of=[v])
    w = made.disturbances("w1:3")
    made.dynamics([omega + w[0], 10 * v - 9.81 * sp.sin(phi) - omega / 5 + w[1]])
    made.outputs([omega])
    error = refused(ob.StructureError, "Measure phi", made.discretise("euler", 0.01))
    assert error.mode == pytest.approx(1.0, abs=1e-12)
    assert error.symbols == ("phi",)


def test_a_disturbance_in_an_output():
    made = ob.Plant("noisy")
    (x,), (f,) = made.states("x", range=(-1, 1)), made.faults("f")
    v, w = made.disturbances("v w")
    made.dynamics([0.5 * x + f + v], Ts=1)
    made.outputs([x + w])
    error = refused(ob.StructureError, "state of its own", made)
    assert error.symbol == "w"
    # the remedy that the message names
    again = ob.Plant("noise as a state")
    x, n = again.states("x n", range=(-1, 1))
    (f,) = again.faults("f")
    v, w = again.disturbances("v w")
    again.dynamics([0.5 * x + f + v, w], Ts=1)
    again.outputs([x + n])
    assert ob.HinfUIO(method="general").design(again).performance["l2_gain"] > 1.0


def test_parameters_scheduling_and_sensor_faults():
    for declare, what in (
        (lambda p: p.params("a", range=(0.1, 0.2)), "parameter a"),
        (lambda p: p.scheduling("a", range=(0.1, 0.2)), "scheduling variable a"),
    ):
        made = ob.Plant("uncertain")
        (x,), (f,), (w,) = made.states("x", range=(-1, 1)), made.faults("f"), made.disturbances("w")
        (a,) = declare(made)
        made.dynamics([a * x + f + w], Ts=1)
        made.outputs([x])
        refused(ob.StructureError, what, made)
    made = ob.Plant("sensor")
    (x,), (w,) = made.states("x", range=(-1, 1)), made.disturbances("w")
    made.dynamics([0.5 * x + w], Ts=1)
    made.outputs([x])
    made.sensor_faults("s", of=["y1"])
    refused(ob.StructureError, "sensor fault s", made)


def test_a_jacobian_without_bound():
    made = plant(g=(0, lambda x: sp.Rational(1, 10) * x[0] ** 2), box=(-np.inf, np.inf))
    refused(ob.UnboundedError, "x1", made)


def test_a_nonlinearity_that_is_too_strong():
    made = ob.Plant("seen at the vertices only")
    x = made.states("x1:4", range=(-5, 5))
    (f,), (w,) = made.faults("f"), made.disturbances("w")
    made.dynamics([1.2 * x[0] + w, 2 * sp.sin(x[0]), f], Ts=1)
    made.outputs([x[1], x[2]])
    error = refused(ob.InfeasibleDesign, "no quadratic V", made)
    assert "smaller ranges" in str(error)
    assert "polytopic" in str(error)


def test_a_level_below_the_least_one(consistent):
    error = refused(
        ob.InfeasibleDesign, "mu = 0.3 is infeasible", consistent[0], ob.HinfUIO(mu=0.3)
    )
    assert error.least_mu == pytest.approx(0.459853, abs=3e-5)
    assert "0.45861" in str(error)
    assert ob.HinfUIO(mu=0.46).design(*consistent).performance["l2_gain"] == 0.46


def test_a_decay_that_no_gain_reaches(consistent):
    refused(ob.InfeasibleDesign, "shrinks to 0.05", consistent[0], ob.HinfUIO(decay=0.05))
    slower = ob.HinfUIO(decay=0.2).design(*consistent)
    assert slower.performance["decay"] == 0.2
    assert "V+ <= 0.2 V" in str(slower.guarantee)


def test_a_majorant_that_is_none(consistent):
    with pytest.raises(ob.ObsynthError, match="too small for the row of x1"):
        ob.HinfUIO(majorant=(0, 0.5, 0.1089)).design(*consistent)
    with pytest.raises(ob.ObsynthError, match="has to be positive"):
        ob.HinfUIO(majorant=(0, 0, 0.1089)).design(*consistent)
    with pytest.raises(ob.ObsynthError, match="has 2 numbers"):
        ob.HinfUIO(majorant=(0.5, 0.5)).design(*consistent)


def test_gains_that_are_none(consistent):
    method = ob.HinfUIO(method="polytopic")
    with pytest.raises(ob.ObsynthError, match="it takes K of shape"):
        method.analyse(consistent[0], {"L": np.zeros((3, 2))})
    with pytest.raises(ob.ObsynthError, match=r"finite numbers of shape \(3, 2\)"):
        method.analyse(consistent[0], {"K": np.zeros((2, 3))})


def test_gains_that_let_the_fault_through(consistent, paper_gain):
    method = ob.HinfUIO(method="polytopic")
    with pytest.raises(ob.ObsynthError, match="H does not decouple f") as caught:
        method.analyse(consistent[0], paper_gain | {"H": [[0.0, 0.999]]})
    assert caught.value.residual == pytest.approx(1e-3)
    with pytest.raises(ob.ObsynthError, match="F does not decouple f"):
        method.analyse(consistent[0], paper_gain | {"F": np.zeros((3, 2))})


def test_a_level_that_given_gains_do_not_keep(consistent, paper_gain):
    with pytest.raises(ob.InfeasibleDesign, match="cannot be shown"):
        ob.HinfUIO(method="polytopic", mu=0.46).analyse(consistent[0], paper_gain)


@pytest.mark.parametrize(
    "options",
    [
        {"method": "best"},
        {"multipliers": "two"},
        {"form": "draft"},
        {"mu": 0.0},
        {"mu": np.inf},
        {"slack": 0.0},
        {"decay": 1.0},
        {"majorant": (-1.0, 1.0)},
        {"majorant": ((1.0, 0.1), (0.1, 1.0))},
        {"majorant": (1.0,), "multipliers": "per_row"},
        {"method": "polytopic", "multipliers": "single"},
        {"form": "printed", "method": "general"},
        {"form": "printed", "decay": 0.5},
    ],
)
def test_options(options):
    with pytest.raises(ob.ObsynthError) as caught:
        ob.HinfUIO(**options)
    assert caught.value.option in options


def test_a_majorant_may_be_a_diagonal_matrix():
    diagonal = (0.0, 0.517, 0.1089)
    assert ob.HinfUIO(majorant=np.diag(diagonal)) == ob.HinfUIO(majorant=diagonal)


def seen_in_x2():
    """The example with y = x2 alone: P wants to be infinite in one direction."""
    stored = ob.plants.hinf_example().to_dict()
    stored["outputs"] = [{"name": "y1", "unit": "", "expression": "x2"}]
    return ob.Plant.from_dict(stored)


@pytest.mark.parametrize("options", [{"method": "polytopic"}, {"multipliers": "per_entry"}])
def test_a_level_that_only_a_large_storage_function_shows(options):
    """1.001925 lies below the least level under the first cap of P, and is proved under a wider.

    Mutant: no wider caps.
    """
    plant = seen_in_x2()
    assert ob.HinfUIO(**options).design(plant).performance["least_mu"] > 1.00195
    observer = ob.HinfUIO(mu=1.001925, **options).design(plant)
    assert observer.certificate.check().valid
    worst = ob.worst_case(observer, steps=500)
    assert worst.gain <= 1.001925


def test_a_refused_level_says_what_was_shown():
    """Mutants: a refusal without the caps of P; infeasible where only the proof failed."""
    error = refused(
        ob.InfeasibleDesign,
        "mu = 1.0018 is infeasible with P <= ",
        seen_in_x2(),
        ob.HinfUIO(method="polytopic", mu=1.0018),
    )
    assert "not found up to 1e+08 I" in str(error)
    assert "exact arithmetic: " in str(error)
    assert "found with P <= 10000 I is 1.00195" in str(error)
