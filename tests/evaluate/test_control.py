"""Systems of python-control as plants, plants and observers as systems of it."""

import control
import numpy as np
import pytest

import obsynth as ob


def pendulum(t, x, u, params):
    return np.array([x[1], -params["k"] * np.sin(x[0]) - 0.1 * x[1] * np.abs(x[1]) + u[0]])


def nonlinear(update=pendulum, output=lambda t, x, u, params: x[:1]):
    return control.nlsys(
        update,
        output,
        states=["angle", "speed"],
        inputs=["torque"],
        outputs=["y[0]"],
        params={"k": 2.5},
        name="pendulum",
    )


RANGES = {"angle": (-1, 1), "speed": (-3, 3), "torque": (-1, 1)}


def test_a_nonlinear_system_is_a_plant():
    plant = ob.from_control(nonlinear(), noise={"y_0_": 0.01}, range=RANGES)
    plant.actuator_faults("f", of="torque", range=(-1, 1), rate=0.1)
    assert (plant.name, plant.output_names) == ("pendulum", ("y_0_",))
    assert str(plant.rhs[1]) == "f - 0.1*speed*Abs(speed) + torque - 2.5*sin(angle)"
    assert plant.w[0].upper == 0.01
    observer = ob.BoundedErrorUIO(bounds="peak").design(plant.discretise("euler", Ts=0.05))
    assert np.isfinite(observer.half_widths).all()


def test_a_linear_system_there_and_back():
    A, B, C, D = [[0, 1], [-2, -0.3]], [[0], [1]], [[1, 0], [0, 1]], [[0], [0.5]]
    system = control.ss(A, B, C, D, 0.1, states=["p", "v"], inputs=["u"], outputs=["a", "b"])
    plant = ob.from_control(system, "mass", range={"x": (-1, 1), "u": (-1, 1)})
    back = ob.to_control(plant)
    assert (plant.Ts, back.dt) == (0.1, 0.1)
    assert (back.state_labels, back.output_labels) == (["p", "v"], ["a", "b"])
    linear = back.linearize(0, 0)
    for mine, given in zip((linear.A, linear.B, linear.C, linear.D), (A, B, C, D), strict=True):
        assert np.allclose(mine, given, atol=1e-6)


def test_a_plant_moves_as_in_simulate():
    plant = ob.plants.van_der_pol()
    system = ob.to_control(plant)
    t = np.linspace(0, 2, 201)
    u = np.vstack([np.sin(t), 0.1 * np.ones_like(t)])
    told = control.input_output_response(system, t, u, [1, 0.5], solve_ivp_kwargs={"rtol": 1e-9})
    function, x = plant.function(), np.array([1, 0.5])
    for k in range(200):
        for j in range(20):
            at = t[k] + j * 5e-4
            x = x + 5e-4 * np.array(function(x, np.sin(at), [], 0.1, [], [], [])[0]).ravel()
    assert np.allclose(told.states[:, -1], x, atol=3e-3)


def test_an_observer_says_what_its_step_says():
    """Inputs and readings exchanged, or labels by one, would differ."""
    plant = ob.plants.cruise_control().discretise("euler", Ts=0.1)
    detector = ob.FaultDetector(ob.BoundedErrorUIO(bounds="peak").design(plant))
    scenario = ob.scenarios.gentle(plant, steps=40)
    run = ob.simulate(plant, detector, scenario)
    system = ob.to_control(detector)
    start = detector.memory0(scenario.guess, f_range=scenario.f_range)
    u = np.vstack([run.u.T, run.y.T])
    told = control.input_output_response(system, run.t, u, start)
    found = dict(zip(system.output_labels, told.outputs, strict=True))
    for label, mine in {
        "v_hat": run.xhat[:, 0],
        "v_lower": run.x_lower[:, 0],
        "f_upper": run.f_upper[:, 0],
        "status": run.status,
        "f_alarm": run.alarm[:, 0],
    }.items():
        assert np.array_equal(found[label], mine), label


def branching(t, x, u, params):
    return np.array([x[1], 1.0 if x[0] > 0 else -1.0])


@pytest.mark.parametrize(
    ("update", "noise", "message"),
    [
        (branching, {}, "right-hand side of pendulum does not take symbols .*casadi.if_else"),
        (lambda t, x, u, p: x[:1], {}, "has 1 rows of 2"),
        (lambda t, x, u, p: np.array([x[1], t * x[0]]), {}, "depends on the time"),
        (pendulum, {"z": 1}, "noise has 'z', which is no output; outputs are y_0_"),
    ],
)
def test_what_is_no_plant(update, noise, message):
    with pytest.raises(ob.PlantError, match=message):
        ob.from_control(nonlinear(update), noise=noise, range=RANGES)
