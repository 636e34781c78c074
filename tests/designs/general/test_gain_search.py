"""The search for gains: its fast sums are the proved bounds, and its gradient theirs."""

import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from methods import motor
from obsynth.designs.general.gain import GainSearch, find_gain, riccati_starts, scaled
from obsynth.designs.general.method import bound_peak
from obsynth.designs.general.model import read


@pytest.fixture(scope="module")
def design():
    return read(motor()).design


@pytest.fixture(scope="module")
def search(design):
    data = scaled(design)
    return GainSearch(data, np.linspace(1.0, 2.0, len(data.x)))


def near(search, seed):
    """A gain near the first start, with no entry that is zero."""
    Z = next(riccati_starts(search.data))
    return Z + 2e-4 * np.random.default_rng(seed).standard_normal(Z.shape)


@pytest.mark.parametrize("seed", range(3))
def test_its_value_is_the_bound(design, search, seed):
    """Mutants: any response left out of the sums; other units."""
    data = search.data
    Z = near(search, seed)
    found = search.value(Z)
    b = bound_peak(design.changed(Z=data.deployed(Z, design.L0.shape[1]))).bound.b
    assert found.b * np.tile(data.x, 2) == pytest.approx(b, rel=1e-5)
    assert found.mean == pytest.approx(search.weights @ found.b, rel=1e-12)


def test_its_gradient_is_that_of_the_value(search):
    """Mutants: any term of it with another sign."""
    Z = near(search, 7)
    gradient, step = search.value_and_gradient(Z)[1].reshape(Z.shape), 1e-8
    for entry in np.ndindex(Z.shape):
        moved = np.zeros_like(Z)
        moved[entry] = step
        slope = (search.value(Z + moved).mean - search.value(Z - moved).mean) / (2 * step)
        assert gradient[entry] == pytest.approx(slope, rel=1e-4)


def test_no_neighbour_of_what_is_found_is_better_and_the_same_is_found_again(design):
    weights = 1.0 / scaled(design).x
    Z = find_gain(design, weights)
    assert np.array_equal(Z, find_gain(design, weights))
    search = GainSearch(scaled(design), np.full(design.size, 1.0 / design.size))
    best, rng = search.value(search.data.gain(Z)).mean, np.random.default_rng(1)
    for _ in range(20):
        moved = Z * (1 + 0.01 * rng.standard_normal(Z.shape))
        assert search.value(search.data.gain(moved)).mean > best * (1 - 1e-4)


def quarter_car() -> ob.Plant:
    """A suspension over an unknown road, whose actuator loses force slowly; steps of 1 ms."""
    plant = ob.Plant("quarter car")
    ranges = [(-0.15, 0.15), (-1.5, 1.5), (-0.1, 0.1), (-3, 3)]
    zs, vs, zu, vu = plant.states("zs vs zu vu", range=ranges)
    (u,) = plant.inputs("u", range=(-1000, 1000))
    (road,) = plant.unknown_inputs("road")
    plant.actuator_faults("f", of=u, rate=20, range=(-500, 500))
    n1, n2, n3 = plant.disturbances("n1 n2 n3", bound=[0.001, 0.001, 0.01])
    d, v = zs - zu, vs - vu
    force = 16000 * d + 100000 * d**3 + 1000 * v + 300 * v * sp.tanh(5 * v)
    tyre = 160000 * (road - zu)
    plant.dynamics({zs: vs, vs: (u - force) / 300, zu: vu, vu: (force - u + tyre) / 40})
    plant.outputs([d + n1, zu + n2, vu + n3])
    return plant.discretise("euler", Ts=0.001)


def test_starts_that_are_too_slow_are_asked_for_a_decay():
    """Mutant: no decay is asked for; then no start holds, and f is said to be in its range."""
    design = read(quarter_car()).design
    data = scaled(design)
    search = GainSearch(data, np.full(design.size, 1.0 / design.size))
    found = [search.value(Z) for Z in riccati_starts(data)]
    assert not np.isfinite(found[0].mean)
    best = min(found, key=lambda value: value.mean)
    assert best.radius < 0.998 and best.b[-1] < 0.4  # of the range of f; .21 once searched


def target() -> ob.Plant:
    """A moving target seen by range, bearing with a drift, and one coordinate."""
    plant = ob.Plant("target")
    ranges = [(20, 100), (20, 100), (-10, 10), (-10, 10)]
    x, y, vx, vy = plant.states("x y vx vy", range=ranges, nominal=[60, 60, 0, 0])
    n1, n2, ax, ay = plant.disturbances("n1 n2 ax ay", bound=[0.2, 0.005, 0.5, 0.5])
    plant.sensor_faults("drift", of="bearing", range=(-0.1, 0.1), rate=0.0005)
    plant.dynamics({x: vx, y: vy, vx: ax, vy: ay})
    range_ = sp.sqrt(x**2 + y**2) + n1
    plant.outputs({"range": range_, "bearing": sp.atan2(y, x) + n2, "px": x + 5 * n1})
    return plant.discretise("euler", Ts=0.1)


def test_starts_whose_riccati_equation_scipy_gives_up_are_left_out():
    """Mutant: SciPy's ValueError of some ends the design, in every method that begins from them."""
    assert list(riccati_starts(scaled(read(target()).design)))


def test_a_fault_that_one_state_hides_is_divided_out():
    """Where c = 0 nobody sees the leak. Mutant: what the search refuses is called infeasible."""
    plant = ob.Plant("flask")
    (c,) = plant.states("c", range=(0, 20), nominal=5)
    (u,) = plant.inputs("u", range=(0, 5), nominal=1)
    (leak,) = plant.process_faults("leak", range=(0, 0.5), rate=0.002)
    (n,) = plant.disturbances("n", bound=0.05)
    plant.dynamics([u - c / 5 - leak * c / 10])
    plant.outputs([c + n])
    sampled = plant.discretise("euler", Ts=0.1)
    with pytest.raises(ob.InfeasibleDesign, match=r"where c = 0, leak = .* not decay"):
        ob.HinfUIO().design(sampled)
    observer = ob.BoundedErrorUIO(bounds="peak").design(sampled)
    assert observer.performance["core_half_widths"][0] <= 0.0501
    assert observer.performance["predicted_half_widths"][1] <= 0.251
