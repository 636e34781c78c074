"""With noisy outputs: what the printed indicators do, and the generator of the noise."""

import casadi as ca
import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.set_adaptive.indicators import fault_indicators
from obsynth.designs.set_adaptive.method import SetAdaptiveObserver
from obsynth.symbolic.noise import bounded_noise, splitmix64
from obsynth.symbolic.scenarios.three_tanks import three_tanks_control

BOUND = 4.5e-3
A13, A20, S_C, K = 1.329e-4, 1.772e-4, 0.0154, 1.329e-3


def root(z):
    return ca.sign(z) * ca.sqrt(ca.fabs(z))


def march(observer, w, f, raised):
    """Runge-Kutta of plant, control and observer with .01 s, noise held, control at the stages."""
    n = observer.ode.numel_in(0)
    z, v, fault, high = (
        ca.SX.sym(name, size) for name, size in zip("zvfh", (3 + n, 2, 2, 1), strict=True)
    )

    def rates(z):
        x, y = z[:3], z[:2] + v
        wanted = ca.vertcat(0.5 * (1 + 0.07 * high), 0.1 * (1 + 0.5 * high))
        u = ca.vertcat(
            ca.fmax(0, -K * root(y[0] - wanted[0])),
            ca.fmax(0, -K * root(y[1] - wanted[1]) + A20 * root(y[1])),
        )
        one, two = A13 * root(x[0] - x[2]), A13 * root(x[2] - x[1])
        dx = ca.vertcat(u[0] + fault[0] - one, u[1] + fault[1] + two - A20 * root(x[1]), one - two)
        return ca.vertcat(dx / S_C, observer.ode(z[3:], u, y))

    h = 0.01
    k1 = rates(z)
    k2 = rates(z + h / 2 * k1)
    k3 = rates(z + h / 2 * k2)
    k4 = rates(z + h * k3)
    step = ca.Function("rk4", [z, v, fault, high], [z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    loops = step.mapaccum(500)
    start = observer.memory0([0.5, 0.1, 0.3], f_range=[(-1e-4, 1e-4)] * 2)
    rows = [np.concatenate([[0.5, 0.1, 0.3], start])[None]]
    for k in range(0, len(w) - 1, 500):
        part = slice(k, k + 500)
        rows.append(np.array(loops(rows[-1][-1], w[part].T, f[part].T, raised[part][None])).T)
    return np.vstack(rows)[: len(w)]


@pytest.fixture(scope="module")
def noisy(tanks, paper_gain, schedule):
    f, raised = schedule(30_500)
    w = bounded_noise(1, 30_500, [BOUND, BOUND])
    found = {}
    for Gamma in (0.003, 0.01, 0.03):
        observer = SetAdaptiveObserver(form="printed", Gamma=Gamma).analyse(tanks, paper_gain)
        z = march(observer, w, f, raised)
        found[Gamma] = observer, z, fault_indicators(observer, z[:, 3:], z[:, :2] + w), w
    return found


@pytest.mark.long
@pytest.mark.parametrize("Gamma", [0.003, 0.01, 0.03])
def test_false_alarms_of_the_printed_indicators(noisy, numbers, Gamma):
    observer, z, indicators, _ = noisy[Gamma]
    expected = numbers["noise_splitmix64"][f"{Gamma:g}"]
    layout = observer.memory_layout
    assert z[19_900, :3] == pytest.approx(expected["x199"], abs=1e-5)
    for name, key in (("theta_m", "tm199"), ("theta_M", "tM199")):
        np.testing.assert_allclose(z[19_900, 3:][layout[name]], expected[key], atol=2e-7)
    part = slice(2_000, 20_000)
    for name, flags in (("d", indicators.d), ("s", indicators.s), ("z", indicators.z)):
        for i in (0, 1):
            wanted = expected["FA"][f"{name}{i + 1}"]
            assert flags[part, i].sum() == pytest.approx(wanted, rel=0.01, abs=2), (name, i)


@pytest.mark.long
@pytest.mark.parametrize("Gamma", [0.003, 0.01, 0.03])
def test_delays_of_the_printed_indicators(noisy, numbers, Gamma):
    expected = numbers["noise_splitmix64"][f"{Gamma:g}"]["d"]
    indicators = noisy[Gamma][2]
    for i, start in enumerate((20_000, 30_000)):
        for name, flags in (("d", indicators.d), ("s", indicators.s)):
            late = np.flatnonzero(flags[start:, i])
            wanted = expected[f"{name}{i + 1}"]
            if wanted is None:
                assert not late.size
            else:
                assert late[0] * 0.01 == pytest.approx(wanted, abs=0.02)


def test_the_printed_state_indicator_is_useless_with_noise(noisy):
    # two thirds of all fault-free samples
    assert noisy[0.01][2].s[2_000:20_000, 0].mean() > 0.6


def test_bounds_that_include_the_noise_do_not_alarm(tanks, schedule):
    f, raised = schedule(8_000)
    w = bounded_noise(1, 8_000, [BOUND, BOUND])
    observer = SetAdaptiveObserver(gain_cap=0.5).design(tanks)
    z = march(observer, w, f, raised)
    indicators = fault_indicators(observer, z[:, 3:], z[:, :2] + w)
    assert not indicators.S.any()
    assert not indicators.D.any()
    assert not indicators.Z.any()
    layout = observer.memory_layout
    assert (z[:, 3:][:, layout["xi_m"]] <= z[:, :3]).all()
    assert (z[:, :3] <= z[:, 3:][:, layout["xi_M"]]).all()


# -- the generator -------------------------------------------------------------------


def splitmix_by_hand(seed, count):
    mask, state, drawn = 2**64 - 1, seed, []
    for _ in range(count):
        state = (state + 0x9E3779B97F4A7C15) & mask
        z = state
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
        drawn.append(((z ^ (z >> 31)) >> 11) * 2.0**-53)
    return drawn


def test_the_first_pair_of_the_note(numbers):
    first = bounded_noise(1, 5, [BOUND, BOUND])[0]
    assert first == pytest.approx([5.99054e-4, 2.212036e-3], rel=1e-6)
    assert first.tolist() == pytest.approx(
        numbers["noise_splitmix64"]["0.01"]["first_noise"], rel=1e-14
    )


@pytest.mark.parametrize("seed", [0, 1, 12345, 2**64 - 1])
def test_splitmix_is_the_integer_recursion(seed):
    assert splitmix64(seed, 100).tolist() == splitmix_by_hand(seed, 100)


@pytest.mark.parametrize("seed", [-1, 2**64, 0.5, True])
def test_a_seed_that_is_no_64_bit_number(seed):
    with pytest.raises(ob.PlantError, match="seed"):
        splitmix64(seed, 1)


def test_the_scenario_of_the_note():
    scenario = ob.scenarios.three_tanks()
    assert scenario.steps == 32_000
    assert scenario.feedback
    assert scenario.faults[[0, 19_999, 20_000, 29_999, 30_000]].tolist() == [
        [0, 0],
        [0, 0],
        [8e-5, 0],
        [8e-5, 0],
        [8e-5, 6e-5],
    ]
    assert scenario.disturbances[0] == pytest.approx([5.99054e-4, 2.212036e-3], rel=1e-6)
    assert np.abs(scenario.disturbances).max() <= BOUND
    assert not ob.scenarios.three_tanks(noise=None).disturbances.any()
    assert not ob.scenarios.three_tanks("fault free").faults.any()
    law = three_tanks_control(0.01)
    y = np.array([0.52, 0.12])
    # raised on (100, 200], not at its left end
    assert law(10_000, y)[0] == 0.0
    assert law(10_001, y)[0] == pytest.approx(K * np.sqrt(0.535 - 0.52))
    assert law(20_000, y)[0] > 0.0
    assert law(20_001, y)[0] == 0.0
    with pytest.raises(ob.PlantError, match="unknown"):
        ob.scenarios.three_tanks("FS1")
    with pytest.raises(ob.PlantError, match="multiple"):
        ob.scenarios.three_tanks(end=1.005)
